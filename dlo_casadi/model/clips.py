"""Clips: what holds a cable between its ends.

A clip k at the arc length s_k adds lam_k . (r(s_k) - place_k) to the Lagrangian. In every segment
r(s_k) advances by the share of the segment before s_k, as for a point force: arc lengths need not
be nodes. For an eyelet s_k is also an unknown, and dL/ds_k = lam_k . t = 0: no force along the
cable. A clamped clip bends the cable by a moment. The nearest node is moved to it and carries its
frame, so that the curvature does not jump inside an element.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.node import Heading, Node, conjugate, quaternion_product
from dlo_casadi.rod.supports import SupportKind

# Distance before the edge of a segment, as a share of its length, from which on a place counts as
# beyond it. Rounding is smaller, so that just one segment has the derivatives by the place.
BESIDE = 1e-9


@dataclass(frozen=True)
class HeldClip:
    """A clip of one pose as declared.

    Parameters
    ----------
    place : (dimension,) [m]
    at : float [m] or None
        Arc length from the start at which it holds the cable; None for an eyelet.
    heading : float [rad], optional
        Direction of a clamped clip in a plane, continuous along the cable.
    orientation : (4,), optional
        Frame of a clamped clip in space: a unit quaternion (x, y, z, w), x forward.
    """

    kind: SupportKind
    place: tuple[float, ...]
    at: float | None = None
    heading: float | None = None
    orientation: tuple[float, ...] | None = None
    name: str = "clip"

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", SupportKind(self.kind))

    @property
    def frame(self) -> FloatArray | None:
        """Its frame (coordinates,) in the form of a node; None if the cable may turn."""
        if not self.kind.direction:
            return None
        if self.orientation is None:
            return np.array([self.heading], dtype=float)
        found = np.array(self.orientation, dtype=float)
        return found / max(np.linalg.norm(found), 1e-300)

    def vector(self, node: type[Node]) -> FloatArray:
        """Place, frame and arc length (`clip_size`,)."""
        frame = self.frame
        own = np.array(node.identity) if frame is None else frame
        return np.concatenate([self.place, own, [self.at or 0.0]])


@dataclass(frozen=True)
class ClipLoad:
    """What the cable does to a clip.

    Parameters
    ----------
    at : float [m]
        Arc length at which it holds the cable.
    force : (dimension,) [N]
    moment : () or (3,) [N m]
        In a plane one number, counter-clockwise; in space about the world's axes. Zero where the
        cable may turn.
    """

    at: float
    force: FloatArray
    moment: FloatArray


def clip_rows(clips: Sequence[HeldClip], loads: Sequence[ClipLoad]) -> list[dict[str, Any]]:
    """Clips and what the cable does to them, as plain data in SI units."""
    return [
        {
            "name": clip.name,
            "kind": str(clip.kind),
            "at": load.at,
            "force": load.force.tolist(),
            "moment": load.moment.tolist(),
        }
        for clip, load in zip(clips, loads, strict=True)
    ]


def clip_size(node: type[Node]) -> int:
    """Size of `HeldClip.vector`."""
    return node.dimension + node.coordinates + 1


@dataclass(frozen=True)
class ClampNode:
    """The nodes of m poses that carry the frame of one clamped clip.

    `index` (m,) of the node, `frame` (m, coordinates), `held` (increment,): rotations it blocks.
    """

    index: IntArray
    frame: FloatArray
    held: BoolArray


@dataclass(frozen=True)
class Clipped:
    """Where the clips of m poses are on their cables.

    Parameters
    ----------
    kinds : (k,) SupportKind
    at : (m, k) [m]
        Arc lengths of the clips.
    places : (m, n + 1) [m]
        Arc lengths of the nodes; nodes of clamped clips are moved to these.
    """

    chain: Chain
    kinds: tuple[SupportKind, ...]
    at: FloatArray
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
        for k, kind in enumerate(kinds):
            if not kind.direction:
                continue
            index = np.rint(declared[:, k, -1] / chain.h).astype(np.intp).clip(1, chain.n - 1)
            frame = node.moved(declared[:, k, node.dimension : -1], turn[k])
            held = kind.rotations(node)
            if not held.all():
                frame = _rolled_with(frame, x[rows, index])
            places[rows, index] = at[:, k]
            clamps.append(ClampNode(index, frame, held))
        return cls(chain, kinds, at, tuple(clamps), places)

    @classmethod
    def none(cls, chain: Chain, count: int) -> "Clipped":
        """Cables of `count` poses without clips."""
        return cls(chain, (), np.zeros((count, 0)), (), np.tile(chain.places, (count, 1)))

    @property
    def in_order(self) -> BoolArray:
        """Whether the clips (m,) are in order along the cable, and the eyelets within it."""
        low, high = np.zeros(len(self.at)), np.full(len(self.at), self.chain.length)
        return np.asarray(np.all(np.diff(np.column_stack([low, self.at, high])) > 0, axis=1))

    @property
    def cells(self) -> FloatArray:
        """Bending cells (m, n_cells, 2) [m]; between moved nodes where a clip is clamped."""
        if self.clamps:
            return np.stack([self.places[:, :-1], self.places[:, 1:]], axis=2)
        return np.broadcast_to(self.chain.cells, (len(self.at), *self.chain.cells.shape))

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
        cells, nodes = self.cells, iter(self.clamped.T)
        found = [(cells[:, 0, 0], np.zeros(len(cells), dtype=np.intp))]
        for kind, at in zip(self.kinds, self.at.T, strict=True):
            if kind.direction:
                node = next(nodes)
                found += [(at, node - 1), (at, node)]
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
        if self.clamps:
            table[..., [0, 2]] = self.places[:, :-1, None]
            table[..., [1, 3]] = np.diff(self.places)[..., None]
        at = np.broadcast_to(self.at[:, None], (*table.shape[:2], self.at.shape[1]))
        return np.concatenate([table, at], axis=2)

    def rest(self, inside: FloatArray) -> FloatArray:
        """Rest strains inside (m, n_segments, 3 strains, q) of segments between moved nodes.

        m + a x + c (x^2 - 1/12) of an even element, with x = x_0 + w y.
        """
        if not self.clamps:
            return inside
        low, width = self.places[:, :-1, None, None], np.diff(self.places)[..., None, None]
        x = (low + width / 2 - self.chain.places[:-1, None, None]) / self.chain.h - 0.5
        own, (mean, a, c) = np.empty_like(inside), (inside[:, :, k::3] for k in range(3))
        for k, part in enumerate(_within(mean, a, c, x, width / self.chain.h)):
            own[:, :, k::3] = part
        return own

    def hold(self, force: Vector, x: FloatArray, stiffness: FloatArray) -> None:
        """Hold the nodes x at clamped clips in their frames by a stiffness (m,) [N m].

        This affects nothing else: the cable uses the clip's frame instead, see `carried`.
        """
        rows = np.arange(len(x))[:, None]
        for clamp in self.clamps:
            gap = self.chain.kind.node.difference(clamp.frame, x[rows[:, 0], clamp.index])
            held = (stiffness[:, None] * gap)[:, clamp.held, None]
            force.x[rows, clamp.index[:, None], clamp.held] = held

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
        for clamp in self.clamps:
            s = self.chain.places[clamp.index]
            e = clamp.index - (s <= self.places[rows, clamp.index])
            width = self.places[rows, e + 1] - self.places[rows, e]
            u = ((s - self.places[rows, e]) / width)[:, None, None]
            width = width[:, None, None]
            (r0, t0), (r1, t1) = (np.split(stations[rows, e + j], 2, axis=1) for j in (0, 1))
            chord, v = r1 - r0, 1 - u
            place = r0 + u**2 * (3 - 2 * u) * chord + width * u * v * (v * t0 - u * t1)
            slope = 6 * u * v * chord / width + v * (1 - 3 * u) * t0 + u * (3 * u - 2) * t1
            out[rows, clamp.index] = np.concatenate([place, slope], axis=1)
        return out


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


def clamped_nodes(chain: Chain, clips: Sequence[HeldClip]) -> tuple[int, ...]:
    """Nodes held by the clamped clips: those nearest to them."""
    at = np.array([clip.at for clip in clips if clip.kind.direction], dtype=float)
    return tuple(np.rint(at / chain.h).astype(int).clip(1, chain.n - 1).tolist())


def node_places(chain: Chain, clips: Sequence[HeldClip]) -> FloatArray:
    """Arc lengths (n_nodes,) [m] of the nodes; nodes of clamped clips are moved to these."""
    places = chain.places.copy()
    held = [clip.at for clip in clips if clip.kind.direction]
    places[list(clamped_nodes(chain, clips))] = held
    return places


def _alike(frame: FloatArray, beside: FloatArray) -> FloatArray:
    """Frames (m, coordinates) with quaternion signs as in `beside`; headings unchanged."""
    if frame.shape[1] == 1:
        return frame
    return frame * np.where((frame * beside).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def _rolled_with(frame: FloatArray, x: FloatArray) -> FloatArray:
    """Frames (m, 4) rolled about their x axes as the quaternions x (m, 4) are, relative to them."""
    a, _, _, w = quaternion_product(conjugate(frame.T), x.T)
    size = np.maximum(np.hypot(a, w), 1e-300)
    zero = np.zeros_like(a)
    return np.stack(quaternion_product(frame.T, (a / size, zero, zero, w / size)), axis=1)


def tangents(node: type[Node], x: FloatArray) -> FloatArray:
    """Unit tangents (..., dimension) of nodes (..., coordinates)."""
    if node is Heading:
        return np.concatenate([np.cos(x), np.sin(x)], axis=-1)
    forward: Any = np.eye(3)[0]
    flat = x.reshape((-1, node.coordinates))
    return np.asarray(node.to_world(flat, forward)).reshape((*x.shape[:-1], node.dimension))
