"""One thread per process: the matrices are small, and the tests run in two processes."""

import os
import sys
from pathlib import Path

import pytest

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Nothing that a test writes has to outlast a power cut, and each wait for the disk takes
# milliseconds. Tests of disks that fail put their own in its place.
os.fsync = lambda number: None

# Some tests run what scripts share. At the end, so that scripts/fit.py hides no other module.
sys.path.append(str(Path(__file__).parents[1] / "scripts"))


@pytest.fixture
def fewer_starts(monkeypatch):
    """Clips are placed from 4 guesses instead of 16: enough for one or two on a line."""
    monkeypatch.setattr("dlo_casadi.cable.placing.GUESSES", 4)
    monkeypatch.setattr("dlo_casadi.cable.placing.STARTS", 2)
