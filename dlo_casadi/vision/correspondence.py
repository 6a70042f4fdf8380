"""Which pixels of two photographs show the same points of the cable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.vision.image_curve import ImageCurve
from dlo_casadi.vision.view import Array

_CAP = 3.0  # standard deviations at which a pair costs as much as a pixel that is left over
_GOOD = 2.0  # largest distance of the pixels of a pair, standard deviations
_STEP = 0.05  # cost of a pair: prefers the shortest of equal ways along an epipolar line
_NEAR_PX = 2.0  # how far off a curve may be seen; pixels three times as far are not of it
_POSE_PX = 0.5  # error of an epipolar line from the cameras' places


@dataclass(frozen=True)
class Match:
    """Pairs of pixels of two photographs, in order along the cable."""

    first: NDArray[np.intp]  # (P,), their places in the two lines
    second: NDArray[np.intp]
    share: float  # of the pixels of both lines that found a partner on their epipolar line


def match_lines(one: ImageCurve, other: ImageCurve) -> Match:
    """Match two lines, in order, by the distances from each other's epipolar lines.

    For rays a and b of the same point b^T E a = 0, with the essential matrix E = [t]_x R of the
    second camera's place seen from the first. The way of least cost

        sum min(d_kl / s_kl, 3)^2 + 0.05,  d^2 = (b^T E a)^2 / (|(E a)_xy|^2 + |(E^T b)_xy|^2)

    through all pairs (k, l) that never goes back, by dynamic programming; s^2 adds up the
    variances of both pixels and of the cameras' places. Pixels at the ends may be left over, at
    the price of a pair that does not match: what one photograph hides costs alike everywhere.

    References
    ----------
    Sampson's distance: Hartley, Zisserman, Multiple View Geometry, 2004, section 11.4.3. Ordering:
    Ohta, Kanade, Stereo by intra- and inter-scanline search, 1985.
    """
    off = _epipolar_distance(one, other)
    variance = one.std[:, None] ** 2 + other.std[None, :] ** 2 + _POSE_PX**2
    off /= np.sqrt(variance)
    cost = np.minimum(off, _CAP) ** 2 + _STEP
    first, second = _cheapest_way(cost)
    good = off[first, second] < _GOOD
    first, second = first[good], second[good]
    found = len(np.unique(first)) + len(np.unique(second))
    return Match(first, second, found / (len(one.pixels) + len(other.pixels)))


def places_along(curve: ImageCurve, points: Array) -> Array:
    """Where along a line in space the pixels of a photograph lie, in order.

    Parameters
    ----------
    curve : ImageCurve
        What is seen.
    points : (M, 3) [m]
        Along the line in space, evenly and closely spaced.

    Returns
    -------
    (K,) share of the way along the curve, 0 to 1, of the point that is seen nearest to each pixel;
    nan where none is near.
    """
    seen = curve.viewpoint.to_pixels(points)
    away = np.linalg.norm(curve.pixels[:, None, :] - seen[None, :, :], axis=2) / _NEAR_PX
    found = nearest_in_order(np.minimum(away, _CAP))
    off = away[np.arange(len(found)), np.maximum(found, 0)]
    return np.where((found >= 0) & (off < _CAP), found / (len(points) - 1), np.nan)


def nearest_in_order(away: Array) -> NDArray[np.intp]:
    """Columns of a table of distances (K, M) that rows belong to, never going back.

    Distances in standard deviations. Of several columns of a row the nearest is taken; -1 where
    the row is left over at an end.
    """
    first, second = _cheapest_way(away**2 + _STEP)
    order = np.argsort(-away[first, second], kind="stable")  # the nearest is written last
    found = np.full(len(away), -1)
    found[first[order]] = second[order]
    return found


def triangulate(one: ImageCurve, other: ImageCurve, match: Match) -> Array:
    """Points (P, 3) [m] of least squares from the matched rays.

    With a = q_xy / q_z and q = R p + t each ray gives two equations, (a R_z - R_xy) p = t_xy - a
    t_z.
    """
    rows, sides = [], []
    for seen, chosen in ((one, match.first), (other, match.second)):
        R, t = seen.viewpoint.rotation, seen.viewpoint.translation
        rays = seen.rays[chosen]
        rows.append(rays[:, :, None] * R[2] - R[:2])
        sides.append(t[:2] - rays * t[2])
    A, b = np.concatenate(rows, axis=1), np.concatenate(sides, axis=1)
    normal = np.einsum("pki,pkj->pij", A, A)
    return np.linalg.solve(normal, np.einsum("pki,pk->pi", A, b)[..., None])[..., 0]


def _epipolar_distance(one: ImageCurve, other: ImageCurve) -> Array:
    """Sampson's distance (K, L) [px] of all pairs of pixels."""
    R = other.viewpoint.rotation @ one.viewpoint.rotation.T
    t = other.viewpoint.translation - R @ one.viewpoint.translation
    E = np.cross(t, R, axisb=0, axisc=0)
    a = np.column_stack([one.rays, np.ones(len(one.pixels))])
    b = np.column_stack([other.rays, np.ones(len(other.pixels))])
    in_other, in_one = a @ E.T, b @ E
    slope = np.sum(in_other[:, :2] ** 2, axis=1)[:, None] + np.sum(in_one[:, :2] ** 2, axis=1)
    focal = np.sqrt(one.viewpoint.camera.focal * other.viewpoint.camera.focal)
    return np.asarray(focal * np.abs(in_other @ b.T) / np.sqrt(slope))


def _cheapest_way(cost: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Places (P,), (P,) of the pairs on the cheapest way through a table of costs (K, L).

    In a row, D_l = c_l + min(A_l, D_l-1) with A the best from the row before; with C the running
    sum of c that is D_l = C_l + min_{m <= l} (A_m - C_m-1), which needs no loop.
    """
    high, wide = cost.shape
    total = np.empty_like(cost)
    total[0] = np.minimum(cost[0] + _CAP**2 * np.arange(wide), np.cumsum(cost[0]))
    for k in range(1, high):
        above = total[k - 1].copy()
        above[1:] = np.minimum(above[1:], total[k - 1, :-1])
        above[0] = min(above[0], _CAP**2 * k)
        run = np.cumsum(cost[k])
        total[k] = run + np.minimum.accumulate(above - run + cost[k])
    last_row = total[-1] + _CAP**2 * np.arange(wide)[::-1]
    last_column = total[:, -1] + _CAP**2 * np.arange(high)[::-1]
    if last_row.min() <= last_column.min():
        k, m = high - 1, int(last_row.argmin())
    else:
        k, m = int(last_column.argmin()), wide - 1
    way = [(k, m)]
    while k > 0 or m > 0:
        behind = total[k, m] - cost[k, m]
        before = [(k - 1, m - 1), (k - 1, m), (k, m - 1)]
        best, i, j = min((total[i, j], i, j) for i, j in before if i >= 0 and j >= 0)
        skipped = _CAP**2 * (m if k == 0 else k if m == 0 else np.inf)
        if skipped <= behind + 1e-9 and skipped <= best:
            break
        k, m = i, j
        way.append((k, m))
    first, second = np.array(way[::-1]).T
    return first, second
