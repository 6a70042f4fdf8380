"""Find the line of a cable in a depth camera's cloud of points on its surface."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import BSpline
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, chord_lengths, length_of, unit
from dlo_casadi.errors import VisionError, counted
from dlo_casadi.vision.chain import Strand, order_strands
from dlo_casadi.vision.profiles import fit_curve
from dlo_casadi.vision.workplane import BEFORE_BOARD, ExpectedLine, KnownCable

_ALIKE = 40.0  # distance in CIE Lab within which a colour counts as the cable's
_REACH = 2.0  # diameters: distance of neighbouring points, and of points from the line
_LONELY = 0.2  # share of the median number of neighbours; a point with fewer is left out
_SHORTEST = 2.0  # diameters: shorter strands are left out
_KNOT, _SMOOTH = 5.0, 2.0  # diameters, of the spline
_ROUNDS = 4  # rounds of assigning points to the spline and refitting it; it converges in three
SPACING = 0.01  # m, distance between points of the line
_FEWEST = 5  # points of the cloud needed for one point of the line
# Most cubes of half a diameter that points may fill, per diameter of length. A rendered cable with
# 2 mm of noise, 30 % hidden, fills 7 to 9 in one frame and 11 to 15 in three; the rest is for what
# is beside it. At the limit a wall (26000 cubes, 61000 points) takes 11 s and 1.1 GB; one of 200000
# points takes 33 s and 3.0 GB.
_CUBES = 200
_LEAST = 0.25  # smallest share of the length that must be seen
_TOLD = 0.05  # share of the length: a longer hidden part is reported


def of_color(colors: FloatArray, wanted: Sequence[float]) -> BoolArray:
    """Which colours (K, 3), red, green, blue from 0 to 255, are like the wanted one."""

    def lab(rgb: FloatArray) -> FloatArray:
        row = np.asarray(rgb, np.float32).reshape(1, -1, 3) / 255.0
        return np.asarray(cv2.cvtColor(row, cv2.COLOR_RGB2LAB)[0])

    away = np.linalg.norm(lab(colors) - lab(np.array([wanted])), axis=1)
    return np.asarray(away < _ALIKE)


def line_in_cloud(
    points: FloatArray, cable: KnownCable, camera: FloatArray | None
) -> tuple[FloatArray, tuple[str, ...]]:
    """Find the line of a cable in a cloud of its surface.

    Neighbouring points form strands, which are ordered like those in a photograph; a spline
    through them is fitted to all points nearby. A camera sees only the near half of the surface:
    a point at the distance u from the middle, across the line of sight, lies sqrt(r^2 - u^2) before
    the axis, r being the cable's radius, and is moved back by this distance. Each point of the line
    is a mean over a centimetre.

    Parameters
    ----------
    points : (K, 3) [m]
        Of the cable; a few others are harmless.
    cable : KnownCable
        Its fixtures, (3,) [m] each, and its size.
    camera : (3,) [m] or None
        Place of the camera. Without it the line lies pi r / 4 before the axis.

    Returns
    -------
    (M, 3) [m]
        Points of the line, ordered from start to end; hidden stretches are left out.
    tuple of str
        What a user should know.

    Raises
    ------
    VisionError
        If too little of a cable is found, or its points are too few.
    """
    diameter = cable.diameter
    surface = np.asarray(points[np.isfinite(points).all(axis=1)], float)
    cubes, limit = len(_cubes(surface, diameter)), round(_CUBES * cable.length / diameter)
    if cubes > limit:
        raise VisionError(
            f"{counted(len(surface), 'point')} fill {cubes} cubes of half the cable's diameter, "
            f"which itself fills fewer than {limit}. Try: --color or --box, so that the cable "
            "alone is left; length and diameter in metres."
        )
    expected = ExpectedLine(cable.fixtures, diameter, cable.length, cable.length, BEFORE_BOARD)
    chain = order_strands(_strands(surface, diameter), expected)
    if chain is None or chain.supported < _LEAST * cable.length:
        seen = 0.0 if chain is None else chain.supported
        raise VisionError(
            f"no cable found in {counted(len(surface), 'point')}: strands of {seen:.3f} m of "
            f"{cable.length:g} m at best. Try: --color or --box, so that the cable alone is left; "
            "length and diameter in metres; clouds and grippers in one frame."
        )
    line = np.vstack(chain.strands)
    t = chord_lengths(line)
    kept = np.concatenate([[True], np.diff(t) > 0])
    curve = fit_curve(t[kept], line[kept], np.ones(int(kept.sum())), _KNOT * diameter, diameter)
    for _ in range(_ROUNDS):
        curve, at, near = _refitted(curve, surface, diameter, camera)
    found = _means(curve, at, near)
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    seen = float(steps[steps < 2.5 * SPACING].sum())
    if seen < _LEAST * cable.length:
        raise VisionError(
            f"only {seen:.3f} m of {cable.length:g} m of the cable have the {_FEWEST} points per "
            f"cm that are needed; the mean is {len(near) / (100.0 * cable.length):.1f}. Try: the "
            "cloud before it was thinned out; a camera that is nearer."
        )
    messages = []
    if seen < (1.0 - _TOLD) * cable.length:
        hidden = 100 * (1.0 - seen / cable.length)
        messages.append(f"{hidden:.0f} % of the cable is hidden, or has too few points")
    if camera is None:
        before = 1e3 * np.pi * diameter / 8
        messages.append(f"the line is {before:.1f} mm before the axis (no place of the camera)")
    return found, tuple(messages)


def _strands(points: FloatArray, diameter: float) -> list[Strand]:
    """Lines through the connected parts of a cloud, lonely points left out."""
    reach = _REACH * diameter
    if len(points) < _FEWEST:
        return []
    tree = cKDTree(points)
    count = tree.query_ball_point(points, reach, return_length=True)
    points = points[count > _LONELY * np.median(count)]
    first = _cubes(points, diameter)  # each is moved to the mean of its neighbours
    tree = cKDTree(points)
    nodes = np.array(
        [points[near].mean(axis=0) for near in tree.query_ball_point(points[first], reach)]
    )
    graph = cKDTree(nodes).sparse_distance_matrix(cKDTree(nodes), reach).tocsr()
    n, part = connected_components(graph, directed=False)
    strands = []
    for k in range(n):
        inside = np.flatnonzero(part == k)
        if len(inside) < _FEWEST:
            continue
        own: Any = graph[inside][:, inside]
        tip = np.argmax(dijkstra(own, indices=np.array([0]))[0])
        away = dijkstra(own, indices=np.array([tip]))[0]
        bins = np.floor(away / diameter).astype(int)
        line = np.array([nodes[inside[bins == b]].mean(axis=0) for b in np.unique(bins)])
        if length_of(line) > _SHORTEST * diameter:
            strands.append(Strand(line, 1.0, 1.0, np.zeros(3), np.zeros(3)))
    return strands


def _cubes(points: FloatArray, diameter: float) -> IntArray:
    """Index of one point in each cube of half a diameter that points fill."""
    cubes = np.floor(points / (0.5 * diameter)).astype(int)
    return np.asarray(np.unique(cubes, axis=0, return_index=True)[1])


def _refitted(
    curve: BSpline, points: FloatArray, diameter: float, camera: FloatArray | None
) -> tuple[BSpline, FloatArray, FloatArray]:
    """The spline fitted to all points near it, their places on it, and the points on the axis."""
    lower, upper = curve.t[curve.k], curve.t[-curve.k - 1]
    margin = diameter if upper - lower > 4 * diameter else 0.0
    fine = np.linspace(
        lower - margin, upper + margin, max(3, round(8 * (upper - lower) / diameter))
    )
    away, nearest = map(np.asarray, cKDTree(curve(fine)).query(points))
    near = np.asarray(away < _REACH * diameter)
    near &= (nearest > 0) & (nearest < len(fine) - 1)  # those beyond the ends are not beside it
    points, t = points[near], fine[nearest[near]]
    tangent = unit(curve(t, 1))
    t = t + ((points - curve(t)) * tangent).sum(axis=1)
    if camera is not None:
        sight = points - camera
        sight = unit(sight - (sight * tangent).sum(axis=1, keepdims=True) * tangent)
        across = ((points - curve(t)) * np.cross(tangent, sight)).sum(axis=1)
        points = points + np.sqrt(np.maximum(0.25 * diameter**2 - across**2, 0.0))[:, None] * sight
    order = np.argsort(t)
    t, points = t[order], points[order]
    return fit_curve(t, points, np.ones(len(t)), _KNOT * diameter, _SMOOTH * diameter), t, points


def _means(curve: BSpline, t: FloatArray, points: FloatArray) -> FloatArray:
    """Points (K, 3) of the curve, each moved by the mean of the cloud beside it."""
    bins = np.floor((t - t[0]) / SPACING).astype(int)
    found = []
    for b in np.unique(bins):
        inside = bins == b
        if inside.sum() >= _FEWEST:
            residual = points[inside] - curve(t[inside])
            found.append(curve(t[inside].mean()) + residual.mean(axis=0))
    return np.reshape(found, (-1, 3))
