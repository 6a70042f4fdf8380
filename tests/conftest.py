"""What all tests share: threads, the C compiler, sessions that are run once."""

import os
import pickle
import shutil
import sys
from pathlib import Path

import pytest
from filelock import FileLock

# One thread per process: the matrices are small, and the tests run in two processes.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Tests start many processes, each of which would compile the whole package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Solvers are compiled without optimisation, which takes clang a fifth of GCC's time. Tests that
# name a compiler keep theirs.
if shutil.which("clang"):
    os.environ.setdefault("CC", "clang")

# Nothing that a test writes has to outlast a power cut, and each wait for the disk takes
# milliseconds. Tests of disks that fail put their own in its place.
os.fsync = lambda number: None

# Some tests run what scripts share. At the end, so that scripts/fit.py hides no other module.
sys.path.append(str(Path(__file__).parents[1] / "scripts"))


@pytest.fixture(scope="session")
def run_once(tmp_path_factory):
    """Function that runs a session once for all processes of the tests, and names its outcome."""
    from dlo_casadi.session import run_session

    parallel = "PYTEST_XDIST_WORKER" in os.environ
    own = tmp_path_factory.getbasetemp()
    folder = own.parent if parallel else own

    def run(name, config):
        path = folder / f"{name}.pickle"
        with FileLock(path.with_suffix(".lock")):
            if not path.exists():
                path.write_bytes(pickle.dumps(run_session(config)))
            return pickle.loads(path.read_bytes())

    return run


@pytest.fixture
def fewer_starts(monkeypatch):
    """Clips are placed from 4 guesses instead of 16: enough for one or two on a line."""
    monkeypatch.setattr("dlo_casadi.cable.placing.GUESSES", 4)
    monkeypatch.setattr("dlo_casadi.cable.placing.STARTS", 2)
