"""Contact without friction: inequalities on the nodes of the cable.

No node may come nearer to an obstacle than the cable's own radius. Node i has the gap

    g_i = distance of r_i from the surface - diameter / 2 >= 0,   lam_i >= 0,   lam_i g_i = 0

and adds -lam_i g_i to the Lagrangian: lam_i is the size of the force on the obstacle, along the
surface's normal n. The force acts on each segment before the node as one at the end of the cable
would. Contacts that are active (lam_i / c - g_i > 0: a primal-dual active set) are conditions of a
Newton step, others have no force. That the normal of a round obstacle turns as a node moves adds
outer products to the Hessian: internal columns of the band matrix.

Between nodes a cable of the curvature k relative to the surface may be deeper by h^2 k / 8; where
it lies along a surface by far less.

References
----------
Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002): primal-dual active sets as Newton's method.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.obstacles import surfaces_near

# Depth [lengths] under a force as large as the cable's weight: it keeps apart contacts that depend
# on each other.
DEPTH = 1e-8
# Gap [lengths] that counts as much as such a force in deciding whether a contact is active.
BALANCED = 1e-2


@dataclass(frozen=True)
class Touching:
    """Nodes of m poses that may touch obstacles: K on each cable, one obstacle after the other.

    Parameters
    ----------
    model : CableModel
    normal : (m, K, d)
    bends : (m, K, d, d - 1)
        See `obstacles.Surface`.
    sizes : (m, K) [N]
        Sizes of the forces, whether active or not.
    active : (m, K) bool
    depth : float
        See `DEPTH`.
    """

    model: CableModel
    normal: FloatArray
    bends: FloatArray
    sizes: FloatArray
    active: BoolArray
    depth: float

    @classmethod
    def of(
        cls,
        model: CableModel,
        places: FloatArray,
        offsets: FloatArray,
        sizes: FloatArray,
        depth: float,
    ) -> Touching:
        """Which nodes at these places (m, n + 1, d) [m] touch.

        `offsets` (m, surfaces) [m]: how far the surfaces are outwards of the declared ones.
        """
        gap, normal, bends = _near(model, places, offsets)
        active = sizes * _per_force(model, BALANCED) > gap
        return cls(model, normal, bends, sizes, active, depth)

    # ---- forces ----------------------------------------------------------------------------------

    @cached_property
    def felt(self) -> FloatArray:
        """Sizes (m, K) [N] of the forces, zero where a contact is not active."""
        return np.where(self.active, self.sizes, 0.0)

    @cached_property
    def pulls(self) -> FloatArray:
        """Forces (m, K, d) [N] of the cables on the obstacles."""
        return np.asarray(-self.felt[..., None] * self.normal)

    @cached_property
    def before(self) -> BoolArray:
        """Whether each segment is before each node (K, n)."""
        node = np.arange(self.sizes.shape[1]) % _count(self.model) + 1
        return np.arange(self.model.n) < node[:, None]

    @property
    def beyond(self) -> FloatArray:
        """Sums (m, n, d) [N] of the forces on obstacles beyond the start of each segment."""
        return np.asarray(self.before.T @ self.pulls)

    def beyond_along(self, sizes: FloatArray) -> FloatArray:
        """Change (m, n, d, q) of `beyond` along changes (m, K, q) of the forces' sizes."""
        change = self.normal[..., None] * (self.active[..., None] * sizes)[:, :, None]
        return np.asarray(-np.einsum("ks,mkdq->msdq", self.before, change))

    @property
    def softness(self) -> FloatArray:
        """Gap per force (m, K) [m/N] of active contacts, and of others the row's own scale."""
        depth, balanced = (_per_force(self.model, size) for size in (self.depth, BALANCED))
        return np.where(self.active, depth, balanced)

    def gaps(self, places: FloatArray, offsets: FloatArray) -> FloatArray:
        """Gaps (m, K) [m] of nodes (m, n + 1, d), zero where a contact is not active."""
        return np.where(self.active, _near(self.model, places, offsets)[0], 0.0)

    def added(self, force: Vector, gaps: FloatArray) -> Vector:
        """The gradient with the contacts' conditions, last.

        -g - lam / c of active ones, those of others bring their forces to zero [m].
        """
        rows = -gaps - self.sizes * self.softness
        y = np.concatenate([force.y, rows[..., None]], axis=1)
        y[:, self._no_pull] = 0.0
        return Vector(force.x, y)

    def energy(self, places: FloatArray, gaps: FloatArray) -> FloatArray:
        """What the Lagrangian (m,) [J] has of contacts, less the work of `beyond`."""
        work = (self.beyond * np.diff(places, axis=1)).sum(axis=(1, 2))
        own = self.felt * (gaps + self.felt * self.softness / 2)
        return np.asarray(-work - own.sum(axis=1))

    @property
    def _no_pull(self) -> list[int]:
        """Rows of the border of a force at a free end."""
        return self.model.end_pull if self.model.end == "free" else []

    # ---- derivatives -----------------------------------------------------------------------------

    @cached_property
    def _used(self) -> IntArray:
        """Contacts that are active in any pose."""
        return np.flatnonzero(self.active.any(axis=0))

    def _along(self, vectors: FloatArray) -> FloatArray:
        """Vectors (m, K, d) at the nodes `_used`, as those of the advances (m, a, n, d) to them."""
        used = self._used
        return np.asarray(vectors[:, used, None] * self.before[used, :, None])

    @cached_property
    def _normals(self) -> FloatArray:
        """The gaps' change with the advances, of the contacts `_used`, where active."""
        return self._along(self.normal * self.active[..., None])

    @property
    def _turning(self) -> FloatArray:
        """Functions of the advances whose squares are the second derivatives lam d^2 g."""
        bends = self.bends * np.sqrt(np.maximum(self.felt, 0.0))[..., None, None]
        each = [self._along(own) for own in np.moveaxis(bends, -1, 0)]
        found = np.concatenate(each, axis=1)
        return np.asarray(found[:, found.any(axis=(0, 2, 3))])

    def matrix(self, plain: BandMatrix, bend: FloatArray) -> BandMatrix:
        """The Hessian, from that without contacts and from that of the segments (m, n, ...)."""
        turning = self._turning
        inner, n_lam = turning.shape[1], self.model.n_lam
        k = n_lam + self.sizes.shape[1]
        border = np.zeros((*plain.border.shape[:3], k + inner))
        corner = np.zeros((len(border), k + inner, k + inner))
        border[..., :n_lam], corner[:, :n_lam, :n_lam] = plain.border, plain.corner
        at = np.concatenate([n_lam + self._used, np.arange(k, k + inner)])
        vectors = np.concatenate([-self._normals, turning], axis=1)
        border[..., at], to_border, mutual = self._products(vectors, bend)
        corner[:, :n_lam, at], corner[:, at, :n_lam] = to_border, np.swapaxes(to_border, 1, 2)
        corner[:, at[:, None], at] = mutual
        own = np.concatenate([-self.softness, np.ones((len(border), inner))], axis=1)
        diagonal = np.arange(n_lam, k + inner)
        corner[:, diagonal, diagonal] += own
        for row in self._no_pull:
            border[..., row] = corner[:, row] = corner[:, :, row] = 0.0
            corner[:, row, row] = -1.0
        return BandMatrix(plain.diagonal, plain.upper, border, corner, inner)

    def _products(
        self, vectors: FloatArray, bend: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of functions of the advances by nodes (m, N, b, a) and border (m, k, a).

        And by each other (m, a, a), where they are forces.
        """
        b, pull = self.model.node.increment, self.model.end_pull
        by_pull = bend[..., 2 * b + np.array(pull)]
        on_segments = by_pull @ np.moveaxis(vectors, 1, -1)
        first, last, border = np.split(on_segments, [b, 2 * b], axis=2)
        nodes = np.zeros((len(first), first.shape[1] + 1, *first.shape[2:]))
        nodes[:, :-1] += first
        nodes[:, 1:] += last
        mutual = np.einsum("mcsd,msda->mca", vectors, border[:, :, pull])
        return nodes, border.sum(axis=1), mutual

    def along(self, change: Vector, moved: FloatArray, offsets: FloatArray) -> Vector:
        """Add contacts to the gradient's change at fixed nodes and multipliers.

        `moved` (m, n, d, q): the change of the advances; `offsets` (m, surfaces, q) [m]: that of
        the surfaces.
        """
        rows = np.repeat(offsets, _count(self.model), axis=1) * self.active[..., None]
        rows[:, self._used] -= np.einsum("masd,msdq->maq", self._normals, moved)
        y = np.concatenate([change.y, rows], axis=1)
        y[:, self._no_pull] = 0.0
        return Vector(change.x, y)


def _count(model: CableModel) -> int:
    """Number of nodes that may touch one obstacle."""
    return model.n_contacts // len(model.surfaces)


def _near(
    model: CableModel, places: FloatArray, offsets: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gaps (m, K) [m], normals and bends of all obstacles, see `obstacles.Surface`."""
    some = places[:, 1 : 1 + _count(model)]
    gap, normal, bends = surfaces_near(model.surfaces, some)
    return gap - np.repeat(offsets, some.shape[1], axis=1) - model.cable.diameter / 2, normal, bends


def _per_force(model: CableModel, gap: float) -> float:
    """A gap [m/N] in lengths for a force as large as the cable's weight and bending forces."""
    cable = model.cable
    weight = cable.mass * float(np.linalg.norm(model.gravity))
    return gap * cable.length / (weight + cable.bending_stiffness / cable.length**2)
