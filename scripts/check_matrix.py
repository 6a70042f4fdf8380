"""Every kind of session, all the way: check, fit, report, prediction, generated C.

    python scripts/check_matrix.py [--only FILTER] [--pairwise] [--jobs N] [--seed 0]
                                   [--output FILE]
    python scripts/check_matrix.py --only space-markers --keep FOLDER

Start {pinned, clamped} x end {pinned, clamped, free} x {plane, space} x {lines, markers,
photographs, rendered} x rest {straight, bowed: hardly curved, curved} x {unread, read: with
readings of force and moment} x {one, two, nine} poses x {once, again: one pose taken again}, all
that a configuration admits. FILTER is levels joined by dashes: `space-nine` is every kind with
both; --pairwise takes few kinds in which every two levels meet, and every way to hold a cable each
rest.

Each session is drawn from this toolkit's own model with nothing hidden: a fine mesh, noise,
fixtures and sensors off by draws from their tolerances. It goes through `dlo check`, a fit with
diagnosis, all files of results, terminal and notebook, `dlo predict` from the written results, and
the generated C, compiled, which must give Python's prediction to 1e-6 of the length. One line for
each: verdict, whether the 95 and the 99 % interval hold the true EI, seconds, what went wrong; at
the end tracebacks, half-written files, clean sessions that were refused or accused, fits with an
unstable pose, EI outside of its 99 % interval, and runs of more than three times the median
time of their kind. A session depends on the seed and its kind alone. The exit status is 1 if
anything but time is listed.

A session takes some ten seconds, with photographs of nine poses a minute.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import partial
from io import StringIO
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import options, run
from matplotlib import pyplot
from matrix.cells import CELLS, Cell, pairwise
from matrix.sessions import FULL, Session, Size, draw_session
from PIL import Image
from rich.console import Console
from scipy.special import stdtrit

import dlo_casadi as dlo
from dlo_casadi.api import Result
from dlo_casadi.cable.fitted_cable import Shape
from dlo_casadi.cli import main as command
from dlo_casadi.errors import DloError
from dlo_casadi.estimation.constrained import student_95, threshold
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.report.sections import print_summary
from dlo_casadi.report.terminal import candidate_table
from dlo_casadi.report.writer import OWNED
from dlo_casadi.runtime.parallel import generator_of

# Largest difference between the generated C and Python, as a share of the length.
APART = 1e-6
# Names of a clamp's direction in the plane and in space.
DIRECTIONS = ("heading", "orientation")
# Duration of a run, over the median of its kind, from which it is reported.
SLOW = 3.0
# Verdict that is right in a session with nothing hidden.
CLEAN = "complete"


@dataclass
class Row:
    """Result of one session."""

    name: str
    verdict: str = "none"
    added: list[str] = field(default_factory=list)
    inside_95: bool | None = None
    inside_99: bool | None = None
    error: float | None = None
    seconds: float = 0.0
    refused: str = ""
    traceback: str = ""
    halves: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    unstable: list[str] = field(default_factory=list)

    @property
    def accused(self) -> bool:
        """Whether something was found in a session with nothing hidden."""
        return not self.traceback and not self.refused and self.verdict != CLEAN

    def text(self) -> str:
        """One line, and below it what went wrong."""
        known = {True: "inside", False: "OUTSIDE", None: "-"}
        intervals = f"95 % {known[self.inside_95]}, 99 % {known[self.inside_99]}"
        found = "+".join(self.added)
        line = f"{self.name}: {self.verdict} {found}".rstrip()
        more = [f"refused: {self.refused}"] * bool(self.refused) + self.halves
        more += [self.traceback] * bool(self.traceback)
        more += [f"not stable: {', '.join(self.unstable)}"] * bool(self.unstable)
        if self.verdict == "unexplained":
            more += self.doubts
        return "\n    ".join([f"{line} | {intervals} | {self.seconds:.1f} s", *more])


class CommandError(Exception):
    """A command that ended in a traceback: its text."""


def run_cell(cell: Cell, size: Size, seed: int, keep: Path | None = None) -> Row:
    """Draw a session of a kind, and take it all the way."""
    row = Row(cell.name)
    with ExitStack() as stack:
        if keep is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dlo_matrix_")))
        else:
            folder = keep / cell.name
            folder.mkdir(parents=True, exist_ok=True)
        begin = time.perf_counter()
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("error")  # a warning of a library is a mistake of this package
        try:
            session = draw_session(cell, size, generator_of(seed, CELLS.index(cell)), folder)
            begin = time.perf_counter()
            take_through(session, folder / "results", row)
        except DloError as error:
            row.refused = str(error)
        except CommandError as error:
            row.traceback = str(error)
        except Exception:
            row.traceback = traceback.format_exc()
        finally:
            pyplot.close("all")
        row.seconds = time.perf_counter() - begin
    return row


def take_through(session: Session, results: Path, row: Row) -> None:
    """Check, fit, write, show, predict, generate; what is found goes to the row."""
    code, said = commanded("check", session.path)
    if code:
        row.refused = said
        return
    result = dlo.fit(session.path)
    row.verdict = str(result.verdict)
    row.added = [effect.name for effect in result.effects]
    row.doubts = list(result.doubts)
    fitted = zip(result.fit.problem.measured, result.fit.stable, strict=True)
    row.unstable = [item.pose.name for item, stable in fitted if not stable]
    judge_stiffness(result, session.stiffness, row)
    result.write(results)
    row.halves = list(missing_files(results, session, result))
    page = Console(file=StringIO(), width=100)
    print_summary(page, result)
    page.print(candidate_table(result))
    for shown in (str(result), result._repr_html_()):
        if not shown:
            row.halves.append("the notebook shows nothing")
    result.plot()
    compare_with_c(results, session, row)


def commanded(*words: str | Path) -> tuple[int, str]:
    """Exit code and output of a command of `dlo`; its traceback is raised."""
    out, errors = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(errors):
        code = command([str(word) for word in words])
    if "Traceback (most recent call last)" in errors.getvalue():
        raise CommandError(errors.getvalue())
    return code, out.getvalue() + errors.getvalue() if code == 0 else errors.getvalue()


def judge_stiffness(result: Result, true: float, row: Row) -> None:
    """Whether the intervals of EI hold the truth; a model that explains nothing has none.

    That of 99 % has the ends of the one of 95 % on a logarithmic scale, farther by what the profile
    is cut higher at.
    """
    estimate = result.stages[-1].parameters[BENDING_STIFFNESS]
    if estimate.interval_95 is None:
        return
    fit = result.fit
    cut, t_95 = np.sqrt(threshold(fit)) / fit.inflation, student_95(fit, BENDING_STIFFNESS)
    t_99 = stdtrit(fit.variance_degrees(BENDING_STIFFNESS), 0.995)
    wider = (cut + t_99 - t_95) / cut

    def inside(factor: float) -> bool:
        low, high = (None if x is None else np.log(x / estimate.value) for x in ends)
        off = np.log(true / estimate.value)
        return bool((low is None or factor * low <= off) and (high is None or off <= factor * high))

    ends = estimate.interval_95
    row.error = float(np.log(estimate.value / true))
    row.inside_95, row.inside_99 = inside(1.0), inside(wider)


def missing_files(results: Path, session: Session, result: Result) -> Iterator[str]:
    """Missing files of a folder of results, and drafts left in it."""
    present = {path.name for path in results.iterdir()}
    if present != set(OWNED):
        yield f"the folder holds {', '.join(sorted(present))}"
    report = json.loads((results / "report.json").read_text(encoding="utf-8"))
    if report["verdict"] != result.verdict or not report["stages"]:
        yield "report.json is not of this run"
    if not (results / "report.html").read_text(encoding="utf-8").rstrip().endswith("</html>"):
        yield "report.html has no end"
    experiment = session.document["experiment"]
    figures = {path.name for path in (results / "figures").glob("*.png")}
    wanted = {"poses.png", "residuals.png", "rest_curvature.png", "errors.png", "candidates.png"}
    if "force_std" in experiment["measurement"]:
        wanted.add("readings.png")
    straight = session.document["cable"]["rest_shape"] == "straight"
    measured = max(len(pose.points) for pose in result.poses if pose.role == "fit")
    if experiment["boundary"]["end"] == "free" and straight and measured >= 10:
        wanted.add("moment.png")
    if lost := wanted - figures:
        yield f"no {', '.join(sorted(lost))}"
    for path in (results / "figures").rglob("*.*"):
        with Image.open(path) as image:
            image.load()
    lines = {path.stem for path in (results / "centerlines").glob("*.csv")}
    if lost := {pose.name for pose in result.poses if len(pose.points)} - lines:
        yield f"no centre-lines of {', '.join(sorted(lost))}"


def compare_with_c(results: Path, session: Session, row: Row) -> None:
    """Predict the first pose from the written results, with Python and with the generated C."""
    pose = session.document["experiment"]["poses"][0]
    held = {
        key: pose[key]
        for key in ("start", "end", *(f"{s}_{k}" for s in ("start", "end") for k in DIRECTIONS))
        if key in pose
    }
    words: list[str | Path] = ["predict", results, "--figure", results.parent / "shape.png"]
    for key, value in held.items():
        words += [f"--{key.replace('_', '-')}", *map(repr, np.atleast_1d(value).tolist())]
    code, said = commanded(*words)
    if code:
        row.refused = said
        return
    code, said = commanded(*words[:2], *words[4:], "--json")
    predicted = dlo.predict(results, **held)
    if code or not np.allclose(json.loads(said)["points"], predicted.points):
        row.halves.append("dlo predict --json is not the prediction")
    apart = np.abs(solved_in_c(predicted) - predicted.equilibrium.points).max()
    if not apart <= APART * predicted.curve.length:
        row.halves.append(f"the generated C is {apart:.2g} m from Python's prediction")


def solved_in_c(predicted: Shape) -> np.ndarray:
    """Nodes (n + 1, d) [m] of the same pose by the generated C, compiled."""
    solver = predicted.cable.compile(flags=("-O0",))  # compiles quickly
    return solver.solve(predicted.pose).points


def matching(cells: Sequence[Cell], levels: str) -> list[Cell]:
    """Cells with all of some levels, which stand in the order of a name."""
    found = []
    for cell in cells:
        rest = iter(cell)
        if all(level in rest for level in levels.split("-")):
            found.append(cell)
    return found


def summary(rows: Sequence[Row]) -> list[str]:
    """What is wrong, each kind of it with its sessions."""
    kinds = defaultdict(list)
    for row in rows:
        _, _, frame, measured, _, _, poses, _ = row.name.split("-")
        kinds[frame, measured, poses].append(row)
    slow = []
    for same in kinds.values():
        usual = float(np.median([row.seconds for row in same]))
        slow += [f"{r.name} ({r.seconds:.0f} s)" for r in same if r.seconds > SLOW * usual]
    listed = {
        "ended in a traceback": [row.name for row in rows if row.traceback],
        "left half of the results": [row.name for row in rows if row.halves],
        "clean and refused": [row.name for row in rows if row.refused],
        "clean and accused": [f"{row.name} ({row.verdict})" for row in rows if row.accused],
        "with a pose whose equilibrium is not stable": [r.name for r in rows if r.unstable],
        "with EI outside of its 99 % interval": [r.name for r in rows if r.inside_99 is False],
        f"slower than {SLOW:g} times the median of their kind": slow,
    }
    known = [row for row in rows if row.inside_95 is not None]
    lines = [
        f"{len(rows)} sessions; of {len(known)} EI lies in the 95 % interval in "
        f"{sum(bool(row.inside_95) for row in known)}, in that of 99 % in "
        f"{sum(bool(row.inside_99) for row in known)}"
    ]
    for what, names in listed.items():
        lines += [f"{len(names)} {what}", *(f"  {name}" for name in names)]
    return lines


def main() -> int:
    """Run the sessions; 1 if there is anything to mend."""
    parser = options(__doc__, seed=0, jobs=True, output=True)
    parser.add_argument("--only", default="", metavar="FILTER", help="levels, joined by dashes")
    parser.add_argument("--pairwise", action="store_true", help="few that hold all pairs of levels")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="sessions and results stay there"
    )
    args = parser.parse_args()
    cells = list(pairwise() if args.pairwise else CELLS)
    cells = matching(cells, args.only) if args.only else cells
    if not cells:
        parser.error(f"no kind of session has the levels {args.only}, in this order")
    work = partial(run_cell, size=FULL, seed=args.seed, keep=args.keep)
    found = run(work, cells, args, lambda cell, row, seconds: row.text())
    print(*summary(found), sep="\n")
    bad = any(r.traceback or r.halves or r.refused or r.accused or r.unstable for r in found)
    return int(bad or any(row.inside_99 is False for row in found))


if __name__ == "__main__":
    sys.exit(main())
