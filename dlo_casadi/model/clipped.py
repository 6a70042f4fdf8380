"""Where the clips of many poses are on their cables, and what their arc lengths and turns change.

The nearest node is moved to each clip, and carries a clamped one's frame: see `clips`. If a clip
slips, or the cable slides through it, the ends of the two segments beside it move along the cable.
If a clamped clip turns, its node turns with it. These changes are exact: derivatives of the
segments by these numbers are the same as by any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, cross
from dlo_casadi.model.clips import ClipLoad, placed_nodes
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.node import Node
from dlo_casadi.rod.quaternions import conjugate, quaternion_product
from dlo_casadi.rod.supports import SupportKind

# Indices (N,) of poses and of segments.
Ends = tuple[IntArray, IntArray]
# No change of segments or nodes, which broadcasts.
NONE = np.zeros((1, 1, 1, 1))


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
class Slides:
    """What moves m cables along the supports through which they slide.

    These are derivatives of the N segments whose ends then move along the cable.

    Parameters
    ----------
    at : (N,), (N,) int
        Indices of their poses and segments.
    rows : (u,) int
        Of the arc lengths at these supports in derivatives of segments.
    rates : (N, 2, u)
        Of the arc lengths of both ends of a segment with those.
    slope : (N, u) [N]
        Of the Lagrangian by those: summed over the segments the configurational force.
    mixed : (N, rows, u)
        Of the gradient of the segments.
    twice : (N, 2, 2)
        Of the Lagrangian by both ends of a segment.
    """

    at: Ends
    rows: IntArray
    rates: FloatArray
    slope: FloatArray
    mixed: FloatArray
    twice: FloatArray

    @classmethod
    def of(cls, at: Ends, rows: IntArray, rates: FloatArray, edges: Sequence[FloatArray]) -> Self:
        """From the outputs (N, ...) of `Functions.segment_by_edges`."""
        mixed, slope, twice = edges
        return cls(at, rows, rates, by_rates(rates, slope)[..., 0], mixed @ rates, twice)

    def add(self, gradient: FloatArray, bend: FloatArray) -> None:
        """Add their rows to gradients and Hessians of the segments (m, n_segments, rows, ...)."""
        (poses, segments), rows = self.at, self.rows
        each = poses[:, None], segments[:, None]
        gradient[(*each, rows, 0)] += self.slope
        bend[(*each, slice(None), rows)] += self.mixed.transpose(0, 2, 1)
        bend[(*each, rows)] += self.mixed.transpose(0, 2, 1)
        both = by_rates(self.rates, self.twice @ self.rates)
        bend[poses[:, None, None], segments[:, None, None], rows[:, None], rows] += both

    def add_along(self, change: FloatArray, turned: FloatArray, rate: FloatArray) -> None:
        """Add to the change of gradients (m, n_segments, rows, q) what moves both nodes.

        Rotations (m, n_segments, 2b, q) and arc lengths (m, n_segments, 2, q) of these.
        """
        own = self.mixed[:, : turned.shape[2]].transpose(0, 2, 1) @ turned[self.at]
        own = own + by_rates(self.rates, self.twice @ rate[self.at])
        poses, segments = self.at
        change[poses[:, None], segments[:, None], self.rows] += own


def by_rates(rates: FloatArray, by_ends: FloatArray) -> FloatArray:
    """Derivatives (N, u, ...) by what moves segments' ends, from those by the ends (N, 2, ...)."""
    return rates.transpose(0, 2, 1) @ by_ends


@dataclass(frozen=True)
class Clipped:
    """Where the clips of m poses are on their cables.

    Parameters
    ----------
    kinds : (k,) SupportKind
    at, near : (m, k) [m]
        Arc lengths of the clips, and those to which their nodes are the nearest ones.
    nodes : (m, k) int
        Nodes that are moved to the clips.
    places : (m, n + 1) [m]
        Arc lengths of the nodes.
    """

    chain: Chain
    kinds: tuple[SupportKind, ...]
    at: FloatArray
    near: FloatArray
    nodes: IntArray
    clamps: tuple[ClampNode, ...]
    places: FloatArray

    @classmethod
    def of(
        cls,
        chain: Chain,
        kinds: tuple[SupportKind, ...],
        declared: FloatArray,
        at: FloatArray,
        turn: FloatArray,
        x: FloatArray,
    ) -> "Clipped":
        """Clips at the arc lengths `at` (m, k) [m] of shapes x (m, n_nodes, coordinates).

        The arc lengths in `declared` (m, k, clip_size) determine the nearest nodes, which then stay
        the same while an unknown slip changes, or an eyelet's arc length. `turn` (k, m, increment)
        [rad]: of frames from the declared ones.
        """
        node, rows, clamps = chain.kind.node, np.arange(len(x)), []
        nodes, places = placed_nodes(chain, declared[..., -1], at)
        for k, (kind, index) in enumerate(zip(kinds, nodes.T, strict=True)):
            if not kind.direction:
                continue
            frame = node.moved(declared[:, k, node.dimension : -1], turn[k])
            aligned, held = frame, kind.rotations(node)
            if not held.all():
                frame = rolled_with(frame, x[rows, index])
            clamps.append(ClampNode(index, frame, held, aligned, turn[k]))
        return cls(chain, kinds, at, declared[..., -1], nodes, tuple(clamps), places)

    @classmethod
    def none(cls, chain: Chain, count: int) -> "Clipped":
        """Cables of `count` poses without clips."""
        none, places = np.zeros((count, 0)), np.tile(chain.places, (count, 1))
        return cls(chain, (), none, none, none.astype(np.intp), (), places)

    @property
    def in_order(self) -> BoolArray:
        """Whether the clips (m,) are in order along the cable, and the eyelets within it."""
        low, high = np.zeros(len(self.at)), np.full(len(self.at), self.chain.length)
        return np.asarray(np.all(np.diff(np.column_stack([low, self.at, high])) > 0, axis=1))

    @property
    def cells(self) -> FloatArray:
        """Bending cells (m, n_cells, 2) [m], between the nodes."""
        if self.kinds:
            return np.stack([self.places[:, :-1], self.places[:, 1:]], axis=2)
        return np.broadcast_to(self.chain.cells, (len(self.at), *self.chain.cells.shape))

    @property
    def before(self) -> FloatArray:
        """1 where a segment is before a clip (m, n_segments, k), else 0."""
        return (np.arange(self.chain.n_segments)[:, None] < self.nodes[:, None]).astype(float)

    def at_nodes(self, rate: FloatArray) -> FloatArray:
        """Changes (m, n_nodes, q) of the nodes' arc lengths with those of clips (m, k, q)."""
        found = np.zeros((*self.places.shape, rate.shape[2]))
        found[np.arange(len(rate))[:, None], self.nodes] = rate
        return found

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
            x[rows, clamp.index] = _alike(clamp.frame, x[rows, clamp.index])
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
            both[rows, before, c:] = _alike(clamp.frame, both[rows, before, :c])
            both[rows, after, :c] = _alike(clamp.frame, both[rows, after, c:])
        return both

    def segments(self) -> FloatArray:
        """Arguments `place` of the segments (m, n_segments, ...), see `Lagrangian`."""
        even = self.chain.layout.segments
        if not self.kinds:
            return np.broadcast_to(even, (len(self.at), *even.shape))
        table = np.empty((len(self.at), len(even), 4))
        table[..., 0], table[..., 1] = self.places[:, :-1], self.places[:, 1:]
        table[..., 2], table[..., 3] = even[:, 5], even[:, 0]
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

    def evenly(self, stations: FloatArray) -> FloatArray:
        """Places and dr/ds (m, n + 1, 2 d, q) at even arc lengths, given those at moved nodes."""
        out, rows = stations.copy(), np.arange(len(stations))
        for index in self.nodes.T:
            e, u, width = self._evened(index)
            (r0, t0), (r1, t1) = (np.split(stations[rows, e + j], 2, axis=1) for j in (0, 1))
            chord, v = r1 - r0, 1 - u
            place = r0 + u**2 * (3 - 2 * u) * chord + width * u * v * (v * t0 - u * t1)
            slope = 6 * u * v * chord / width + v * (1 - 3 * u) * t0 + u * (3 * u - 2) * t1
            out[rows, index] = np.concatenate([place, slope], axis=1)
        return out

    def evenly_along(self, stations: FloatArray, at: FloatArray) -> FloatArray:
        """Change of `evenly` (m, n + 1, 2 d, q) as the clips slide by `at` (m, k, q) [m]."""
        if not self.kinds:
            return NONE
        m, count, size, _ = stations.shape
        out, rows = np.zeros((m, count, size, at.shape[2])), np.arange(m)
        moved = self.at_nodes(at)
        for index in self.nodes.T:
            e, u, width = self._evened(index)
            dw = (moved[rows, e + 1] - moved[rows, e])[:, None]
            du = -(moved[rows, e][:, None] + u * dw) / width
            (r0, t0), (r1, t1) = (np.split(stations[rows, e + j], 2, axis=1) for j in (0, 1))
            chord, v = (r1 - r0) / width, 1 - u
            place = u * v * (v * t0 - u * t1) * dw
            place = place + (6 * u * v * chord + v * (1 - 3 * u) * t0 + u * (3 * u - 2) * t1) * (
                width * du
            )
            bend = 6 * (1 - 2 * u) * chord + (6 * u - 4) * t0 + (6 * u - 2) * t1
            slope = bend * du - 6 * u * v * chord * dw / width
            out[rows, index] = np.concatenate([place, slope], axis=1)
        return out

    def _evened(self, index: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Element (m,) with the even place of a moved node; its share (m, 1, 1) and length [m]."""
        rows, s = np.arange(len(self.at)), self.chain.places[index]
        e = (self.places <= s[:, None]).sum(axis=1) - 1
        width = self.places[rows, e + 1] - self.places[rows, e]
        u = (s - self.places[rows, e]) / width
        return e, u[:, None, None], width[:, None, None]


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


def _alike(frame: FloatArray, beside: FloatArray) -> FloatArray:
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
