"""Worker processes under watch: one that hangs, swells or dies is ended, and says so."""

from __future__ import annotations

import multiprocessing
import os
import resource
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkProcess
from typing import Any

# Data of one process beyond what it was born with [bytes]; processor time of an input [s], which
# other work on the machine does not stretch; and time by the clock, for one that waits for ever.
MOST_MEMORY = 2 * 10**9
MOST_SECONDS = 10.0
_MOST_WAITING = 600.0
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class _Worker:
    process: ForkProcess
    connection: Connection
    item: Any = None
    begin: float = 0.0
    spent: float = 0.0  # processor time at the begin [s]


def watched(
    work: Callable[[Any], tuple[str, str]],
    items: Iterable[Any],
    jobs: int,
    allowed: Callable[[Any], float] = lambda _: MOST_SECONDS,
) -> Iterator[tuple[Any, str, str]]:
    """Do the work in `jobs` processes; yield (item, outcome, text) in the order of their ends.

    Outcomes are those of `work`, and "hang" (more processor time [s] than `allowed`), "memory" or
    "crash".
    """
    context = multiprocessing.get_context("fork")
    waiting = iter(items)

    def start() -> _Worker:
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(work, theirs, ours), daemon=True)
        process.start()
        theirs.close()
        return _Worker(process, ours)

    def feed(worker: _Worker) -> None:
        worker.item = next(waiting, None)
        if worker.item is not None:
            worker.begin, worker.spent = time.monotonic(), _processor_time(worker.process.pid)
            worker.connection.send(worker.item)

    workers = [start() for _ in range(jobs)]
    try:
        for worker in workers:
            feed(worker)
        while busy := [worker for worker in workers if worker.item is not None]:
            ready = wait([worker.connection for worker in busy], timeout=0.2)
            for worker in busy:
                item, most = worker.item, allowed(worker.item)
                if worker.connection in ready:
                    try:
                        outcome, text = worker.connection.recv()
                        if _processor_time(worker.process.pid) - worker.spent > most:
                            outcome, text = "hang", f"more than {most:g} s\n{text}"
                        feed(worker)
                        yield item, outcome, text
                        continue
                    except EOFError:
                        worker.process.join()
                        outcome = "crash"
                        text = f"the process ended with exit code {worker.process.exitcode}"
                elif (
                    _processor_time(worker.process.pid) - worker.spent > most
                    or time.monotonic() - worker.begin > _MOST_WAITING
                ):
                    outcome, text = "hang", f"no end within {most:g} s of processor time"
                else:
                    continue
                worker.process.kill()
                worker.process.join()
                worker.connection.close()
                k = workers.index(worker)
                workers[k] = start()
                feed(workers[k])
                yield item, outcome, text
    finally:
        for worker in workers:
            worker.process.kill()
            worker.process.join()


def _serve(
    work: Callable[[Any], tuple[str, str]], connection: Connection, other: Connection
) -> None:
    other.close()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libraries print of a damaged picture
    most = _data_size() + MOST_MEMORY
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    while True:
        try:
            item = connection.recv()
        except EOFError:
            return
        try:
            found = work(item)
        except MemoryError as error:
            found = "memory", str(error)
        connection.send(found)


def _data_size() -> int:
    """Data that this process already has, its parent's at the fork [bytes]."""
    with open("/proc/self/status") as file:
        (line,) = (line for line in file if line.startswith("VmData:"))
    return int(line.split()[1]) * 1024


def _processor_time(pid: int | None) -> float:
    """Processor time of a process so far [s]."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            fields = file.read().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / _TICKS
