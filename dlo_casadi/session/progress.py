"""How far a run has come, and where its time went."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol


class Progress(Protocol):
    """Who wants to know how far a run has come."""

    def step(self, name: str, done: int, total: int) -> None:
        """`done` of `total` parts of the named work are finished."""

    def message(self, text: str) -> None:
        """Something worth a line."""


@dataclass
class Silent:
    """Progress that nobody watches."""

    lines: list[str] = field(default_factory=list)

    def step(self, name: str, done: int, total: int) -> None:
        """Ignore."""

    def message(self, text: str) -> None:
        """Keep the line."""
        self.lines.append(text)


class Clock:
    """Wall-clock time per part of the run; parts that run beside one another both count."""

    def __init__(self) -> None:
        self._begin = time.perf_counter()
        self.parts: dict[str, float] = {}
        self._last = self._begin

    def lap(self, name: str) -> None:
        """Add the time since the last lap to the named part."""
        now = time.perf_counter()
        self.parts[name] = self.parts.get(name, 0.0) + now - self._last
        self._last = now

    def add(self, name: str, seconds: float) -> None:
        """Add the time [s] that a named part has taken beside others."""
        self.parts[name] = self.parts.get(name, 0.0) + seconds

    def total(self) -> dict[str, float]:
        """All parts and the total [s]."""
        parts = {key: self.parts.get(key, 0.0) for key in TIMED}
        return {**parts, "total": time.perf_counter() - self._begin}


TIMED = ("vision", "algorithm1", "batch", "diagnosis")
