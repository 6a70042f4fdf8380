"""The line in space that the photographs of one pose agree on, without any model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.board import Board, locate_camera
from dlo_casadi.vision.camera import Array, Camera
from dlo_casadi.vision.centerline import SPACING
from dlo_casadi.vision.curves import chord_length
from dlo_casadi.vision.image import spoilt
from dlo_casadi.vision.image_curve import (
    TIP,
    ImageCurve,
    Match,
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

_AGREE = 0.6  # least share of a photograph's pixels on the common line: each may hide parts
_READINGS = 8  # largest number of ways to read the photographs of a pose: loops are few
_SURE = 0.9  # share from which the first curve of a pair is good enough
_AGREE_PX = 1.0  # px added to four standard deviations: errors of the cameras' places
_FAR = 0.05  # largest distance of the line's end from its fixture, of the length
_LONGER = 1.1  # largest length of a line in space, up to its fixtures, of the cable's
_NARROW = np.radians(5.0)  # between two cameras; below, depths are ten times worse than the rest


@dataclass(frozen=True)
class _Pair:
    """Two photographs, what matches in them, and the angle [rad] between their directions."""

    one: ImageCurve
    other: ImageCurve
    match: Match
    angle: float


@dataclass(frozen=True)
class _Agreement:
    """A curve that photographs, read in one way, show together."""

    curves: Mapping[str, ImageCurve]
    fit: CurveFit
    share: float  # of its pixels in the photograph that agrees least
    worst: str  # that photograph

    @property
    def score(self) -> tuple[float, float]:
        """What of two readings the better one has more of: agreement, then likelihood."""
        return min(self.share, _SURE), -self.fit.surprise


def agreeing_fit(
    curves: dict[str, ImageCurve],
    problems: dict[str, str],
    fixtures: list[Array],
    length: float,
    spans: int,
) -> CurveFit | None:
    """The curve that most photographs agree on, of all that are left in `curves`.

    Those that contradict it are moved from the curves to the problems.
    """
    while len(curves) > 1:
        pairs = _pairs(curves)
        if max(pair.angle for pair in pairs) < _NARROW:
            first, *others = curves
            for name in others:
                problems[name] = (
                    f"{name}: the photographs are taken from nearly the same place as {first}, "
                    f"less than {np.degrees(_NARROW):.0f} degrees apart: no depth. Try: step "
                    "aside, 30 to 90 degrees around the cable."
                )
                del curves[name]
            break
        best: _Agreement | None = None
        for reading in _readings(curves):
            found = _agreement_of(reading, fixtures, length, spans)
            if found is not None and (best is None or found.score > best.score):
                best = found
            if best is not None and best.share > _SURE and len(curves) > 2:
                break  # of three drawn photographs of a loop a wrong order left 84 % at most
        if best is None:
            _blame(curves, problems, pairs[0], fixtures)
            continue
        curves.update(best.curves)
        if best.share > _AGREE:
            return best.fit
        problems[best.worst] = (
            f"{best.worst}: only {100 * best.share:.0f} % of the line in it lie on the line in "
            "space that the photographs of this pose show together. Try: is it of this pose? Was "
            "the cable or the board moved between the photographs?"
        )
        del curves[best.worst]
    return None


def _readings(curves: Mapping[str, ImageCurve]) -> list[dict[str, ImageCurve]]:
    """All ways to read the photographs, those first that turn the fewest loops round."""
    ways = [loops_either_way(curve) for curve in curves.values()]
    turned = sorted(product(*(range(len(way)) for way in ways)), key=np.count_nonzero)
    return [
        {name: way[k] for name, way, k in zip(curves, ways, chosen, strict=True)}
        for chosen in turned[:_READINGS]
    ]


def _pairs(curves: Mapping[str, ImageCurve]) -> list[_Pair]:
    """All pairs of photographs, first those that match well and are seen from different places."""
    pairs = []
    for one, other in combinations(curves.values(), 2):
        ahead = float(one.viewpoint.rotation[2] @ other.viewpoint.rotation[2])
        angle = float(np.arccos(np.clip(ahead, -1, 1)))
        pairs.append(_Pair(one, other, match_lines(one, other), angle))
    return sorted(pairs, key=lambda pair: -(pair.match.share**8) * np.sin(pair.angle))


def _agreement_of(
    curves: Mapping[str, ImageCurve], fixtures: list[Array], length: float, spans: int
) -> _Agreement | None:
    """The curve from a pair that most photographs agree on; None where no pair gives one."""
    best: _Agreement | None = None
    seen = list(curves.values())
    for pair in _pairs(curves):
        if pair.match.share <= _AGREE:
            continue
        places = [chord_length(curve.pixels) for curve in (pair.one, pair.other)]
        along = places[0][pair.match.first] + places[1][pair.match.second]
        points = triangulate(pair.one, pair.other, pair.match)
        fit = fit_curve_to_images(seen, first_curve(points, along, spans))
        if not _possible(fit, seen, fixtures, length):
            continue
        shares = dict(zip(curves, map(_share_near, seen, fit.residuals), strict=True))
        worst = min(shares, key=lambda name: shares[name])
        if best is None or shares[worst] > best.share:
            best = _Agreement(curves, fit, shares[worst], worst)
        if best.share > _SURE:
            break
    return best


def _possible(
    fit: CurveFit, curves: list[ImageCurve], fixtures: list[Array], length: float
) -> bool:
    """Whether a curve is no longer than the cable, and ends where the photographs show its ends."""
    tips = np.array([_tips_off(curve, fixtures) / curve.width for curve in curves])
    shown = np.all(tips < TIP, axis=0)
    away = fit.curve.away_from(fixtures)
    far = _FAR * length + TIP * curves[0].diameter
    whole = fit.curve.length + float(away.sum())
    return bool(whole < _LONGER * length and np.all(away[shown] < far))


def _share_near(curve: ImageCurve, residuals: Array) -> float:
    """Share of the pixels with two edges that lie on the line in space."""
    near = np.abs(residuals) < _AGREE_PX + 4.0 * curve.std
    return float(near[curve.whole].sum() / max(int(curve.whole.sum()), 1))


def _blame(
    curves: dict[str, ImageCurve], problems: dict[str, str], pair: _Pair, fixtures: list[Array]
) -> None:
    """Leave out the photograph whose line ends farthest from where the fixtures are declared."""
    off = {name: float(_tips_off(curve, fixtures).max()) for name, curve in curves.items()}
    worst = max(off, key=lambda name: off[name])
    others = ", ".join(name for name in curves if name != worst)
    problems[worst] = (
        f"{worst}: the line in it and that in {others} are not of the same cable in space: at most "
        f"{100 * pair.match.share:.0f} % of their pixels can be matched, or the line would not "
        f"lead from fixture to fixture. The line in {worst} ends {off[worst]:.0f} px from where "
        "the fixtures are declared. Try: are both of this pose? Was the cable or the board moved "
        "between the photographs?"
    )
    del curves[worst]


def _tips_off(curve: ImageCurve, fixtures: list[Array]) -> Array:
    """Distances [px] of the line's ends from the fixtures, as the photograph shows them."""
    places = curve.viewpoint.to_pixels(fixtures)
    ends = curve.pixels[[0, -1]][: len(places)]
    return np.asarray(np.linalg.norm(ends - places, axis=1))


# Diameters, of the spline: no cable bends sharper; with half of it the lines in space of rendered
# photographs move by less than a tenth of their std.
_SPAN = 2.0
_SPANS = (20, 100)
_UNKNOWN = 0.05  # unknown part of the length beyond which a message says why
_KNOWN = 0.25  # diameters: standard deviation beyond which a point is left out
_MISSING = 0.1  # of the length: a line that is shorter by more misses a hidden stretch


@dataclass(frozen=True)
class SpaceLine:
    """A line in space, and how well each of its points is known.

    Parameters
    ----------
    points : (K, 3) [m]
        In the board frame, ordered from start to end, evenly spaced.
    std : (K,) [m]
        Largest standard deviation in any direction across the line; where a point lies along it,
        photographs do not tell.
    gaps : tuple of int
        Indices of the points after which a stretch is missing.
    """

    points: Array
    std: Array
    gaps: tuple[int, ...]


@dataclass(frozen=True)
class Views:
    """What the photographs of one pose show.

    Parameters
    ----------
    line : SpaceLine or None
        None where fewer than two photographs agree.
    curves : dict of str to ImageCurve
        What is seen in each usable photograph, by its name, in pixels.
    problems : dict of str to str
        Why a photograph is not used, and what to try.
    messages : tuple of str
        What else a user should know; those on one photograph begin with its name.
    places : dict of str to (K, 3) [m]
        Where the pixels of the curves lie: on the line in space, nan for those that are not of it.
        Without a line it is a guess, at depths from fixture to fixture.
    """

    line: SpaceLine | None
    curves: Mapping[str, ImageCurve]
    problems: Mapping[str, str]
    messages: tuple[str, ...]
    places: Mapping[str, Array]


def measure_views(
    photographs: Mapping[str, NDArray[np.uint8]],
    board: Board,
    camera: Camera,
    *,
    start: ArrayLike,
    end: ArrayLike | None,
    diameter: float,
    length: float,
) -> Views:
    """Measure a cable in photographs from several places: the line in each, and in space.

    Parameters
    ----------
    photographs : dict of str to (H, W, 3) uint8
        Pictures of one pose, blue, green, red, by their names.
    board : Board
        The board that is seen in each.
    camera : Camera
        That took them all.
    start, end : (3,) [m]
        The fixtures in the board frame; `end` is None for a free end.
    diameter, length : scalar [m]
        Of the cable.

    Nothing is raised for a photograph that cannot be used: `problems` names it, and the others
    are used. One photograph alone gives no line.
    """
    problems: dict[str, str] = {}
    curves: dict[str, ImageCurve] = {}
    for name, image in photographs.items():
        try:
            viewpoint = locate_camera(image, board, camera)
            curves[name] = see_cable(
                image, viewpoint, start=start, end=end, diameter=diameter, length=length
            )
        except VisionError as error:
            why = spoilt(image)
            problems[name] = f"{name}: {error.message}{'' if why in error.message else why}"
    fixtures = [np.asarray(at, float) for at in (start, end) if at is not None]
    spans = int(np.clip(length / (_SPAN * diameter), *_SPANS))
    fit = agreeing_fit(curves, problems, fixtures, length, spans)
    line: SpaceLine | None = None
    messages: list[str] = []
    if fit is not None:
        images = [photographs[name] for name in curves]
        fit, seen = measure_shared_outlines(fit, list(curves.values()), images)
        curves = dict(zip(curves, seen, strict=True))
        line, messages = _line_and_messages(fit, fixtures, diameter, length)
    if fit is not None and line is not None:
        places = dict(zip(curves, fit.places, strict=True))
        unknown = 1.0 - _seen(line) / length
        if unknown > _UNKNOWN:
            why = _unsure(curves, photographs, diameter)
            messages.append(f"{100 * unknown:.0f} % of the cable are not known in space: {why}")
    else:
        places = {name: _guessed(curve, fixtures) for name, curve in curves.items()}
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


def _guessed(curve: ImageCurve, fixtures: list[Array]) -> Array:
    """Places (K, 3) [m] of pixels, if depth went evenly from fixture to fixture along the line."""
    viewpoint = curve.viewpoint
    depths = viewpoint.in_camera(fixtures)[:, 2]
    along = chord_length(curve.pixels)
    depth = np.interp(along / along[-1], np.linspace(0.0, 1.0, len(depths)), depths)
    at = np.column_stack([curve.rays, np.ones(len(depth))]) * depth[:, None]
    return np.asarray((at - viewpoint.translation) @ viewpoint.rotation)


def _line_and_messages(
    fit: CurveFit, fixtures: list[Array], diameter: float, length: float
) -> tuple[SpaceLine | None, list[str]]:
    """Evenly spaced points that are well known, and how they fit the fixtures and the length.

    No line where a stretch of the cable is shown by no photograph.
    """
    away = fit.curve.away_from(fixtures)
    whole = fit.curve.length + float(away.sum())
    missing = 1.0 - whole / length if len(fixtures) == 2 else 0.0
    if missing >= _MISSING:
        return None, [
            f"the photographs show a line in space that is {100 * missing:.0f} % shorter than the "
            "cable: a stretch is hidden in some of them, or pointed to the camera. No line is "
            "given. Try: a photograph from another side; check the length"
        ]
    t = np.linspace(0.0, 1.0, max(2, round(fit.curve.length / SPACING) + 1))
    std = fit.std(t)
    known = np.nonzero(std < _KNOWN * diameter)[0]
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


def _seen(line: SpaceLine) -> float:
    """Length [m] of what is known."""
    steps = np.linalg.norm(np.diff(line.points, axis=0), axis=1)
    return float(np.delete(steps, list(line.gaps)).sum())


def _unsure(
    curves: Mapping[str, ImageCurve], photographs: Mapping[str, NDArray[np.uint8]], diameter: float
) -> str:
    """Why a part of the line is not known, and what to try."""
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
        f"their corners are {curves[worst].viewpoint.reprojection_error:.2f} px RMS off. Try: that "
        f"photograph once more, sharp and not too bright.{spoilt(photographs[worst])}"
    )
