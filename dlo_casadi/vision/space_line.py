"""The line in space on which the photographs of one pose agree, without any model."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray, chord_lengths, unit
from dlo_casadi.errors import VisionError
from dlo_casadi.vision.board import Board, locate_camera
from dlo_casadi.vision.camera import Camera, Picture
from dlo_casadi.vision.centerline import SPACING
from dlo_casadi.vision.image import spoilt
from dlo_casadi.vision.image_curve import (
    TIP,
    ImageCurve,
    loops_either_way,
    match_lines,
    see_cable,
    triangulate,
)
from dlo_casadi.vision.space_curve import (
    CurveFit,
    first_curve,
    fit_curve_to_images,
    measure_shared_outlines,
)
from dlo_casadi.vision.workplane import KnownCable

_AGREE = 0.6  # smallest share of a photograph's pixels on the common line: each may hide parts
_READINGS = 8  # largest number of orders of loops that are tried
_SURE = 0.9  # share of pixels beyond which the first curve of a pair is good enough
_AGREE_PX = 1.0  # px, errors of the cameras' poses, added to four standard deviations
_FAR = 0.05  # of the length: largest distance of the line's end from its fixture
_LONGER = 1.1  # of the cable's length: largest length of a line in space up to its fixtures
_NARROW = np.radians(5.0)  # smallest angle at the cable: depths are ten times less accurate
# Length of a span of the spline [diameters]: no cable bends more sharply. With half of it lines in
# space from rendered photographs change by less than a tenth of their std.
_SPAN = 2.0
_SPANS = (20, 100)  # smallest and largest number of spans
_UNKNOWN = 0.05  # of the length: unknown part beyond which a message gives the reason
_KNOWN = 0.25  # diameters: largest standard deviation of a point
_MISSING = 0.1  # of the length: a line that is shorter by more lacks a hidden part


@dataclass(frozen=True)
class SpaceLine:
    """A line in space, with the uncertainty of each point."""

    points: FloatArray
    """(K, 3) [m], in the board frame, ordered from start to end, evenly spaced."""
    std: FloatArray
    """(K,) [m], largest standard deviation in any direction across the line; where a point lies
    along it, photographs do not tell."""
    gaps: tuple[int, ...]
    """Indices of the points after which a stretch is missing."""


@dataclass(frozen=True)
class Views:
    """Lines found in the photographs of one pose, and in space."""

    line: SpaceLine | None
    """None where fewer than two photographs agree."""
    curves: Mapping[str, ImageCurve]
    """What is seen in each usable photograph, by its name, in pixels."""
    problems: Mapping[str, str]
    """Why a photograph is not used, and what to try."""
    messages: tuple[str, ...]
    """What else a user should know; those on one photograph begin with its name."""
    places: Mapping[str, FloatArray]
    """Where the pixels of the curves lie, (K, 3) [m]: on the line in space, nan for those that are
    not of it. Without a line it is a guess, at depths from fixture to fixture."""


def measure_views(
    photographs: Mapping[str, Picture], board: Board, camera: Camera, cable: KnownCable
) -> Views:
    """Measure a cable in photographs from several places: the line in each, and in space.

    Nothing is raised for a photograph that cannot be used: `problems` names it, and the others
    are used. One photograph alone gives no line.

    Parameters
    ----------
    photographs : dict of str to (H, W, 3) uint8
        Pictures of one pose by their names: one `camera` took them all, each shows the `board`.
    cable : KnownCable
        Its fixtures, (3,) [m] each, and its size.
    """
    problems: dict[str, str] = {}
    curves: dict[str, ImageCurve] = {}
    for name, image in photographs.items():
        try:
            curves[name] = see_cable(image, locate_camera(image, board, camera), cable)
        except VisionError as error:
            why = spoilt(image)
            problems[name] = f"{name}: {error.message}{'' if why in error.message else why}"
    fit = agreeing_fit(curves, problems, cable)
    line: SpaceLine | None = None
    messages: list[str] = []
    if fit is not None:
        images = [photographs[name] for name in curves]
        fit, seen = measure_shared_outlines(fit, list(curves.values()), images)
        curves = dict(zip(curves, seen, strict=True))
        line, messages = _line_and_messages(fit, cable)
    if fit is not None and line is not None:
        places = dict(zip(curves, fit.places, strict=True))
        steps = np.linalg.norm(np.diff(line.points, axis=0), axis=1)
        unknown = 1.0 - float(np.delete(steps, list(line.gaps)).sum()) / cable.length
        if unknown > _UNKNOWN:
            why = _unsure(curves, photographs, cable.diameter)
            messages.append(f"{100 * unknown:.0f} % of the cable are not known in space: {why}")
    else:
        places = {name: _guessed(curve, cable) for name, curve in curves.items()}
    if len(curves) == 1:
        messages.append(
            f"{next(iter(curves))}: one photograph alone gives no line in space: its pixels serve "
            "a fit, which has the depth from the cable's mechanics alone, and errors are those "
            "across the line of sight. Try: a second photograph from another place, 30 to 90 "
            "degrees around the cable."
        )
    of_one = [
        f"{name}: {message}"
        for name, curve in curves.items()
        for message in (*curve.viewpoint.messages, *curve.messages)
    ]
    return Views(line, curves, problems, (*of_one, *messages), places)


@dataclass(frozen=True)
class _Agreement:
    """A curve common to photographs, with one order of their loops."""

    curves: Mapping[str, ImageCurve]
    fit: CurveFit
    share: float  # share of its pixels in the photograph that agrees least
    worst: str  # name of that photograph
    score: tuple[float, float]
    """What of two readings the better one has more of: agreement, then likelihood."""


def agreeing_fit(
    curves: dict[str, ImageCurve], problems: dict[str, str], cable: KnownCable
) -> CurveFit | None:
    """The curve on which most photographs in `curves` agree.

    Photographs that contradict it are moved from `curves` to `problems`.
    """
    while len(curves) > 1:
        pairs = _pairs(curves, cable)
        if max(pair.angle for pair in pairs) < _NARROW:
            first, *others = curves
            for name in others:
                del curves[name]
                problems[name] = (
                    f"{name}: the photographs are taken from nearly the same place as {first}, "
                    f"less than {np.degrees(_NARROW):.0f} degrees apart: no depth. Try: step "
                    "aside, 30 to 90 degrees around the cable."
                )
            break
        best: _Agreement | None = None
        # All orders of the loops, those with the fewest reversed loops first.
        ways = [loops_either_way(curve) for curve in curves.values()]
        turned = sorted(product(*(range(len(way)) for way in ways)), key=np.count_nonzero)
        for chosen in turned[:_READINGS]:
            read = [way[k] for way, k in zip(ways, chosen, strict=True)]
            found = _agreement_of(dict(zip(curves, read, strict=True)), cable)
            if found is not None and (best is None or found.score > best.score):
                best = found
            if best is not None and best.share > _SURE and len(curves) > 2:
                break  # with three drawn photographs of a loop a wrong order reached 84 % at most
        if best is None:
            # The photograph whose line ends farthest from the declared fixtures.
            off = {n: float(_tips_off(curve, cable).max()) for n, curve in curves.items()}
            worst = max(off, key=lambda name: off[name])
            others = [name for name in curves if name != worst]
            problems[worst] = (
                f"{worst}: the line in it and that in {', '.join(others)} are not of the same "
                f"cable in space: at most {100 * pairs[0].share:.0f} % of their pixels can "
                "be matched, or the line would not lead from fixture to fixture. The line in "
                f"{worst} ends {off[worst]:.0f} px from where the fixtures are declared. Try: are "
                "both of this pose? Was the cable or the board moved between the photographs?"
            )
        else:
            curves.update(best.curves)
            if best.share > _AGREE:
                return best.fit
            worst = best.worst
            problems[worst] = (
                f"{worst}: only {100 * best.share:.0f} % of the line in it lie on the line in "
                "space that the photographs of this pose show together. Try: is it of this pose? "
                "Was the cable or the board moved between the photographs?"
            )
        del curves[worst]
    return None


class _Pair(NamedTuple):
    """Two photographs, their matched pixels, and the angle [rad] of their cameras at the cable."""

    one: ImageCurve
    other: ImageCurve
    first: IntArray
    second: IntArray
    share: float
    angle: float


def _pairs(curves: Mapping[str, ImageCurve], cable: KnownCable) -> list[_Pair]:
    """All pairs of photographs, first those that match well and have a large angle."""
    middle = cable.fixtures.mean(axis=0)
    pairs = []
    for one, other in combinations(curves.values(), 2):
        sights = unit(middle - np.array([one.viewpoint.center, other.viewpoint.center]))
        angle = float(np.arccos(np.clip(sights[0] @ sights[1], -1, 1)))
        pairs.append(_Pair(one, other, *match_lines(one, other), angle))
    return sorted(pairs, key=lambda pair: -(pair.share**8) * np.sin(pair.angle))


def _agreement_of(curves: Mapping[str, ImageCurve], cable: KnownCable) -> _Agreement | None:
    """The curve from a pair on which most photographs agree; None where no pair gives one.

    It is no longer than the cable, and ends where it ends in the photographs.
    """
    best: _Agreement | None = None
    seen = list(curves.values())
    tips = np.array([_tips_off(curve, cable) / curve.width for curve in seen])
    shown = np.all(tips < TIP, axis=0)
    far = _FAR * cable.length + TIP * cable.diameter
    spans = int(np.clip(cable.length / (_SPAN * cable.diameter), *_SPANS))
    for one, other, first, second, share, _ in _pairs(curves, cable):
        if share <= _AGREE:
            continue
        along = chord_lengths(one.pixels)[first] + chord_lengths(other.pixels)[second]
        guess = first_curve(triangulate(one, other, first, second), along, spans)
        fit = fit_curve_to_images(seen, guess)
        away = fit.curve.away_from(cable.fixtures)
        too_long = fit.curve.length + float(away.sum()) >= _LONGER * cable.length
        if too_long or np.any(away[shown] >= far):
            continue
        shares = {}
        for (name, curve), residuals in zip(curves.items(), fit.residuals, strict=True):
            near = np.abs(residuals) < _AGREE_PX + 4.0 * curve.std
            shares[name] = float(near[curve.whole].sum() / max(int(curve.whole.sum()), 1))
        worst = min(shares, key=lambda name: shares[name])
        if best is None or shares[worst] > best.share:
            score = min(shares[worst], _SURE), -fit.surprise
            best = _Agreement(curves, fit, shares[worst], worst, score)
        if best.share > _SURE:
            break
    return best


def _tips_off(curve: ImageCurve, cable: KnownCable) -> FloatArray:
    """Distances [px] of the line's ends from the fixtures in the photograph."""
    places = curve.viewpoint.to_pixels(cable.fixtures)
    return np.asarray(np.linalg.norm(curve.pixels[[0, -1]][: len(places)] - places, axis=1))


def _guessed(curve: ImageCurve, cable: KnownCable) -> FloatArray:
    """Places (K, 3) [m] of pixels, with depth linear along the line from fixture to fixture."""
    viewpoint = curve.viewpoint
    depths = viewpoint.in_camera(cable.fixtures)[:, 2]
    along = chord_lengths(curve.pixels)
    depth = np.interp(along / along[-1], np.linspace(0.0, 1.0, len(depths)), depths)
    at = np.column_stack([viewpoint.rays(curve.pixels), np.ones(len(depth))]) * depth[:, None]
    return np.asarray((at - viewpoint.translation) @ viewpoint.rotation)


def _line_and_messages(fit: CurveFit, cable: KnownCable) -> tuple[SpaceLine | None, list[str]]:
    """Evenly spaced points of small uncertainty, and messages on the fixtures and the length.

    There is no line if a part of the cable is not visible in any photograph.
    """
    length = cable.length
    away = fit.curve.away_from(cable.fixtures)
    whole = fit.curve.length + float(away.sum())
    missing = 1.0 - whole / length if len(away) == 2 else 0.0
    if missing >= _MISSING:
        return None, [
            f"the photographs show a line in space that is {100 * missing:.0f} % shorter than the "
            "cable: a stretch is hidden in some of them, or pointed to the camera. No line is "
            "given. Try: a photograph from another side; check the length"
        ]
    t = np.linspace(0.0, 1.0, max(2, round(fit.curve.length / SPACING) + 1))
    std = fit.std(t)
    known = np.nonzero(std < _KNOWN * cable.diameter)[0]
    gaps = tuple(int(i) for i in np.nonzero(np.diff(known) > 1)[0])
    line = SpaceLine(fit.curve.position(t[known]), std[known], gaps)
    messages = [
        f"the line in space stops {1e3 * distance:.0f} mm before the {name}"
        for name, distance in zip(("start", "end"), away, strict=False)
        if distance > max(0.03 * length, 0.01)
    ]
    if abs(missing) > 0.03:
        messages.append(
            f"the line in space is {100 * abs(missing):.1f} % "
            f"{'longer' if missing < 0 else 'shorter'} than declared ({whole:.3f} of "
            f"{length:g} m, up to both fixtures): check the length, camera.matrix and marker_size"
        )
    return line, messages


def _unsure(
    curves: Mapping[str, ImageCurve], photographs: Mapping[str, Picture], diameter: float
) -> str:
    """Sentence on an unknown part of the line: why, and what to try."""
    places = {
        name: float(np.sqrt(np.linalg.eigvalsh(curve.viewpoint.covariance[3:, 3:])[-1]))
        for name, curve in curves.items()
    }
    worst = max(places, key=lambda name: places[name])
    if places[worst] < _KNOWN * diameter:
        return (
            "hidden, or seen along their depth. A third photograph from another side would show "
            "them"
        )
    return (
        f"the markers in {worst} tell where its camera stands to {1e3 * places[worst]:.1f} mm, "
        f"their corners are {curves[worst].viewpoint.reprojection_error:.2f} px RMS off. Try: "
        "camera.matrix, which `dlo calibrate` finds; that photograph once more, sharp and not too "
        f"bright.{spoilt(photographs[worst])}"
    )
