"""Sessions with known truth, run once each by the command that users run."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


@lru_cache
def _run(config: Path, output: Path) -> dict:
    subprocess.run(
        [sys.executable, "scripts/fit.py", str(config), "--output", str(output), "--quiet"],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    return json.loads((output / "report.json").read_text())


@pytest.fixture(scope="session")
def report(tmp_path_factory):
    """Function that runs fit.py on a bench session and reads its report."""
    folder = tmp_path_factory.mktemp("results")

    def of(name: str) -> dict:
        config = ROOT / "tests" / "data" / "bench" / name / "session.yaml"
        if name == "connector":
            config = ROOT / "configs" / "cable.yaml"
        return _run(config, folder / name)

    return of


@pytest.fixture(scope="session")
def truth():
    """Function that reads what is in a bench session."""

    def of(name: str) -> dict:
        path = ROOT / "tests" / "data" / "bench_truth" / name / "truth.yaml"
        return yaml.safe_load(path.read_text())

    return of
