"""The commands; the only module that prints or exits."""

from __future__ import annotations

import argparse
import json
import re
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from dlo_casadi.config import load_config
from dlo_casadi.errors import DloError
from dlo_casadi.predict import PredictedShape, predict
from dlo_casadi.report.drawing import draw_prediction
from dlo_casadi.report.terminal import prediction_table, print_summary
from dlo_casadi.report.writer import ResultsFolder
from dlo_casadi.session import run_session

OK, UNEXPECTED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
DRAWN = (".png", ".pdf", ".svg", ".jpg")


# ---- fit ---------------------------------------------------------------------------------------


def main_fit(argv: Sequence[str] | None = None) -> int:
    """Run `fit.py CONFIG [--output DIR] [--quiet] [--no-diagnosis]`; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="fit.py",
        description="Fit a cable to its photographs or centre-lines and report what was found.",
        epilog="Exit codes: 0 done, 2 bad input, 130 interrupted (earlier results are kept).",
    )
    parser.add_argument("config", type=Path, help="configuration, such as configs/cable.yaml")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder of the results; default results/<config name>/",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument(
        "--no-diagnosis", action="store_true", help="do not search for missing effects"
    )
    arguments = parser.parse_args(argv)
    return _guarded(lambda: _fit(arguments), "earlier results are as they were")


def _fit(arguments: argparse.Namespace) -> None:
    config = load_config(arguments.config)
    if arguments.no_diagnosis:
        diagnosis = config.diagnosis.model_copy(update={"enabled": False})
        config = replace(config, diagnosis=diagnosis)
    output = arguments.output or Path("results") / config.name
    console = _console(quiet=arguments.quiet)
    with ResultsFolder(output) as folder, Watch(Console(stderr=True), arguments.quiet) as watch:
        outcome = run_session(config, watch)
        watch.step("write the results", 0, 1)
        folder.write(outcome)
        watch.step("write the results", 1, 1)
    print_summary(console, outcome)
    console.print(f"Results: {output}", soft_wrap=True)


@dataclass
class Watch:
    """Shows how far a run has come: live on a terminal, line by line elsewhere.

    Parameters
    ----------
    console : Console
        Not the one of the results, so that those can be redirected alone.
    quiet : bool
    """

    console: Console
    quiet: bool = False
    _bars: Progress | None = None
    _tasks: dict[str, TaskID] = field(default_factory=dict)
    _begun: dict[str, float] = field(default_factory=dict)

    def __enter__(self) -> Watch:
        if not self.quiet and self.console.is_terminal:
            self._bars = Progress(
                SpinnerColumn(finished_text="+"),
                TextColumn("{task.description}"),
                BarColumn(bar_width=24),
                TextColumn("{task.fields[detail]}"),
                TimeElapsedColumn(),
                console=self.console,
            )
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def step(self, name: str, done: int, total: int) -> None:
        """`done` of `total` parts of the named work are finished."""
        _signals.check()
        name, detail = ("read the poses", name[5:]) if name.startswith("read ") else (name, "")
        first = name not in self._begun
        begun = self._begun.setdefault(name, time.perf_counter())
        if self.quiet:
            return
        if self._bars is not None:
            if first:
                self._tasks[name] = self._bars.add_task(name, total=total, detail="")
            self._bars.update(self._tasks[name], completed=done, total=total, detail=detail)
        elif done >= total:
            seconds = time.perf_counter() - begun
            self.console.print(f"{name}: {seconds:.1f} s", highlight=False)

    def message(self, text: str) -> None:
        """Something worth a line."""
        if not self.quiet:
            self.console.print(text, highlight=False)


# ---- predict -----------------------------------------------------------------------------------


def main_predict(argv: Sequence[str] | None = None) -> int:
    """Run `predict.py PARAMETERS --end X Y [...]`; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="predict.py",
        description="Predict the shape of a fitted cable from where its ends are held.",
        epilog="Exit codes: 0 done, 2 bad input or no equilibrium.",
    )
    parser.add_argument("parameters", type=Path, help="parameters.yaml or its folder")
    for side, remark in (("end", "; not for a free end"), ("start", "")):
        parser.add_argument(
            f"--{side}",
            nargs=2,
            type=float,
            metavar=("X", "Y"),
            help=f"where the {side} is held [m]{remark}",
        )
    parser.add_argument("--start-heading", type=float, metavar="R", help="clamped start [rad]")
    parser.add_argument("--end-heading", type=float, metavar="R", help="clamped end [rad]")
    parser.add_argument("--branch", choices=("ccw", "cw"), help="which way the cable turns")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument("--figure", type=Path, metavar="FILE", help=f"draw it: {', '.join(DRAWN)}")
    arguments = parser.parse_args(_plain_numbers(sys.argv[1:] if argv is None else argv))
    return _guarded(lambda: _predict(arguments), "nothing was written")


def _predict(arguments: argparse.Namespace) -> None:
    figure = arguments.figure
    if figure is not None and figure.suffix.lower() not in DRAWN:
        raise DloError(f"--figure {figure}: the name must end in {', '.join(DRAWN)}")
    shape = predict(
        arguments.parameters,
        arguments.end,
        start=arguments.start,
        start_heading=arguments.start_heading,
        end_heading=arguments.end_heading,
        branch=arguments.branch,
    )
    if figure is not None:
        try:
            draw_prediction(figure, shape.as_dict())
        except OSError as error:
            raise DloError(f"--figure {figure}: cannot be written: {error.strerror}") from None
    if arguments.json:
        print(json.dumps(shape.as_dict(), indent=1, allow_nan=False))
        return
    console = _console()
    console.print(prediction_table(shape.as_dict(), _notes(shape)))
    if figure is not None:
        console.print(f"Figure: {figure}", soft_wrap=True)


def _notes(shape: PredictedShape) -> list[str]:
    """What a reader of the prediction should know of the file it came from."""
    metadata, notes = shape.cable.metadata, []
    if metadata.edited:
        notes.append("note: the model in this file was changed after it had been fitted")
    if metadata.identifiable is False:
        notes.append(
            "note: the shapes did not determine the bending stiffness; the shape is more certain "
            "than forces and energy"
        )
    return notes


_NEGATIVE = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def _plain_numbers(argv: Sequence[str]) -> list[str]:
    """Write -1e-2 as -0.01: argparse takes the former for an option."""
    return [
        np.format_float_positional(float(text), trim="0") if _NEGATIVE.fullmatch(text) else text
        for text in argv
    ]


# ---- both --------------------------------------------------------------------------------------


def _console(quiet: bool = False) -> Console:
    """Where results go; a file or a pipe has room for a whole table."""
    width = None if sys.stdout.isatty() else 120
    return Console(quiet=quiet, highlight=False, width=width)


def _guarded(work: Callable[[], None], kept: str) -> int:
    """Run a command and turn what goes wrong into a message and an exit code."""
    errors = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
    # SIGINT, too: a shell may have started the command with it ignored.
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    _signals.received = False
    try:
        for number in before:
            signal.signal(number, _signals.interrupt)
        work()
    except DloError as error:
        errors.print(f"{type(error).__name__}: {error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        errors.print(f"interrupted; {kept}")
        return INTERRUPTED
    except Exception:
        errors.print(traceback.format_exc())
        errors.print("This is a bug. Please report it with the lines above and your configuration.")
        return UNEXPECTED
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return OK


class _Signals:
    """Whether a signal has come: a library underneath may swallow the exception that it raises."""

    def __init__(self) -> None:
        self.received = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        self.received = True
        raise KeyboardInterrupt

    def check(self) -> None:
        """Raise what has been swallowed."""
        if self.received:
            raise KeyboardInterrupt


_signals = _Signals()
