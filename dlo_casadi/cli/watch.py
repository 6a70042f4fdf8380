"""How far a run has come: live on a terminal, line by line elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

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

# Without a terminal: no more than one line in so many seconds about a part that is under way.
PATIENCE = 10.0


@dataclass
class Shown:
    """Where progress is shown, unless it is `quiet`: not on the console of the results.

    Those can then be redirected alone.
    """

    console: Console
    quiet: bool = False
    bars: Progress | None = field(default=None, init=False)
    spoken: float = field(default=0.0, init=False)

    def begin(self, *columns: ProgressColumn) -> None:
        """Begin a bar with these columns, if this is a terminal."""
        self.spoken = time.perf_counter()
        if not self.quiet and self.console.is_terminal:
            self.bars = Progress(*columns, console=self.console)
            self.bars.start()

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

    def __enter__(self) -> Watch:
        self.begin(
            SpinnerColumn(finished_text="+"),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[detail]}", markup=False),
            TimeElapsedColumn(),
            TextColumn("left, at most:"),
            TimeRemainingColumn(),
        )
        return self

    def step(self, name: str, done: int, total: int) -> None:
        """`done` of `total` parts of the named work are finished."""
        signals.check()
        name, detail = ("read the poses", name[5:]) if name.startswith("read ") else (name, "")
        first = name not in self._begun
        begun = self._begun.setdefault(name, time.perf_counter())
        self.spoken = max(self.spoken, begun)
        if self.quiet:
            return
        if self.bars is not None:
            if first:
                self._tasks[name] = self.bars.add_task(name, total=total, detail="")
            self.bars.update(self._tasks[name], completed=done, total=total, detail=detail)
        else:
            self._speak(name, done, total, time.perf_counter() - begun)

    def _speak(self, name: str, done: int, total: int, seconds: float) -> None:
        now = time.perf_counter()
        if done >= total:
            self.console.print(f"{name}: {seconds:.1f} s", highlight=False)
        elif done and now - self.spoken > PATIENCE:
            left = seconds * (total - done) / done
            self.console.print(
                f"{name}: {done} of {total}, at most {left:.0f} s left", highlight=False
            )
        else:
            return
        self.spoken = now

    def warn(self, warnings: Sequence[str]) -> None:
        """What a run that may take long should have been told before; its report repeats it."""
        for text in warnings:
            self.message(f"warning: {text}")
