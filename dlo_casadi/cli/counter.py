"""How far many equal tasks have come, and between which times the rest will take."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

from dlo_casadi.cli.guard import signals
from dlo_casadi.cli.watch import PATIENCE, Shown
from dlo_casadi.errors import counted
from dlo_casadi.runtime.parallel import Tally


@dataclass
class Counter(Shown):
    """Shows a tally: a bar on a terminal, a line now and then elsewhere.

    Parameters
    ----------
    noun : str
        What is counted.
    size : int
        How many of them a task holds.
    count : int, optional
        All of them: the last task may hold fewer.
    """

    noun: str = "task"
    size: int = 1
    count: int | None = None

    def __enter__(self) -> Counter:
        self.begin(BarColumn(bar_width=30), TextColumn("{task.description}"), TimeElapsedColumn())
        return self

    def show(self, tally: Tally) -> None:
        """Show how far the tasks have come."""
        signals.check()
        if self.quiet:
            return
        now = time.perf_counter()
        if self.bars is not None:
            task = self.bars.task_ids[0] if self.bars.task_ids else self.bars.add_task(self.noun)
            text = self._text(tally)
            self.bars.update(task, completed=tally.done, total=tally.total, description=text)
        elif tally.done == tally.total or now - self.spoken > PATIENCE:
            self.message(f"{self._text(tally)}; {duration(tally.elapsed)} so far")
            self.spoken = now

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
