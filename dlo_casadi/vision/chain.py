"""Find the cable coarsely: the chain of strands that fits its width, length and fixtures best."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import Array
from dlo_casadi.vision.curves import length_of
from dlo_casadi.vision.strands import (
    Contrast,
    candidate_maps,
    find_strands,
    local_contrast,
    thresholds,
)
from dlo_casadi.vision.workplane import ExpectedLine, WorkPlane

_State: TypeAlias = tuple[float, tuple[int, ...], float, float]  # cost, path, seen, total
_BEAM = 40
_LENGTH_TOLERANCE = 0.05  # relative; two clicked reference points are no better than this
_TURN, _TURN_FOLDED = 2.0, 0.5  # price of a turn between strands, in diameters per rad^2
_FOLD_REACH = 6.0  # diameters between two strands up to which they may be those of a fold


@dataclass(frozen=True)
class Chain:
    """Strands in the order in which the cable runs through them."""

    strands: tuple[Array, ...]  # each (K, 2) [m], directed from start to end
    used: tuple[int, ...]  # their places in the list that was searched
    supported: float  # [m], length that was seen
    total: float  # [m], length with straight gaps
    cost: float  # [m], lower is better; about -length for a cable that is seen without a gap


def order_strands(
    strands: list[Array],
    widths: list[float],
    expected: ExpectedLine,
) -> Chain | None:
    """Find the chain of strands that explains the cable best.

    The cost of a chain, in metres,

        J = -sum_strands seen (1 - p) + gaps + sum_links d (4 a^2 + 2 b^2)
            + 0.5 L (max(0, total / L - 1.02, 0.98 - total / S) / 0.05)^2

    prefers long seen stretches of the right width, short gaps, and links that go on in the
    direction of the strand: a is the difference of the turns into and out of the gap (0 on a
    circle), b the whole turn, p = 0.8 max(0, |log(width / d)| - 0.25), at most 1/2; S and L are
    the shortest and the longest possible length. Where the line may fold, a turn costs d b^2 / 2.
    `widths` are those of the unbranched `strands`, relative to the cable's.
    """
    if not strands:
        return None
    diameter, length = expected.diameter, expected.longest
    ways = [way for strand in strands for way in (strand, strand[::-1])]
    seen = np.array([length_of(way) for way in ways])
    first = np.array([way[0] for way in ways])
    last = np.array([way[-1] for way in ways])
    inwards = np.array([_tangent(way, diameter) for way in ways])
    outwards = np.array([-_tangent(way[::-1], diameter) for way in ways])
    excess = np.abs(np.log(np.repeat(widths, 2))) - 0.25
    worth = seen * (1 - np.clip(0.8 * excess, 0.0, 0.5))
    gap, link = _links(last, outwards, first, inwards, diameter, expected.in_space)
    to_first = np.linalg.norm(first - expected.start, axis=1)
    free = expected.end is None
    to_end = np.zeros(len(ways)) if free else np.linalg.norm(last - expected.end, axis=1)
    states: list[_State] = [
        (float(to_first[w] - worth[w]), (w,), float(seen[w]), float(seen[w] + to_first[w]))
        for w in range(len(ways))
        if to_first[w] < 0.6 * length
    ]
    best: _State | None = None
    for _ in range(len(strands)):
        states.sort(key=lambda state: state[0])
        following: list[_State] = []
        for cost, path, supported, total in states[:_BEAM]:
            tip = path[-1]
            whole = total + to_end[tip]
            off = max(whole / length - 1.0, 1.0 - whole / expected.shortest)
            misfit = max(0.0, off - 0.02) / _LENGTH_TOLERANCE
            closed = cost + to_end[tip] + 0.5 * length * misfit**2
            if best is None or closed < best[0]:
                best = (closed, path, supported, whole)
            reach = total + gap[tip] + seen
            usable = np.isfinite(link[tip]) & (reach < 1.15 * length + 2 * diameter)
            for w in np.nonzero(usable)[0]:
                if any(w // 2 == p // 2 for p in path):
                    continue
                step = float(link[tip, w] - worth[w])
                following.append(
                    (cost + step, (*path, int(w)), supported + float(seen[w]), float(reach[w]))
                )
        if not following:
            break
        states = following
    if best is None:
        return None
    cost, path, supported, total = best
    return Chain(tuple(ways[w] for w in path), tuple(w // 2 for w in path), supported, total, cost)


def _tangent(line: Array, diameter: float) -> Array:
    """Give the unit direction at the first point of a line, over its first two diameters."""
    away = np.linalg.norm(line - line[0], axis=1)
    far = int(np.argmax(away > 2 * diameter)) or len(line) - 1
    step = line[far] - line[min(1, far - 1)]
    return step / max(float(np.linalg.norm(step)), 1e-12)


def _links(
    last: Array, outwards: Array, first: Array, inwards: Array, diameter: float, folds: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gap [m] and cost [m] of going from the last point of way i to the first of way j."""
    across = first[None, :, :] - last[:, None, :]
    gap = np.linalg.norm(across, axis=2)
    heading_out = np.arctan2(outwards[:, 1], outwards[:, 0])[:, None]
    heading_in = np.arctan2(inwards[:, 1], inwards[:, 0])[None, :]
    heading = np.arctan2(across[..., 1], across[..., 0])
    turn = _wrap(heading_in - heading_out)
    before = _wrap(heading - heading_out)
    after = _wrap(heading_in - heading)
    short = gap < (_FOLD_REACH if folds else 1.5) * diameter
    uneven = np.where(short, 0.0, before - after)
    cost = gap + diameter * (4 * uneven**2 + (_TURN_FOLDED if folds else _TURN) * turn**2)
    if not folds:
        cost[(np.abs(turn) > 2.5) | (short & (np.abs(turn) > 1.0))] = np.inf
    cost[~short & ((np.abs(before) > 1.4) | (np.abs(after) > 1.4))] = np.inf
    return gap, cost


def _wrap(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


_GOOD = -0.7  # cost per length of a cable that is seen nearly from fixture to fixture
_GOOD_FOLDED = -0.9  # the same where a cable's length in the picture is not known beforehand
_LEAST = 0.25  # least share of the length that must be seen
_TWIN = 0.5  # of the cable's length: longer strands beside it are a second cable
_ROOT = 3.0  # diameters from the chain within which a strand that it covers twice begins
_ALIKE = 0.5  # largest difference in colour of a cable's strands, of that from the surroundings
_TWIN_CONTRAST = 0.6  # least contrast of a second cable, relative to the first


@dataclass
class Workings:
    """What the steps of one extraction have seen: filled as far as it comes."""

    plane: WorkPlane | None = None
    candidate: NDArray[np.float32] | None = None  # (h, w), how much its pixels stand out
    cut: float = 0.0  # level above which a pixel may be cable
    lines: list[Array] = field(default_factory=list)  # all strands at that level, (K, 2) [m]
    chosen: tuple[Array, ...] = ()  # those that make up the cable, from start to end
    unsound: Array = field(default_factory=lambda: np.zeros((0, 2)))  # [m], odd profiles on the way


@dataclass(frozen=True)
class _Line:
    """A strand in metres, and how it looks."""

    points: Array  # (K, 2) [m]
    width: float  # relative to the cable's
    level: float  # how much it stands out from its surroundings
    colour: Array  # (3,) [grey levels]
    step: Array  # (3,) [grey levels], its difference from the surroundings

    @property
    def length(self) -> float:
        return length_of(self.points)


@dataclass(frozen=True)
class _Finding:
    """A chain, its strands, and the picture and level in which it was found."""

    chain: Chain
    ours: list[_Line]
    rest: list[_Line]
    candidate: NDArray[np.float32]
    cut: float


def find_cable(plane: WorkPlane, expected: ExpectedLine, workings: Workings) -> Chain:
    """Try the candidate pictures in turn and keep the chain of least cost."""
    diameter = expected.diameter
    length = expected.typical
    width_px = diameter / plane.pixel
    area_px = length * diameter / plane.pixel**2
    if plane.reachable.sum() < 2 * area_px * _LEAST:
        raise VisionError(
            "no cable found: almost nothing of the place that it can reach is in the picture. "
            "Try: start, end and length in metres and in the board frame?"
        )
    contrast = local_contrast(plane.image, plane.reachable, width_px)
    best: _Finding | None = None
    longest = 0.0
    good = _GOOD_FOLDED if expected.in_space else _GOOD
    for candidate in candidate_maps(contrast, area_px):
        for cut in thresholds(candidate[plane.reachable], area_px):
            mask = (candidate > cut) & plane.reachable
            lines = _lines(mask, candidate, plane, contrast, expected)
            longest = max([longest, *(line.length for line in lines)])
            chain = _chain(lines, expected)
            if chain is not None and expected.in_space:
                lines = _of_one_colour(lines, [lines[i] for i in chain.used])
                chain = _chain(lines, expected)
            better = chain is not None and (best is None or chain.cost < best.chain.cost)
            if chain is not None and better:
                ours = [lines[i] for i in chain.used]
                rest = [lines[i] for i in range(len(lines)) if i not in chain.used]
                best = _Finding(chain, ours, rest, candidate, cut)
                workings.chosen = chain.strands
            if better or best is None:
                workings.candidate, workings.cut = candidate, cut
                workings.lines = [line.points for line in lines]
        if best is not None and best.chain.cost < good * min(best.chain.total, length):
            break
    if best is None or best.chain.supported < _LEAST * length:
        seen = 0.0 if best is None else best.chain.supported
        raise VisionError(
            f"no cable found: {_light(plane)}the best chain of lines shows {seen:.3f} m of "
            f"{length:g} m, the longest single line {longest:.3f} m (wanted: {1e3 * diameter:.1f} "
            f"mm wide; noise {contrast.noise.mean():.1f} grey levels). Try: is the cable in the "
            "picture and in focus? start, end, length and diameter right? a background of another "
            "brightness or colour?"
        )
    if expected.in_space:
        best = replace(best, chain=_with_folds(best, diameter))
        workings.chosen = best.chain.strands
    _refuse_twins(best, plane, contrast, expected)
    return best.chain


def _chain(lines: list[_Line], expected: ExpectedLine) -> Chain | None:
    """Put strands in order."""
    return order_strands([line.points for line in lines], [line.width for line in lines], expected)


def _of_one_colour(lines: list[_Line], chosen: list[_Line]) -> list[_Line]:
    """Strands of the colour of the longest one of the chosen, and not of a shadow's.

    Away from the board a shadow is a line of its own, and the cable's contrast changes with what is
    behind it, but not its colour.
    """
    ours = max(chosen, key=lambda line: line.length)
    step = float(np.linalg.norm(ours.step))
    return [line for line in lines if np.linalg.norm(line.colour - ours.colour) < _ALIKE * step]


def _with_folds(found: _Finding, diameter: float) -> Chain:
    """The chain, with strands inserted along which the cable goes forth and back.

    Seen from its side, a bend is a strand with a free end that the cable covers twice: it begins
    where the chain turns back, and both parts of the chain there lead into it.
    """
    parts = list(found.chain.strands)
    for line in found.rest:
        if line.length < 2 * diameter:
            continue
        whole = np.vstack(parts)
        for way in (line.points, line.points[::-1]):
            away = np.linalg.norm(whole - way[0], axis=1)
            root = int(np.argmin(away))
            free = np.linalg.norm(whole - way[-1], axis=1).min()
            inwards = way[len(way) // 4] - way[0]
            before = _towards(whole[: root + 1][::-1], diameter)
            after = _towards(whole[root:], diameter)
            # both parts of the chain lie behind the strand's beginning
            if away[root] < _ROOT * diameter < free and max(before @ inwards, after @ inwards) < 0:
                ends = np.cumsum([len(part) for part in parts])
                k = int(np.searchsorted(ends, root, side="right"))
                at = root - (int(ends[k - 1]) if k else 0)
                split = [parts[k][: at + 1], way, way[::-1], parts[k][at + 1 :]]
                parts[k : k + 1] = [part for part in split if len(part)]
                break
    return replace(found.chain, strands=tuple(parts))


def _towards(line: Array, diameter: float) -> Array:
    """Step (2,) [m] from the first point of a line to a point four diameters away."""
    far = np.linalg.norm(line - line[0], axis=1) > 4 * diameter
    return np.asarray(line[int(np.argmax(far)) if far.any() else -1] - line[0])


def _lines(
    mask: NDArray[np.bool_],
    candidate: NDArray[np.float32],
    plane: WorkPlane,
    contrast: Contrast,
    expected: ExpectedLine,
) -> list[_Line]:
    """Strands of a mask in metres, without their staircase, cut where they pass a fixture.

    What lies beyond a fixture, a tail of the cable, is then not taken for the measured part.
    """
    width_px = expected.diameter / plane.pixel
    margin = max(2, round(width_px))
    lines = []
    for strand in find_strands(mask, width_px):
        columns, rows = strand.points.astype(int).T
        level = float(np.median(candidate[rows, columns]))
        colour = np.median(plane.image[rows, columns], axis=0)
        step = np.median(contrast.difference[rows, columns], axis=0) * contrast.noise
        smooth = gaussian_filter1d(strand.points, 0.5 * width_px, axis=0, mode="nearest")
        points = plane.to_board(smooth[1:-1:2])
        cuts = [0, len(points)]
        for fixture in expected.fixtures.values():
            away = np.linalg.norm(points - fixture, axis=1)
            nearest = int(np.argmin(away)) if len(away) else 0
            if margin <= nearest < len(points) - margin and away[nearest] < expected.diameter:
                cuts.append(nearest)
        parts = [points[a:b] for a, b in pairwise(sorted(cuts))]
        width = strand.width / width_px
        lines += [_Line(part, width, level, colour, step) for part in parts if len(part) > 2]
    return lines


def _refuse_twins(
    best: _Finding, plane: WorkPlane, contrast: Contrast, expected: ExpectedLine
) -> None:
    """Raise if strands away from the chain look like a second cable.

    Within reach of the fixtures all of them count together; beyond, where the cable cannot be
    anyway, only one long strand does.
    """
    diameter, length = expected.diameter, expected.typical
    rest = ((best.candidate > best.cut) & plane.inside).astype(np.uint8)
    for strand in best.chain.strands:
        at = np.round(plane.to_pixels(strand)).astype(np.int32)
        cv2.polylines(rest, [at], False, 0, round(3 * diameter / plane.pixel))
    if rest.sum() < 0.5 * _TWIN * length * diameter / plane.pixel**2:
        return
    level = float(np.median([line.level for line in best.ours]))
    width = float(np.median([line.width for line in best.ours]))
    near, far = 0.0, 0.0
    lines = _lines(rest > 0, best.candidate, plane, contrast, expected)
    for line in _of_one_colour(lines, best.ours) if expected.in_space else lines:
        alike = line.level > _TWIN_CONTRAST * level and 0.6 < line.width / width < 1.6
        if not alike or line.length < 5 * diameter:
            continue
        columns, rows = plane.to_pixels(line.points).round().astype(int).T
        if plane.reachable[rows, columns].mean() > 0.5:
            near += line.length
        else:
            far = max(far, line.length)
    second = max(near, far)
    if second > _TWIN * length:
        raise VisionError(
            f"two cables: beside the strand of {best.chain.supported:.3f} m there is "
            f"{second:.3f} m of the same width and colour (the cable is {length:g} m long). "
            "Try: leave one cable in the picture, or cover the other."
        )


def _light(plane: WorkPlane) -> str:
    """What is wrong with the light, if anything."""
    mean = float(plane.image[plane.reachable].mean())
    if 15 <= mean <= 245:
        return ""
    what, cure = ("too dark", "more light") if mean < 15 else ("overexposed", "less light")
    return f"the picture is {what} (mean brightness {mean:.0f} of 255, try {cure}), "
