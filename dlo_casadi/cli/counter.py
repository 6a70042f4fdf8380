"""How far many equal tasks have come, and between which times the rest will take."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from dlo_casadi.cli.guard import signals
from dlo_casadi.errors import counted
from dlo_casadi.runtime.parallel import Tally

# Without a terminal: no more than one line in so many seconds.
_PATIENCE = 10.0


@dataclass
class Counter:
    """Shows a tally: a bar on a terminal, a line now and then elsewhere.

    Parameters
    ----------
    console : Console
        Not the one of the results.
    noun : str
        What is counted.
    quiet : bool
    size : int
        How many of them a task holds.
    count : int, optional
        All of them: the last task may hold fewer.
    """

    console: Console
    noun: str
    quiet: bool = False
    size: int = 1
    count: int | None = None
    _bar: Progress | None = None
    _task: TaskID | None = None
    _spoken: float = 0.0

    def __enter__(self) -> Counter:
        self._spoken = time.perf_counter()
        if not self.quiet and self.console.is_terminal:
            self._bar = Progress(
                BarColumn(bar_width=30),
                TextColumn("{task.description}"),
                TimeElapsedColumn(),
                console=self.console,
            )
            self._task = self._bar.add_task(self.noun, total=None)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, tally: Tally) -> None:
        """Show how far the tasks have come."""
        signals.check()
        if self.quiet:
            return
        now = time.perf_counter()
        if self._bar is not None and self._task is not None:
            text = self._text(tally)
            self._bar.update(self._task, completed=tally.done, total=tally.total, description=text)
        elif tally.done == tally.total or now - self._spoken > _PATIENCE:
            self.message(f"{self._text(tally)}; {duration(tally.elapsed)} so far")
            self._spoken = now

    def message(self, text: str) -> None:
        """Something worth a line."""
        if not self.quiet:
            self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    def _text(self, tally: Tally) -> str:
        done, total = self.size * tally.done, self.size * (tally.total or tally.done)
        if self.count is not None:
            done, total = min(done, self.count), self.count
        text = f"{done:,} of {counted(total, self.noun, ',')}".replace(",", " ")
        if tally.failed:
            text += f", {tally.failed} lost"
        if tally.remaining is not None and tally.done != tally.total:
            low, high = (duration(seconds) for seconds in tally.remaining)
            text += f", {low} left" if low == high else f", {low} to {high} left"
        return text


def duration(seconds: float) -> str:
    """As precise as one needs it: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
