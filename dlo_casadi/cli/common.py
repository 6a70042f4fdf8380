"""Common parts of the subcommands: options, format of the help, output, and progress."""

import argparse
import json
import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import wraps
from inspect import getdoc
from pathlib import Path
from textwrap import indent
from typing import Any, Self

from rich.console import Console
from rich.markup import escape
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

from dlo_casadi.cli import EXIT_CODES, OK, signals
from dlo_casadi.config import Config, load_config
from dlo_casadi.errors import ConfigError, DloError, counted
from dlo_casadi.io.files import finite
from dlo_casadi.runtime.parallel import Tally

# Endings of figures' names.
DRAWN = (".png", ".pdf", ".svg", ".jpg")
# Shortest interval between two lines about the same part, without a terminal [s].
PATIENCE = 10.0

# Function that adds an option to a parser or a group.
Option = Callable[[Any], object]


def option(*names: str, **settings: Any) -> Option:
    """An argument of `argparse`."""
    return lambda parser: parser.add_argument(*names, **settings)


def one_of(*options: Option, required: bool = False) -> Option:
    """Make a group of mutually exclusive options."""

    def add(parser: Any) -> None:
        group = parser.add_mutually_exclusive_group(required=required)
        for item in options:
            item(group)

    return add


def jobs(default: int = 1) -> Option:
    """`--jobs`."""
    text = "number of processes; default %(default)s"
    return option("--jobs", type=_positive, default=default, metavar="N", help=text)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: a number of processes, 1 or more")
    return int(text)


def figure(what: str) -> Option:
    """`--figure`, the name of a file that can be drawn."""
    text = f"{what}: {', '.join(DRAWN)}"
    return option("--figure", type=_drawn, metavar="FILE", help=text)


def _drawn(text: str) -> Path:
    if Path(text).suffix.lower() not in DRAWN:
        raise DloError(f"--figure {text}: the name must end in {', '.join(DRAWN)}")
    return Path(text)


CONFIG = option("config", type=Path, help="configuration, such as configs/cable.yaml")
PARAMETERS = option("parameters", type=Path, help="parameters.yaml of a fit, or its folder")
SCHEDULER = option("--scheduler", metavar="ADDRESS", help="of a Dask cluster, instead")


def command(
    *options: Option, codes: str = "", json: str | None = "print JSON instead of tables"
) -> Callable[[Callable[[argparse.Namespace], int | None]], Callable[[Sequence[str]], int]]:
    """Make a subcommand from the function of the same name: from arguments to exit code.

    Its docstring is the help: a description and, after an empty line, examples, one command a line.
    A `CONFIG` among the options is loaded before the call.

    Parameters
    ----------
    options : Option
        In the order of the help.
    codes : str
        Meaning of the exit codes, if they differ from those of every command.
    json : str or None
        Help of `--json`, which is added with `--quiet`; neither is added if None.
    """
    if json is not None:
        quiet = option("--quiet", action="store_true", help="print nothing but errors")
        options = (*options, quiet, option("--json", action="store_true", help=json))

    def decorate(work: Callable[[argparse.Namespace], int | None]) -> Callable[..., int]:
        @wraps(work)
        def run(argv: Sequence[str]) -> int:
            description, _, examples = str(getdoc(work)).partition("\n\n")
            epilog = (
                f"examples:\n{indent(examples, '  ')}\n\n{EXIT_CODES}{'; ' * bool(codes)}{codes}"
            )
            parser = argparse.ArgumentParser(
                prog=f"dlo {work.__name__.strip('_').replace('_', '-')}",
                description=description,
                epilog=epilog,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
            for item in options:
                item(parser)
            chosen = parser.parse_args(plain_numbers(argv))
            if "config" in chosen:
                chosen.config = configuration(chosen.config)
            return work(chosen) or OK

        return run

    return decorate


def plain_numbers(argv: Sequence[str]) -> list[str]:
    """Write -1e-2 as -0.01: argparse takes the former for an option."""
    number = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
    return [f"{Decimal(text):f}" if number.fullmatch(text) else text for text in argv]


def configuration(path: Path) -> Config:
    """Load a configuration; for a folder, list the configurations it holds."""
    if os.path.isdir(path):
        found = [str(file) for file in sorted(path.glob("*.y*ml"))[:5]]
        hint = ", ".join(found) or "a YAML file, such as configs/cable.yaml"
        many = f"; all in it and below: dlo fit-many {path}" if found else ""
        raise ConfigError(f"a folder is no configuration.\n  Try: {hint}{many}", path)
    return load_config(path)


class Page(Console):
    """Destination of results: JSON only with `--json`, otherwise text, unless `--quiet`."""

    def __init__(self, chosen: argparse.Namespace) -> None:
        width = None if sys.stdout.isatty() else 120  # a file or a pipe has room for a whole table
        quiet = chosen.quiet or chosen.json
        super().__init__(quiet=quiet, highlight=False, emoji=False, width=width)
        self.as_json: bool = chosen.json

    def data(self, data: Any) -> None:
        """Print plain data as JSON, if requested; numbers that are not finite as null."""
        if self.as_json:
            print(json.dumps(finite(data), indent=1, allow_nan=False))

    def say(self, text: object, mark: str = "") -> None:
        """Print a line unchanged, however long, after a mark with markup."""
        self.print(f"{mark}{escape(str(text))}", soft_wrap=True)

    def warn(self, text: str) -> None:
        """Print a warning."""
        self.say(text, "[bold yellow]warning:[/] ")


# ---- progress: live on a terminal, otherwise line by line ---------------------------------------


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
        signals.check()
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
