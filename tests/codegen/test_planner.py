"""The planner example: OMPL in C++ calls the generated solver for every state and motion."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PLANNER = Path(__file__).parents[2] / "scripts" / "planner"
# OMPL's headers compile more quickly without an optimiser.
QUICK = {"CMAKE_BUILD_TYPE": "None", "CFLAGS": "-O1", "CXXFLAGS": "-O0"}


def missing():
    """What the example needs and this machine has not."""
    tools = [tool for tool in ("cmake", "g++") if shutil.which(tool) is None]
    headers = list(Path("/usr/include").glob("ompl*/**/RRTstar.h"))
    return ", ".join([*tools, *([] if headers else ["OMPL (apt-get install libompl-dev)"])])


@pytest.mark.skipif(bool(missing()), reason=f"not installed: {missing()}")
@pytest.mark.parametrize(
    ("where", "iterations", "limits"),
    [
        pytest.param((), "300", ("bend_radius", "clearance"), marks=pytest.mark.long),
        pytest.param(
            *(("--space",), "100", ("bend_radius", "force", "twist", "clearance")),
            marks=pytest.mark.long,
        ),
        pytest.param(
            *(("--clips",), "100", ("bend_radius", "force", "moment", "twist", "clearance")),
            marks=pytest.mark.long,
        ),
    ],
    ids=["plane", "space", "clips"],
)
def test_a_path_is_planned_checked_and_drawn(tmp_path, where, iterations, limits):
    command = [sys.executable, str(PLANNER / "plan.py"), "--output", str(tmp_path), *where]
    command += ["--iterations", iterations]
    run = subprocess.run(command, capture_output=True, text=True, env=os.environ | QUICK)
    assert run.returncode == 0, run.stderr
    assert "turned down for clearance of a motion" in run.stdout
    for name in limits:
        nearest, limit = re.search(rf"{name} (\S+) [^(\n]+ \(limit (\S+)\)", run.stdout).groups()
        assert (float(nearest) >= float(limit)) == (name in ("bend_radius", "clearance"))
    assert (tmp_path / "plan.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    "where",
    [(), *(pytest.param((x,), marks=pytest.mark.long) for x in ("--space", "--clips"))],
    ids=["plane", "space", "clips"],
)
def test_the_same_from_python(tmp_path, where):
    pytest.importorskip("ompl", reason="the PyPI package ompl is not installed")
    script = str(PLANNER / "plan_python.py")
    command = [sys.executable, script, "--output", str(tmp_path), *where]
    run = subprocess.run([*command, "--seconds", "2"], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "plan_python.png").stat().st_size > 10_000
