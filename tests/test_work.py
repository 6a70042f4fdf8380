"""Work is counted in steps, the same wherever it is done, and bounds count finished tasks."""

import logging

import pytest
from tasks import work

from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import begin, map_in_order, open_executor
from dlo_casadi.runtime.work import Bound, accounted, part, spend, spent


def test_parts_hold_their_own_parts():
    with accounted() as account:
        spend(1)
        for _ in range(2):
            with part("search"):
                spend(10)
                with part("fits"):
                    spend(100)
        with part("fits"):
            spend(1000)
    assert account.steps == 1221
    told = {(depth, name): (one.calls, one.steps) for depth, name, one in account.rows()}
    assert told == {(0, "search"): (2, 220), (1, "fits"): (2, 200), (0, "fits"): (1, 1000)}


def test_an_account_inside_another_is_its_own():
    with accounted() as outer:
        spend(1)
        with accounted() as inner:
            spend(2)
    assert (outer.steps, inner.steps) == (1, 2)


@pytest.mark.parametrize("jobs", [1, 2])
def test_steps_of_tasks_are_counted_wherever_they_run(jobs):
    """Each task begins with an account of its own: its bounds do not depend on other tasks."""
    with open_executor(jobs=jobs) as executor, accounted() as account:
        with part("search"):
            assert map_in_order(executor, work, [3, 4, 5]) == [3, 4, 5]
            assert begin(executor, work, 6)() == 6
        assert spent() == 18
    assert account.parts["search"].parts["fits"].calls == 4


def test_a_bound_counts_from_where_it_is_set():
    with accounted():
        spend(5)
        bound = Bound(10)
        spend(9)
        assert not bound.met
        map_in_order(InProcess(), work, [1])
        assert bound.met


def test_work_is_logged(caplog):
    with accounted() as account, part("search"), part("fits"):
        spend(7)
    with caplog.at_level(logging.INFO, logger="dlo_casadi"):
        account.tell()
    assert [line.split()[:5] for line in caplog.messages] == [
        ["search", "1", "x", "7", "steps"],
        ["fits", "1", "x", "7", "steps"],
    ]
