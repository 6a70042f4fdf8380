"""Show the progress of a run: live on a terminal, otherwise line by line."""

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

from dlo_casadi.cli import signals
from dlo_casadi.errors import counted
from dlo_casadi.runtime.parallel import Tally

# Shortest interval between two lines about the same part, without a terminal [s].
PATIENCE = 10.0


@dataclass
class Shown:
    """Shows progress, unless it is `quiet`, on another console than the results.

    Results can therefore be redirected alone.
    """

    console: Console = field(default_factory=lambda: Console(stderr=True))
    quiet: bool = False
    bars: Progress | None = field(default=None, init=False)
    spoken: float = field(default=0.0, init=False)
    _tasks: dict[str, TaskID] = field(default_factory=dict, init=False)

    def columns(self) -> Sequence[ProgressColumn | str]:
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
        """Show a message on its own line."""
        if not self.quiet:
            self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def update(
        self, part: str, done: int, total: int | None, line: str, description: str, detail: str = ""
    ) -> None:
        """Move the bar of a part, or print a line at its end and occasionally before."""
        if self.bars is not None:
            if part not in self._tasks:
                self._tasks[part] = self.bars.add_task(part, detail="")
            bar = self._tasks[part]
            self.bars.update(bar, completed=done, total=total, description=description)
            self.bars.update(bar, detail=detail)
        elif done == total or (done and time.perf_counter() - self.spoken > PATIENCE):
            self.message(line)
            self.spoken = time.perf_counter()


@dataclass
class Watch(Shown):
    """Shows the progress of a run, and the longest time that its current part will take.

    The remaining time is extrapolated from the progress of the named part; a part that reports no
    progress has none.
    """

    _begun: dict[str, float] = field(default_factory=dict)

    def columns(self) -> Sequence[ProgressColumn | str]:
        """Name, bar and times of a part."""
        detail = TextColumn("{task.fields[detail]}", markup=False)
        left = "left, at most:", TimeRemainingColumn()
        ended = SpinnerColumn(finished_text="+")
        return ended, "{task.description}", BarColumn(24), detail, TimeElapsedColumn(), *left

    def step(self, name: str, done: int, total: int) -> None:
        """Report that `done` of `total` parts of the named work are finished."""
        signals.check()
        name, detail = ("read the poses", name[5:]) if name.startswith("read ") else (name, "")
        now = time.perf_counter()
        begun = self._begun.setdefault(name, now)
        self.spoken = max(self.spoken, begun)
        line = f"{name}: {now - begun:.1f} s"
        if done < total:
            left = (now - begun) * (total - done) / max(done, 1)
            line = f"{name}: {done} of {total}, at most {left:.0f} s left"
        self.update(name, done, total, line, name, detail)

    def warn(self, warnings: Sequence[str]) -> None:
        """Print warnings before a run that may take long; its report repeats them."""
        for text in warnings:
            self.message(f"warning: {text}")


@dataclass
class Counter(Shown):
    """Shows the progress of many equal tasks, and an interval of the remaining time.

    Parameters
    ----------
    noun : str
        Noun of the counted things.
    size : int
        Number of things in a task.
    count : int, optional
        Number of all things: the last task may have fewer.
    """

    noun: str = "task"
    size: int = 1
    count: int | None = None

    def columns(self) -> Sequence[ProgressColumn | str]:
        """A bar, its text and its time."""
        return BarColumn(30), "{task.description}", TimeElapsedColumn()

    def show(self, tally: Tally) -> None:
        """Show the progress of the tasks."""
        signals.check()
        text = self._text(tally)
        line = f"{text}; {duration(tally.elapsed)} so far"
        self.update(self.noun, tally.done, tally.total, line, text)

    def _text(self, tally: Tally) -> str:
        done, total = self.size * tally.done, self.size * (tally.total or tally.done)
        if self.count is not None and tally.total is not None:
            # An earlier run may have finished the tasks that are not counted.
            earlier = -(-self.count // self.size) - tally.total
            done, total = min(done + self.size * earlier, self.count), self.count
        text = f"{done:,} of {counted(total, self.noun, ',')}".replace(",", " ")
        if tally.failed:
            text += f", {tally.failed} lost"
        if tally.remaining is not None and tally.done != tally.total:
            low, high = (duration(seconds) for seconds in tally.remaining)
            text += f", {low} left" if low == high else f", {low} to {high} left"
        return text


def duration(seconds: float) -> str:
    """A duration in words, rounded: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
