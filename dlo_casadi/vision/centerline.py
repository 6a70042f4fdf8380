"""From a photograph to the centre-line of its cable, in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.curve import SmoothCurve, chord_length, fit_curve
from dlo_casadi.vision.refine import (
    Crossings,
    EdgeShape,
    average,
    cable_direction,
    edge_shape,
    find_edges,
    sample_profiles,
)
from dlo_casadi.vision.search import find_cable
from dlo_casadi.vision.view import Array, View
from dlo_casadi.vision.workplane import rectify

_MOST_POINTS = 400
_SPACING = 0.0025  # m


@dataclass(frozen=True)
class Centerline:
    """The centre-line of a cable, as seen in one photograph.

    Parameters
    ----------
    points : (K, 2) [m]
        In the board frame, ordered from start to end.
    std : (K,) [m]
        Standard deviation of each point across the cable. Neighbours share their errors.
    pixels : (K, 2) [px]
        The same points in the photograph.
    coverage : scalar
        Length along the points, without the gaps, over the length of the cable.
    gaps : tuple of int
        Indices of the points after which a stretch is missing.
    confidence : scalar in 0..1
        Coverage times the share of sound profiles.
    messages : tuple of str
        What a user should know, in plain sentences.
    """

    points: Array
    std: Array
    pixels: Array
    coverage: float
    gaps: tuple[int, ...]
    confidence: float
    messages: tuple[str, ...]


def extract_centerline(
    image: NDArray[np.uint8],
    view: View,
    *,
    start: ArrayLike,
    end: ArrayLike | None,
    diameter: float,
    length: float,
) -> Centerline:
    """Isolate the cable, order it from start to end and refine it to sub-pixel.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph, blue, green, red.
    view : View
        Where its pixels lie on the cable's plane.
    start, end : (2,) [m]
        The fixtures in the board frame; `end` is None for a free end.
    diameter, length : scalar [m]
        Of the cable.

    Raises
    ------
    VisionError
        If no cable or more than one is found, or if it does not lead to the fixtures.

    A cylinder of radius r whose axis lies at the distance D from the camera, seen at the angle a
    from the normal of the board, has its silhouette's middle r^2 tan(a) / D beside its axis: 7 um
    for r = 6 mm, D = 1.7 m, a = 17 degrees, and therefore left uncorrected.
    """
    first = np.asarray(start, float)
    last = None if end is None else np.asarray(end, float)
    plane = rectify(image, view, start=first, end=last, diameter=diameter, length=length)
    chain = find_cable(plane, start=first, end=last, diameter=diameter, length=length).chain
    curve, t = _first_curve(chain.strands, diameter, first, last)
    curve, t, crossings, good = _refine(image, view, curve, t, diameter)
    points = curve.position(t) + crossings.offset[:, None] * curve.normal(t)
    kept = np.nonzero(good)[0]
    step = max(_SPACING, (t[-1] - t[0]) / _MOST_POINTS)
    kept = kept[np.unique(np.floor(t[kept] / step), return_index=True)[1]]
    points = points[kept]
    jumps = np.diff(t[kept])
    gaps = tuple(int(i) for i in np.nonzero(jumps > 3 * step)[0])
    seen = float(jumps[jumps <= 3 * step].sum())
    coverage = min(1.0, seen / length)
    return Centerline(
        points,
        np.full(len(kept), 0.06 / view.scale),
        view.to_pixels(points),
        coverage,
        gaps,
        float(np.clip(coverage * good.mean(), 0, 1)),
        (),
    )


def _refine(
    image: NDArray[np.uint8], view: View, curve: SmoothCurve, t: Array, diameter: float
) -> tuple[SmoothCurve, Array, Crossings, NDArray[np.bool_]]:
    """Move the curve onto the middle between the cable's edges; tell which profiles show them."""
    bright = image.astype(np.float32)
    profiles = sample_profiles(bright, view, curve, t, diameter)
    good = profiles.inside & (t > t[0] + 2 * diameter) & (t < t[-1] - 2 * diameter)
    direction = cable_direction(profiles, good, diameter)
    shape = EdgeShape(diameter, 0.8 / view.scale)
    for along, trusting in ((0.15, False), (0.15, False), (ALONG, True)):
        raw = sample_profiles(bright, view, curve, t, diameter)
        profiles = average(raw, good if trusting else raw.inside, along * diameter)
        shape = edge_shape(profiles, direction, good, EdgeShape(diameter, 0.8 / view.scale))
        crossings = find_edges(profiles, direction, shape)
        sound = raw.inside & _sound(crossings, good, diameter)
        good = good & sound if trusting else sound
        if good.sum() < 10:
            raise VisionError("no cable found")
        points = curve.position(t) + crossings.offset[:, None] * curve.normal(t)
        moved = fit_curve(t, points, good.astype(float), 2 * diameter, 0.5 * diameter)
        if not trusting:
            curve = moved
    return curve, t, crossings, good


ALONG = 0.7


def _first_curve(
    strands: tuple[Array, ...], diameter: float, start: Array, end: Array | None
) -> tuple[SmoothCurve, Array]:
    """Smooth curve through the strands, extended straight to the fixtures, and its samples t."""
    points = np.vstack(strands)
    t = chord_length(points)
    keep = np.concatenate([[True], np.diff(t) > 0])
    points, t = points[keep], t[keep]
    curve = fit_curve(t, points, np.ones(len(t)), 2 * diameter, diameter)
    head = _extension(points[0], curve, t[0], start, diameter, -1.0)
    tail = 0.0 if end is None else _extension(points[-1], curve, t[-1], end, diameter, 1.0)
    samples = np.arange(t[0], t[-1], diameter / 8)
    line = curve.position(samples)
    ahead = line[0] + np.arange(-head, 0.0, diameter / 8)[:, None] * _slope(curve, t[0])
    beyond = line[-1] + np.arange(diameter / 8, tail, diameter / 8)[:, None] * _slope(curve, t[-1])
    line = np.vstack([ahead, line, beyond])
    t = chord_length(line)
    return fit_curve(t, line, np.ones(len(t)), 2 * diameter, 0.5 * diameter), t


def _slope(curve: SmoothCurve, t: float) -> Array:
    slope = np.asarray(curve.spline(t, 1))
    return slope / np.linalg.norm(slope)


def _extension(
    tip: Array, curve: SmoothCurve, t: float, fixture: Array, diameter: float, sign: float
) -> float:
    """How far the fixture lies ahead of the tip [m], if it is near."""
    ahead = float(sign * (fixture - tip) @ _slope(curve, t))
    return ahead if 0 < ahead < 4 * diameter else 0.0


def _sound(crossings: Crossings, usual: NDArray[np.bool_], diameter: float) -> NDArray[np.bool_]:
    """Profiles that show the cable and nothing else: usual in height, width and place."""
    height = float(np.median(crossings.height[usual]))
    width = float(np.median(crossings.width[usual]))
    return (
        (np.abs(crossings.height / height - 1) < 0.4)
        & (np.abs(crossings.width / width - 1) < 0.3)
        & (np.abs(crossings.offset) < 0.4 * diameter)
    )
