"""Cells of the tables that compare sessions with their truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from dlo_casadi.session.outcome import Outcome


def asked(doc: str) -> tuple[Path, Path, list[str]]:
    """Folder of sessions, folder of truths, and names, as asked for on the command line."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("sessions", type=Path, help="folders with a session.yaml")
    parser.add_argument("truths", type=Path, help="folders of the same names with a truth.yaml")
    parser.add_argument("names", nargs="*", help="sessions; all by default")
    given = parser.parse_args()
    found = sorted(path.parent.name for path in given.sessions.glob("*/session.yaml"))
    if lost := set(given.names) - set(found) or ({"session.yaml"} if not found else set()):
        parser.error(f"no {', '.join(sorted(lost))} in {given.sessions}")
    return given.sessions, given.truths, given.names or found


def stiffness_cell(outcome: Outcome, name: str, exact: float) -> tuple[str, bool]:
    """A stiffness with its interval, and whether the truth lies inside."""
    found = outcome.stages[-1].parameters[name]
    low, high = found.interval_95 or (None, None)
    inside = low is not None and high is not None and low <= exact <= high
    told = "unbounded" if low is None or high is None else f"{low:.4g} to {high:.4g}"
    return f"{found.value:.4g} ({told}; {exact:g})", inside
