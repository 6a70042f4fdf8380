"""Which cables of a fleet are unlike the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dlo_casadi.fleet.columns import Row, last_error

# Beyond it a value is called an outlier (Iglewicz and Hoaglin, 1993).
OUTLYING = 3.5
# With fewer sessions nothing is unlike the others.
FEWEST = 5
# A z-score where all others are equal to the last digit.
LARGEST = 99.0


@dataclass(frozen=True)
class Judged:
    """A row and what is odd about it.

    Parameters
    ----------
    row : dict
    stiffness_z, error_z : float or None
        Robust z-scores of log EI and of the log of the last stage's error.
    reasons : tuple of str
        Why to look at it first; empty if nothing is odd.
    """

    row: Row
    stiffness_z: float | None
    error_z: float | None
    reasons: tuple[str, ...]


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


def judge(rows: Sequence[Row]) -> list[Judged]:
    """All rows, the oddest first: failed, unexplained, outlying, then the others by score."""
    stiffness = robust_z([_log(row["bending_stiffness"]) for row in rows])
    errors = robust_z([_log(last_error(row)) for row in rows])
    judged = [
        Judged(row, z, e, _reasons(row, z, e))
        for row, z, e in zip(rows, stiffness, errors, strict=True)
    ]
    return sorted(judged, key=_order)


def _log(value: float | None) -> float | None:
    return None if value is None or value <= 0 else float(np.log(value))


def _reasons(row: Row, stiffness: float | None, error: float | None) -> tuple[str, ...]:
    if row["status"] != "done":
        return (str(row["status"]),)
    reasons = {
        "unexplained": row["verdict"] == "unexplained",
        "stiffer": stiffness is not None and stiffness > OUTLYING,
        "softer": stiffness is not None and stiffness < -OUTLYING,
        # Flag only large errors as outliers, never small ones.
        "larger error": error is not None and error > OUTLYING,
    }
    return tuple(text for text, holds in reasons.items() if holds)


def _order(item: Judged) -> tuple[bool, bool, bool, float, str]:
    worst = max(abs(item.stiffness_z or 0.0), item.error_z or 0.0)
    return (
        item.row["status"] == "done",
        "unexplained" not in item.reasons,
        not item.reasons,
        -worst,
        str(item.row["session"]),
    )
