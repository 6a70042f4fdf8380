"""Where the clips of many poses are on their cables, and what their arc lengths and turns change.

The nearest node is moved to each clip, and carries a clamped one's frame: see `clips`. If a clip
slips, or the cable slides through it, the ends of the two segments beside it move along the cable.
If a clamped clip turns, its node turns with it. These changes are exact: derivatives of the
segments by these numbers are the same as by any other.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, cross
from dlo_casadi.model.clips import ClipLoad, moved_with, placed_nodes
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.chain import Chain, with_cells_beyond
from dlo_casadi.rod.node import Node
from dlo_casadi.rod.quaternions import conjugate, quaternion_product
from dlo_casadi.rod.supports import SupportKind

# No change of segments or nodes, which broadcasts.
NONE = np.zeros((1, 1, 1, 1))


class Supported(Protocol):
    """What is asked of a `CableModel` here."""

    @property
    def chain(self) -> Chain:
        """Its mesh."""

    @property
    def clips(self) -> tuple[SupportKind, ...]:
        """Kinds of its clips."""

    @property
    def loose(self) -> tuple[bool, bool]:
        """Whether the cable slides through its start, and through its end."""


@dataclass(frozen=True)
class ClampNode:
    """The nodes of m poses that carry the frame of one clamped clip.

    `index` (m,) of the node, `frame` (m, coordinates), `held` (increment,): rotations it blocks.
    `aligned` (m, coordinates): the frame before it takes the cable's roll, where that is free;
    `turn` (m, increment) [rad]: of that from the declared one.
    """

    index: IntArray
    frame: FloatArray
    held: BoolArray
    aligned: FloatArray
    turn: FloatArray

    def turned(self, node: type[Node], change: FloatArray) -> FloatArray:
        """Rotations (m, increment, q) of the frame about its own axes, as the `turn` changes."""
        own = np.moveaxis(_stepped(self.turn[:, None], np.moveaxis(change, 1, 2)), 2, 1)
        if not self.held.all():
            both = node.rotations(self.frame).inv() * node.rotations(self.aligned)
            own = both.as_matrix() @ own
        return np.asarray(own * self.held[:, None])


@dataclass(frozen=True)
class Clipped:
    """Where the clips of m poses are on their cables.

    Parameters
    ----------
    kinds : (k,) SupportKind
        Of the clips.
    loose : (bool, bool)
        Whether the cable slides through its start, and through its end.
    held, near : (m, k + 2) [m]
        Arc lengths of the start, the clips and the end, and those that determine their nodes, see
        `placed_nodes`.
    nodes : (m, k) int
        Nodes that are moved to the clips.
    places : (m, n + 1) [m]
        Arc lengths of the nodes.
    """

    chain: Chain
    kinds: tuple[SupportKind, ...]
    loose: tuple[bool, bool]
    held: FloatArray
    near: FloatArray
    nodes: IntArray
    clamps: tuple[ClampNode, ...]
    places: FloatArray

    @classmethod
    def of(
        cls,
        model: "Supported",
        frames: FloatArray,
        near: FloatArray,
        held: FloatArray,
        turn: FloatArray,
        x: FloatArray,
    ) -> "Clipped":
        """Supports at the arc lengths `held` of shapes x (m, n_nodes, coordinates).

        Those in `near` determine the nodes, which then stay the same while an unknown slip changes,
        or an arc length at which the cable slides. `frames` (m, k, coordinates): of clips, as
        declared; `turn` (k, m, increment) [rad]: from these.
        """
        chain, loose = model.chain, model.loose
        node, rows, clamps = chain.kind.node, np.arange(len(x)), []
        nodes, places = placed_nodes(chain, near, held, loose)
        for k, (kind, index) in enumerate(zip(model.clips, nodes.T, strict=True)):
            if not kind.direction:
                continue
            frame = node.moved(frames[:, k], turn[k])
            aligned, blocked = frame, kind.rotations(node)
            if not blocked.all():
                frame = rolled_with(frame, x[rows, index])
            clamps.append(ClampNode(index, frame, blocked, aligned, turn[k]))
        return cls(chain, model.clips, loose, held, near, nodes, tuple(clamps), places)

    @classmethod
    def none(cls, chain: Chain, count: int) -> "Clipped":
        """Cables of `count` poses without clips, between ends that do not slide."""
        ends = np.tile([0.0, chain.length], (count, 1))
        nodes, places = np.zeros((count, 0), dtype=np.intp), np.tile(chain.places, (count, 1))
        return cls(chain, (), (False, False), ends, ends, nodes, (), places)

    @property
    def at(self) -> FloatArray:
        """Arc lengths (m, k) [m] of the clips."""
        return self.held[:, 1:-1]

    @property
    def moved(self) -> bool:
        """Whether nodes stand at arc lengths of their own."""
        return bool(self.kinds) or any(self.loose)

    @property
    def in_order(self) -> BoolArray:
        """Whether the supports (m,) are in order along the cable."""
        return np.asarray(np.all(np.diff(self.held) > 0, axis=1))

    @property
    def cells(self) -> FloatArray:
        """Bending cells (m, n_cells, 2) [m], between the nodes."""
        if self.moved:
            return np.stack([self.places[:, :-1], self.places[:, 1:]], axis=2)
        return np.broadcast_to(self.chain.cells, (len(self.held), *self.chain.cells.shape))

    @cached_property
    def _resting(self) -> IntArray | None:
        """Even cells (m, n_segments), whose rest strains segments have, if ends slide.

        -1 and n before and after the declared length of the cable.
        """
        if not any(self.loose):
            return None
        _, there = placed_nodes(self.chain, self.near, self.near, self.loose)
        middle = (there[:, 1:] + there[:, :-1]) / (2 * self.chain.h)
        return np.floor(middle).clip(-1, self.chain.n).astype(np.intp)

    def rest_inside(self, means: FloatArray) -> FloatArray:
        """Rest strains inside (m, n_segments, 3 strains, q) even cells, see `Chain.rest_inside`.

        Where ends slide, those of the cell that a segment is in; before and after the declared
        length the rest strains stay as at its ends.
        """
        inside = self.chain.rest_inside(means)
        if self._resting is None:
            return inside
        rows = np.arange(len(inside))[:, None]
        return np.asarray(with_cells_beyond(inside)[rows, self._resting + 1])

    @property
    def before(self) -> FloatArray:
        """1 where a segment is before a clip (m, n_segments, k), else 0."""
        return (np.arange(self.chain.n_segments)[:, None] < self.nodes[:, None]).astype(float)

    def at_nodes(self, rate: FloatArray) -> FloatArray:
        """Changes (m, n_nodes, q) of arc lengths of nodes with those of supports (m, k + 2, q)."""
        still = np.zeros((*self.places.shape, rate.shape[2]))
        return moved_with(self.nodes, still, rate, self.loose)

    @property
    def clamped(self) -> IntArray:
        """Nodes (m, number of clamped clips) that carry the frames of clamped clips."""
        own = [clamp.index for clamp in self.clamps]
        return np.array(own, dtype=np.intp).reshape((len(own), len(self.at))).T

    @property
    def kinks(self) -> tuple[FloatArray, IntArray]:
        """Where the curvature jumps or has a kink: arc lengths (m, K) [m], and the cells there.

        These are both ends, both sides of each clamped clip, and the other clips.
        """
        cells = self.cells
        found = [(cells[:, 0, 0], np.zeros(len(cells), dtype=np.intp))]
        for kind, at, node in zip(self.kinds, self.at.T, self.nodes.T, strict=True):
            found += [(at, node - 1)] * kind.direction + [(at, node)]
        found.append((cells[:, -1, 1], np.full(len(cells), cells.shape[1] - 1)))
        at, beside = zip(*found, strict=True)
        return np.stack(at, axis=1), np.stack(beside, axis=1)

    def in_frames(self, x: FloatArray) -> FloatArray:
        """Nodes (m, n_nodes, coordinates); clamped ones have the clips' frames."""
        rows = np.arange(len(x))
        x = x.copy() if self.clamps else x
        for clamp in self.clamps:
            x[rows, clamp.index] = alike(clamp.frame, x[rows, clamp.index])
        return x

    def free(self, step: FloatArray) -> FloatArray:
        """Increments (m, n_nodes, increment, q) of nodes without those that clips block."""
        rows = np.arange(len(step))
        step = step.copy() if self.clamps else step
        for clamp in self.clamps:
            step[rows, clamp.index] *= ~clamp.held[:, None]
        return step

    def carried(self, both: FloatArray) -> FloatArray:
        """Nodes (m, n_segments, 2 coordinates) of segments; clamped ones have the clips' frames."""
        c, rows = both.shape[2] // 2, np.arange(len(both))
        for clamp in self.clamps:
            before, after = clamp.index - 1, clamp.index
            both[rows, before, c:] = alike(clamp.frame, both[rows, before, :c])
            both[rows, after, :c] = alike(clamp.frame, both[rows, after, c:])
        return both

    def segments(self) -> FloatArray:
        """Arguments `place` of the segments (m, n_segments, ...), see `Lagrangian`."""
        even = self.chain.layout.segments
        if not self.moved:
            return np.broadcast_to(even, (len(self.held), *even.shape))
        table = np.empty((len(self.held), len(even), 4))
        table[..., 0], table[..., 1] = self.places[:, :-1], self.places[:, 1:]
        resting = even[:, 0] if self._resting is None else self._resting * self.chain.h
        table[..., 2], table[..., 3] = even[:, 5], resting
        return table

    def gaps(self, x: FloatArray) -> FloatArray:
        """Rotations (m, n_nodes, increment, 1) of nodes x from the frames of clamped clips."""
        node, rows = self.chain.kind.node, np.arange(len(x))
        found = np.zeros((*x.shape[:2], node.increment, 1))
        for clamp in self.clamps:
            found[rows, clamp.index, :, 0] = node.difference(clamp.frame, x[rows, clamp.index])
        return found

    def turned(self, change: FloatArray) -> FloatArray:
        """Rotations (m, n_nodes, increment, q) of nodes as turns of clips (m, k, increment, q)."""
        if not self.clamps:
            return NONE
        node, rows = self.chain.kind.node, np.arange(len(change))
        found = np.zeros((*self.places.shape, *change.shape[2:]))
        clamped = [k for k, kind in enumerate(self.kinds) if kind.direction]
        for k, clamp in zip(clamped, self.clamps, strict=True):
            found[rows, clamp.index] = clamp.turned(node, change[:, k])
        return found

    def hold(self, force: Vector, moments: FloatArray) -> None:
        """Hold nodes at clamped clips by moments (m, n_nodes, increment, q) [N m].

        This affects nothing else: the cable uses the clip's frame instead, see `carried`.
        """
        rows = np.arange(len(moments))[:, None]
        for clamp in self.clamps:
            at = rows, clamp.index[:, None], clamp.held
            force.x[at] = moments[at]

    def hold_matrix(self, matrix: BandMatrix, stiffness: FloatArray) -> None:
        """The derivative of `hold`."""
        rows = np.arange(len(stiffness))
        for clamp in self.clamps:
            i, free = clamp.index, ~clamp.held
            matrix.diagonal[rows, i] *= np.outer(free, free)
            matrix.diagonal[rows, i] += stiffness[:, None, None] * np.diag(clamp.held)
            matrix.upper[rows, i - 1] *= free
            matrix.upper[rows, i] *= free[:, None]
            matrix.border[rows, i] *= free[:, None]

    def loads(self, forces: FloatArray, by_turns: FloatArray) -> list[tuple[ClipLoad, ...]]:
        """Loads on the clips of each pose: forces (m, k, dimension) [N], and moments.

        `by_turns` (m, n_nodes, increment): derivatives of the energy by rotations of the nodes.
        """
        node, rows = self.chain.kind.node, np.arange(len(forces))
        moments = np.zeros((*forces.shape[:2], node.increment))
        clamped = [k for k, kind in enumerate(self.kinds) if kind.direction]
        for k, clamp in zip(clamped, self.clamps, strict=True):
            own = -by_turns[rows, clamp.index] * clamp.held
            moments[:, k] = node.to_world(clamp.frame, own)
        return [
            tuple(
                ClipLoad(float(s), force, np.squeeze(own))
                for s, force, own in zip(*each, strict=True)
            )
            for each in zip(self.at, forces, moments, strict=True)
        ]


def _stepped(delta: FloatArray, step: FloatArray) -> FloatArray:
    """Increments (..., increment) of nodes `moved` by delta that a small `step` of it makes.

    In space 2 vec(c^-1 dc) of the Cayley map c = (delta / 2, 1) / sqrt(1 + |delta|^2 / 4).
    """
    if step.shape[-1] == 1:
        return step
    turned = step - cross(*np.broadcast_arrays(delta, step)) / 2
    return np.asarray(turned / (1 + (delta**2).sum(axis=-1, keepdims=True) / 4))


def by_axes(moments: FloatArray, step: FloatArray) -> FloatArray:
    """Change of moments (..., increment, q) about nodes' axes that turn by a small `step`.

    It is that beyond the second derivatives by increments, which are symmetric: M x step / 2.
    """
    if step.shape[-2] == 1:
        return np.zeros_like(step)
    both = (np.moveaxis(x, -2, -1) for x in np.broadcast_arrays(moments, step))
    return np.moveaxis(cross(*both), -1, -2) / 2


def alike(frame: FloatArray, beside: FloatArray) -> FloatArray:
    """Frames (m, coordinates) with quaternion signs as in `beside`; headings unchanged."""
    if frame.shape[1] == 1:
        return frame
    return frame * np.where((frame * beside).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def rolled_with(frame: FloatArray, x: FloatArray) -> FloatArray:
    """Frames (m, 4) rolled about their x axes as the quaternions x (m, 4) are, relative to them."""
    a, _, _, w = quaternion_product(conjugate(frame.T), x.T)
    size = np.maximum(np.hypot(a, w), 1e-300)
    zero = np.zeros_like(a)
    return np.stack(quaternion_product(frame.T, (a / size, zero, zero, w / size)), axis=1)
