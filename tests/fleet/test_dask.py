"""The same on a Dask cluster: a real scheduler and two worker processes on this machine."""

import os
import signal
from functools import partial

import pytest

pytest.importorskip("pyarrow", reason="tables need pyarrow: pip install 'dlo-casadi[table]'")
pytest.importorskip("distributed", reason="needs Dask: pip install 'dlo-casadi[dask]'")

import pyarrow.parquet as pq
from distributed import LocalCluster
from tasks import draw, kill_once, root, threads
from tiny_sessions import QUICK, without_times

from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.fleet.run import find_sessions, fit_fleet
from dlo_casadi.runtime import executors
from dlo_casadi.runtime.parallel import map_as_completed, map_in_order, open_executor


@pytest.fixture(scope="module")
def cluster():
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as running:
        yield running


def test_tasks_errors_and_threads(cluster, tmp_path):
    with open_executor(scheduler=cluster.scheduler_address, logs=tmp_path) as executor:
        assert executor.workers == 2
        assert map_in_order(executor, draw, range(4)) == [draw(k) for k in range(4)]
        assert map_in_order(executor, abs, [-1, -1]) == [1, 1], "equal calls are two tasks"
        (ended,) = map_as_completed(executor, root, [-2.0])
        with pytest.raises(EquilibriumError, match=r"p: -2\.0 has no root") as caught:
            _ = ended.value
        assert caught.value.p_des == (-2.0, 0.0)
        for blas, opencv, pid in map_in_order(executor, threads, range(4)):
            assert set(blas) == {1}
            assert opencv == 1
            assert pid != os.getpid()
    assert list(tmp_path.glob("worker-*.log"))


def test_a_worker_killed_by_its_task_is_replaced(cluster, tmp_path):
    with open_executor(scheduler=cluster.scheduler_address) as executor:
        work = partial(kill_once, str(tmp_path / "mark"))
        assert map_in_order(executor, work, range(6)) == [x * x for x in range(6)]
    assert (tmp_path / "mark").exists()


@pytest.mark.long
def test_a_worker_killed_in_the_middle_changes_no_digit(cluster, fleet, expected, tmp_path):
    killed = []

    def kill_one(tally):
        if not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    sessions = find_sessions(fleet)[1]
    (tmp_path / "logs").mkdir()
    with open_executor(scheduler=cluster.scheduler_address, logs=tmp_path / "logs") as executor:
        fit_fleet(sessions, tmp_path, executor, QUICK, progress=kill_one)
    assert killed
    assert without_times(pq.read_table(tmp_path / "table.parquet")) == expected
    assert len(list((tmp_path / "rows").glob("*.json"))) == len(expected)


def test_other_versions_on_a_worker_are_refused(cluster, monkeypatch):
    own = executors.software()
    monkeypatch.setattr(executors, "software", _OtherVersion(own))
    with (
        pytest.raises(DloError, match=r"worker .* has numpy 0\.1, this machine numpy"),
        open_executor(scheduler=cluster.scheduler_address),
    ):
        pass


class _OtherVersion:
    """Versions of this machine here, of another one on a worker."""

    def __init__(self, own):
        self.own, self.home = own, os.getpid()

    def __call__(self):
        return self.own if os.getpid() == self.home else {**self.own, "numpy": "0.1"}


def test_no_scheduler(monkeypatch):
    monkeypatch.setattr(executors, "PATIENCE", 0.5)
    with (
        pytest.raises(DloError, match="no Dask scheduler answers at tcp"),
        open_executor(scheduler="tcp://127.0.0.1:9"),
    ):
        pass
