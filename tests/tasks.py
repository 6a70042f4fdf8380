"""What the tests of `runtime` do in other processes, which import this file and little else."""

import os
import signal
import time
from pathlib import Path

from threadpoolctl import threadpool_info

from dlo_casadi.errors import EquilibriumError
from dlo_casadi.runtime.parallel import generator_of
from dlo_casadi.runtime.work import part, spend, spent


def square(x):
    return x * x


def root(x):
    if x < 0:
        raise EquilibriumError(f"{x} has no root", pose="p", p_des=(x, 0.0))
    return x**0.5


def threads(_):
    import cv2

    return [row["num_threads"] for row in threadpool_info()], cv2.getNumThreads(), os.getpid()


def kill_once(mark, x):
    """Square of x; the worker that meets item 3 first is killed."""
    if x == 3 and not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return x * x


def kill_always(x):
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x * x


def draw(index):
    return generator_of(7, index).standard_normal(3).tolist()


def slowly(x):
    time.sleep(0.05)
    return x, os.getpid()


def kill_elsewhere(pid):
    if os.getpid() != pid:
        os.kill(os.getpid(), signal.SIGKILL)
    return "done here"


def broken(x):
    raise ZeroDivisionError("oops")


def work(steps):
    with part("fits"):
        spend(steps)
    return spent()
