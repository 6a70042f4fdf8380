"""Work of fits and searches: counted and bounded in steps, timed part by part.

One step is one linearisation of a whole problem, all its poses together: of a relaxed fit, or of a
trial step along equilibria. Steps are the same on every machine; seconds are not, and bound
nothing. Each task of an executor keeps its own account, in this process as in another one, and the
account is added to that of whoever waits for the task: a bound counts finished tasks, wherever they
ran.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
Result = TypeVar("Result")

log = logging.getLogger("dlo_casadi.work")


@dataclass
class Part:
    """What one named part of the work took, its own parts included.

    Parameters
    ----------
    calls, steps : int
    seconds : float
        Wall-clock time; parts that run in parallel all count in full.
    """

    calls: int = 0
    steps: int = 0
    seconds: float = 0.0
    parts: dict[str, "Part"] = field(default_factory=dict)

    def add(self, other: "Part") -> None:
        """Add what another account of the same work took, part by part."""
        self.calls += other.calls
        self.steps += other.steps
        self.seconds += other.seconds
        for name, part in other.parts.items():
            self.parts.setdefault(name, Part()).add(part)

    def rows(self, depth: int = 0) -> Iterator[tuple[int, str, "Part"]]:
        """All parts inside, each with its depth and name, the longest first."""
        for name, part in sorted(self.parts.items(), key=lambda item: -item[1].seconds):
            yield depth, name, part
            yield from part.rows(depth + 1)

    def tell(self) -> None:
        """Log a line for each part: what, how often, how many steps, how long."""
        for depth, name, part in self.rows():
            told = "  " * depth + name, part.calls, part.steps, part.seconds
            log.info("%-40s %4d x %6d steps %8.2f s", *told)


# Parts under way in this thread, the outermost first.
_under_way: ContextVar[list[Part]] = ContextVar("work")


def _open() -> list[Part]:
    """Parts under way; a thread that has none begins its own account."""
    parts = _under_way.get(None)
    if parts is None:
        _under_way.set(parts := [Part()])
    return parts


@contextmanager
def accounted() -> Iterator[Part]:
    """Account for the work inside alone; the account is complete at the end."""
    before = _under_way.set([Part()])
    try:
        yield _open()[0]
    finally:
        _under_way.reset(before)


@contextmanager
def part(name: str) -> Iterator[None]:
    """Account for the work inside as a part of this name."""
    parts, own, began = _open(), Part(1), time.perf_counter()
    parts.append(own)
    try:
        yield
    finally:
        own.seconds = time.perf_counter() - began
        parts.pop()
        parts[-1].parts.setdefault(name, Part()).add(own)
        parts[-1].steps += own.steps


def accounted_as(name: str) -> Callable[[Callable[P, Result]], Callable[P, Result]]:
    """Decorate a function whose work is a part of this name."""

    def decorated(function: Callable[P, Result]) -> Callable[P, Result]:
        @wraps(function)
        def counted(*args: P.args, **kwargs: P.kwargs) -> Result:
            with part(name):
                return function(*args, **kwargs)

        return counted

    return decorated


def spend(steps: int = 1) -> None:
    """Count steps."""
    _open()[-1].steps += steps


def add(work: Part) -> None:
    """Add the account of a finished task to the part under way."""
    own = _open()[-1]
    own.add(Part(0, work.steps, 0.0, work.parts))


def spent() -> int:
    """Steps counted so far in the present account."""
    return sum(part.steps for part in _open())


@dataclass(frozen=True)
class Bound:
    """A bound on work from now on: once it is met nothing more is begun.

    Parameters
    ----------
    steps : float
    begun : int
        Steps counted when the work began.
    """

    steps: float
    begun: int = field(default_factory=spent)

    @property
    def met(self) -> bool:
        """Whether that many steps have been counted."""
        return spent() - self.begun >= self.steps


UNBOUNDED = Bound(np.inf, 0)
