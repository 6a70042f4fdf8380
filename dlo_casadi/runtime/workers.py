"""What holds in a process that does tasks: one thread, a log, the end with its parent."""

from __future__ import annotations

import faulthandler
import logging
import multiprocessing
import multiprocessing.connection
import os
import platform
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from importlib.metadata import version
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from dlo_casadi.runtime.interrupts import BLOCKABLE, INTERRUPTS, interrupts_held

# Read by BLAS, OpenMP and OpenCV when they are loaded.
THREADS = dict.fromkeys(
    (
        *("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
        *("VECLIB_MAXIMUM_THREADS", "OPENCV_FOR_THREADS_NUM"),
    ),
    "1",
)


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set variables of the environment; what was set before is put back."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold BLAS, OpenMP and OpenCV to one thread each: the matrices are small.

    Libraries that are loaded already are told so, others find it in the environment.
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
def starting_processes() -> Iterator[None]:
    """Hold interrupts back while processes are started, and in them until `begin_worker`.

    A process that is interrupted half way in its start, or whose parent is, prints its stack.
    """
    with interrupts_held():
        if not BLOCKABLE:
            yield
            return
        resource_tracker.ensure_running()  # which lets go of the signals when it starts
        # What is started inherits the mask.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTS)
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def begin_worker(logs: str | None, libraries: Sequence[str] = ()) -> None:
    """Leave interrupts to the parent, end with it, keep the stack of a crash; import libraries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if BLOCKABLE:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTS)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    if logs is not None:
        stream = open(log_file(Path(logs)), "a")  # noqa: SIM115 (as long as the process)
        faulthandler.enable(stream)
        # What libraries print would tear the progress of the parent.
        for number in (1, 2):
            os.dup2(stream.fileno(), number)
    for name in libraries:
        import_module(name)


def _end_with(sentinel: int) -> None:
    """A worker whose parent was killed would wait for work for ever."""
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


def software() -> dict[str, str]:
    """Versions on which the digits of results depend."""
    packages = ("dlo-casadi", "casadi", "numpy", "scipy", "opencv-contrib-python-headless")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def worker_name() -> str:
    """Machine and process."""
    return f"{platform.node()}-{os.getpid()}"


def log_file(folder: Path) -> Path:
    """Where this process keeps its log."""
    return folder / f"worker-{worker_name()}.log"


def worker_log(folder: str | None) -> logging.Logger:
    """Logger of this process, to its own file in that folder if there is one."""
    logger = logging.getLogger("dlo_casadi.worker")
    if folder is None:
        return logger
    path = str(log_file(Path(folder)))
    if any(getattr(old, "baseFilename", None) == path for old in logger.handlers):
        return logger
    for old in list(logger.handlers):
        logger.removeHandler(old)
        old.close()
    try:
        handler: logging.Handler = logging.FileHandler(
            path, encoding="utf-8", errors="backslashreplace"
        )
    except OSError:
        # A machine of the cluster that does not see the folder: Dask keeps its own log there.
        return logger
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    return logger
