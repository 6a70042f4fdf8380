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
    known = np.array([value for value in values if value is not None])
    if len(known) < FEWEST:
        return [None] * len(values)
    middle = float(np.median(known))
    spread = float(np.median(np.abs(known - middle)))
    scores: list[float | None] = []
    for value in values:
        if value is None:
            scores.append(None)
        elif spread > 0:
            scores.append(float(np.clip(0.6745 * (value - middle) / spread, -LARGEST, LARGEST)))
        else:
            scores.append(float(np.sign(value - middle)) * LARGEST)
    return scores


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
    reasons = []
    if row["verdict"] == "unexplained":
        reasons.append("unexplained")
    if stiffness is not None and abs(stiffness) > OUTLYING:
        reasons.append("stiffer" if stiffness > 0 else "softer")
    # Of errors only large ones are odd.
    if error is not None and error > OUTLYING:
        reasons.append("larger error")
    return tuple(reasons)


def _order(item: Judged) -> tuple[int, float, str]:
    group = 3
    if item.row["status"] != "done":
        group = 0
    elif "unexplained" in item.reasons:
        group = 1
    elif item.reasons:
        group = 2
    worst = max(abs(item.stiffness_z or 0.0), item.error_z or 0.0)
    return group, -worst, str(item.row["session"])
