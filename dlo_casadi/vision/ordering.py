"""Which strands make up the cable, and in which order: from fixture to fixture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.vision.curve import length_of
from dlo_casadi.vision.view import Array
from dlo_casadi.vision.workplane import ExpectedLine

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
