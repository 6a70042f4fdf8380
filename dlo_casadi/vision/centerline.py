"""From a photograph to the centre-line of its cable: coarse strands refined profile by profile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, gaussian_filter1d, label

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import Array, View
from dlo_casadi.vision.chain import Workings, find_cable
from dlo_casadi.vision.curves import SmoothCurve, chord_length, fit_curve, length_of
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
from dlo_casadi.vision.workplane import ExpectedLine, rectify

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


SPACING = 0.0025  # m, between points of a line
_MOST_POINTS = 400
_FAR = 0.2  # largest distance of the line's end from a fixture in the picture, of the length
_LEAST = 0.2  # least part of the length that must be measured
_DOUBTFUL = 0.8  # confidence below which a message says why
_SHORT = 0.97  # of the length: a shorter line between both fixtures is not to scale


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
    coverage : scalar in 0..1
        Length along the points, without the gaps, over the length of the cable.
    gaps : tuple of int
        Indices of the points after which a stretch is missing.
    confidence : scalar in 0..1
        Share of the line inside the picture that was measured soundly.
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
    workings: Workings | None = None,
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
    workings : Workings, optional
        Is filled with what the steps have seen, also where one of them fails.

    Raises
    ------
    VisionError
        If no cable or more than one is found, or if it does not lead to the fixtures.

    A cylinder of radius r whose axis lies at the distance D from the camera, seen at the angle a
    from the normal of the board, has its silhouette's middle r^2 tan(a) / D beside its axis: 7 um
    for r = 6 mm, D = 1.7 m, a = 17 degrees, and therefore left uncorrected.
    """
    last = None if end is None else np.asarray(end, float)
    expected = ExpectedLine(np.asarray(start, float), last, diameter, length, length)
    measured = measure_line(image, view, expected, workings or Workings())
    trace, kept, gaps, seen = measured.trace, measured.kept, measured.gaps, measured.seen
    points = trace.points[kept]
    return Centerline(
        points,
        trace.std[kept],
        view.to_pixels(points),
        min(1.0, seen / length),
        gaps,
        measured.confidence,
        (
            *_gap_messages(trace, kept, gaps, length),
            *_fit_messages(points, seen, expected),
            *measured.messages,
        ),
    )


@dataclass(frozen=True)
class MeasuredLine:
    """The trace of a cable and what of it counts."""

    trace: Trace
    kept: NDArray[np.intp]  # (K,), sound profiles, evenly spaced
    gaps: tuple[int, ...]  # indices of the kept ones after which a stretch is missing
    seen: float  # [m], length along the kept ones, without the gaps
    confidence: float  # share of the line inside the picture that was measured soundly
    messages: tuple[str, ...]  # on its width and soundness


def measure_line(
    image: NDArray[np.uint8], view: View, expected: ExpectedLine, workings: Workings
) -> MeasuredLine:
    """Find the line in a plane, trace it, and choose the sound and evenly spaced profiles."""
    diameter = expected.diameter
    workings.plane = rectify(image, view, expected)
    chain = find_cable(workings.plane, expected, workings)
    trace = trace_cable(image, view, chain.strands, expected)
    workings.unsound = trace.points[~trace.sound & trace.inside]

    step = max(SPACING, float(trace.t[-1] - trace.t[0]) / _MOST_POINTS)
    kept = np.nonzero(trace.sound)[0]
    kept = kept[np.unique(np.floor(trace.t[kept] / step), return_index=True)[1]]
    jumps = np.diff(trace.t[kept])
    missing = jumps > max(2.5 * step, 0.5 * diameter)
    seen = float(jumps[~missing].sum())
    found = f"no cable found: a line of {chain.supported:.3f} m was found, but "
    if seen < _LEAST * expected.typical:
        raise VisionError(
            f"{found}only {seen:.3f} m of it look like a cable of {1e3 * diameter:.1f} mm with an "
            "edge on both sides. Try: the right diameter; a sharper photograph; a plainer "
            "background; more contrast."
        )
    width, pixel = trace.shape.width, 1.0 / view.scale
    if not 0.45 * diameter < width < max(1.7 * diameter, diameter + 2.5 * pixel):
        raise VisionError(
            f"{found}it is {1e3 * width:.1f} mm wide and the cable {1e3 * diameter:.1f} mm. "
            "Try: the right diameter, in metres; is the cable in the picture?"
        )
    _check_fixtures(trace.points[kept], view, expected)
    confidence = float(np.clip(trace.sound.sum() / max(1, trace.inside.sum()), 0.0, 1.0))
    messages = []
    if abs(width - diameter) >= 0.3 * diameter + pixel:
        messages.append(
            f"the line is {1e3 * width:.1f} mm wide and the cable {1e3 * diameter:.1f} mm: "
            "check the diameter, and whether a shadow was taken for the cable"
        )
    if confidence < _DOUBTFUL:
        messages.append(
            f"only {100 * confidence:.0f} % of the line look like a cable with an edge on both "
            "sides: a sharper photograph, a plainer background or more contrast would help"
        )
    gaps = tuple(int(i) for i in np.nonzero(missing)[0])
    return MeasuredLine(trace, kept, gaps, seen, confidence, tuple(messages))


def _in_picture(point: Array, view: View) -> bool:
    height, width = view.shape
    u, v = view.to_pixels(point)[0]
    return bool(0 <= u <= width - 1 and 0 <= v <= height - 1)


def _check_fixtures(points: Array, view: View, expected: ExpectedLine) -> None:
    """Raise if the line ends far from a fixture that is in the picture."""
    for name, fixture, tip, away in expected.tips(points):
        if away <= _FAR * expected.typical or not _in_picture(fixture, view):
            continue
        if expected.in_space:
            (u, v), (at_u, at_v) = view.to_pixels([fixture, tip])
            raise VisionError(
                f"the cable does not reach its {name}: the line found ends at ({at_u:.0f}, "
                f"{at_v:.0f}) px, and the {name} is declared where ({u:.0f}, {v:.0f}) px shows it. "
                f"Try: {name} in metres and in the board frame? Is the photograph of this pose? Is "
                "the cable hidden there?"
            )
        raise VisionError(
            f"the cable does not reach its {name}: the line found ends {away:.3f} m from "
            f"({fixture[0]:.3f}, {fixture[1]:.3f}) m, at ({tip[0]:.3f}, {tip[1]:.3f}) m. "
            f"Try: {name} in metres and in the board frame? Is the cable hidden there?"
        )


def _gap_messages(
    trace: Trace, kept: NDArray[np.intp], gaps: tuple[int, ...], length: float
) -> list[str]:
    """Sentences on what is missing along the line: how much, where and why."""
    messages = []
    for i in gaps:
        missing = slice(kept[i], kept[i + 1])
        before, after = trace.t[kept[i]], trace.t[kept[i + 1]]
        share = f"{100 * (after - before) / length:.0f} % of the cable"
        where = f"between {before:.2f} and {after:.2f} m of the measured line"
        if not trace.inside[missing].all():
            messages.append(f"{share}, {where}, are outside the picture")
        elif trace.glare[missing].mean() > 0.3:
            messages.append(
                f"glare hides {share}, {where}: a lamp from the side or a softer one would help"
            )
        else:
            messages.append(f"{share}, {where}, are hidden or do not look like it")
    return messages


def _fit_messages(points: Array, seen: float, expected: ExpectedLine) -> list[str]:
    """Sentences on how the line fits the fixtures and the length."""
    messages, length, whole = [], expected.typical, length_of(points)
    for name, _, _, away in expected.tips(points):
        if away > max(0.03 * length, 0.01):
            messages.append(f"the measured line stops {away:.3f} m before the {name} fixture")
        if expected.end is not None:
            whole += away
    off = f"{100 * abs(whole / length - 1):.1f} %"
    if whole > 1.03 * length:
        messages.append(
            f"the line found is {off} longer than declared ({whole:.3f} of {length:g} m): "
            "check the scale and the length"
        )
    elif expected.end is not None and whole < _SHORT * length:
        messages.append(
            f"the line found is {off} shorter than declared ({whole:.3f} of {length:g} m, up to "
            "both fixtures): check the scale and the length"
        )
    elif expected.end is None and seen < 0.9 * length:
        messages.append(f"only {seen:.3f} m of {length:g} m were measured")
    return messages
