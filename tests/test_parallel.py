"""Tasks end once each, wherever they run and whatever happens to their workers."""

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial

import casadi as ca
import cv2  # noqa: F401 (that it is loaded in this process)
import pytest
from scipy.special import ndtri
from tasks import (
    broken,
    draw,
    kill_always,
    kill_elsewhere,
    kill_once,
    root,
    slowly,
    square,
    threads,
)

from dlo_casadi.equilibrium.by_ipopt import run_ipopt
from dlo_casadi.errors import DloError, EquilibriumError
from dlo_casadi.runtime import parallel
from dlo_casadi.runtime.executors import INTERRUPTS, InProcess, interrupts_held
from dlo_casadi.runtime.parallel import (
    LostTaskError,
    Tally,
    begin,
    generator_of,
    map_as_completed,
    map_in_order,
    open_executor,
)


@pytest.fixture(scope="module")
def pool():
    with open_executor(jobs=2) as executor:
        yield executor


@pytest.fixture(scope="module")
def two_of_us():
    with open_executor(jobs=2, here=True, libraries=("dlo_casadi.equilibrium.pose",)) as executor:
        executor.submit(os.getpid).result()
        yield executor


def test_this_process_does_its_share(two_of_us):
    for count in (2, 3, 12):
        done = map_in_order(two_of_us, slowly, range(count))
        assert [x for x, _ in done] == list(range(count))
        own = sum(pid == os.getpid() for _, pid in done)
        assert len({pid for _, pid in done}) == 2
        assert abs(own - count / 2) <= 2, "nobody waits while there is work"
    assert map_in_order(two_of_us, slowly, [7]) == [(7, os.getpid())]
    ended = {done.item: done for done in map_as_completed(two_of_us, root, iter([4.0, -1.0, 9.0]))}
    assert (ended[4.0].value, ended[9.0].value) == (2.0, 3.0)
    with pytest.raises(EquilibriumError):
        _ = ended[-1.0].value


def test_one_call_beside_others(two_of_us):
    beside, here = begin(two_of_us, slowly, 3), begin(InProcess(), slowly, 3)
    assert beside()[0] == here()[0] == 3
    assert beside()[1] != here()[1] == os.getpid()
    with pytest.raises(EquilibriumError):
        begin(two_of_us, root, -1.0)()
    with pytest.raises(EquilibriumError):
        begin(InProcess(), root, -1.0)()


def test_a_task_is_what_it_was_when_it_was_begun(two_of_us):
    numbers = dict.fromkeys(range(300_000))
    beside = begin(two_of_us, len, numbers)
    numbers.clear()
    assert beside() == 300_000
    with pytest.raises(TypeError, match="pickle"):
        begin(two_of_us, len, threading.Lock())()
    assert [done.item for done in map_as_completed(two_of_us, slowly, range(2))]


def test_a_bug_elsewhere_comes_with_its_stack(two_of_us):
    with pytest.raises(ZeroDivisionError) as caught:
        begin(two_of_us, broken, 1)()
    assert "in broken" in "".join(caught.value.__notes__)
    with pytest.raises(EquilibriumError) as caught:
        begin(two_of_us, root, -1.0)()
    assert not hasattr(caught.value, "__notes__")  # what a user has done is no bug


def test_a_call_that_nobody_else_makes_is_made_when_it_is_asked_for():
    made = []
    beside = begin(InProcess(), made.append, 1)
    assert not made
    beside()
    assert made == [1]


def test_what_a_killed_worker_leaves_is_done_here():
    with open_executor(jobs=2, here=True) as executor:
        assert begin(executor, kill_elsewhere, os.getpid())() == "done here"
        assert map_in_order(executor, kill_elsewhere, [os.getpid()] * 6) == ["done here"] * 6
        assert map_in_order(executor, square, range(4)) == [0, 1, 4, 9]


def test_without_a_worker_that_starts_all_is_done_here():
    with open_executor(jobs=2, here=True, libraries=("no_such_module",)) as executor:
        assert begin(executor, square, 3)() == 9
        assert map_in_order(executor, square, range(5)) == [0, 1, 4, 9, 16]


def test_one_call_has_one_thread_wherever_it_is_made(two_of_us, pool):
    for executor in (two_of_us, pool, InProcess(), ThreadPoolExecutor(1)):
        blas, opencv, pid = begin(executor, threads, None)()
        assert (set(blas), opencv) == ({1}, 1)
        # CasADi's expressions are not made for threads.
        assert (pid == os.getpid()) == (executor not in (two_of_us, pool))


def test_a_pool_ends_its_own_processes_and_no_task():
    with open_executor(jobs=2, here=True) as executor:
        begin(executor, os.getpid)()
        other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(0.6,))
        other.start()
        late = executor.submit(slowly, 5)
    assert late.result()[0] == 5
    other.join()
    assert other.exitcode == 0


def test_an_interrupt_waits_for_the_start_of_processes():
    """Also where another thread takes the signal, as that of a progress bar."""
    stop = threading.Event()
    thread = threading.Thread(target=stop.wait)
    thread.start()
    done = []

    def start():
        with interrupts_held():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            done.append("started")

    try:
        with interruptible(), pytest.raises(KeyboardInterrupt):
            start()
    finally:
        stop.set()
        thread.join()
    assert done == ["started"]


def test_interrupts_of_a_program_around_python_are_left_to_it(monkeypatch):
    """Python knows no handler that such a program has set, and cannot set it again."""
    before = [signal.getsignal(number) for number in INTERRUPTS]
    monkeypatch.setattr(signal, "getsignal", lambda _: None)
    real = signal.signal
    monkeypatch.setattr(signal, "signal", lambda number, handler: real(number, handler) and None)
    with interrupts_held():
        pass
    monkeypatch.undo()
    assert [signal.getsignal(number) for number in INTERRUPTS] == before


@contextmanager
def interruptible():
    """As in a terminal: below nohup interrupts are ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_interrupt_is_no_failure_of_the_solver():
    """CasADi swallows it, and IPOPT returns as if its functions could not be evaluated."""
    x = ca.MX.sym("x", 40)
    interrupting = Interrupting("interrupting", {"enable_fd": True})
    problem = {"x": x, "f": ca.sumsqr(x) + 1e-9 * interrupting(x[0])}
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("solver", "ipopt", problem, options)
    with interruptible(), pytest.raises(KeyboardInterrupt):
        run_ipopt(solver, x0=1.0)


class Interrupting(ca.Callback):
    def __init__(self, name, options):
        ca.Callback.__init__(self)
        self.construct(name, options)

    def eval(self, arguments):
        os.kill(os.getpid(), signal.SIGINT)
        return [arguments[0] ** 2]


def test_in_process_results_come_one_by_one_and_in_order():
    run = []
    with open_executor() as executor:
        for done in map_as_completed(executor, lambda x: run.append(x) or x, [5, 6, 7]):
            assert run[-1] == done.item, "a task was run before the one before it was handed out"
    assert run == [5, 6, 7]


def test_pool_and_process_give_the_same(pool):
    assert map_in_order(pool, square, range(20)) == [x * x for x in range(20)]
    assert map_in_order(pool, draw, range(6)) == map_in_order(InProcess(), draw, range(6))


def test_an_error_ends_its_own_task_alone_and_keeps_what_it_knows(pool):
    ended = {done.item: done for done in map_as_completed(pool, root, [4.0, -1.0, 9.0])}
    assert ended[4.0].value == 2.0
    assert ended[9.0].value == 3.0
    with pytest.raises(EquilibriumError, match=r"p: -1\.0 has no root") as caught:
        _ = ended[-1.0].value
    assert caught.value.p_des == (-1.0, 0.0)


def test_any_executor_of_the_standard_library_takes_items_only_when_there_is_room():
    taken = []

    def items():
        for x in range(50):
            taken.append(x)
            yield x

    with ThreadPoolExecutor(3) as executor:
        for k, done in enumerate(map_as_completed(executor, square, items())):
            assert done.value == done.item**2
            assert len(taken) <= k + 4, "two are submitted at a time: threads are one worker"


def test_a_killed_worker_loses_nothing(tmp_path):
    (tmp_path / "logs").mkdir()
    with open_executor(jobs=2, logs=tmp_path / "logs") as executor:
        work = partial(kill_once, str(tmp_path / "mark"))
        assert map_in_order(executor, work, range(8)) == [x * x for x in range(8)]
    assert (tmp_path / "mark").exists(), "nothing was killed"
    logs = list((tmp_path / "logs").glob("worker-*.log"))
    text = "".join(path.read_text() for path in logs)
    assert len(logs) >= 2, "each process keeps its own log, and at least one is anew"
    assert text.count("task 3 begins") == 2
    assert text.count("task 3 done") == 1


def test_a_task_that_kills_its_worker_is_given_up_and_no_other():
    with open_executor(jobs=2) as executor:
        ended = list(map_as_completed(executor, kill_always, range(6)))
    assert sorted(done.item for done in ended) == list(range(6))
    for done in ended:
        if done.item == 3:
            with pytest.raises(LostTaskError, match="lost 3 times, at last alone"):
                _ = done.value
        else:
            assert done.value == done.item**2


def test_an_interrupt_ends_the_running_tasks():
    begin = time.perf_counter()

    def interrupted():
        with open_executor(jobs=2) as executor:
            for _ in map_as_completed(executor, time.sleep, [0.0, 600.0, 600.0, 600.0]):
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.perf_counter() - begin < 60


def test_remaining_time_is_an_interval_that_holds_the_truth(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(parallel, "one_thread", nullcontext)  # a millisecond for each of 2400

    def work(seconds):
        clock[0] += seconds

    inside = []
    for k in range(40):
        durations = generator_of(0, k).exponential(3.0, 60)
        tallies: list[Tally] = []
        list(map_as_completed(InProcess(), work, durations, progress=tallies.append))
        assert [tally.done for tally in tallies] == list(range(1, 61))
        assert tallies[0].remaining is None
        assert tallies[-1].remaining == (0.0, 0.0)
        low, high = tallies[19].remaining
        inside.append(low <= durations[20:].sum() <= high)
    # 90 % of 40 are 36, and the standard deviation of their number is 1.9; intervals that always
    # hold are too wide.
    assert 31 <= sum(inside) < 40


def test_remaining_time_by_hand():
    """After tasks of 1, 2, 3 s six more in two processes: (12 +- z sqrt(6 + 6^2 / 3)) / 2."""
    half = ndtri(0.95) * 18**0.5
    found = parallel._remaining([1.0, 2.0, 3.0], 9, 2)
    assert found == pytest.approx(((12 - half) / 2, (12 + half) / 2), rel=1e-3)


def test_environment_is_as_before(monkeypatch):
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with open_executor(jobs=2) as executor:
        for name in ("MKL_NUM_THREADS", "OMP_NUM_THREADS"):
            assert executor.submit(os.getenv, name).result() == "1"
        assert "MKL_NUM_THREADS" not in os.environ
        assert os.environ["OMP_NUM_THREADS"] == "3"


def test_bad_numbers_of_processes():
    with pytest.raises(DloError, match="--jobs 0"), open_executor(jobs=0):
        pass
    both = open_executor(jobs=2, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(DloError, match="its own number of workers"), both:
        pass
