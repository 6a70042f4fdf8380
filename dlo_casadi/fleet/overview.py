"""Outlying sessions, and the overview page that lists them first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from dlo_casadi import __version__
from dlo_casadi.errors import counted
from dlo_casadi.fleet.rows import Row, last_error

if TYPE_CHECKING:
    from jinja2 import Template

# Modified z-score beyond which a value is an outlier (Iglewicz and Hoaglin, 1993).
OUTLYING = 3.5
# Fewest sessions among which there may be outliers.
FEWEST = 5
# Largest z-score, also of a value where all others are equal to the last digit.
LARGEST = 99.0


@dataclass(frozen=True)
class Judged:
    """A row and its outlier scores.

    Parameters
    ----------
    row : dict
    stiffness_z, error_z : float or None
        Robust z-scores of log EI and of the log of the last stage's error.
    """

    row: Row
    stiffness_z: float | None
    error_z: float | None

    @property
    def error(self) -> float | None:
        """Error of the last stage [m]."""
        return last_error(self.row)

    @property
    def verdict(self) -> str:
        """Verdict of the diagnosis, or why there is none."""
        row = self.row
        return str(
            (row["verdict"] or "not diagnosed") if row["status"] == "done" else row["status"]
        )

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons to look at it first; empty if it is not unusual."""
        if self.row["status"] != "done":
            return (self.verdict,)
        stiffness, error = self.stiffness_z or 0.0, self.error_z or 0.0
        reasons = {
            "unexplained": self.verdict == "unexplained",
            "stiffer": stiffness > OUTLYING,
            "softer": stiffness < -OUTLYING,
            # Flag only large errors as outliers, never small ones.
            "larger error": error > OUTLYING,
        }
        return tuple(text for text, holds in reasons.items() if holds)

    @property
    def order(self) -> tuple[bool, bool, bool, float, str]:
        """Sorting key: the most unusual sessions first."""
        return (
            self.row["status"] == "done",
            "unexplained" not in self.reasons,
            not self.reasons,
            -max(abs(self.stiffness_z or 0.0), self.error_z or 0.0),
            str(self.row["session"]),
        )


def judge(rows: Sequence[Row]) -> list[Judged]:
    """All rows, the most unusual first: failed, unexplained, outlying, then the others by score."""
    measures = [row["bending_stiffness"] for row in rows], [last_error(row) for row in rows]
    scores = [
        robust_z([None if x is None or x <= 0 else float(np.log(x)) for x in values])
        for values in measures
    ]
    return sorted(map(Judged, rows, *scores), key=lambda item: item.order)


def robust_z(values: Sequence[float | None]) -> list[float | None]:
    """Modified z-scores: z = 0.6745 (x - median) / median |x - median|.

    None where there is no value, and everywhere if there are fewer than five values.

    References
    ----------
    Iglewicz and Hoaglin, How to detect and handle outliers, 1993.
    """
    known = np.array(values, dtype=float)
    if np.isfinite(known).sum() < FEWEST:
        return [None] * len(values)
    away = known - np.nanmedian(known)
    with np.errstate(divide="ignore", invalid="ignore"):
        scores = 0.6745 * away / np.nanmedian(np.abs(away))
    scores = np.clip(np.where(away == 0, 0.0, scores), -LARGEST, LARGEST)
    return [None if np.isnan(score) else float(score) for score in scores]


def overview_html(rows: Sequence[Row], output: Path) -> str:
    """The page of a fleet as text: one row per session; self-contained, without a script.

    Parameters
    ----------
    rows : sequence of dict
    output : Path
        Folder in which the page will lie; sessions with results in it are linked.
    """
    judged = judge(rows)
    verdicts = Counter(item.verdict for item in judged)
    counts = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in verdicts.most_common())
    odd = sum(bool(item.reasons) for item in judged)
    return _template().render(
        title=counted(len(rows), "session"),
        summary=f"{counts or 'nothing is finished yet'}. {odd} to look at first.",
        judged=[(item, _link(item.row, output)) for item in judged],
        outlying=OUTLYING,
        version=__version__,
    )


@cache
def _template() -> Template:
    # Imported here, since workers import this module but write no page.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("dlo_casadi.fleet"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template("overview.html")


def _link(row: Row, output: Path) -> str | None:
    """Link to the page of the session's results, or of its failure."""
    for name in ("report.html", "report.json") if row["status"] == "done" else ("failed.html",):
        if (output / "sessions" / row["session"] / name).is_file():
            return quote(f"sessions/{row['session']}/{name}")
    return None
