"""Where tasks run: in this process, in a pool of processes, or on a Dask cluster.

Each is a `concurrent.futures.Executor` with attributes for `parallel.py`: the number of `workers`;
`here`, whether this process is one of them; `losses`, the errors raised when a worker was killed;
and the folder of the workers' `logs`.
"""

import faulthandler
import logging
import multiprocessing
import multiprocessing.connection
import os
import pickle
import platform
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from importlib.metadata import version
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any
from weakref import WeakSet

from threadpoolctl import threadpool_limits

from dlo_casadi.errors import DloError, library

# Longest wait for a scheduler's answer, and for its first worker [s].
PATIENCE = 30.0
# Longest time for a terminated process to end [s]: one that is just starting takes 1 s.
LAST_WORDS = 2.0
# Environment variables that BLAS, OpenMP and OpenCV read when they are loaded.
THREADS = dict.fromkeys(
    (
        *("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
        *("VECLIB_MAXIMUM_THREADS", "OPENCV_FOR_THREADS_NUM"),
    ),
    "1",
)
# Signals by which a command is interrupted.
INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
# Whether signals can be blocked, also in processes started meanwhile: POSIX only.
BLOCKABLE = hasattr(signal, "pthread_sigmask")


class InProcess(Executor):
    """Runs each task immediately, in the process that submits it."""

    here = True

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run and return a finished future; an interrupt is raised here, not kept."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Pool(Executor):
    """Spawned processes, see `open_executor`; if one is killed, a new pool is started."""

    def __init__(
        self, workers: int, logs: Path | None, here: bool, libraries: Sequence[str]
    ) -> None:
        self.workers, self.logs, self.here, self._libraries = workers, logs, here, tuple(libraries)
        self._processes: set[BaseProcess] = set()
        self._tasks: WeakSet[Future[Any]] = WeakSet()
        self._inner = self._start()

    def _start(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            self.workers - self.here,
            # A forked copy of a process with threads and solvers may hang.
            mp_context=multiprocessing.get_context("spawn"),
            initializer=begin_worker,
            initargs=(self.logs, self._libraries),
        )

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit to the pool, or to a new one if a worker of the old pool was killed."""
        try:
            # The pool would pickle later in its own thread, when the arguments may have changed.
            task = pickle.dumps((fn, args, kwargs))
        except Exception as error:
            unsent: Future[Any] = Future()
            unsent.set_exception(error)
            return unsent
        try:
            return self._begun(task)
        except BrokenExecutor:
            self._inner.shutdown()
            self._inner = self._start()
            return self._begun(task)

    def _begun(self, task: bytes) -> Future[Any]:
        before = set(multiprocessing.active_children())
        # Submitting starts the processes, which inherit the environment and then load libraries.
        with environment(THREADS), starting_processes():
            future = self._inner.submit(_unpickled, task)
        self._processes |= set(multiprocessing.active_children()) - before
        self._tasks.add(future)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; with `wait=False` even in the middle of a task."""
        # Idle workers are not awaited: they take half a second to end.
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
    """The workers of a Dask scheduler, see `open_executor`."""

    def __init__(self, address: str, logs: Path | None) -> None:
        distributed = library("distributed", "dask", "--scheduler")
        self.losses, self.logs = distributed.KilledWorker, logs
        try:
            self._client = distributed.Client(
                address, timeout=PATIENCE, set_as_default=False, name="dlo-casadi"
            )
        except (OSError, ValueError) as error:
            raise DloError(
                f"no Dask scheduler answers at {address} within {PATIENCE:g} s: {error}.\n"
                "  Try: `dask scheduler` there, and the address that it prints."
            ) from None
        with ExitStack() as on_failure:
            on_failure.callback(self._client.close)
            self._check_workers(address)
            on_failure.pop_all()
        # Not pure: equal calls are separate tasks, each for its own row or sample.
        self._inner = self._client.get_executor(pure=False)

    def _check_workers(self, address: str) -> None:
        own, same = software(), "  Try: the same environment on all machines."
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE)
            theirs: dict[str, dict[str, str]] = self._client.run(software)
        except TimeoutError:
            raise DloError(
                f"the Dask scheduler at {address} has had no worker for {PATIENCE:g} s.\n"
                f"  Try: `dask worker {address} --nworkers 2 --nthreads 1`"
            ) from None
        except ImportError as error:
            message = f"a worker of the cluster cannot import dlo_casadi: {error}.\n{same}"
            raise DloError(message) from None
        for worker, found in theirs.items():
            other = [name for name in own if found[name] != own[name]]
            has, mine = (", ".join(f"{name} {of[name]}" for name in other) for of in (found, own))
            if other:
                raise DloError(f"worker {worker} has {has}, this machine {mine}.\n{same}")

    @property
    def workers(self) -> int:
        """Number of processes that take tasks now; it may change."""
        return max(1, len(self._client.nthreads()))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit to the cluster."""
        return self._inner.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Disconnect from the cluster; unfinished tasks are cancelled."""
        self._client.close()


@contextmanager
def open_executor(
    jobs: int = 1,
    scheduler: str | None = None,
    logs: Path | None = None,
    *,
    here: bool = False,
    libraries: Sequence[str] = (),
) -> Iterator[Executor]:
    """Open the executor that a command's `--jobs` and `--scheduler` ask for.

        with open_executor(jobs=4) as executor:
            for done in map_as_completed(executor, function, items):
                ...

    On an exception it ends as in `ended_first`.

    Parameters
    ----------
    jobs : int
        Number of processes; 1 runs in this process, more run in a pool.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, such as tcp://192.168.1.5:8786.
    logs : Path, optional
        Folder in which each worker keeps a log; a crash leaves its stack there. It must exist, on a
        file system that the workers see.
    here : bool
        Whether this process is one of the `jobs`, and repeats tasks of a lost worker: only for
        tasks that cannot crash. Otherwise it only waits, and survives crashes of the others.
    libraries : sequence of str
        Modules that other processes import before their first task.

    Raises
    ------
    DloError
        If jobs is not positive, both are given, `distributed` is missing, no scheduler or worker
        answers, or a worker has other versions of libraries that change digits of results.
    """
    if jobs < 1:
        raise DloError(f"--jobs {jobs}: at least one process must do the work")
    if scheduler is not None and jobs > 1:
        raise DloError(
            f"--jobs {jobs} and --scheduler {scheduler}: a cluster has its own number of workers; "
            "give one of the two"
        )
    logs = None if logs is None else logs.resolve()
    executor: Executor = InProcess()
    if scheduler is not None:
        executor = Cluster(scheduler, logs)
    elif jobs > 1:
        executor = Pool(jobs, logs, here, libraries)
    with ended_first(executor):
        yield executor
    executor.shutdown()


@contextmanager
def ended_first(executor: Executor) -> Iterator[None]:
    """On an exception or an interrupt, end an executor before the resources of its tasks are freed.

    Waiting tasks are cancelled, running ones ended.
    """
    try:
        yield
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        raise


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set variables of the environment for a block, then restore them."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS, OpenMP and OpenCV to one thread each: the matrices are small.

    Loaded libraries are set directly, others read the environment.
    """
    with ExitStack() as stack:
        stack.enter_context(environment(THREADS))
        stack.enter_context(threadpool_limits(limits=1))
        cv2: Any = sys.modules.get("cv2")
        if cv2 is not None:
            stack.callback(cv2.setNumThreads, cv2.getNumThreads())
            cv2.setNumThreads(1)
        yield


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Delay interrupts to the end of the block."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives interrupts
        return
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: received.append(number))
        for number in INTERRUPTS
        if signal.getsignal(number) is not None  # one that is not of Python cannot be set again
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for one in received:
            signal.raise_signal(one)


@contextmanager
def starting_processes() -> Iterator[None]:
    """Block interrupts while processes are started, and in them until `begin_worker`.

    Otherwise an interrupted process, or its parent, prints its stack during the start.
    """
    with interrupts_held(), ExitStack() as stack:
        if BLOCKABLE:
            resource_tracker.ensure_running()  # the tracker unblocks the signals when it starts
            # New processes inherit the signal mask.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTS)
            stack.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
        yield


def begin_worker(logs: Path | None, libraries: Sequence[str] = ()) -> None:
    """Set up a worker: ignore interrupts, end with the parent, log crashes, import libraries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if BLOCKABLE:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTS)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    for handler in worker_log(logs).handlers:
        stream = getattr(handler, "stream", sys.stderr)
        faulthandler.enable(stream)
        # Output of libraries would disturb the progress display of the parent.
        for number in (1, 2):
            os.dup2(stream.fileno(), number)
    for name in libraries:
        import_module(name)


def _end_with(sentinel: int) -> None:
    """End this worker when its parent is killed, instead of waiting for work for ever."""
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


def software() -> dict[str, str]:
    """Versions on which the digits of results depend."""
    packages = ("dlo-casadi", "casadi", "numpy", "scipy", "opencv-contrib-python-headless")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def worker_log(folder: Path | None) -> logging.Logger:
    """Logger of this process, to its own file in that folder if there is one."""
    logger = logging.getLogger("dlo_casadi.worker")
    path = folder and folder / f"worker-{platform.node()}-{os.getpid()}.log"
    if path is None or any(old.name == str(path) for old in logger.handlers):
        return logger
    for old in list(logger.handlers):
        logger.removeHandler(old)
        old.close()
    # A machine of the cluster may not see the folder: Dask then keeps its own log.
    with suppress(OSError):
        handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
        handler.name = str(path)
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
    return logger
