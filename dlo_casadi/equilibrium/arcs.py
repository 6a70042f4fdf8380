"""Arcs of a cable in space from one holder to the next, as first guesses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.equilibrium.guess_table import HALF_TURN, TAUT, GuessRow
from dlo_casadi.equilibrium.guesses import (
    arc_half_angle,
    arc_tangents,
    bent_into,
    chord_direction,
    fallen,
    frame_rotation,
    frames_along,
    sagging,
    smallest_turn,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel

# Sum of two unit vectors so short that they have no common direction.
_OPPOSITE = 1e-3
_START, _END = np.zeros(1), np.ones(1)


@dataclass(frozen=True)
class Span:
    """The cable between two holders; arc lengths [m], `chord` (dimension,) [m] or None at a tip."""

    start: float
    end: float
    chord: FloatArray | None
    frames: tuple[FloatArray | None, FloatArray | None]

    @property
    def length(self) -> float:
        """Length along the cable [m]."""
        return self.end - self.start

    @property
    def taut(self) -> bool:
        """Whether the span is so taut that the sides of its arc hardly differ."""
        size = 0.0 if self.chord is None else float(np.linalg.norm(self.chord))
        return arc_half_angle(size, self.length) < TAUT


def arc_frames(
    model: CableModel,
    pose: HeldPose,
    places: FloatArray,
    spans: Sequence[Span],
    clamps: Sequence[tuple[float, FloatArray | None]],
    row: GuessRow,
) -> FloatArray | None:
    """Frames (n_nodes, 4) at arc lengths `places` (n_nodes,) [m] from one end to the other.

    `clamps`: arc lengths and frames of all holders that fix the roll.

    None where the row rolls the cable the other way round and its roll is not nearly half a turn.
    """
    axes = np.zeros((len(places), 3))
    arcs = [_Arc.of(model, span, side) for span, side in zip(spans, row.sides, strict=True)]
    for k, (before, after) in enumerate(pairwise(arcs)):
        if before.ways[1] is None and after.ways[0] is None and not after.falls:
            middle = before.tangents(_END)[0] + after.tangents(_START)[0]
            if np.linalg.norm(middle) > _OPPOSITE:
                arcs[k] = replace(arcs[k], ways=(arcs[k].ways[0], unit(middle)))
                arcs[k + 1] = replace(after, ways=(unit(middle), after.ways[1]))
    for span, arc in zip(spans, arcs, strict=True):
        inside = (places >= span.start - 1e-9) & (places <= span.end + 1e-9)
        u = np.clip((places[inside] - span.start) / span.length, 0.0, 1.0)
        axes[inside] = arc.bent(u)
    edges: list[tuple[float, FloatArray | None]] = list(clamps)
    if not edges or edges[0][0] > places[0]:
        edges.insert(0, (float(places[0]), None))
    if edges[-1][0] < places[-1]:
        edges.append((float(places[-1]), None))
    x, roll = frames_along(places, axes, edges, pose.turns, other_way=row.rolled)
    left_out = row.rolled and (pose.turns or not 0.0 < abs(roll) < np.pi + HALF_TURN)
    return None if left_out else x


@dataclass(frozen=True)
class _Arc:
    """The arc of a span, or its fall to a free end; `ways`: directions of its ends (3,)."""

    over: tuple[float, FloatArray, FloatArray] | None
    fall: tuple[FloatArray, FloatArray] | None
    ways: tuple[FloatArray | None, FloatArray | None]

    @classmethod
    def of(cls, model: CableModel, span: Span, quarter: int) -> Self:
        """The arc that bulges along gravity, turned about its chord by quarter turns."""
        down = np.array(model.gravity)
        clamps = frame_rotation(span.frames[0]), frame_rotation(span.frames[1])
        first, last = (None if one is None else one.apply(np.eye(3)[0]) for one in clamps)
        if span.chord is None:
            down = down / max(float(np.linalg.norm(down)), 1e-12)
            ahead = down if first is None else first
            turn = smallest_turn(ahead, down if np.any(down) else ahead).as_rotvec()
            return cls(None, (ahead, turn), (first, last))
        along = chord_direction(span.chord / span.length, clamps, down)
        turned = Rotation.from_rotvec(quarter * np.pi / 2 * along).apply(sagging(along, down))
        return cls(
            (float(np.linalg.norm(span.chord)) / span.length, along, turned), None, (first, last)
        )

    @property
    def falls(self) -> bool:
        """Whether it falls to a free end."""
        return self.over is None

    def tangents(self, u: FloatArray) -> FloatArray:
        """Tangents (k, 3) at shares u (k,) of its length."""
        if self.over is not None:
            return arc_tangents(u, *self.over)
        assert self.fall is not None
        first, turn = self.fall
        return np.asarray(Rotation.from_rotvec(fallen(u)[:, None] * turn).apply(first))

    def bent(self, u: FloatArray) -> FloatArray:
        """The same bent into the directions of its ends."""
        if self.falls:
            return self.tangents(u)
        both = self.tangents(np.array([0.0, 1.0]))
        return np.asarray(bent_into(u, self.tangents(u), both, self.ways))
