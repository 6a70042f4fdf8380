"""Small sessions, each run once, that all tests of the report look at."""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # before numpy: the matrices are small

import pytest  # noqa: E402
from small_sessions import in_space, photographs, small  # noqa: E402

from dlo_casadi.session import run_session  # noqa: E402


@pytest.fixture(scope="session")
def outcome():
    return run_session(small("short_clean"))


@pytest.fixture(scope="session")
def photographed():
    return run_session(photographs(("pose_01", "pose_03", "pose_04", "pose_05", "pose_09")))


@pytest.fixture(scope="session")
def in_room():
    return run_session(in_space(("pose_01", "pose_02", "pose_04")))
