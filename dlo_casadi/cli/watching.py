"""`dlo watch`: a fitted cable is tracked through poses that arrive."""

import argparse
import json
import time
from collections import deque
from pathlib import Path
from typing import Any

from dlo_casadi.cable.file import load
from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.cable.watch import Watched
from dlo_casadi.cli import signals
from dlo_casadi.cli.common import PARAMETERS, Page, command, option
from dlo_casadi.cli.fitted import named
from dlo_casadi.errors import DloError, counted
from dlo_casadi.io.files import only_run, write_file
from dlo_casadi.tracking.inquiry import Change

# Poses on the page, and the shortest time [s] between two of its versions.
_SHOWN, _REFRESHED = 100, 1.0
_PAGE = "watch.html"


@command(
    PARAMETERS,
    option(
        "source",
        type=Path,
        help="a folder into which files of poses are written (JSON or YAML, keys as in a session), "
        "or a CSV that grows: pose,s_m,x_m,y_m,end_x_m,end_y_m,...",
    ),
    option("--std", type=float, metavar="M", help="noise of a coordinate [m]; the fit's without"),
    option("--force-std", type=float, metavar="N", help="noise of a force; not used without"),
    option("--moment-std", type=float, metavar="NM", help="noise of a moment; not used without"),
    option(
        "--correlated", type=float, metavar="M", help="of a line's noise [m]; the fit's without"
    ),
    option("--forget", type=float, default=1.0, metavar="X", help="share kept from pose to pose"),
    option("--drift", nargs="+", metavar="NAME=STD", help="parameters that walk at random, a pose"),
    option("--compiled", action="store_true", help="compile the equilibria (needs a C compiler)"),
    option("--once", action="store_true", help="stop when all that is there is read"),
    option("--again", action="store_true", help="begin anew, not where an earlier run has ended"),
    option("--into", type=Path, metavar="FOLDER", help="for state and page; watch/ of the fit"),
    option("--interval", type=float, default=0.2, metavar="S", help="between two looks [s]"),
    codes="2 is also a source that is not there",
    json="print a line of JSON for each pose",
)
def watch(chosen: argparse.Namespace) -> None:
    """Track a fitted cable through poses that arrive: a line for each, changes, and a page.

    dlo watch results/rope poses/
    dlo watch results/rope poses.csv --std 4e-4 --once
    dlo watch results/rope poses/ --json | your_program
    """
    if not 0 < chosen.interval < 3600:
        raise DloError(f"--interval {chosen.interval:g}: seconds between two looks belong here")
    cable = load(chosen.parameters)
    given = chosen.parameters
    beside = given if given.is_dir() else given.parent
    into = chosen.into or beside / "watch"
    known = _noise(beside)
    if not (chosen.std or known):
        raise DloError(
            f"the noise of the points is not known: {beside / 'report.json'} does not tell it.\n"
            "  Try: --std 4e-4 [m]"
        )
    settings: dict[str, Any] = {
        "std": chosen.std or known.get("std"),
        "correlated": known.get("along", 0.0) if chosen.correlated is None else chosen.correlated,
        "force_std": chosen.force_std,
        "moment_std": chosen.moment_std,
        "forget": chosen.forget,
        "drift": named("drift", chosen),
        "compiled": chosen.compiled,
    }
    with only_run(into):
        watched = Watched(cable, chosen.source, into, settings, again=chosen.again)
        page, shown = Page(chosen), _Shown(chosen.source, into)
        if watched.tracker.count:
            page.say(f"{into}: going on after {counted(watched.tracker.count, 'pose')}")
        page.say(f"page: {into / _PAGE}")
        try:
            while True:
                for line in watched.arrived(last=chosen.once):
                    signals.check()
                    if chosen.json:
                        print(json.dumps(line), flush=True)
                    said = _said(line)
                    page.say(f"{line['pose']}: {said}")
                    shown.add(line, said)
                    shown.write(watched)
                shown.write(watched, last=True)
                if chosen.once:
                    break
                signals.check()
                time.sleep(chosen.interval)
        finally:
            watched.close()


def _noise(folder: Path) -> dict[str, float]:
    """Noise of the fit's points, and its correlation length [m]; empty if that is not known."""
    try:
        found = json.loads((folder / "report.json").read_text("utf-8"))["measurement"]
        return {"std": float(found["std"]), "along": float(found["correlation_length_m"] or 0.0)}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _said(line: dict[str, Any]) -> str:
    """What a line tells, in words."""
    if line["problem"]:
        return f"skipped: {' '.join(line['problem'].split())}"
    text = f"{1e3 * line['rms']:.3g} mm off, p = {line['probability']:.2g}"
    text += ", refused" * line["refused"]
    for name, one in line["parameters"].items():
        if name.endswith("stiffness"):
            text += f", {name} {one['value']:.4g} (std {one['std']:.1g})"
    if line["change"]:
        text += f"; {Change(**line['change'])}"
    return text


class _Shown:
    """The page of the last poses, and the cable as it is now."""

    def __init__(self, source: Path, into: Path) -> None:
        self.source, self.into = source, into
        self.rows: deque[tuple[str, float, bool, str]] = deque(maxlen=_SHOWN)
        self.written, self.stale = 0.0, True

    def add(self, line: dict[str, Any], said: str) -> None:
        """One more pose."""
        seen = line.get("rms", 0.0), bool(line.get("refused", True))
        self.rows.append((line["pose"], *seen, said))
        self.stale = True

    def write(self, watched: Watched, *, last: bool = False) -> None:
        """Write both, unless that was done a moment ago."""
        from dlo_casadi.report.page import watched_page

        now = time.monotonic()
        if not self.stale or (now - self.written < _REFRESHED and not last):
            return
        cable: FittedCable = watched.tracker.cable
        count = watched.tracker.count
        write_file(self.into / _PAGE, watched_page(cable, self.source, count, list(self.rows)))
        watched.save()
        self.written, self.stale = now, False
