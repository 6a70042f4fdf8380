"""Clips: what holds a cable between its ends.

A clip k at the arc length s_k adds lam_k . (r(s_k) - place_k) to the Lagrangian. The nearest node
is moved to s_k, so that shear and curvature jump at a node; on the segments before it lam_k acts
like a force at their end. A clamped clip bends the cable by a moment, and its node carries its
frame. For an eyelet s_k is also an unknown, and dL/ds_k = 0: no force along the cable.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.node import Heading, Node
from dlo_casadi.rod.supports import SupportKind


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


def nearest_nodes(chain: Chain, at: FloatArray) -> IntArray:
    """Nodes (..., k) nearest to arc lengths (..., k) [m] in order, another one for each."""
    k = np.arange(at.shape[-1])
    near = np.maximum(np.rint(at / chain.h).astype(np.intp) - k, 1)
    return np.asarray(np.minimum(np.maximum.accumulate(near, axis=-1), chain.n - len(k)) + k)


def placed_nodes(
    chain: Chain, near: FloatArray, at: FloatArray, loose: tuple[bool, bool] = (False, False)
) -> tuple[IntArray, FloatArray]:
    """Nodes (m, k) of the clips, and arc lengths (m, n + 1) [m] of all nodes.

    `near`, `at` (m, k + 2) [m]: of the start, the clips and the end. The nodes nearest to `near`
    are moved to the clips at `at`. Where the cable slides through an end, see `CableModel.loose`,
    nodes are spread evenly from there to the next clip.
    """
    even, inner = np.tile(chain.places, (len(at), 1)), near[:, 1:-1]
    if any(loose):
        low, size = near[:, :1], near[:, -1:] - near[:, :1]
        even, inner = low + size * (even / chain.length), (inner - low) * (chain.length / size)
    nodes = nearest_nodes(chain, inner)
    return nodes, moved_with(nodes, even, at, loose)


def laid_for(chain: Chain, at: FloatArray) -> FloatArray:
    """Arc lengths (..., 2) [m] of both ends for which nodes are laid: middles of elements there.

    Shapes that were reached in different ways then have the same nodes; and no middle of evenly
    laid nodes is on the edge of an even cell.
    """
    middles = np.floor(at / chain.h) + 0.5
    middles[..., 1] = np.maximum(middles[..., 1], middles[..., 0] + 1)
    return np.asarray(middles * chain.h)


def moved_with(
    nodes: IntArray, others: FloatArray, at: FloatArray, loose: tuple[bool, bool]
) -> FloatArray:
    """Values (m, n + 1, ...) of nodes: of supports `at` (m, k + 2, ...), and of `others`.

    From an end that slides to the next support they are interpolated.
    """
    found, k, count = others.copy(), nodes.shape[1], others.shape[1]
    found[np.arange(len(at))[:, None], nodes] = at[:, 1:-1]
    shape = (*others.shape[:2], *[1] * (others.ndim - 2))
    for end, beside in ((0, 1), (-1, -2)):
        if not loose[end]:
            continue
        first, last = (0, count - 1) if end == 0 else (count - 1, 0)
        reached = nodes[:, [end]] if k else np.full((len(at), 1), last)
        share = ((np.arange(count) - reached) / (first - reached)).reshape(shape)
        own = at[:, [beside]] + share * (at[:, [end]] - at[:, [beside]])
        found = np.where(share > 0, own, found)
    return found


def tangents(node: type[Node], x: FloatArray) -> FloatArray:
    """Unit tangents (..., dimension) of nodes (..., coordinates)."""
    if node is Heading:
        return np.concatenate([np.cos(x), np.sin(x)], axis=-1)
    forward: Any = np.eye(3)[0]
    flat = x.reshape((-1, node.coordinates))
    return np.asarray(node.to_world(flat, forward)).reshape((*x.shape[:-1], node.dimension))
