"""Arc lengths of a cable's markers, measured in the poses of a recording."""

from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings.fixtures import Gripper

# m, distance of a marker from a fixture below which their direction is not the cable's: a spline
# through a marker 1 mm from a gripper's origin, in any direction, was 4 to 14 mm too long.
_BESIDE = 0.01
_SAMPLES = 50  # points of a spline between two markers, to compute its length: exact to 1e-5


def arc_lengths(
    start: Gripper | None, places: FloatArray, end: Gripper | None
) -> tuple[FloatArray, float, float]:
    """Arc lengths (M,) [m] of markers from the start; length of the cable and its scatter [m].

    They are means over all poses of lengths along a cubic spline through fixtures and markers,
    clamped in the grippers' directions. A marker beside a fixture is no knot of it.
    """
    knots = places
    if start is not None:
        knots = np.concatenate([start.places[None], knots])
    if end is not None:
        knots = np.concatenate([knots, end.places[None]])
    spans = np.full((knots.shape[1], len(knots) - 1), np.nan)
    for k, row in enumerate(spans):
        seen = np.flatnonzero(np.isfinite(knots[:, k]).all(axis=1))
        if len(seen) < 2:
            continue
        x = knots[seen, k]
        ends: Any = tuple(
            (1, gripper.frames[k, :, 0]) if gripper is not None else (2, np.zeros(3))
            for gripper in (start, end)
        )
        chords = np.linalg.norm(np.diff(x, axis=0), axis=1)
        at_start = start is not None and chords[0] < _BESIDE
        at_end = end is not None and chords[-1] < _BESIDE
        kept = np.ones(len(x), bool)
        kept[1] &= not at_start
        kept[-2] &= not at_end
        s = np.zeros(len(x))
        s[kept] = _along_spline(x[kept], ends)
        if at_start:
            s[1] = chords[0]
        if at_end:
            s[-2] = s[-1] - chords[-1]
        for i, j, span in zip(seen, seen[1:], np.diff(s), strict=False):
            if j == i + 1:
                row[i] = span
    if np.isnan(spans).all(axis=0).any():
        raise MeasurementError(
            "two neighbouring markers of the cable are seen together in no pose.\n  Try: fill "
            "their gaps, or leave one of them out: --cable"
        )
    found = np.nanmean(spans, axis=0)
    s = np.concatenate([[0.0], np.cumsum(found)])
    first = 0 if start is None else 1
    scatter = float(np.where(np.isnan(spans), found, spans).sum(axis=1).std())
    return s[first : first + len(places)], float(s[-1]), scatter


def _along_spline(x: FloatArray, ends: Any) -> FloatArray:
    """Lengths (K,) [m] to each of the points (K, 3) along a cubic spline with these conditions."""
    s = chord_lengths(x)
    for _ in range(3):  # the parameter converges to the arc length
        fine = np.linspace(s[:-1], s[1:], _SAMPLES + 1, axis=1)
        curve = CubicSpline(s, x, bc_type=ends)(fine)
        s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=1), axis=2).sum(axis=1)))
    return s
