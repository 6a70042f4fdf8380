"""A fleet of tiny sessions and its table, computed in this process."""

import pytest
from tiny_sessions import QUICK, without_times, write_fleet, write_session

from dlo_casadi.config import load_config
from dlo_casadi.fleet.run import find_sessions, fit_fleet
from dlo_casadi.runtime.executors import InProcess


@pytest.fixture(scope="session")
def tiny(run_once, tmp_path_factory):
    """Outcome of one tiny session."""
    path = write_session(tmp_path_factory.mktemp("tiny") / "cable")
    return run_once("tiny", load_config(path))


@pytest.fixture(scope="session")
def fleet(tmp_path_factory):
    """Folder of the sessions."""
    folder = tmp_path_factory.mktemp("cables")
    write_fleet(folder)
    return folder


@pytest.fixture(scope="session")
def expected(fleet, tmp_path_factory):
    """Rows of the table without interruption, one session after the other."""
    import pyarrow.parquet as pq

    output = tmp_path_factory.mktemp("in_process")
    fit_fleet(find_sessions(fleet)[1], output, InProcess(), QUICK)
    return without_times(pq.read_table(output / "table.parquet"))
