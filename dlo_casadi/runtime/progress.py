"""What long work tells of its progress."""

from collections.abc import Callable
from typing import Protocol

Step = Callable[[str, int, int], None]
"""Told what is done, how much of it is done, and how much there is."""


class Progress(Protocol):
    """Receiver of the progress of long work."""

    def step(self, name: str, done: int, total: int) -> None:
        """Report that `done` of `total` parts of the named work are finished.

        With a method `warn` (texts) besides, likely mistakes are told before the fits.
        """


def nobody(*_: object) -> None:
    """Receive progress that nobody wants to see."""
