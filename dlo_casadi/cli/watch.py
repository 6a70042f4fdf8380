"""How far a run has come: live on a terminal, line by line elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from dlo_casadi.cli.guard import signals
from dlo_casadi.errors import counted
from dlo_casadi.runtime.parallel import Tally

# Without a terminal: no more than one line in so many seconds about a part that is under way.
PATIENCE = 10.0


@dataclass
class Shown:
    """Shows progress, unless it is `quiet`: not on the console of the results.

    Those can then be redirected alone.
    """

    console: Console = field(default_factory=lambda: Console(stderr=True))
    quiet: bool = False
    bars: Progress | None = field(default=None, init=False)
    spoken: float = field(default=0.0, init=False)

    def columns(self) -> Sequence[ProgressColumn]:
        """Columns of a bar on a terminal."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        self.spoken = time.perf_counter()
        if not self.quiet and self.console.is_terminal:
            self.bars = Progress(*self.columns(), console=self.console)
            self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.bars is not None:
            self.bars.stop()

    def message(self, text: str) -> None:
        """Something worth a line."""
        if not self.quiet:
            self.console.print(text, highlight=False, markup=False, soft_wrap=True)


@dataclass
class Watch(Shown):
    """Shows how far a run has come, and how long its part will take at most.

    The remaining time is that of the named part, from the pace of what is done; a part that is
    one piece has none.
    """

    _tasks: dict[str, TaskID] = field(default_factory=dict)
    _begun: dict[str, float] = field(default_factory=dict)

    def columns(self) -> Sequence[ProgressColumn]:
        """Name, bar and times of a part."""
        return (
            SpinnerColumn(finished_text="+"),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[detail]}", markup=False),
            TimeElapsedColumn(),
            TextColumn("left, at most:"),
            TimeRemainingColumn(),
        )

    def step(self, name: str, done: int, total: int) -> None:
        """`done` of `total` parts of the named work are finished."""
        signals.check()
        name, detail = ("read the poses", name[5:]) if name.startswith("read ") else (name, "")
        now = time.perf_counter()
        begun = self._begun.setdefault(name, now)
        self.spoken = max(self.spoken, begun)
        if self.quiet:
            return
        if self.bars is not None:
            if name not in self._tasks:
                self._tasks[name] = self.bars.add_task(name, total=total, detail="")
            self.bars.update(self._tasks[name], completed=done, total=total, detail=detail)
        elif done >= total:
            self.message(f"{name}: {now - begun:.1f} s")
            self.spoken = now
        elif done and now - self.spoken > PATIENCE:
            left = (now - begun) * (total - done) / done
            self.message(f"{name}: {done} of {total}, at most {left:.0f} s left")
            self.spoken = now

    def warn(self, warnings: Sequence[str]) -> None:
        """What a run that may take long should have been told before; its report repeats it."""
        for text in warnings:
            self.message(f"warning: {text}")


@dataclass
class Counter(Shown):
    """Shows how far many equal tasks have come, and between which times the rest will take.

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

    def columns(self) -> Sequence[ProgressColumn]:
        """A bar, its text and its time."""
        return BarColumn(bar_width=30), TextColumn("{task.description}"), TimeElapsedColumn()

    def show(self, tally: Tally) -> None:
        """Show how far the tasks have come."""
        signals.check()
        if self.quiet:
            return
        now, text = time.perf_counter(), self._text(tally)
        if self.bars is not None:
            task = self.bars.task_ids[0] if self.bars.task_ids else self.bars.add_task(self.noun)
            self.bars.update(task, completed=tally.done, total=tally.total, description=text)
        elif tally.done == tally.total or now - self.spoken > PATIENCE:
            self.message(f"{text}; {duration(tally.elapsed)} so far")
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
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
