"""From a photograph to the centre-line of its cable: coarse strands refined profile by profile."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import binary_dilation, gaussian_filter1d, label

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, chord_lengths, length_of
from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import Picture, View
from dlo_casadi.vision.chain import Workings, find_cable
from dlo_casadi.vision.profiles import (
    Crossings,
    EdgeShape,
    cable_direction,
    edge_shape,
    find_edges,
    fit_curve,
    local_directions,
    normals,
    sample_profiles,
)
from dlo_casadi.vision.workplane import ALONG_BOARD, ExpectedLine, KnownCable, rectify

_STEP = 1 / 8  # of the diameter: distance between profiles
_RAW, FINE = 0.15, 0.7  # diameters over which profiles are averaged: to judge them, and to measure
# Relative difference in height or width beyond which a profile is unusual. Both vary by 1.5 %
# along a cable of seven pixels, and by 6 % half a width from its end.
_UNLIKE = 0.05
# First guess of the edges' blur, in diameters. The first curve may follow a highlight, a tenth of a
# diameter beside the middle; a narrower guess takes the cable's rim for its surroundings.
_FIRST_BLUR = 0.12
_WHITE = 248  # grey level
_FLOOR_PX = 0.06  # smallest error averaged over centimetres, due to sampling and compression
SPACING = 0.0025  # m, distance between points of a line
_MOST_POINTS = 400
_FAR = 0.2  # of the length: largest distance of the line's end from a fixture in the picture
_LEAST = 0.2  # smallest share of the length that must be measured
_DOUBTFUL = 0.8  # confidence below which a message gives the reason
_SHORT = 0.97  # share of the length: a shorter line between both fixtures has a wrong scale


@dataclass(frozen=True)
class Trace:
    """Middle of the cable at closely spaced profiles."""

    t: FloatArray  # (K,) [m], length along the line, gaps included
    points: FloatArray  # (K, 2) [m], middle of the two edges
    std: FloatArray  # (K,) [m], standard deviation across the cable
    sound: BoolArray  # (K,), the profile shows the cable and nothing else
    inside: BoolArray  # (K,), it lies in the photograph
    glare: BoolArray  # (K,), half of the cable's width is white beyond measure
    direction: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Weights (3,) of blue, green and red by which most of the cable stands out."""
    shape: EdgeShape = field(default_factory=EdgeShape)  # typical; 0 where no edges were found
    width_std: float = 0.0  # [m], scatter of the width along the line


def trace_cable(
    image: Picture, view: View, strands: tuple[FloatArray, ...], expected: ExpectedLine
) -> Trace:
    """Fit a smooth curve to the strands and move it onto the middle between the edges.

    Two rounds on nearly raw profiles find those that show the cable; the last round measures on
    profiles averaged along the cable, over sound ones only.
    """
    diameter, varied = expected.diameter, expected.scene.varied
    curve, t = _first_curve(strands, expected)
    bright = image.astype(np.float32)
    raw = sample_profiles(bright, view, curve, t, diameter)
    usual = raw.inside & (t > t[0] + 2 * diameter) & (t < t[-1] - 2 * diameter)
    if usual.sum() < 8:
        usual = raw.inside
    sound = np.zeros(len(t), bool)
    nothing = Trace(t, curve(t), 0.0 * t, sound, raw.inside, sound)
    if usual.sum() < 8:
        return nothing
    common = cable_direction(raw, usual, diameter)
    direction = local_directions(raw, common, usual, diameter) if varied else common
    guess = EdgeShape(diameter, max(0.8 / view.scale, _FIRST_BLUR * diameter))
    for _ in range(2):
        smooth = raw.average(raw.inside, _RAW * diameter)
        shape = edge_shape(smooth, direction, usual, guess)
        rough = find_edges(smooth, direction, shape)
        sound = raw.inside & _is_usual(rough, usual, diameter)
        # Not in front of the board: with it the interval of EI from ten rendered poses was half
        # as wide as without, and did not contain the truth.
        if not varied:
            sound &= ~_beside_end(rough, t, sound, diameter)
        if sound.sum() < 8:
            return replace(nothing, points=curve(t), inside=raw.inside)
        points = curve(t) + rough.offset[:, None] * normals(curve(t, 1))
        curve = fit_curve(t, points, sound.astype(float), 2 * diameter, 0.5 * diameter)
        usual = sound
        raw = sample_profiles(bright, view, curve, t, diameter)
    # In a plane, light shifts the edges equally in all photographs. `edge_bias` models this better:
    # EI of the rendered `connector` is 0.2 % off with it, 2 % with a correction here.
    rough = find_edges(raw.average(raw.inside, _RAW * diameter), direction, shape, varied)
    fine = find_edges(raw.average(sound, FINE * diameter), direction, shape, varied)
    sound = _without_rims(
        raw.inside & _is_usual(rough, sound, diameter) & _is_usual(fine, sound, diameter)
    )
    points = curve(t) + fine.offset[:, None] * normals(curve(t, 1))
    std = _std(rough.offset, fine.offset, sound, view)
    scatter = np.abs(fine.width[sound] - shape.width)
    width_std = 1.4826 * float(np.median(scatter)) if len(scatter) else 0.0
    body = np.abs(raw.offset) < 0.5 * diameter
    glare = (raw.values[:, body].min(axis=2) > _WHITE).mean(axis=1) > 0.5
    return Trace(t, points, std, sound, raw.inside, glare, common, shape, width_std)


def _first_curve(
    strands: tuple[FloatArray, ...], expected: ExpectedLine
) -> tuple[BSpline, FloatArray]:
    """Smooth curve through the strands, extended straight at both ends, and its samples t.

    It is extended to a near fixture, otherwise by two diameters: a skeleton ends half a width too
    early, and the profiles show the cable's end.
    """
    diameter = expected.diameter
    points = np.vstack(strands)
    t = chord_lengths(points)
    keep = np.concatenate([[True], np.diff(t) > 0])
    points, t = points[keep], t[keep]
    curve = fit_curve(t, points, np.ones(len(t)), 2 * diameter, diameter)
    step = _STEP * diameter
    line = curve(np.arange(t[0], t[-1], step))
    ahead = [2 * diameter, 2 * diameter]
    forwards = [curve(at, 1) / np.linalg.norm(curve(at, 1)) for at in (t[0], t[-1])]
    for k, fixture in enumerate(expected.fixtures):
        away = float((line[0] - fixture if k == 0 else fixture - line[-1]) @ forwards[k])
        ahead[k] = max(away, 0.0) if away < 4 * diameter else 2 * diameter
    before = line[0] + np.arange(-ahead[0], -0.5 * step, step)[:, None] * forwards[0]
    beyond = line[-1] + np.arange(step, ahead[1], step)[:, None] * forwards[1]
    line = np.vstack([before, line, beyond])
    t = chord_lengths(line)
    return fit_curve(t, line, np.ones(len(t)), 2 * diameter, 0.5 * diameter), t


def _is_usual(found: Crossings, usual: BoolArray, diameter: float) -> BoolArray:
    """Profiles with usual height, width and place of the cable."""
    tall, wide = (part / np.median(part[usual]) for part in (found.height, found.width))
    alike = (tall > 0.35) & (tall < 2.5) & (np.abs(wide - 1) < 0.3)
    return alike & (np.abs(found.offset) < 0.4 * diameter)


def _beside_end(found: Crossings, t: FloatArray, sound: BoolArray, diameter: float) -> BoolArray:
    """Profiles within a diameter of a line's end, up to the last one that differs from inner ones.

    Blur of the cable's end, or a holder, moves the middle before a profile looks unusual.
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


def _without_rims(sound: BoolArray) -> BoolArray:
    """Leave out short sound intervals, and the neighbourhood of long unsound ones.

    Beside a holder, a pin or an occluder its colour leaks into profiles that still look sound. This
    also happens at the line's ends, at the fixtures.
    """
    rim = round(0.35 / _STEP)
    sound = sound.copy()
    sound[:rim] = sound[-rim:] = False
    kept = sound & ~binary_dilation(_longer(~sound, rim), iterations=rim)
    return _longer(kept, 1.5 / _STEP)


def _longer(flags: BoolArray, least: float) -> BoolArray:
    """Flags (K,) in runs longer than `least`."""
    runs, _ = label(flags)
    return flags & (np.bincount(runs)[runs] > least)


def _std(rough: FloatArray, fine: FloatArray, sound: BoolArray, view: View) -> FloatArray:
    """Standard deviation of each point (K,) [m].

    It is the scatter of the rough places about the fine ones, over two diameters, which decreases
    with the square root of the length of the averages; plus the error of the photograph's sampling,
    and of the board's pose: corner error over the root of the number of corners, times 1.5 for the
    lever to the cable.
    """
    deviation = 2.0 / _STEP
    weight = gaussian_filter1d(sound.astype(float), deviation)
    spread = gaussian_filter1d(np.where(sound, rough - fine, 0.0) ** 2, deviation)
    scatter = np.sqrt(spread / np.maximum(weight, 1e-6) * _RAW / FINE)
    corners = max(1, 4 * len(view.markers))
    board = 1.5 * view.reprojection_error / np.sqrt(corners)
    return np.sqrt(scatter**2 + (_FLOOR_PX**2 + board**2) / view.scale**2)


@dataclass(frozen=True)
class ExtractedCenterline:
    """The centre-line of a cable, as seen in one photograph."""

    points: FloatArray
    """(K, 2) [m], in the board frame, ordered from start to end."""
    std: FloatArray
    """(K,) [m], standard deviation across the cable. Neighbours share their errors."""
    pixels: FloatArray
    """(K, 2) [px], the same points in the photograph."""
    coverage: float
    """Length along the points, without the gaps, over the length of the cable, 0..1."""
    gaps: tuple[int, ...]
    """Indices of the points after which a stretch is missing."""
    confidence: float
    """Share of the line inside the picture that was measured soundly, 0..1."""
    messages: tuple[str, ...]
    """What a user should know, in plain sentences."""


def extract_centerline(
    image: Picture, view: View, cable: KnownCable, workings: Workings | None = None
) -> ExtractedCenterline:
    """Isolate the cable, order it from start to end and refine it to sub-pixel.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph, blue, green, red; the view tells where its pixels lie on the cable's plane.
    cable : KnownCable
        Its fixtures, (2,) [m] each, and its size.
    workings : Workings, optional
        Is filled with the results of the steps, also if one of them fails.

    Raises
    ------
    VisionError
        If no cable or more than one is found, or if it does not lead to the fixtures.

    A cylinder of radius r whose axis lies at the distance D from the camera, seen at the angle a
    from the normal of the board, has its silhouette's middle r^2 tan(a) / D beside its axis: 7 um
    for r = 6 mm, D = 1.7 m, a = 17 degrees, and therefore left uncorrected.
    """
    length, workings = cable.length, workings or Workings()
    expected = ExpectedLine(cable.fixtures, cable.diameter, length, length, ALONG_BOARD)
    line = measure_line(image, view, expected, workings)
    points = line.trace.points[line.kept]
    if line.unreached:
        name, fixture, tip, away = line.unreached[0]
        raise VisionError(
            f"the cable does not reach its {name}: the line found ends {away:.3f} m from "
            f"({fixture[0]:.3f}, {fixture[1]:.3f}) m, at ({tip[0]:.3f}, {tip[1]:.3f}) m. "
            f"Try: {name} in metres and in the board frame? Is the cable hidden there?"
        )
    workings.pixels, workings.gaps = view.to_pixels(points), line.gaps
    return ExtractedCenterline(
        points,
        line.trace.std[line.kept],
        workings.pixels,
        min(1.0, line.seen / length),
        line.gaps,
        line.confidence,
        (*_remarks(line, expected), *line.messages),
    )


@dataclass(frozen=True)
class MeasuredLine:
    """The trace of a cable and its sound points."""

    trace: Trace
    kept: IntArray  # (K,), sound profiles, evenly spaced
    gaps: tuple[int, ...]  # indices of kept profiles that are followed by a gap
    seen: float  # [m], length along the kept profiles, without the gaps
    confidence: float  # share of the line inside the picture that was measured soundly
    messages: tuple[str, ...]  # on its width and soundness
    unreached: list[tuple[str, FloatArray, FloatArray, float]]
    """Of the fixtures in the picture those far from the line's ends, see `ExpectedLine.tips`."""


def measure_line(
    image: Picture, view: View, expected: ExpectedLine, workings: Workings
) -> MeasuredLine:
    """Find the line in a plane, trace it, and choose the sound and evenly spaced profiles."""
    diameter = expected.diameter
    workings.view, workings.expected = view, expected
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
    wide = f"{1e3 * width:.1f} mm wide and the cable {1e3 * diameter:.1f} mm"
    # On the board a narrower line is a highlight with one of the edges: millimetres off the middle.
    least = 0.45 * diameter
    if not expected.scene.varied:
        least = max(least, 0.7 * diameter - pixel)
    if not least < width < max(1.7 * diameter, diameter + 2.5 * pixel):
        cure = "" if width > diameter else " a softer lamp, or one from the side, if it is glossy;"
        raise VisionError(
            f"{found}it is {wide}. Try: the right diameter, in metres;{cure} is the cable in the "
            "picture?"
        )
    confidence = float(np.clip(trace.sound.sum() / max(1, trace.inside.sum()), 0.0, 1.0))
    messages = []
    if abs(width - diameter) >= 0.3 * diameter + pixel:
        messages.append(
            f"the line is {wide}: check the diameter, and whether a shadow was taken for the cable"
        )
    if confidence < _DOUBTFUL:
        messages.append(
            f"only {100 * confidence:.0f} % of the line look like a cable with an edge on both "
            "sides: a sharper photograph, a plainer background or more contrast would help"
        )
    far = [tip for tip in expected.tips(trace.points[kept]) if tip[-1] > _FAR * expected.typical]
    at = view.to_pixels([fixture for _, fixture, *_ in far])
    in_picture = np.all((at >= 0) & (at <= np.array(view.shape[::-1]) - 1), axis=1)
    unreached = [tip for tip, seen_there in zip(far, in_picture, strict=True) if seen_there]
    gaps = tuple(int(i) for i in np.nonzero(missing)[0])
    return MeasuredLine(trace, kept, gaps, seen, confidence, tuple(messages), unreached)


def _remarks(line: MeasuredLine, expected: ExpectedLine) -> Iterator[str]:
    """Sentences on gaps of the line (size, place, reason), and its fit to fixtures and length."""
    trace, length = line.trace, expected.typical
    for i in line.gaps:
        missing = slice(line.kept[i], line.kept[i + 1])
        before, after = trace.t[line.kept[i : i + 2]]
        share = f"{100 * (after - before) / length:.0f} % of the cable"
        where = f"between {before:.2f} and {after:.2f} m of the measured line"
        if not trace.inside[missing].all():
            yield f"{share}, {where}, are outside the picture"
        elif trace.glare[missing].mean() > 0.3:
            yield f"glare hides {share}, {where}: a lamp from the side or a softer one would help"
        else:
            yield f"{share}, {where}, are hidden or do not look like it"
    points, held = trace.points[line.kept], len(expected.fixtures) == 2
    whole = length_of(points)
    for name, _, _, away in expected.tips(points):
        if away > max(0.03 * length, 0.01):
            yield f"the measured line stops {away:.3f} m before the {name} fixture"
        whole += away if held else 0.0
    off = f"the line found is {100 * abs(whole / length - 1):.1f} %"
    than = f"than declared ({whole:.3f} of {length:g} m"
    if whole > 1.03 * length:
        yield f"{off} longer {than}): check the scale and the length"
    elif held and whole < _SHORT * length:
        yield f"{off} shorter {than}, up to both fixtures): check the scale and the length"
    elif not held and line.seen < 0.9 * length:
        yield f"only {line.seen:.3f} m of {length:g} m were measured"
