"""One function applied to many items, on any executor."""

import logging
import multiprocessing
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Sequence, Sized
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from operator import call
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import numpy as np

from dlo_casadi.errors import DloError
from dlo_casadi.runtime.executors import one_thread, worker_log
from dlo_casadi.runtime.executors import open_executor as open_executor
from dlo_casadi.runtime.work import Part, accounted, add

Item = TypeVar("Item")
Result = TypeVar("Result")

# Repetitions of a task lost with its worker; the last one runs without other tasks.
RETRIES = 2
# Half width of the 90 % interval of a standard normal distribution.
NINETY = 1.645


class LostTaskError(DloError):
    """A task whose worker was killed in every attempt."""


@dataclass(frozen=True)
class Finished(Generic[Item, Result]):
    """One task that has ended.

    Parameters
    ----------
    index : int
        Index of the item.
    item : object
    result : object or None
    error : BaseException or None
        Exception of the function, or a `LostTaskError`.
    seconds : float
        Duration on the worker.
    work : Part
        What its fits took.
    """

    index: int
    item: Item
    result: Result | None
    error: BaseException | None
    seconds: float
    work: Part = field(default_factory=Part)

    @property
    def value(self) -> Result:
        """The result; an exception of the function is raised here."""
        if self.error is not None:
            raise self.error
        return cast(Result, self.result)


@dataclass(frozen=True)
class Tally:
    """Progress of the tasks.

    Parameters
    ----------
    done, failed : int
        Numbers of tasks; `done` includes failed ones.
    total : int or None
    elapsed : float [s]
    remaining : (float, float) or None [s]
        90 % interval, from the durations so far; None until two tasks are done.
    """

    done: int
    failed: int
    total: int | None
    elapsed: float
    remaining: tuple[float, float] | None


def map_as_completed(
    executor: Executor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    total: int | None = None,
    progress: Callable[[Tally], None] | None = None,
) -> Generator[Finished[Item, Result]]:
    """Apply a function to all items; yield each as soon as it has ended.

    An exception of the function ends only its own item. A task lost with a killed worker is
    repeated on another one, the last time without other tasks; if it is lost every time, it ends
    with a `LostTaskError`. If this process is one of the executor's workers, it runs tasks between
    submissions, and the lost ones. Each task has one thread of BLAS, OpenMP and OpenCV, so that its
    numbers do not depend on where it runs.

    Parameters
    ----------
    executor : Executor
        Any executor; those of `open_executor` keep logs and survive a killed worker.
    function : callable
        Of one item. Both, and its result, must be picklable unless all run in this process.
    items : iterable
        Consumed as tasks are submitted, two for each worker.
    total : int, optional
        Number of items, if they have no length.
    progress : callable, optional
        Called after each task.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    here, logs = getattr(executor, "here", False), getattr(executor, "logs", None)
    losses = getattr(executor, "losses", BrokenExecutor)
    waiting = iter(enumerate(items))
    again: list[tuple[int, Item, int]] = []
    suspects: list[tuple[int, Item, int]] = []
    under_way: dict[Future[Finished[Any, Result]], tuple[int, Item, int]] = {}
    started, taken, failed, durations = time.perf_counter(), 0, 0, list[float]()

    def room() -> int:
        workers = workers_of(executor)  # asked again: workers of a cluster come and go
        most = 2 * (workers - here)
        if here and (workers == 1 or total is not None):
            # Towards the end, leave waiting tasks to this process.
            left = (total or 0) - taken
            most = min(most, (workers - 1) * max(1, left // (2 * workers))) if left > 1 else 0
        return max(0, most - len(under_way))

    def submit(index: int, item: Item, lost: int = 0) -> None:
        under_way[executor.submit(_run, function, index, item, logs)] = index, item, lost

    def ended(item: Item, task: Finished[Any, Result]) -> Finished[Item, Result]:
        nonlocal failed
        done: Finished[Item, Result] = replace(task, item=item)
        failed += done.error is not None
        add(task.work)
        durations.append(done.seconds)
        if progress is not None:
            left = _remaining(durations, total, workers_of(executor))
            elapsed = time.perf_counter() - started
            progress(Tally(len(durations), failed, total, elapsed, left))
        return done

    try:
        while True:
            while again and room():
                submit(*again.pop())
            for index, item in islice(waiting, room()):
                taken += 1
                submit(index, item)
            own = list(islice(waiting, int(here)))
            for index, item in own:
                taken += 1
                yield ended(item, _run(function, index, item, None))
            if not under_way:
                if own:
                    continue
                if not suspects:
                    return
                submit(*suspects.pop())
            # After its own task this process continues without waiting for the others.
            for future in wait(under_way, 0.0 if own else None, FIRST_COMPLETED).done:
                index, item, lost = under_way.pop(future)
                if future.cancelled():
                    raise LostTaskError("the executor was shut down with tasks under way")
                error = future.exception()
                if error is None:
                    task = future.result()
                elif here and isinstance(error, losses):
                    task = _run(function, index, item, None)
                else:
                    if isinstance(error, losses):
                        if lost < RETRIES:
                            # The last repetition runs alone: no other task can cause its loss.
                            put_off = again if lost + 1 < RETRIES else suspects
                            put_off.append((index, item, lost + 1))
                            continue
                        error = LostTaskError(
                            f"task {index} was lost {lost + 1} times, at last alone: its worker "
                            "was killed.\n  Try: more memory; see the workers' logs."
                        )
                    task = Finished(index, None, None, error, 0.0)
                yield ended(item, task)
    finally:
        for future in under_way:
            future.cancel()


def map_in_order(
    executor: Executor, function: Callable[[Item], Result], items: Sequence[Item]
) -> list[Result]:
    """Results of all items in their order; the first exception is raised."""
    ended = map_as_completed(executor, function, items)
    return [item.value for item in sorted(ended, key=lambda item: item.index)]


def begin(executor: Executor, function: Callable[..., Result], *args: Any) -> Callable[[], Result]:
    """Begin one call in the background; the returned function waits for its result.

    It raises what the call raised. If the executor has no other worker, or its worker was killed,
    the call runs here on demand. Like each task of `map_as_completed` it has one thread.
    """
    task = partial(_run, call, 0, partial(function, *args))
    begun: Future[Finished[Any, Result]] | None = None
    if workers_of(executor) > 1:
        begun = executor.submit(task, getattr(executor, "logs", None))

    def result() -> Result:
        try:
            done = task(None) if begun is None else begun.result()
        except getattr(executor, "losses", BrokenExecutor):
            done = task(None)
        add(done.work)
        return done.value

    return result


def workers_of(executor: Executor) -> int:
    """Number of processes; the standard library's executors have it as `_max_workers`.

    Threads count as one: they share an interpreter, and the paper's loop and IPOPT with it.
    """
    if isinstance(executor, ThreadPoolExecutor):
        return 1
    return int(getattr(executor, "workers", getattr(executor, "_max_workers", 1)) or 1)


def generator_of(seed: int, index: int) -> np.random.Generator:
    """Random number generator of one task: it depends on the seed and the index alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))


# CasADi's expressions are not thread-safe: a worker does one task at a time.
_one_at_a_time = threading.RLock()


def _run(
    function: Callable[[Item], Result], index: int, item: Item, logs: Path | None
) -> Finished[Any, Result]:
    """Run one task, timed and logged; the result holds an exception, but not the item."""
    # Nested tasks are not logged.
    log = worker_log(logs) if logs is not None else logging.getLogger("dlo_casadi.unlogged")
    result, failure = None, None
    with _one_at_a_time, one_thread():
        begin = time.perf_counter()
        log.info("task %d begins: %.200r", index, item)
        try:
            with accounted() as work:
                result = function(item)
        except Exception as error:
            log.info("task %d failed", index, exc_info=True)
            if multiprocessing.parent_process() is not None and not isinstance(error, DloError):
                error.add_note(traceback.format_exc())  # the stack is not pickled
            failure = error
        seconds = time.perf_counter() - begin
        if failure is None:
            log.info("task %d done in %.3f s", index, seconds)
        return Finished(index, None, result, failure, seconds, work)


def _remaining(
    durations: Sequence[float], total: int | None, workers: int
) -> tuple[float, float] | None:
    """90 % interval of the remaining time, from mean and deviation of the durations so far.

    (k mean +- 1.645 s sqrt(k + k^2 / m)) / workers  with k tasks left and m done.
    """
    m = len(durations)
    if total is None or m < 2:
        return None
    seconds = np.array(durations)
    k = total - m
    middle = k * float(seconds.mean())
    spread = NINETY * float(seconds.std(ddof=1)) * (k + k**2 / m) ** 0.5
    return max(0.0, middle - spread) / workers, (middle + spread) / workers
