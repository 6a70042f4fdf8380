"""Which photographs of a pose show one cable, and the line in space that they agree on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from dlo_casadi.vision.correspondence import Match, match_lines, triangulate
from dlo_casadi.vision.curve import chord_length
from dlo_casadi.vision.image_curve import TIP, ImageCurve, loops_either_way
from dlo_casadi.vision.space_curve import CurveFit, first_curve, fit_curve_to_images
from dlo_casadi.vision.view import Array

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
