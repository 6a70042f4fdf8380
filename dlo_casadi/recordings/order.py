"""Markers in their order along the cable, their arc lengths, and labels that are exchanged."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.recordings.fixtures import Gripper
from dlo_casadi.thresholds import FITS

LONGER = 0.03  # relative difference of declared and measured length beyond which one is a mistake
_FEW = 4  # markers through which a spline is often shorter than the cable
# m, distance of a marker from a fixture below which their direction is not the cable's: a spline
# through a marker 1 mm from a gripper's origin, in any direction, was 4 to 14 mm too long.
_BESIDE = 0.01
_SAMPLES = 50  # points of a spline between two markers, to compute its length: exact to 1e-5
# Largest share of a pose's misfit that the exchange of two labels may leave. Of 252 exchanges in
# lines of sample sessions (5 to 20 markers) the right one leaves 0.02 in the median, 0.14 in 95 %;
# the best of the others leaves 0.40 or more in 95 %.
_EXPLAINED = 0.3
_MOST = 3  # exchanges in one pose that are looked for, one after the other


def in_order(
    markers: Mapping[str, FloatArray], start: Gripper | None, end: Gripper | None
) -> list[int]:
    """Order of the markers from the start to the end of the cable.

    The largest distance of two markers over all poses approximates their distance along the cable.
    With these distances the shortest tree that joins all markers is the cable itself.
    """
    places = np.array([*markers.values()])
    tree, neighbours = _tree(places)
    if neighbours.max() > 2:
        branch = list(markers)[int(np.argmax(neighbours))]
        raise MeasurementError(
            f"the markers are no chain: three lead to {branch!r}.\n  Try: --cable with a part of "
            "the names of the cable's own markers."
        )
    order = _from_start(tree, neighbours, places, start, end)
    if len(order) < len(places):
        raise MeasurementError(
            f"no pose shows one of the markers {', '.join(np.array([*markers])[order])} and one of "
            "the others.\n  Try: fill their gaps, or leave some out: --cable"
        )
    return order


def _largest(one: FloatArray, others: FloatArray, skipped: int = 0) -> FloatArray:
    """Largest distance over the poses of places (P, 3) from others (..., P, 3), nan left out.

    Without the `skipped` poses in which it is larger still.
    """
    away = np.nan_to_num(np.linalg.norm(one - others, axis=-1))
    return np.asarray(np.sort(away, axis=-1)[..., -1 - skipped])


def _tree(places: FloatArray, skipped: int = 0) -> tuple[Any, Any]:
    """Shortest tree through markers (M, P, 3), and the number of neighbours (M,) of each.

    It has no edges between markers that are never seen together.
    """
    apart = np.array([_largest(one, places, skipped) for one in places])
    tree = minimum_spanning_tree(apart)
    return tree, np.bincount(np.concatenate(tree.nonzero()), minlength=len(places))


def _from_start(
    tree: Any,
    neighbours: Any,
    places: FloatArray,
    start: Gripper | None,
    end: Gripper | None,
    skipped: int = 0,
) -> list[int]:
    """Markers along a chain, from the tip that is closer to the start."""
    tips = np.flatnonzero(neighbours <= 1).tolist()
    if start is not None:
        tips.sort(key=lambda k: _largest(places[k], start.places, skipped))
    elif end is not None:
        tips.sort(key=lambda k: -_largest(places[k], end.places, skipped))
    order, _ = depth_first_order(tree, tips[0], directed=False)
    return [int(k) for k in order]


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
        near = np.diff(seen) == 1
        row[seen[:-1][near]] = np.diff(s)[near]
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


def check_arc_lengths(
    s: FloatArray, length: float, scatter: float, places: FloatArray, names: Sequence[str]
) -> None:
    """Raise MeasurementError if measured arc lengths (M,) [m] are proven wrong.

    No marker is farther from the next than the cable between them is long, and the length does not
    change from pose to pose.
    """
    chords = np.linalg.norm(np.diff(places, axis=0), axis=2)  # (M - 1, P)
    excess = np.nanmax(chords, axis=1, initial=0.0) - np.diff(s)
    k = int(np.argmax(excess))
    if excess[k] > FITS * length / 2:
        pose = int(np.nanargmax(chords[k])) + 1
        cause = f"{counted(len(s), 'marker')} are too few for that"
        if len(s) > _FEW:
            cause = f"are labels exchanged in pose {pose}?"
        raise MeasurementError(
            f"markers {names[k]} and {names[k + 1]} are {np.nanmax(chords[k]):.4f} m apart in pose "
            f"{pose}, but {np.diff(s)[k]:.4f} m along a spline through the markers (mean of all "
            f"poses): {cause}.\n  Try: --length and --at, measured with a tape; more markers; "
            "other labels; --start-offset."
        )
    if scatter > LONGER * length:
        raise MeasurementError(
            f"the cable's length along a spline through {counted(len(s), 'marker')} is "
            f"{length:.4f} m with a scatter of {scatter:.4f} m from pose to pose: a cable does not "
            "change its length.\n  Try: --length and --at, measured with a tape; the body that "
            "holds each end: --start, --end; cable and grippers in one frame."
        )


def exchanged_labels(
    places: FloatArray, start: Gripper | None, end: Gripper | None
) -> dict[tuple[int, int], list[int]]:
    """Pairs of markers whose labels are exchanged in a minority of the poses, and these poses.

    Places (M, P, 3) [m] of the markers; M stands for the start and M + 1 for the end. Distances
    between neighbours hardly change from pose to pose. Where they do, the labels of two markers are
    exchanged if their exchange makes them the same again. Wrong places also spoil the order, which
    therefore is sought without the largest distances of as many poses as it takes.
    """
    count, poses = places.shape[:2]
    for skipped in range((poses + 1) // 2):
        tree, neighbours = _tree(places, skipped)
        if neighbours.max() > 2:
            continue
        knots = _from_start(tree, neighbours, places, start, end, skipped)
        known = [*places[knots]]
        if start is not None:
            knots, known = [count, *knots], [start.places, *known]
        if end is not None:
            knots, known = [*knots, count + 1], [*known, end.places]
        found = _exchanged(np.array(known))
        if found is not None:
            return {(knots[i], knots[j]): at for (i, j), at in found.items()}
    return {}


def _exchanged(knots: FloatArray) -> dict[tuple[int, int], list[int]] | None:
    """Pairs of points (K, P, 3) along the cable that are exchanged, and the poses.

    None if distances of neighbours change from pose to pose and no exchange explains it.
    """

    def steps(points: FloatArray) -> FloatArray:
        return np.linalg.norm(np.diff(points, axis=-2), axis=-1)

    by_pose = np.swapaxes(knots, 0, 1)
    chords = steps(by_pose)  # (P, K - 1)
    together = np.isfinite(chords).any(axis=0)
    usual = np.where(together, 0.0, np.nan)
    usual[together] = np.nanmedian(chords[:, together], axis=0)
    tolerance = LONGER * float(np.nansum(usual))
    off = np.nan_to_num(np.abs(chords - usual))
    found: dict[tuple[int, int], list[int]] = {}
    for k in np.flatnonzero(off.max(axis=1) > tolerance):
        points = by_pose[k].copy()
        seen = np.flatnonzero(np.isfinite(points).all(axis=1))
        pairs = [*combinations(seen.tolist(), 2)]
        made = []
        for _ in range(_MOST):
            trials = np.repeat(points[None], len(pairs), axis=0)
            for trial, (i, j) in zip(trials, pairs, strict=True):
                trial[[i, j]] = trial[[j, i]]
            left = np.nan_to_num(np.abs(steps(trials) - usual))
            best = int(left.sum(axis=1).argmin())
            points = trials[best]
            made.append(pairs[best])
            if left[best].max() <= tolerance:
                break
        if left[best].max() > tolerance or left[best].sum() > _EXPLAINED * off[k].sum():
            return None
        for pair in made:
            found.setdefault(pair, []).append(int(k))
    return found
