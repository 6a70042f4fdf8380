"""Find a cable in space in one photograph, and match its pixels with other photographs."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import label
from scipy.spatial import cKDTree

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, chord_lengths
from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import CameraPose, Picture
from dlo_casadi.vision.centerline import FINE, measure_line
from dlo_casadi.vision.chain import Workings
from dlo_casadi.vision.profiles import normals
from dlo_casadi.vision.workplane import BEFORE_BOARD, ExpectedLine, KnownCable

_NEAREST = 0.2  # m: smallest distance from which a cable can be photographed
_BESIDE = 1.6  # widths: distance between two parts of the line below which they share an edge
_APART = 2.0  # widths: distance along the line from which two places are different parts
TIP = 4.0  # widths: distance from a fixture beyond which a message reports the line's end
_CAP = 3.0  # standard deviations at which a pair costs as much as an unmatched pixel
_GOOD = 2.0  # standard deviations: largest distance of the pixels of a pair
_STEP = 0.05  # cost of a pair, which prefers the shortest of equal paths along an epipolar line
_NEAR_PX = 2.0  # error of a projected curve; pixels three times as far off do not belong to it
_POSE_PX = 0.5  # error of an epipolar line from the cameras' poses


@dataclass(frozen=True)
class ImageCurve:
    """The centre-line in one photograph, ordered from start to end."""

    viewpoint: CameraPose
    """Where the camera stands."""
    pixels: FloatArray
    """(K, 2) [px], middle of the cable's outline, as photographed."""
    std: FloatArray
    """(K,) [px], standard deviation of each across the line."""
    whole: BoolArray
    """(K,), both edges are seen; where not, another stretch of the cable lies beside or behind,
    and the pixel is only somewhere in their common outline."""
    width: float
    """Distance [px] of the two edges, the median along the line."""
    width_std: float
    """Its scatter [px] along the line."""
    diameter: float
    """Of the cable [m], as declared."""
    distance: float
    """Depth [m] at which the picture was searched: between the fixtures."""
    correlation: float
    """Length [px] along the line, to either side, over which neighbours share their errors: the
    integral of the correlation from 0 on. Pixels are averaged along the cable by a Gaussian."""
    confidence: float
    """Share of the line inside the picture that was measured soundly, 0..1."""
    messages: tuple[str, ...]
    """What a user should know."""
    direction: FloatArray
    """Colours (3,) by which the cable stands out."""
    blur: float
    """Blur [px] of its edges."""

    @property
    def spacing(self) -> float:
        """Distance [px] of neighbouring pixels, the median."""
        return float(np.median(np.linalg.norm(np.diff(self.pixels, axis=0), axis=1)))


def see_cable(
    image: Picture, viewpoint: CameraPose, cable: KnownCable, workings: Workings | None = None
) -> ImageCurve:
    """Find the cable in front of the board, order it from start to end, refine it to sub-pixel.

    The photograph is searched in the plane that faces the camera at the distance of the fixtures,
    (3,) [m] each. `viewpoint` is the pose of the camera; the rest is as in `extract_centerline`.
    """
    diameter, workings = cable.diameter, workings or Workings()
    depths = viewpoint.in_camera(cable.fixtures)[:, 2]
    if depths.min() < _NEAREST:
        raise VisionError(
            f"a fixture would be {depths.min():.2f} m before the camera. "
            "Try: start and end in metres and in the board frame, z out of the board?"
        )
    distance = float(depths.mean())
    view = viewpoint.facing(distance)
    expected = _expected_line(cable, viewpoint, distance)
    line = measure_line(image, view, expected, workings)
    if line.unreached:
        name, fixture, tip, _ = line.unreached[0]
        (u, v), (at_u, at_v) = view.to_pixels([fixture, tip])
        raise VisionError(
            f"the cable does not reach its {name}: the line found ends at ({at_u:.0f}, "
            f"{at_v:.0f}) px, and the {name} is declared where ({u:.0f}, {v:.0f}) px shows it. "
            f"Try: {name} in metres and in the board frame? Is the photograph of this pose? Is "
            "the cable hidden there?"
        )
    trace, pixel, width = line.trace, 1.0 / view.scale, line.trace.shape.width
    hidden = np.isfinite(other_stretches(trace.points, trace.t, width)) & trace.inside
    every = max(1, round(np.median(np.diff(trace.t[line.kept])) / np.median(np.diff(trace.t))))
    shared = np.nonzero(hidden)[0][::every]
    kept = np.sort(np.concatenate([line.kept[~hidden[line.kept]], shared]))
    workings.pixels = view.to_pixels(trace.points[kept])
    before = np.searchsorted(kept, line.kept[list(line.gaps)], side="right") - 1
    workings.gaps = tuple(before.tolist())
    tips = [
        f"the line in the photograph ends {away / pixel:.0f} px from where the {name} is declared"
        for name, _, _, away in expected.tips(trace.points[kept])
        if away > TIP * width
    ]
    return ImageCurve(
        viewpoint=viewpoint,
        pixels=workings.pixels,
        std=np.where(hidden[kept], 0.5 * width, trace.std[kept]) / pixel,
        whole=~hidden[kept],
        width=width / pixel,
        width_std=trace.width_std / pixel,
        diameter=diameter,
        distance=distance,
        correlation=FINE * np.sqrt(np.pi) * diameter / pixel,
        confidence=line.confidence,
        messages=(*line.messages, *tips),
        direction=trace.direction,
        blur=trace.shape.blur / pixel,
    )


def _expected_line(cable: KnownCable, viewpoint: CameraPose, distance: float) -> ExpectedLine:
    """The expected line in the facing plane, with bounds on its length there.

    The lower bound is the distance of the fixtures there, or some diameters. The upper bound is the
    cable's length at the smallest possible depth: half of the length beyond the distance of the
    fixtures may lead towards the camera; with a free end all of it.
    """
    flat = viewpoint.flattened(cable.fixtures, distance)
    fixtures, length = viewpoint.in_camera(cable.fixtures), cable.length
    ahead = length
    if len(fixtures) == 2:
        chord = float(np.linalg.norm(fixtures[1] - fixtures[0]))
        ahead = 0.25 * np.sqrt(max(length**2 - chord**2, 0.0))
    nearest = fixtures[:, 2].min() - ahead
    shortest = max(float(np.linalg.norm(flat[-1] - flat[0])), 10 * cable.diameter)
    longest = max(length * distance / max(nearest, 0.5 * distance), length)
    return ExpectedLine(flat, cable.diameter, shortest, longest, BEFORE_BOARD)


def other_stretches(points: FloatArray, t: FloatArray, width: float) -> FloatArray:
    """Signed distance (K,) from each point of a line to the nearest other part of it.

    It is positive to the left, and nan where no other part shares an edge. Points (K, 2) are
    closely spaced, at lengths t (K,) along a line of this `width`, all in the same units.
    """
    normal = normals(np.gradient(points, axis=0))
    pairs = cKDTree(points).query_pairs(_BESIDE * width, output_type="ndarray")
    here, there = np.vstack([pairs, pairs[:, ::-1]]).T
    other = np.abs(t[there] - t[here]) > _APART * width
    here, there = here[other], there[other]
    across = points[there] - points[here]
    offset = np.sum(across * normal[here], axis=1)
    along = across[:, 0] * normal[here, 1] - across[:, 1] * normal[here, 0]
    level = np.abs(along) < 1.5 * float(np.median(np.diff(t)))
    here, offset = here[level], offset[level]
    farthest_first = np.argsort(-np.abs(offset))
    beside = np.full(len(points), np.nan)
    beside[here[farthest_first]] = offset[farthest_first]
    return beside


def loops_either_way(curve: ImageCurve) -> list[ImageCurve]:
    """The curve as it was ordered, and with each of its loops in the opposite order.

    Where a line meets itself, one photograph hardly shows whether the two parts cross or turn back:
    the loop between them may have either order.
    """
    apart = np.linalg.norm(curve.pixels[:, None] - curve.pixels[None], axis=2)
    t = chord_lengths(curve.pixels)
    meets = (apart < curve.width) & (t[None] - t[:, None] > _APART * curve.width)
    labels, count = label(meets, np.ones((3, 3)))
    ways = [curve]
    for where in range(1, count + 1):
        i, j = np.unravel_index(np.where(labels == where, apart, np.inf).argmin(), apart.shape)
        order = np.arange(len(t))
        order[i + 1 : j] = order[i + 1 : j][::-1]
        pixels, std, whole = curve.pixels[order], curve.std[order], curve.whole[order]
        ways.append(replace(curve, pixels=pixels, std=std, whole=whole))
    return ways


def match_lines(one: ImageCurve, other: ImageCurve) -> tuple[IntArray, IntArray, float]:
    """Match two lines, in order, by the distances from each other's epipolar lines.

    For rays a and b of the same point b^T E a = 0, with the essential matrix E = [t]_x R of the
    second camera's place seen from the first. The way of least cost

        sum min(d_kl / s_kl, 3)^2 + 0.05,  d^2 = (b^T E a)^2 / (|(E a)_xy|^2 + |(E^T b)_xy|^2)

    through all pairs (k, l) that never goes back, by dynamic programming; s^2 adds up the
    variances of both pixels and of the cameras' poses. Pixels at the ends may stay unmatched, at
    the cost of a bad pair: parts hidden in one photograph cost the same everywhere.

    Returns
    -------
    Places (P,), (P,) of the pairs in the two lines, and the share of the pixels of both that found
    a partner on their epipolar line.

    References
    ----------
    Sampson's distance: Hartley, Zisserman, Multiple View Geometry, 2004, section 11.4.3. Ordering:
    Ohta, Kanade, Stereo by intra- and inter-scanline search, 1985.
    """
    R = other.viewpoint.rotation @ one.viewpoint.rotation.T
    t = other.viewpoint.translation - R @ one.viewpoint.translation
    E = np.cross(t, R, axisb=0, axisc=0)
    a, b = (
        np.column_stack([seen.viewpoint.rays(seen.pixels), np.ones(len(seen.pixels))])
        for seen in (one, other)
    )
    in_other, in_one = a @ E.T, b @ E
    slope = np.sum(in_other[:, :2] ** 2, axis=1)[:, None] + np.sum(in_one[:, :2] ** 2, axis=1)
    focal = np.sqrt(one.viewpoint.camera.focal * other.viewpoint.camera.focal)
    off = focal * np.abs(in_other @ b.T) / np.sqrt(slope)
    off /= np.sqrt(one.std[:, None] ** 2 + other.std[None, :] ** 2 + _POSE_PX**2)
    first, second = _cheapest_way(np.minimum(off, _CAP) ** 2 + _STEP)
    good = off[first, second] < _GOOD
    first, second = first[good], second[good]
    found = len(np.unique(first)) + len(np.unique(second))
    return first, second, found / (len(one.pixels) + len(other.pixels))


def places_along(curve: ImageCurve, points: FloatArray) -> FloatArray:
    """Places (K,), 0 to 1, of a photograph's pixels along a line in space, in order.

    The line's points (M, 3) [m] are evenly and closely spaced; the place is that of the point whose
    image is nearest to the pixel, nan if none is near.
    """
    seen = curve.viewpoint.to_pixels(points)
    away = np.linalg.norm(curve.pixels[:, None, :] - seen[None, :, :], axis=2) / _NEAR_PX
    found = nearest_in_order(np.minimum(away, _CAP))
    off = away[np.arange(len(found)), np.maximum(found, 0)]
    return np.where((found >= 0) & (off < _CAP), found / (len(points) - 1), np.nan)


def nearest_in_order(away: FloatArray) -> IntArray:
    """Column of each row in a table of distances (K, M), never decreasing.

    Distances are in standard deviations. Of several columns of a row the nearest is taken; -1 where
    the row is unmatched at an end.
    """
    first, second = _cheapest_way(away**2 + _STEP)
    order = np.argsort(-away[first, second], kind="stable")  # the nearest is written last
    found = np.full(len(away), -1)
    found[first[order]] = second[order]
    return found


def triangulate(
    one: ImageCurve, other: ImageCurve, first: IntArray, second: IntArray
) -> FloatArray:
    """Least-squares points (P, 3) [m] of the rays of matched pixels.

    With a = q_xy / q_z and q = R p + t each ray gives two equations, (a R_z - R_xy) p = t_xy - a
    t_z.
    """
    rows, sides = [], []
    for seen, chosen in ((one, first), (other, second)):
        R, t = seen.viewpoint.rotation, seen.viewpoint.translation
        rays = seen.viewpoint.rays(seen.pixels[chosen])
        rows.append(rays[:, :, None] * R[2] - R[:2])
        sides.append(t[:2] - rays * t[2])
    A, b = np.concatenate(rows, axis=1), np.concatenate(sides, axis=1)
    normal = np.einsum("pki,pkj->pij", A, A)
    return np.linalg.solve(normal, np.einsum("pki,pk->pi", A, b)[..., None])[..., 0]


def _cheapest_way(cost: FloatArray) -> tuple[IntArray, IntArray]:
    """Places (P,), (P,) of the pairs on the cheapest way through a table of costs (K, L).

    In a row, D_l = c_l + min(A_l, D_l-1) with A the best from the row before; with C the running
    sum of c that is D_l = C_l + min_{m <= l} (A_m - C_m-1), which needs no loop. A row and a column
    before the table, and a cost beyond its end, are the price of unmatched pixels.
    """
    high, wide = cost.shape
    total, beyond = np.zeros((high + 1, wide + 1)), np.full((high + 1, wide + 1), np.inf)
    total[0], total[:, 0] = _CAP**2 * np.arange(wide + 1), _CAP**2 * np.arange(high + 1)
    beyond[-1], beyond[:, -1] = total[0, ::-1], total[::-1, 0]
    for k in range(high):
        above = np.minimum(total[k, :-1], total[k, 1:])
        run = np.cumsum(cost[k])
        total[k + 1, 1:] = run + np.minimum.accumulate(above - run + cost[k])
    k, m = map(int, np.unravel_index(np.argmin(total + beyond), total.shape))
    way = []
    while k > 0 and m > 0:
        way.append((k - 1, m - 1))
        _, k, m = min((total[i, j], i, j) for i, j in ((k - 1, m - 1), (k - 1, m), (k, m - 1)))
    first, second = np.array(way[::-1], int).reshape(-1, 2).T
    return first, second
