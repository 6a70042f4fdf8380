"""From a photograph to the centre-line of its cable, in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.curve import length_of
from dlo_casadi.vision.search import Workings, find_cable
from dlo_casadi.vision.trace import Trace, trace_cable
from dlo_casadi.vision.view import Array, View
from dlo_casadi.vision.workplane import ExpectedLine, rectify

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
    workings.trace = trace = trace_cable(image, view, chain.strands, expected)

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
