"""Sessions with known truth, run once each."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
import yaml

from dlo_casadi.config import load_config
from dlo_casadi.report.sections import report_dict
from dlo_casadi.session import run_session

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def report():
    """Function that runs a bench session and gives its report."""

    @cache
    def of(name: str) -> dict:
        config = ROOT / "tests" / "data" / "bench" / name / "session.yaml"
        if name == "connector":
            config = ROOT / "configs" / "cable.yaml"
        return report_dict(run_session(load_config(config)))

    return of


@pytest.fixture(scope="session")
def truth():
    """Function that reads what is in a bench session."""

    def of(name: str) -> dict:
        path = ROOT / "tests" / "data" / "bench_truth" / name / "truth.yaml"
        return yaml.safe_load(path.read_text())

    return of
