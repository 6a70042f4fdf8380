"""Where tasks run: in this process, in a pool of processes, or on a Dask cluster.

Each is a `concurrent.futures.Executor` that tells `parallel.py` how many `workers` do its tasks,
how many tasks may be under way (`capacity`), whether this process does some of them (`here`), how
a lost worker shows (`losses`), and where workers keep their `logs`.
"""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any
from weakref import WeakSet

from dlo_casadi.errors import DloError
from dlo_casadi.runtime.workers import (
    THREADS,
    begin_worker,
    environment,
    software,
    starting_processes,
)

# How long a scheduler may take to answer, and to have a worker [s].
PATIENCE = 30.0
# How long a process that is told to end is waited for [s]: one that is just starting takes one.
LAST_WORDS = 2.0


class InProcess(Executor):
    """Runs each task at once, in the process that submits it."""

    workers = 1
    capacity = 1
    here = False
    losses: tuple[type[BaseException], ...] = ()
    logs: Path | None = None

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run and return a finished future; an interrupt is raised here, not kept."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Pool(Executor):
    """A pool of spawned processes that is started anew when one of them was killed.

    Parameters
    ----------
    others : int
        Processes that are started.
    logs : Path, optional
        Folder in which each process keeps a log of its own; a crash leaves its stack there.
    here : bool
        Whether the process that submits tasks is meant to do some of them, too.
    libraries : sequence of str
        Modules that a worker imports before it is asked for anything.
    """

    losses: tuple[type[BaseException], ...] = (BrokenExecutor,)

    def __init__(
        self,
        others: int,
        logs: Path | None = None,
        here: bool = False,
        libraries: Sequence[str] = (),
    ) -> None:
        self.others, self.here = others, here
        self.workers = others + here
        self.capacity = 2 * others
        self.logs, self.libraries = logs, tuple(libraries)
        self._processes: set[BaseProcess] = set()
        self._tasks: WeakSet[Future[Any]] = WeakSet()
        self._inner = self._start()

    def _start(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            self.others,
            # A forked copy of a process with threads and solvers in it may hang.
            mp_context=multiprocessing.get_context("spawn"),
            initializer=begin_worker,
            initargs=(None if self.logs is None else str(self.logs), self.libraries),
        )

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit to the pool, to a new one if a worker of the last was killed."""
        try:
            return self._submitted(fn, *args, **kwargs)
        except BrokenExecutor:
            self._inner.shutdown()
            self._inner = self._start()
            return self._submitted(fn, *args, **kwargs)

    def _submitted(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        try:
            # The pool would pickle in a thread of its own, what is being worked on meanwhile.
            task = pickle.dumps((fn, args, kwargs))
        except Exception as error:
            unsent: Future[Any] = Future()
            unsent.set_exception(error)
            return unsent
        before = set(multiprocessing.active_children())
        # Tasks start the processes, which inherit the environment and load libraries after that.
        with environment(THREADS), starting_processes():
            future = self._inner.submit(_unpickled, task)
        self._processes |= set(multiprocessing.active_children()) - before
        self._tasks.add(future)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; with `wait=False` those in the middle of a task, too."""
        # One without a task is not waited for: it takes half a second to end by itself.
        wait = wait and not all(task.done() for task in self._tasks)
        self._inner.shutdown(wait, cancel_futures=cancel_futures)
        if not wait:
            for process in self._processes:
                process.terminate()
            for process in self._processes:
                process.join(LAST_WORDS)


def _unpickled(task: bytes) -> Any:
    function, args, kwargs = pickle.loads(task)
    return function(*args, **kwargs)


class Cluster(Executor):
    """The workers of a Dask scheduler, by its address.

    Parameters
    ----------
    address : str
        Such as tcp://192.168.1.5:8786.
    logs : Path, optional
        As of `Pool`; on a file system that the workers see.

    Raises
    ------
    DloError
        If `distributed` is missing, or no scheduler or worker answers.
    """

    def __init__(self, address: str, logs: Path | None = None) -> None:
        try:
            import distributed
        except ImportError:
            raise DloError(
                "--scheduler needs Dask.\n  Try: pip install 'dlo-casadi[dask]'"
            ) from None
        self.losses: tuple[type[BaseException], ...] = (distributed.KilledWorker,)
        self.logs = logs
        try:
            self._client = distributed.Client(
                address, timeout=PATIENCE, set_as_default=False, name="dlo-casadi"
            )
        except (OSError, ValueError) as error:
            raise DloError(
                f"no Dask scheduler answers at {address} within {PATIENCE:g} s: {error}.\n"
                "  Try: `dask scheduler` there, and the address that it prints."
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            self._client.close()
            raise DloError(
                f"the Dask scheduler at {address} has had no worker for {PATIENCE:g} s.\n"
                f"  Try: `dask worker {address} --nworkers 2 --nthreads 1`"
            ) from None
        try:
            self._check_software()
        except DloError:
            self._client.close()
            raise
        # Equal calls are different tasks: each is one row, one sample.
        self._inner = self._client.get_executor(pure=False)

    def _check_software(self) -> None:
        """Other versions give other digits: results must not depend on the worker."""
        own = software()
        try:
            theirs: dict[str, dict[str, str]] = self._client.run(software)
        except ImportError as error:
            raise DloError(
                f"a worker of the cluster cannot import dlo_casadi: {error}.\n"
                "  Try: the same environment on all machines."
            ) from None
        for worker, found in theirs.items():
            other = [f"{name} {found[name]}" for name in own if found[name] != own[name]]
            if other:
                mine = ", ".join(f"{name} {own[name]}" for name in own if found[name] != own[name])
                raise DloError(
                    f"worker {worker} has {', '.join(other)}, this machine {mine}.\n"
                    "  Try: the same environment on all machines."
                )

    @property
    def workers(self) -> int:
        """Processes that take tasks now; they may come and go."""
        return max(1, len(self._client.nthreads()))

    @property
    def capacity(self) -> int:
        """Tasks that may be under way."""
        return 2 * self.workers

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit to the cluster."""
        future: Future[Any] = self._inner.submit(fn, *args, **kwargs)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let go of the cluster; what was not awaited is cancelled."""
        self._client.close()


AnyExecutor = InProcess | Pool | Cluster


@contextmanager
def open_executor(
    jobs: int = 1,
    scheduler: str | None = None,
    logs: Path | None = None,
    *,
    here: bool = False,
    libraries: Sequence[str] = (),
) -> Iterator[AnyExecutor]:
    """Open the executor that a command's `--jobs` and `--scheduler` ask for.

        with open_executor(jobs=4) as executor:
            for done in map_as_completed(executor, function, items):
                ...

    On an exception it ends as in `ended_first`.

    Parameters
    ----------
    jobs : int
        1 runs in this process, more in a pool of so many processes.
    scheduler : str, optional
        Address of a Dask scheduler, instead.
    logs : Path, optional
        Folder of the workers' logs; it must exist.
    here : bool
        Whether this process is one of the `jobs`, and does what a lost worker has left: for tasks
        none of which can crash. Else it waits for the others, and outlives them.
    libraries : sequence of str
        Modules that other processes import before they are asked for anything.

    Raises
    ------
    DloError
        If jobs is not positive, both are asked for, or the cluster does not answer.
    """
    if jobs < 1:
        raise DloError(f"--jobs {jobs}: at least one process must do the work")
    if scheduler is not None and jobs > 1:
        raise DloError(
            f"--jobs {jobs} and --scheduler {scheduler}: a cluster has its own number of workers; "
            "give one of the two"
        )
    if logs is not None:
        logs = logs.resolve()
    executor: AnyExecutor
    if scheduler is not None:
        executor = Cluster(scheduler, logs)
    else:
        executor = InProcess() if jobs == 1 else Pool(jobs - here, logs, here, libraries)
    with ended_first(executor):
        yield executor
    executor.shutdown()


@contextmanager
def ended_first(executor: Executor) -> Iterator[None]:
    """End an executor on an exception, an interrupt too, before what its tasks work with is left.

    Waiting tasks are cancelled, running ones ended.
    """
    try:
        yield
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        raise
