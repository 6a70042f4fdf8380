"""From coarse strands to the middle of the cable, profile by profile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter1d, label

from dlo_casadi.vision.curve import SmoothCurve, chord_length, fit_curve
from dlo_casadi.vision.profiles import (
    Crossings,
    EdgeShape,
    Profiles,
    cable_direction,
    edge_shape,
    find_edges,
    local_directions,
    sample_profiles,
)
from dlo_casadi.vision.view import Array, View
from dlo_casadi.vision.workplane import ExpectedLine

_STEP = 1 / 8  # of the diameter: between profiles
_RAW, FINE = 0.15, 0.7  # diameters averaged along the cable, to judge and to measure
# Height and width vary by 1.5 % along a cable of seven pixels, by 6 % half a width from its end.
_UNLIKE = 0.05
_WHITE = 248  # grey level
_FLOOR_PX = 0.06  # what the sampling and compression of a photograph leave, along centimetres


@dataclass(frozen=True)
class Trace:
    """Middle of the cable at closely spaced profiles."""

    t: Array  # (K,) [m], length along the line, gaps included
    points: Array  # (K, 2) [m], middle of the two edges
    std: Array  # (K,) [m], standard deviation across the cable
    sound: NDArray[np.bool_]  # (K,), the profile shows the cable and nothing else
    inside: NDArray[np.bool_]  # (K,), it lies in the photograph
    glare: NDArray[np.bool_]  # (K,), the place of the cable is overexposed
    direction: Array  # (3,), weights of blue, green and red by which most of the cable stands out
    shape: EdgeShape  # typical width and blur; a width of 0 where no edges were found
    width_std: float  # [m], scatter of the width along the line


def trace_cable(
    image: NDArray[np.uint8], view: View, strands: tuple[Array, ...], expected: ExpectedLine
) -> Trace:
    """Lay a smooth curve through the strands and move it onto the middle between the edges.

    Two rounds on nearly raw profiles tell which of them show the cable; a last one measures on
    profiles that are averaged along the cable, over sound ones only. In space the cable may pass in
    front of things of several colours.
    """
    diameter, in_space = expected.diameter, expected.in_space
    curve, t = _first_curve(strands, expected)
    bright = image.astype(np.float32)
    profiles = sample_profiles(bright, view, curve, t, diameter)
    usual = profiles.inside & (t > t[0] + 2 * diameter) & (t < t[-1] - 2 * diameter)
    if usual.sum() < 8:
        usual = profiles.inside
    if usual.sum() < 8:
        return _nothing(curve, t, profiles.inside)
    common = cable_direction(profiles, usual, diameter)
    direction = local_directions(profiles, common, usual, diameter) if in_space else common
    guess = EdgeShape(diameter, 0.8 / view.scale)
    for _ in range(2):
        raw = sample_profiles(bright, view, curve, t, diameter)
        raw = raw.average(raw.inside, _RAW * diameter)
        shape = edge_shape(raw, direction, usual, guess)
        rough = find_edges(raw, direction, shape)
        sound = raw.inside & _is_usual(rough, usual, diameter)
        # Not in space: there the interval of EI of ten rendered poses was half as wide with it, and
        # did not hold the truth.
        if not in_space:
            sound &= ~_beside_end(rough, t, sound, diameter)
        if sound.sum() < 8:
            return _nothing(curve, t, raw.inside)
        points = curve.position(t) + rough.offset[:, None] * curve.normal(t)
        curve = fit_curve(t, points, sound.astype(float), 2 * diameter, 0.5 * diameter)
        usual = sound
    raw = sample_profiles(bright, view, curve, t, diameter)
    # In a plane light shifts all photographs alike, harmonics that `edge_bias` takes up better: EI
    # of the rendered `connector` is 0.2 % off then, 2 % with what is left of them here.
    rough = find_edges(raw.average(raw.inside, _RAW * diameter), direction, shape, in_space)
    fine = find_edges(raw.average(sound, FINE * diameter), direction, shape, in_space)
    sound = _without_rims(
        raw.inside & _is_usual(rough, sound, diameter) & _is_usual(fine, sound, diameter)
    )
    points = curve.position(t) + fine.offset[:, None] * curve.normal(t)
    std = _std(rough.offset, fine.offset, sound, view)
    scatter = np.abs(fine.width[sound] - shape.width)
    width_std = 1.4826 * float(np.median(scatter)) if len(scatter) else 0.0
    glare = _glare(raw, diameter)
    return Trace(t, points, std, sound, raw.inside, glare, common, shape, width_std)


def _glare(profiles: Profiles, diameter: float) -> NDArray[np.bool_]:
    """Profiles (K,) of which half of the cable's width is white beyond measure."""
    body = np.abs(profiles.offset) < 0.5 * diameter
    return (profiles.values[:, body].min(axis=2) > _WHITE).mean(axis=1) > 0.5


def _nothing(curve: SmoothCurve, t: Array, inside: NDArray[np.bool_]) -> Trace:
    """Trace without a sound profile."""
    none = np.zeros(len(t), bool)
    at = curve.position(t)
    return Trace(t, at, np.zeros(len(t)), none, inside, none, np.zeros(3), EdgeShape(0.0, 0.0), 0.0)


def _first_curve(strands: tuple[Array, ...], expected: ExpectedLine) -> tuple[SmoothCurve, Array]:
    """Smooth curve through the strands, extended straight at both ends, and its samples t."""
    start, end, diameter = expected.start, expected.end, expected.diameter
    points = np.vstack(strands)
    t = chord_length(points)
    keep = np.concatenate([[True], np.diff(t) > 0])
    points, t = points[keep], t[keep]
    curve = fit_curve(t, points, np.ones(len(t)), 2 * diameter, diameter)
    step = _STEP * diameter
    line = curve.position(np.arange(t[0], t[-1], step))
    forwards = [curve.spline(at, 1) / np.linalg.norm(curve.spline(at, 1)) for at in (t[0], t[-1])]
    head = _ahead(float((line[0] - start) @ forwards[0]), diameter)
    tail = _ahead(np.inf if end is None else float((end - line[-1]) @ forwards[1]), diameter)
    before = line[0] + np.arange(-head, -0.5 * step, step)[:, None] * forwards[0]
    beyond = line[-1] + np.arange(step, tail, step)[:, None] * forwards[1]
    line = np.vstack([before, line, beyond])
    t = chord_length(line)
    return fit_curve(t, line, np.ones(len(t)), 2 * diameter, 0.5 * diameter), t


def _ahead(away: float, diameter: float) -> float:
    """How far to extend the line [m] towards a fixture `away` metres ahead.

    To the fixture if it is near. If not, two diameters: a skeleton ends half a width early, and
    the profiles tell where the cable does.
    """
    return max(away, 0.0) if away < 4 * diameter else 2 * diameter


def _is_usual(found: Crossings, usual: NDArray[np.bool_], diameter: float) -> NDArray[np.bool_]:
    """Profiles that are usual in height, width and place of the cable."""
    height = float(np.median(found.height[usual]))
    width = float(np.median(found.width[usual]))
    return (
        (found.height / height > 0.35)
        & (found.height / height < 2.5)
        & (np.abs(found.width / width - 1) < 0.3)
        & (np.abs(found.offset) < 0.4 * diameter)
    )


def _beside_end(
    found: Crossings, t: Array, sound: NDArray[np.bool_], diameter: float
) -> NDArray[np.bool_]:
    """Profiles within a diameter of a line's end up to the last that looks unlike those farther in.

    The blur of the cable's end, or its holder, moves the middle long before a profile is unusual.
    """
    beside = np.zeros(len(t), bool)
    inwards = np.flatnonzero(sound)
    for rows in (inwards, inwards[::-1]):
        away = np.abs(t[rows] - t[rows[0]]) if len(rows) else np.zeros(0)
        near, inner = rows[away < diameter], rows[(away >= diameter) & (away < 3 * diameter)]
        if not len(inner):
            continue
        ratios = [part[near] / np.median(part[inner]) for part in (found.height, found.width)]
        odd = np.flatnonzero((np.abs(np.array(ratios) - 1) > _UNLIKE).any(axis=0))
        beside[near[: odd[-1] + 1 if len(odd) else 0]] = True
    return beside


def _without_rims(sound: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Leave out short sound stretches, and the rims of long unsound ones.

    Beside a holder, a pin or an occluder its colour leaks into the profile before that shows. The
    line's ends, at the fixtures, are such rims too.
    """
    rim = round(0.35 / _STEP)
    sound = sound.copy()
    sound[:rim] = sound[-rim:] = False
    kept = sound & ~binary_dilation(_longer(~sound, rim), iterations=rim)
    return _longer(kept, 1.5 / _STEP)


def _longer(flags: NDArray[np.bool_], least: float) -> NDArray[np.bool_]:
    """Those of the flags (K,) that stand in a run of more than `least`."""
    runs, _ = label(flags)
    return flags & (np.bincount(runs)[runs] > least)


def _std(rough: Array, fine: Array, sound: NDArray[np.bool_], view: View) -> Array:
    """Standard deviation of each point (K,) [m].

    The scatter of the rough places about the fine ones, over two diameters, falls with the square
    root of the length of the averages. To it are added what the photograph's sampling leaves, and
    the error of the board's pose: corner error over the root of the number of corners, times 1.5
    for the lever to the cable.
    """
    deviation = 2.0 / _STEP
    weight = gaussian_filter1d(sound.astype(float), deviation)
    spread = gaussian_filter1d(np.where(sound, rough - fine, 0.0) ** 2, deviation)
    scatter = np.sqrt(spread / np.maximum(weight, 1e-6) * _RAW / FINE)
    corners = max(1, 4 * len(view.markers))
    board = 1.5 * view.reprojection_error / np.sqrt(corners)
    return np.sqrt(scatter**2 + (_FLOOR_PX**2 + board**2) / view.scale**2)
