"""The line in space that several photographs of one cable give without any model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.board import Board, locate_camera
from dlo_casadi.vision.correspondence import Match, match_lines, triangulate
from dlo_casadi.vision.curve import chord_length
from dlo_casadi.vision.image import spoilt
from dlo_casadi.vision.sight import (
    TIP,
    Sight,
    loops_either_way,
    other_stretches,
    see_beside,
    see_cable,
)
from dlo_casadi.vision.space_curve import CurveFit, first_curve, fit_curve_to_sights
from dlo_casadi.vision.view import Array, Camera

_SPACING = 0.0025  # m, as of centre-lines in the plane
# Diameters, of the spline: no cable bends sharper; with half of it the lines in space of rendered
# photographs move by less than a tenth of their std.
_SPAN = 2.0
_SPANS = (20, 100)
_AGREE = 0.6  # share of its pixels that must agree with the others: each may hide parts
_UNKNOWN = 0.05  # of the length: from there on it is said why
_KNOWN = 0.25  # diameters: standard deviation beyond which a point is not told
_MISSING = 0.1  # of the length: a line that is so much shorter passes by a stretch that none shows
_READINGS = 8  # at most, of all photographs of a pose together: loops are few
_SURE = 0.9  # share from which no other pair is tried for the first curve
_AGREE_PX = 1.0  # px, beside four standard deviations: errors of cameras' places
_FAR = 0.05  # of the length, beside what is not seen: a line that ends farther away is another's
_LONGER = 1.1  # of the length: a line in space, up to its fixtures, cannot be longer
_NARROW = np.radians(5.0)  # between two cameras: below, depths are ten times worse than the rest


@dataclass(frozen=True)
class SpaceLine:
    """A line in space, and how well each of its points is known.

    Parameters
    ----------
    points : (K, 3) [m]
        In the board frame, ordered from start to end, evenly spaced.
    covariance : (K, 3, 3) [m^2]
        Across the line; where a point lies along it, photographs do not tell.
    std : (K,) [m]
        Largest standard deviation in any direction across the line.
    gaps : tuple of int
        Indices of the points after which a stretch is missing.
    """

    points: Array
    covariance: Array
    std: Array
    gaps: tuple[int, ...]


@dataclass(frozen=True)
class Views:
    """What the photographs of one pose show.

    Parameters
    ----------
    line : SpaceLine or None
        None where fewer than two photographs agree.
    sights : dict of str to Sight
        What is seen in each usable photograph, by its name, in pixels.
    problems : dict of str to str
        Why a photograph is not used, and what to try.
    messages : tuple of str
        What else a user should know; those on one photograph begin with its name.
    places : dict of str to (K, 3) [m]
        Where the pixels of the sights lie: on the line in space, nan for those that are not of it.
        Without a line it is a guess, at depths from fixture to fixture.
    """

    line: SpaceLine | None
    sights: Mapping[str, Sight]
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
    sights: dict[str, Sight] = {}
    for name, image in photographs.items():
        try:
            viewpoint = locate_camera(image, board, camera)
            sights[name] = see_cable(
                image, viewpoint, start=start, end=end, diameter=diameter, length=length
            )
        except VisionError as error:
            why = spoilt(image)
            problems[name] = f"{name}: {error.message}{'' if why in error.message else why}"
    fixtures = [np.asarray(at, float) for at in (start, end) if at is not None]
    places: dict[str, Array] = {}
    spans = int(np.clip(length / (_SPAN * diameter), *_SPANS))
    fit, order = _agreeing_fit(sights, problems, fixtures, length, spans)
    line, missing = None, 0.0
    if fit is not None:
        seen = [sights[name] for name in order]
        fit, seen = _resolve(fit, seen, [photographs[name] for name in order])
        sights.update(zip(order, seen, strict=True))
        missing = 1.0 - _whole(fit, fixtures) / length if len(fixtures) == 2 else 0.0
        if missing < _MISSING:
            line = _points(fit, diameter)
            places = {
                name: _on_line(fit, params) for name, params in zip(order, fit.params, strict=True)
            }
    if line is None:
        places = {name: _guessed(sight, fixtures) for name, sight in sights.items()}
    messages = [
        f"{name}: {message}"
        for name, sight in sights.items()
        for message in (*sight.viewpoint.messages, *sight.messages)
    ]
    if line is None and len(sights) == 1:
        messages.append(
            f"{next(iter(sights))}: one photograph alone gives no line in space: its pixels serve "
            "a fit, which has the depth from the cable's mechanics alone, and errors are those "
            "across the line of sight. Try: a second photograph from another place, 30 to 90 "
            "degrees around the cable."
        )
    elif fit is not None and line is None:
        messages.append(
            f"the photographs show a line in space that is {100 * missing:.0f} % shorter than the "
            "cable: a stretch is hidden in some of them, or pointed to the camera. No line is "
            "given. Try: a photograph from another side; check the length"
        )
    elif fit is not None and line is not None:
        messages += _line_messages(line, fit, fixtures, length)
        unknown = 1.0 - _seen(line) / length
        if unknown > _UNKNOWN:
            why = _unsure(sights, photographs, diameter)
            messages.append(f"{100 * unknown:.0f} % of the cable are not known in space: {why}")
    return Views(line, sights, problems, tuple(messages), places)


@dataclass(frozen=True)
class _Pair:
    """Two photographs, what matches in them, and the angle [rad] between their directions."""

    names: tuple[str, str]
    match: Match
    angle: float


def _agreeing_fit(
    sights: dict[str, Sight],
    problems: dict[str, str],
    fixtures: list[Array],
    length: float,
    spans: int,
) -> tuple[CurveFit | None, list[str]]:
    """The curve that most photographs agree on, and their names.

    Those that contradict it are moved from the sights to the problems.
    """
    while len(sights) > 1:
        pairs = _pairs(sights)
        if max(pair.angle for pair in pairs) < _NARROW:
            first, *others = sights
            for name in others:
                problems[name] = (
                    f"{name}: the photographs are taken from nearly the same place as {first}, "
                    f"less than {np.degrees(_NARROW):.0f} degrees apart: no depth. Try: step "
                    "aside, 30 to 90 degrees around the cable."
                )
                del sights[name]
            break
        best: _Agreement | None = None
        for reading in _readings(sights):
            found = _agreement_of(reading, fixtures, length, spans)
            if found is not None and (best is None or found.score > best.score):
                best = found
            if best is not None and best.share > _SURE and len(sights) > 2:
                break  # of three drawn photographs of a loop a wrong order left 84 % at most
        if best is None:
            _blame(sights, problems, pairs[0], fixtures)
            continue
        sights.update(best.sights)
        if best.share > _AGREE:
            return best.fit, list(sights)
        problems[best.worst] = (
            f"{best.worst}: only {100 * best.share:.0f} % of the line in it lie on the line in "
            "space that the photographs of this pose show together. Try: is it of this pose? Was "
            "the cable or the board moved between the photographs?"
        )
        del sights[best.worst]
    return None, []


@dataclass(frozen=True)
class _Agreement:
    """A curve that photographs, read in one way, show together.

    `share` of its pixels in the photograph that agrees least, `worst`.
    """

    sights: Mapping[str, Sight]
    fit: CurveFit
    share: float
    worst: str

    @property
    def score(self) -> tuple[float, float]:
        """What of two readings the better one has more of: agreement, then likelihood."""
        return min(self.share, _SURE), -self.fit.surprise


def _readings(sights: Mapping[str, Sight]) -> list[dict[str, Sight]]:
    """All ways to read the photographs, those first that turn the fewest loops round."""
    ways = [loops_either_way(sight) for sight in sights.values()]
    turned = sorted(product(*(range(len(way)) for way in ways)), key=np.count_nonzero)
    return [
        {name: way[k] for name, way, k in zip(sights, ways, chosen, strict=True)}
        for chosen in turned[:_READINGS]
    ]


def _agreement_of(
    sights: dict[str, Sight], fixtures: list[Array], length: float, spans: int
) -> _Agreement | None:
    """The curve from a pair that most photographs agree on; None where no pair gives one."""
    best: _Agreement | None = None
    for pair in _pairs(sights):
        fit = _fit(sights, pair, spans) if pair.match.share > _AGREE else None
        if fit is None or not _possible(fit, list(sights.values()), fixtures, length):
            continue
        shares = dict(zip(sights, map(_agreement, sights.values(), fit.residuals), strict=True))
        worst = min(shares, key=lambda name: shares[name])
        if best is None or shares[worst] > best.share:
            best = _Agreement(sights, fit, shares[worst], worst)
        if best.share > _SURE:
            break
    return best


def _pairs(sights: dict[str, Sight]) -> list[_Pair]:
    """All pairs of photographs, first those that match well and are seen from different places."""
    names = list(sights)
    pairs = []
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            ahead = float(sights[one].viewpoint.rotation[2] @ sights[other].viewpoint.rotation[2])
            match = match_lines(sights[one], sights[other])
            pairs.append(_Pair((one, other), match, float(np.arccos(np.clip(ahead, -1, 1)))))
    return sorted(pairs, key=lambda pair: -(pair.match.share**8) * np.sin(pair.angle))


def _fit(sights: dict[str, Sight], pair: _Pair, spans: int) -> CurveFit:
    """First curve of a pair, moved onto what all photographs show."""
    one, other = (sights[name] for name in pair.names)
    match = pair.match
    points = triangulate(one, other, match)
    along = chord_length(one.pixels)[match.first] + chord_length(other.pixels)[match.second]
    return fit_curve_to_sights(list(sights.values()), first_curve(points, along, spans))


def _possible(fit: CurveFit, sights: list[Sight], fixtures: list[Array], length: float) -> bool:
    """Whether a curve is no longer than the cable, and ends where the photographs show its ends."""
    tips = np.array([_tips_off(sight, fixtures) / sight.width for sight in sights])
    shown = np.all(tips < TIP, axis=0)
    ends = fit.curve.position(np.array([0.0, 1.0]))[: len(fixtures)]
    away = np.linalg.norm(ends - np.array(fixtures), axis=1)
    far = _FAR * length + TIP * sights[0].diameter
    return bool(_whole(fit, fixtures) < _LONGER * length and np.all(away[shown] < far))


def _agreement(sight: Sight, residuals: Array) -> float:
    """Share of the pixels with two edges that lie on the curve."""
    near = np.abs(residuals) < _AGREE_PX + 4.0 * sight.std
    return float(near[sight.whole].sum() / max(int(sight.whole.sum()), 1))


def _blame(
    sights: dict[str, Sight], problems: dict[str, str], pair: _Pair, fixtures: list[Array]
) -> None:
    """Leave out the photograph whose line ends farthest from where the fixtures are declared."""
    off = {name: float(_tips_off(sight, fixtures).max()) for name, sight in sights.items()}
    worst = max(off, key=lambda name: off[name])
    others = ", ".join(name for name in sights if name != worst)
    problems[worst] = (
        f"{worst}: the line in it and that in {others} are not of the same cable in space: at most "
        f"{100 * pair.match.share:.0f} % of their pixels can be matched, or the line would not "
        f"lead from fixture to fixture. The line in {worst} ends {off[worst]:.0f} px from where "
        "the fixtures are declared. Try: are both of this pose? Was the cable or the board moved "
        "between the photographs?"
    )
    del sights[worst]


def _tips_off(sight: Sight, fixtures: list[Array]) -> Array:
    """Distances [px] of the line's ends from the fixtures, as the photograph shows them."""
    places = sight.viewpoint.to_pixels(fixtures)
    ends = sight.pixels[[0, -1]][: len(places)]
    return np.asarray(np.linalg.norm(ends - places, axis=1))


def _resolve(
    fit: CurveFit, sights: list[Sight], images: list[NDArray[np.uint8]]
) -> tuple[CurveFit, list[Sight]]:
    """Measure the stretches that share an outline in a photograph, now that the rest is known.

    Whether they cross in it is what makes the line in space likelier; then once more with the
    sides of that line.
    """
    t = np.linspace(0.0, 1.0, 1001)
    points = fit.curve.position(t)
    shared = []
    for sight in sights:
        seen = sight.viewpoint.to_pixels(points)
        beside = other_stretches(seen, chord_length(seen), sight.width)
        shared.append(bool(np.isfinite(beside).any()))
    if not any(shared):
        return fit, sights

    def measure(crossed: bool | None, fit: CurveFit) -> tuple[CurveFit, list[Sight]]:
        points = fit.curve.position(t)
        seen, params = list(sights), list(fit.params)
        for v, image in enumerate(images):
            if shared[v]:
                whole = before.params[v]
                seen[v], params[v] = see_beside(image, sights[v], points, t, whole, crossed)
        return fit_curve_to_sights(seen, fit.curve, params), seen

    before = fit
    likelier = min((measure(crossed, fit)[0] for crossed in (False, True)), key=_surprise)
    return measure(None, likelier)


def _on_line(fit: CurveFit, params: Array) -> Array:
    """Places (K, 3) [m] at parameters; nan where there is none."""
    places = np.full((len(params), 3), np.nan)
    known = np.isfinite(params)
    places[known] = fit.curve.position(params[known])
    return places


def _guessed(sight: Sight, fixtures: list[Array]) -> Array:
    """Places (K, 3) [m] of pixels, if depth went evenly from fixture to fixture along the line."""
    viewpoint = sight.viewpoint
    depths = viewpoint.in_camera(fixtures)[:, 2]
    along = chord_length(sight.pixels)
    depth = np.interp(along / along[-1], np.linspace(0.0, 1.0, len(depths)), depths)
    at = np.column_stack([sight.rays, np.ones(len(depth))]) * depth[:, None]
    return np.asarray((at - viewpoint.translation) @ viewpoint.rotation)


def _surprise(fit: CurveFit) -> float:
    return fit.surprise


def _points(fit: CurveFit, diameter: float) -> SpaceLine:
    """Evenly spaced points that are well known, compared with the cable's thickness."""
    count = max(2, round(fit.curve.length / _SPACING) + 1)
    t = np.linspace(0.0, 1.0, count)
    covariance, std = fit.std(t)
    known = np.nonzero(std < _KNOWN * diameter)[0]
    gaps = np.nonzero(np.diff(known) > 1)[0]
    return SpaceLine(
        fit.curve.position(t[known]),
        covariance[known],
        std[known],
        tuple(int(i) for i in gaps),
    )


def _whole(fit: CurveFit, fixtures: list[Array]) -> float:
    """Length [m] of a curve and of the straight ways from its ends to the fixtures."""
    ends = fit.curve.position(np.array([0.0, 1.0]))
    away = [float(np.linalg.norm(end - at)) for end, at in zip(ends, fixtures, strict=False)]
    return fit.curve.length + sum(away)


def _line_messages(
    line: SpaceLine, fit: CurveFit, fixtures: list[Array], length: float
) -> list[str]:
    """Sentences on how the line in space fits its fixtures and its length."""
    messages = []
    whole = _whole(fit, fixtures)
    ends = fit.curve.position(np.array([0.0, 1.0]))
    for name, end, at in zip(("start", "end"), ends, fixtures, strict=False):
        away = float(np.linalg.norm(end - at))
        if away > max(0.03 * length, 0.01):
            messages.append(f"the line in space stops {1e3 * away:.0f} mm before the {name}")
    if len(fixtures) == 2 and abs(whole / length - 1.0) > 0.03:
        messages.append(
            f"the line in space is {100 * abs(whole / length - 1):.1f} % "
            f"{'longer' if whole > length else 'shorter'} than declared ({whole:.3f} of "
            f"{length:g} m, up to both fixtures): check the length, camera.matrix and marker_size"
        )
    return messages


def _seen(line: SpaceLine) -> float:
    """Length [m] of what is known."""
    steps = np.linalg.norm(np.diff(line.points, axis=0), axis=1)
    return float(np.delete(steps, list(line.gaps)).sum())


def _unsure(
    sights: Mapping[str, Sight], photographs: Mapping[str, NDArray[np.uint8]], diameter: float
) -> str:
    """Why a part of the line is not known, and what to try."""
    places = {
        name: float(np.sqrt(np.linalg.eigvalsh(sight.viewpoint.covariance[3:, 3:])[-1]))
        for name, sight in sights.items()
    }
    worst = max(places, key=lambda name: places[name])
    if places[worst] < _KNOWN * diameter:
        return (
            "hidden, or seen along their depth. A third photograph from another side would show "
            "them"
        )
    return (
        f"the markers in {worst} tell where its camera stands to {1e3 * places[worst]:.1f} mm, "
        f"their corners are {sights[worst].viewpoint.reprojection_error:.2f} px RMS off. Try: that "
        f"photograph once more, sharp and not too bright.{spoilt(photographs[worst])}"
    )
