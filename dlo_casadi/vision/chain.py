"""Find the cable coarsely: the chain of strands that fits its width, length and fixtures best."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from dlo_casadi.arrays import BoolArray, FloatArray, length_of, unit
from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import View
from dlo_casadi.vision.workplane import (
    Contrast,
    ExpectedLine,
    Scene,
    WorkPlane,
    candidate_maps,
    find_strands,
    local_contrast,
    thresholds,
)

_State: TypeAlias = tuple[float, tuple[int, ...], float, float]  # cost, path, seen, total
_BEAM = 40  # number of chains that are followed at a time
_LENGTH_TOLERANCE = 0.05  # relative; two clicked reference points are no more accurate
_LEAST = 0.25  # smallest share of the length that must be seen
_TWIN = 0.5  # share of the cable's length: a longer strand beside the cable is a second cable
_TWIN_CONTRAST = 0.6  # smallest contrast of a second cable, relative to the first
_ROOT = 3.0  # diameters: largest distance from the chain at which a doubly covered strand begins
_ALIKE = 0.5  # largest colour difference of a cable's strands, over that from the surroundings


@dataclass(frozen=True)
class Strand:
    """An unbranched line in metres, with its width and colour."""

    points: FloatArray  # (K, d) [m]
    width: float  # relative to the cable's
    level: float  # how much it stands out from its surroundings
    colour: FloatArray  # (3,) [grey levels]
    step: FloatArray  # (3,) [grey levels], its difference from the surroundings

    @property
    def length(self) -> float:
        """Length [m]."""
        return length_of(self.points)


@dataclass
class Workings:
    """Intermediate results of one extraction, up to the step that it has reached."""

    view: View | None = None  # of the plane in which the cable is looked for
    expected: ExpectedLine | None = None
    plane: WorkPlane | None = None
    candidate: NDArray[np.float32] | None = None  # (h, w), contrast of its pixels
    cut: float = 0.0  # level above which a pixel may be cable
    strands: list[Strand] = field(default_factory=list)  # all at that level
    chosen: tuple[FloatArray, ...] = ()  # those that make up the cable, from start to end
    unsound: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """Places (K, 2) [m] on it that do not look like the cable."""
    pixels: FloatArray | None = None  # (K, 2) [px], the line that was found
    gaps: tuple[int, ...] = ()  # indices of pixels that are followed by a gap


@dataclass(frozen=True)
class StrandChain:
    """Strands in the order in which the cable runs through them."""

    strands: tuple[FloatArray, ...]  # each (K, d) [m], directed from start to end
    used: tuple[int, ...]  # their places in the list that was searched
    supported: float  # [m], length that was seen
    total: float  # [m], length with straight gaps
    cost: float  # [m], lower is better; about -length for a cable that is seen without a gap


def find_cable(plane: WorkPlane, expected: ExpectedLine, workings: Workings) -> StrandChain:
    """Try the candidate pictures in turn and keep the chain of least cost."""
    diameter, length, scene = expected.diameter, expected.typical, expected.scene
    area_px = length * diameter / plane.pixel**2
    if plane.reachable.sum() < 2 * area_px * _LEAST:
        raise VisionError(
            "no cable found: almost nothing of the place that it can reach is in the picture. "
            "Try: start, end and length in metres and in the board frame?"
        )
    contrast = local_contrast(plane, diameter / plane.pixel)
    best: StrandChain | None = None
    longest = 0.0
    for candidate in candidate_maps(contrast, area_px):
        for cut in thresholds(candidate[plane.reachable], area_px):
            mask = (candidate > cut) & plane.reachable
            strands = _strands(mask, candidate, contrast, expected)
            longest = max([longest, *(strand.length for strand in strands)])
            chain = order_strands(strands, expected)
            if chain is not None and scene.varied:
                strands = _of_one_colour(strands, [strands[i] for i in chain.used])
                chain = order_strands(strands, expected)
            better = chain is not None and (best is None or chain.cost < best.cost)
            if better or best is None:
                best, workings.chosen = chain, () if chain is None else chain.strands
                workings.candidate, workings.cut, workings.strands = candidate, cut, strands
        if best is not None and best.cost < scene.good * min(best.total, length):
            break
    if best is None or best.supported < _LEAST * length:
        seen = 0.0 if best is None else best.supported
        mean, light = float(plane.image[plane.reachable].mean()), ""
        if not 15 <= mean <= 245:
            what, cure = ("too dark", "more light") if mean < 15 else ("overexposed", "less light")
            light = f"the picture is {what} (mean brightness {mean:.0f} of 255, try {cure}), "
        raise VisionError(
            f"no cable found: {light}the best chain of lines shows {seen:.3f} m of "
            f"{length:g} m, the longest single line {longest:.3f} m (wanted: {1e3 * diameter:.1f} "
            f"mm wide; noise {contrast.noise.mean():.1f} grey levels). Try: is the cable in the "
            "picture and in focus? start, end, length and diameter right? a background of another "
            "brightness or colour?"
        )
    if scene.varied:
        best = _with_folds(best, workings.strands, diameter)
        workings.chosen = best.strands
    _refuse_twins(best, workings, contrast, expected)
    return best


def _strands(
    mask: BoolArray, candidate: NDArray[np.float32], contrast: Contrast, expected: ExpectedLine
) -> list[Strand]:
    """Strands of a mask in metres, smoothed, and cut where they pass a fixture.

    The cable's tail beyond a fixture is thus not part of the measured line.
    """
    plane, width_px = contrast.plane, expected.diameter / contrast.plane.pixel
    margin = max(2, round(width_px))
    strands = []
    for pixels, strand_px in find_strands(mask, width_px):
        columns, rows = pixels.T
        level = float(np.median(candidate[rows, columns]))
        colour = np.median(plane.image[rows, columns], axis=0)
        step = np.median(contrast.difference[rows, columns], axis=0) * contrast.noise
        smooth = gaussian_filter1d(pixels.astype(float), 0.5 * width_px, axis=0, mode="nearest")
        points = plane.to_board(smooth[1:-1:2])
        cuts = [0, len(points)]
        for fixture in expected.fixtures:
            away = np.linalg.norm(points - fixture, axis=1)
            nearest = int(np.argmin(away)) if len(away) else 0
            if margin <= nearest < len(points) - margin and away[nearest] < expected.diameter:
                cuts.append(nearest)
        parts = [points[a:b] for a, b in pairwise(sorted(cuts))]
        width = strand_px / width_px
        strands += [Strand(part, width, level, colour, step) for part in parts if len(part) > 2]
    return strands


def order_strands(strands: Sequence[Strand], expected: ExpectedLine) -> StrandChain | None:
    """Find the chain of strands that explains the cable best.

    The cost of a chain, in metres,

        J = -sum_strands seen (1 - p) + gaps + sum_links d (4 a^2 + 2 b^2)
            + 0.5 L (max(0, total / L - 1.02, 0.98 - total / S) / 0.05)^2

    prefers long seen stretches of the right width, short gaps, and links that go on in the
    direction of the strand: a is the difference of the turns into and out of the gap (0 on a
    circle), b the whole turn, p = 0.8 max(0, |log(width / d)| - 0.25), at most 1/2; S and L are
    the shortest and the longest possible length. Where the line may fold, a turn costs d b^2 / 2.
    """
    if not strands:
        return None
    diameter, length = expected.diameter, expected.longest
    ways = [way for strand in strands for way in (strand.points, strand.points[::-1])]
    seen = np.array([length_of(way) for way in ways])
    excess = np.abs(np.log(np.repeat([strand.width for strand in strands], 2))) - 0.25
    worth = seen * (1 - np.clip(0.8 * excess, 0.0, 0.5))
    gap, link = _links(ways, diameter, expected.scene)
    to_first, to_end = np.zeros((2, len(ways)))
    for away, fixture, tip in zip((to_first, to_end), expected.fixtures, (0, -1), strict=False):
        away[:] = np.linalg.norm([way[tip] - fixture for way in ways], axis=1)
    states: list[_State] = [
        (float(to_first[w] - worth[w]), (w,), float(seen[w]), float(seen[w] + to_first[w]))
        for w in range(len(ways))
        if to_first[w] < 0.6 * length
    ]
    best: _State | None = None
    for _ in range(len(strands)):
        following: list[_State] = []
        for cost, path, supported, total in sorted(states)[:_BEAM]:
            tip = path[-1]
            whole = total + to_end[tip]
            off = max(whole / length - 1.0, 1.0 - whole / expected.shortest)
            misfit = max(0.0, off - 0.02) / _LENGTH_TOLERANCE
            closed = cost + to_end[tip] + 0.5 * length * misfit**2
            if best is None or closed < best[0]:
                best = (closed, path, supported, whole)
            reach = total + gap[tip] + seen
            usable = np.isfinite(link[tip]) & (reach < 1.15 * length + 2 * diameter)
            usable[[w for p in path for w in (p, p ^ 1)]] = False  # a strand in both directions
            for w in np.flatnonzero(usable).tolist():
                onwards = cost + float(link[tip, w] - worth[w])
                following.append((onwards, (*path, w), supported + float(seen[w]), float(reach[w])))
        states = following
    if best is None:
        return None
    cost, path, supported, total = best
    return StrandChain(
        tuple(ways[w] for w in path), tuple(w // 2 for w in path), supported, total, cost
    )


def _links(ways: list[FloatArray], diameter: float, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Gap [m] and cost [m] of going from the last point of way i to the first of way j."""

    def direction(line: FloatArray) -> FloatArray:
        """Direction (d,) at the first point of a line, over its first two diameters."""
        far = int(np.argmax(np.linalg.norm(line - line[0], axis=1) > 2 * diameter))
        far = far or len(line) - 1
        return np.asarray(line[far] - line[min(1, far - 1)])

    def angle(a: FloatArray, b: FloatArray) -> FloatArray:
        """Angle [rad] of unit vectors (..., d), in any dimension."""
        return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))

    across = np.array([way[0] for way in ways])[None] - np.array([way[-1] for way in ways])[:, None]
    gap = np.linalg.norm(across, axis=2)
    out = unit(np.array([-direction(way[::-1]) for way in ways]))[:, None]
    into = unit(np.array([direction(way) for way in ways]))[None]
    over = unit(across)
    turn, before, after = angle(out, into), angle(out, over), angle(over, into)
    mirrored = 2 * (out * over).sum(axis=2, keepdims=True) * over - out  # the way in, on a circle
    short = gap < scene.short * diameter
    uneven = np.where(short, 0.0, angle(mirrored, into))
    cost = gap + diameter * (4 * uneven**2 + scene.turn * turn**2)
    cost[turn > np.where(short, scene.sharpest[1], scene.sharpest[0])] = np.inf
    cost[~short & ((before > 1.4) | (after > 1.4))] = np.inf
    return gap, cost


def _of_one_colour(strands: list[Strand], chosen: list[Strand]) -> list[Strand]:
    """Strands of the same colour as the longest of the chosen ones, without shadows.

    In front of the board a shadow is a separate line. The cable's contrast changes with its
    background, but its colour does not.
    """
    ours = max(chosen, key=lambda strand: strand.length)
    most = _ALIKE * float(np.linalg.norm(ours.step))
    return [strand for strand in strands if np.linalg.norm(strand.colour - ours.colour) < most]


def _with_folds(chain: StrandChain, strands: list[Strand], diameter: float) -> StrandChain:
    """The chain with strands inserted that the cable follows forth and back.

    Seen from its side, a bend is a strand with a free end that the cable covers twice. It begins
    where the chain turns back, and both adjacent parts of the chain lead into it.
    """

    def step(line: FloatArray) -> FloatArray:
        """Step (2,) [m] from the first point of a line to a point four diameters away."""
        far = np.linalg.norm(line - line[0], axis=1) > 4 * diameter
        return np.asarray(line[int(np.argmax(far)) if far.any() else -1] - line[0])

    parts = list(chain.strands)
    for i, strand in enumerate(strands):
        if i in chain.used or strand.length < 2 * diameter:
            continue
        whole = np.vstack(parts)
        for way in (strand.points, strand.points[::-1]):
            away = np.linalg.norm(whole - way[0], axis=1)
            root = int(np.argmin(away))
            free = np.linalg.norm(whole - way[-1], axis=1).min()
            inwards = way[len(way) // 4] - way[0]
            before, after = step(whole[: root + 1][::-1]), step(whole[root:])
            # both parts of the chain lie behind the strand's beginning
            if away[root] < _ROOT * diameter < free and max(before @ inwards, after @ inwards) < 0:
                ends = np.cumsum([len(part) for part in parts])
                k = int(np.searchsorted(ends, root, side="right"))
                at = root - (int(ends[k - 1]) if k else 0)
                split = [parts[k][: at + 1], way, way[::-1], parts[k][at + 1 :]]
                parts[k : k + 1] = [part for part in split if len(part)]
                break
    return replace(chain, strands=tuple(parts))


def _refuse_twins(
    chain: StrandChain, workings: Workings, contrast: Contrast, expected: ExpectedLine
) -> None:
    """Raise if strands away from the chain look like a second cable.

    Within reach of the fixtures the total length of all of them counts; beyond, where the cable
    cannot be, only a single long strand does.
    """
    diameter, length = expected.diameter, expected.typical
    plane, candidate = contrast.plane, workings.candidate
    assert candidate is not None
    rest = ((candidate > workings.cut) & plane.inside).astype(np.uint8)
    for line in chain.strands:
        at = np.round(plane.to_pixels(line)).astype(np.int32)
        cv2.polylines(rest, [at], False, 0, round(3 * diameter / plane.pixel))
    if rest.sum() < 0.5 * _TWIN * length * diameter / plane.pixel**2:
        return
    ours = [workings.strands[i] for i in chain.used]
    level = float(np.median([strand.level for strand in ours]))
    width = float(np.median([strand.width for strand in ours]))
    near, far = 0.0, 0.0
    strands = _strands(rest > 0, candidate, contrast, expected)
    for strand in _of_one_colour(strands, ours):
        alike = strand.level > _TWIN_CONTRAST * level and 0.7 < strand.width / width < 1.4
        if not alike or strand.length < 5 * diameter:
            continue
        columns, rows = plane.to_pixels(strand.points).round().astype(int).T
        if plane.reachable[rows, columns].mean() > 0.5:
            near += strand.length
        else:
            far = max(far, strand.length)
    second = max(near, far)
    if second > _TWIN * length:
        raise VisionError(
            f"two cables: beside the strand of {chain.supported:.3f} m there is "
            f"{second:.3f} m of the same width and colour (the cable is {length:g} m long). "
            "Try: leave one cable in the picture, or cover the other."
        )
