"""Where the clips of many poses are on their cables, and what their arc lengths and turns change.

The nearest node is moved to each clip but eyelets, and carries a clamped one's frame: see `clips`.
If such a clip slips by ds, the two segments beside it change in start, length and rest strains; of
an eyelet its share of the segment around it changes. If a clamped clip turns, its node turns with
it. These changes are exact: derivatives of the segments by these numbers are the same as by any
other.
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, cross
from dlo_casadi.model.clips import BESIDE, ClipLoad, nearest_nodes
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.element import LAYOUT_SIZE
from dlo_casadi.rod.node import Node
from dlo_casadi.rod.quaternions import conjugate, quaternion_product
from dlo_casadi.rod.supports import SupportKind

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
class Clipped:
    """Where the clips of m poses are on their cables.

    Parameters
    ----------
    kinds : (k,) SupportKind
    at : (m, k) [m]
        Arc lengths of the clips.
    nodes : (m, held) int
        Nodes that are moved to the clips, but to eyelets.
    places : (m, n + 1) [m]
        Arc lengths of the nodes.
    """

    chain: Chain
    kinds: tuple[SupportKind, ...]
    at: FloatArray
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

        `declared` (m, k, clip_size) determines the nearest node, which then stays the same while an
        unknown slip changes. `turn` (k, m, increment) [rad]: of frames from the declared ones.
        """
        node, rows = chain.kind.node, np.arange(len(x))
        places, clamps = np.tile(chain.places, (len(x), 1)), []
        moved = [k for k, kind in enumerate(kinds) if not kind.slides]
        nodes = nearest_nodes(chain, declared[:, moved, -1])
        places[rows[:, None], nodes] = at[:, moved]
        for k, index in zip(moved, nodes.T, strict=True):
            if not kinds[k].direction:
                continue
            frame = node.moved(declared[:, k, node.dimension : -1], turn[k])
            aligned, held = frame, kinds[k].rotations(node)
            if not held.all():
                frame = rolled_with(frame, x[rows, index])
            clamps.append(ClampNode(index, frame, held, aligned, turn[k]))
        return cls(chain, kinds, at, nodes, tuple(clamps), places)

    @classmethod
    def none(cls, chain: Chain, count: int) -> "Clipped":
        """Cables of `count` poses without clips."""
        nodes = np.zeros((count, 0), dtype=np.intp)
        return cls(chain, (), np.zeros((count, 0)), nodes, (), np.tile(chain.places, (count, 1)))

    @property
    def moved(self) -> list[int]:
        """Indices of the clips to which nodes are moved."""
        return [k for k, kind in enumerate(self.kinds) if not kind.slides]

    @property
    def in_order(self) -> BoolArray:
        """Whether the clips (m,) are in order along the cable, and the eyelets within it."""
        low, high = np.zeros(len(self.at)), np.full(len(self.at), self.chain.length)
        return np.asarray(np.all(np.diff(np.column_stack([low, self.at, high])) > 0, axis=1))

    @property
    def cells(self) -> FloatArray:
        """Bending cells (m, n_cells, 2) [m], between the nodes."""
        if self.moved:
            return np.stack([self.places[:, :-1], self.places[:, 1:]], axis=2)
        return np.broadcast_to(self.chain.cells, (len(self.at), *self.chain.cells.shape))

    @property
    def segments_at(self) -> IntArray:
        """Segment (m, k) inside which each clip is, or the one that begins at its node."""
        share = (self.at[:, None] - self.places[:, :-1, None]) / np.diff(self.places)[..., None]
        # A clip at a node counts in one segment only: derivatives by its arc length are one-sided.
        return np.maximum((share >= -BESIDE).sum(axis=1) - 1, 0)

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
        cells, nodes = self.cells, iter(self.nodes.T)
        found = [(cells[:, 0, 0], np.zeros(len(cells), dtype=np.intp))]
        for kind, at in zip(self.kinds, self.at.T, strict=True):
            if not kind.slides:
                node = next(nodes)
                found += [(at, node - 1)] * kind.direction + [(at, node)]
            else:
                found.append((at, np.maximum((cells[:, :, 0] <= at[:, None]).sum(axis=1) - 1, 0)))
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
        """Rows of the layout (m, n_segments, 6 + k), with the arc lengths of the clips."""
        even = self.chain.layout.segments
        table = np.broadcast_to(even, (len(self.at), *even.shape))
        if not self.at.shape[1]:
            return table
        table = table.copy()
        if self.moved:
            table[..., [0, 2]] = self.places[:, :-1, None]
            table[..., [1, 3]] = np.diff(self.places)[..., None]
        at = np.broadcast_to(self.at[:, None], (*table.shape[:2], self.at.shape[1]))
        return np.concatenate([table, at], axis=2)

    def rest(self, inside: FloatArray) -> FloatArray:
        """Rest strains inside (m, n_segments, 3 strains, q) of segments between moved nodes.

        m + a x + c (x^2 - 1/12) of an even element, with x = x_0 + w y.
        """
        if not self.moved:
            return inside
        own, (mean, a, c) = np.empty_like(inside), (inside[:, :, k::3] for k in range(3))
        for k, part in enumerate(_within(mean, a, c, *self._even())):
            own[:, :, k::3] = part
        return own

    def slid(self, k: int, inside: FloatArray) -> tuple[IntArray, FloatArray]:
        """Segments (m, q) that change with the arc length of clip k, and how they do.

        The changes (m, q, 3 strains + 6 + k) are of `rest`, given rest strains `inside` of even
        segments (m, n_segments, 3 strains), and of rows of `segments`.
        """
        first, rows = self.segments_at[:, k, None], np.arange(len(self.at))[:, None]
        moved = not self.kinds[k].slides
        index = np.concatenate([first - 1, first], axis=1) if moved else first
        size = inside.shape[2]
        change = np.zeros((*index.shape, size + LAYOUT_SIZE + len(self.kinds)))
        change[..., size + LAYOUT_SIZE + k] = 1.0
        if moved:
            low, width = np.array([0.0, 1.0]), np.array([1.0, -1.0])
            change[..., [size, size + 2]] = low[:, None]
            change[..., [size + 1, size + 3]] = width[:, None]
            x, w = (part[rows, index, 0] for part in self._even())
            here, h = inside[rows, index], self.chain.h
            dx, dw = (low + width / 2) / h, width / h
            a, c = here[..., 1::3], here[..., 2::3]
            x, w, dx, dw = x, w, dx[:, None], dw[:, None]
            change[..., :size:3] = (a + 2 * c * x) * dx + c * w * dw / 6
            change[..., 1:size:3] = (a + 2 * c * x) * dw + 2 * w * c * dx
            change[..., 2:size:3] = 2 * c * w * dw
        return index, change

    def _even(self) -> tuple[FloatArray, FloatArray]:
        """Middles of segments in even ones (m, n_segments, 1, 1), -1/2 to 1/2, and their widths."""
        low, width = self.places[:, :-1, None, None], np.diff(self.places)[..., None, None]
        x = (low + width / 2 - self.chain.places[:-1, None, None]) / self.chain.h - 0.5
        return x, width / self.chain.h

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
        if not self.moved:
            return NONE
        m, count, size, _ = stations.shape
        out, rows = np.zeros((m, count, size, at.shape[2])), np.arange(m)
        moved = np.zeros((m, count, 1, at.shape[2]))
        moved[rows[:, None], self.nodes, 0] = at[:, self.moved]
        for index in self.nodes.T:
            e, u, width = self._evened(index)
            dw = moved[rows, e + 1] - moved[rows, e]
            du = -(moved[rows, e] + u * dw) / width
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
        e = index - (s <= self.places[rows, index])
        width = self.places[rows, e + 1] - self.places[rows, e]
        u = (s - self.places[rows, e]) / width
        return e, u[:, None, None], width[:, None, None]


def _within(mean: Any, a: Any, c: Any, x: Any, w: Any) -> tuple[Any, Any, Any]:
    """Mean, linear and quadratic variation of m + a y + c (y^2 - 1/12) where y = x + w z."""
    return mean + a * x + c * (x * x + (w * w - 1) / 12), w * (a + 2 * c * x), c * w * w


def moved_rest(chain: Chain, inside: ca.SX, low: ca.SX, width: ca.SX) -> ca.SX:
    """As `Clipped.rest`: symbols (3 strains, n_segments), segments (1, n_segments) [m]."""
    x = (low + width / 2 - ca.DM(chain.places[:-1]).T) / chain.h - 0.5
    rows = ca.vertsplit(inside)
    own: list[ca.SX] = []
    for mean, a, c in zip(rows[::3], rows[1::3], rows[2::3], strict=True):
        own += _within(mean, a, c, x, width / chain.h)
    return ca.vertcat(*own)


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
