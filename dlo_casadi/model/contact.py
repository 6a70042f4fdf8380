"""Contact without friction: inequalities on the nodes of the cable.

No node may come nearer to an obstacle than the cable's own radius. Node i has the gap

    g_i = distance of r_i from the surface - diameter / 2 >= 0,   lam_i >= 0,   lam_i g_i = 0

and adds -lam_i g_i to the Lagrangian: lam_i is the size of the force on the obstacle, along the
surface's normal n. On each segment before the node the force acts like one at the end of the cable.
Active contacts (lam_i / c - g_i > 0: a primal-dual active set) are conditions of a Newton step; the
others have no force. As a node moves, the normal of a round obstacle turns; this adds outer
products to the Hessian: internal columns of the band matrix.

Between nodes, a cable of curvature k relative to the surface may sink in deeper by h^2 k / 8, and
by far less where it lies along a surface.

References
----------
Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002): primal-dual active sets as Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.effects import ContactEffect
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.obstacles import Obstacle, Surface, surfaces_near

# Depth [lengths] under a force as large as the cable's weight; it separates contacts that depend
# on each other. Energies do not include it (`Touching.given_way`): those of 481 of 500 random
# cables, which touch where IPOPT's do, are the same to 3e-11 of m g L + EI/L
# (`scripts/check_cables.py`).
DEPTH = 1e-10
# Gap [lengths] that counts as much as a force of the cable's weight in deciding whether a contact
# is active: it exceeds what this force bends segments.
BALANCED = 1.0
# Maximum number of evaluations of the gaps, which change with the forces on them; change [lengths]
# of the gaps at which they end.
LOOKS, SAME_GAP = 8, 1e-12
# A node this near to a surface [lengths] belongs to the same contact as its pressing neighbours.
CLOSE = 1e-4


@dataclass(frozen=True)
class Contact:
    """A stretch of the cable that touches an obstacle.

    Parameters
    ----------
    start, end : float [m]
        Arc lengths where it begins and ends; equal if the cable touches at a point. Between nodes
        they follow from the nearby forces: evenly spread in between, points at both ends.
    force : (dimension,) [N]
        Of the cable on the obstacle.
    """

    obstacle: str
    start: float
    end: float
    force: FloatArray

    @property
    def row(self) -> dict[str, Any]:
        """As plain data in SI units."""
        at = {"from": self.start, "to": self.end}
        return {"obstacle": self.obstacle, **at, "force": self.force.tolist()}


@dataclass(frozen=True)
class Touching:
    """Nodes of m poses that may touch obstacles: K per cable, one obstacle after the other.

    Parameters
    ----------
    border : (m, k)
        All unknowns beside the nodes; the sizes of the forces [N] come last.
    start : (m, d) [m]
    offsets : (m, surfaces) [m]
        Outward shifts of the surfaces from the declared ones.
    depth : float
        See `DEPTH`.
    normal : (m, K, d)
    bends : (m, K, d, d - 1)
        See `obstacles.Surface`.
    gap : (m, K) [m]
    active : (m, K) bool
    """

    model: CableModel
    border: FloatArray
    start: FloatArray
    offsets: FloatArray
    depth: float
    normal: FloatArray
    bends: FloatArray
    gap: FloatArray
    active: BoolArray

    @classmethod
    def of(
        cls,
        model: CableModel,
        border: FloatArray,
        start: FloatArray,
        offsets: FloatArray,
        depth: float,
        everywhere: bool,
        advances: Callable[[FloatArray, IntArray], FloatArray],
    ) -> Touching:
        """Determine which nodes touch.

        `advances`: those of the segments (q, n, d) [m] of some poses, given forces (q, n, n_lam)
        and the poses' indices (q,). The forces on obstacles bend the segments, and round surfaces
        turn these forces. Gaps are therefore found by fixed-point iteration, for each pose until
        its own have settled, starting with all positive forces. `everywhere`: forces act whatever
        the gaps.
        """
        m, d = start.shape
        count, sizes = model.n_contacts, border[:, model.n_lam :]
        normal, bends = np.zeros((m, count, d)), np.zeros((m, count, d, d - 1))
        gap, felt = np.full((m, count), np.inf), np.full((m, model.n, model.n_lam), np.nan)
        for touching in (np.ones_like(sizes, dtype=bool),) if everywhere else (sizes > 0, None):
            active = sizes * gap_per_force(model, BALANCED) > gap if touching is None else touching
            rows = np.arange(m)
            for _ in range(LOOKS):
                found = cls(model, border, start, offsets, depth, normal, bends, gap, active)
                rows = rows[(found.lam != felt)[rows].any(axis=(1, 2))]
                if not len(rows):
                    break
                felt[rows], before = found.lam[rows], gap[rows]
                gap, normal, bends = gap.copy(), normal.copy(), bends.copy()
                gap[rows], normal[rows], bends[rows] = found._near(rows, advances(felt[rows], rows))
                settled = np.abs(gap[rows] - before) < SAME_GAP * model.cable.length
                rows = rows[~settled.all(axis=1)]
        return cls(model, border, start, offsets, depth, normal, bends, gap, active)

    def subset(self, index: IntArray) -> Touching:
        """The nodes of some of the poses."""
        each = "border", "start", "offsets", "normal", "bends", "gap", "active"
        return replace(self, **{name: getattr(self, name)[index] for name in each})

    @property
    def sizes(self) -> FloatArray:
        """Sizes (m, K) [N] of the forces, whether active or not."""
        return self.border[:, self.model.n_lam :]

    # ---- forces ----------------------------------------------------------------------------------

    @cached_property
    def felt(self) -> FloatArray:
        """Sizes (m, K) [N] of the forces; zero if a contact is not active."""
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

    @property
    def lam(self) -> FloatArray:
        """Unknowns (m, n, n_lam) beside the nodes, with contact forces added, for each segment."""
        found = np.repeat(self.border[:, None, : self.model.n_lam], self.model.n, axis=1)
        found[:, :, self.model.end_pull] += self.beyond
        return found

    def lam_along(self, border: FloatArray) -> FloatArray:
        """Change (m, n, n_lam, q) of `lam` along changes (m, k, q) of the border."""
        lam, sizes = np.split(border, [self.model.n_lam], axis=1)
        change = self.normal[..., None] * (self.active[..., None] * sizes)[:, :, None]
        found = np.repeat(lam[:, None], self.model.n, axis=1)
        found[:, :, self.model.end_pull] -= np.einsum("ks,mkdq->msdq", self.before, change)
        return found

    def held(self, reactions: FloatArray) -> FloatArray:
        """Reactions (m, n_reactions); the start's force is reduced by what obstacles carry."""
        found, rows = reactions.copy(), reaction_rows(self.model.node)["start_force"]
        found[:, rows] -= self.pulls.sum(axis=1)
        return found

    @property
    def softness(self) -> FloatArray:
        """Gap per force (m, K) [m/N] of active contacts; for others the scale of their row."""
        depth, balanced = (gap_per_force(self.model, size) for size in (self.depth, BALANCED))
        return np.where(self.active, depth, balanced)

    @property
    def given_way(self) -> FloatArray:
        """Energy (m,) [J] by which the depth under the contact forces lowers that of a pose."""
        return np.asarray((self.felt**2 * self.softness).sum(axis=1) / 2)

    def _near(self, poses: IntArray, advances: FloatArray) -> Surface:
        """Gaps, normals and bends of all obstacles at some poses (q,)."""
        some = np.concatenate([self.start[poses, None], advances], axis=1).cumsum(axis=1)
        found = surfaces_near(self.model.surfaces, some[:, 1 : 1 + _count(self.model)])
        outwards = np.repeat(self.offsets[poses], _count(self.model), axis=1)
        return found._replace(distance=found.distance - outwards - self.model.cable.diameter / 2)

    @property
    def _pull(self) -> list[int]:
        """Rows of a force at the end of the cable, in derivatives of a segment."""
        return [2 * self.model.node.increment + row for row in self.model.end_pull]

    def added(
        self, total: FloatArray, force: Vector, gradient: FloatArray
    ) -> tuple[FloatArray, Vector]:
        """The Lagrangian (m,) [J] and its gradient, contacts included.

        `gradient` (m, n, 2b + k, 1): that of the segments. The result ends with the contacts'
        conditions [m]: -g - lam / c for active ones; those of the others drive their forces to
        zero.
        """
        advances = gradient[:, :, self._pull, 0]
        all_poses = np.arange(len(advances))
        gaps = np.where(self.active, self._near(all_poses, advances).distance, 0.0)
        y = np.concatenate([force.y, (-gaps - self.sizes * self.softness)[..., None]], axis=1)
        y[:, self.model.no_pull] = 0.0
        work = (self.beyond * advances).sum(axis=(1, 2))
        own = (self.felt * (gaps + self.felt * self.softness / 2)).sum(axis=1)
        return total - work - own, Vector(force.x, y)

    def contacts(self, places: FloatArray) -> list[tuple[Contact, ...]]:
        """Stretches of neighbouring nodes that touch, for each of m poses.

        `places` (m, n + 1) [m]: arc lengths of the nodes.
        """
        count = _count(self.model)
        near, found = self.gap < CLOSE * self.model.cable.length, []
        for sizes, pulls, close, at in zip(self.felt, self.pulls, near, places, strict=True):
            own = []
            for k, obstacle in enumerate(self.model.surfaces):
                some = slice(k * count, (k + 1) * count)
                edges = np.diff(np.pad(close[some].astype(int), 1))
                ends = zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)
                for low, high in ends:
                    pressed = np.flatnonzero(sizes[some][low:high])
                    if not len(pressed):
                        continue
                    low, high = low + pressed[0], low + pressed[-1] + 1
                    force = sizes[some][low:high]
                    own_places = at[low + 1 : high + 1]
                    start = own_places[0] + _inwards(force, own_places)
                    end = max(start, own_places[-1] - _inwards(force[::-1], -own_places[::-1]))
                    total = pulls[some][low:high].sum(axis=0)
                    own.append(Contact(obstacle.name, float(start), float(end), total))
            found.append(tuple(sorted(own, key=lambda one: one.start)))
        return found

    # ---- derivatives -----------------------------------------------------------------------------

    @cached_property
    def _used(self) -> IntArray:
        """Contacts that are active in at least one pose."""
        return np.flatnonzero(self.active.any(axis=0))

    def _along(self, vectors: FloatArray) -> FloatArray:
        """Vectors (m, K, d) at the nodes `_used`, given for each segment's advance (m, a, n, d)."""
        used = self._used
        return np.asarray(vectors[:, used, None] * self.before[used, :, None])

    @cached_property
    def _normals(self) -> FloatArray:
        """Change of the gaps `_used` with the advances, if active."""
        return self._along(self.normal * self.active[..., None])

    @property
    def _turning(self) -> FloatArray:
        """Functions of the advances whose squares sum to the second derivatives lam d^2 g."""
        bends = self.bends * np.sqrt(np.maximum(self.felt, 0.0))[..., None, None]
        each = [self._along(own) for own in np.moveaxis(bends, -1, 0)]
        found = np.concatenate(each, axis=1)
        return np.asarray(found[:, found.any(axis=(0, 2, 3))])

    def matrix(self, plain: BandMatrix, bend: FloatArray) -> BandMatrix:
        """The Hessian with contacts, from that without and from the segments' (m, n, ...)."""
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
        for row in self.model.no_pull:
            border[..., row] = corner[:, row] = corner[:, :, row] = 0.0
            corner[:, row, row] = -1.0
        return BandMatrix(plain.diagonal, plain.upper, border, corner, inner)

    def _products(
        self, vectors: FloatArray, bend: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of functions of the advances by nodes (m, N, b, a) and border (m, k, a).

        Also by each other (m, a, a), taken as forces.
        """
        b, pull = self.model.node.increment, self.model.end_pull
        by_pull = bend[..., self._pull]
        on_segments = by_pull @ np.moveaxis(vectors, 1, -1)
        first, last, border = np.split(on_segments, [b, 2 * b], axis=2)
        nodes = np.zeros((len(first), first.shape[1] + 1, *first.shape[2:]))
        nodes[:, :-1] += first
        nodes[:, 1:] += last
        mutual = np.einsum("mcsd,msda->mca", vectors, border[:, :, pull])
        return nodes, border.sum(axis=1), mutual

    def along(self, change: Vector, segments: FloatArray, p: FloatArray) -> Vector:
        """Add contacts to the gradient's change at fixed nodes and multipliers.

        `segments` (m, n, 2b + k, q): changes of the segments' gradients; `p` (m, n_parameters, q):
        those of the parameters. It is neglected that they turn the normals of round obstacles.
        """
        moved, offsets = segments[:, :, self._pull], outwards(self.model) @ p
        rows = np.repeat(offsets, _count(self.model), axis=1) * self.active[..., None]
        rows[:, self._used] -= np.einsum("masd,msdq->maq", self._normals, moved)
        y = np.concatenate([change.y, rows], axis=1)
        y[:, self.model.no_pull] = 0.0
        return Vector(change.x, y)


def _inwards(force: FloatArray, places: FloatArray) -> float:
    """Distance [m] from the first of nodes with forces [N] inwards to where the contact begins.

    A point force Q acts at the distance x outside the fourth node, and the even force q of the
    following nodes inwards of it, of the fourth one over half an element h/2. Both together have
    the same sum F and moment about the fourth node as the first four forces: F = Q + q (x + h/2),
    M = Q x + q (x^2/2 - h^2/8). `places` [m]: arc lengths inwards.
    """
    if len(force) < 8:
        return 0.0
    s, half = places - places[0], (places[4] - places[3]) / 2
    total, arm = force[:4].sum(), force[:4] @ (s[3] - s[:4])
    q = force[4:-3].sum() / ((places[-3] + places[-4]) / 2 - (places[4] + places[3]) / 2)
    a, b, c = -q / 2, total - q * half, -q * half * half / 2 - arm
    root = b * b - 4 * a * c
    x = -2 * c / (b + np.sqrt(root)) if root > 0 and b > 0 else s[3]
    return float(np.clip(s[3] - x, -s[1], s[2]))


def outwards(model: CableModel) -> FloatArray:
    """Outward shift (surfaces, n_parameters) [m] of the surfaces per unit of each parameter."""
    found = np.zeros((len(model.surfaces), len(model.parameters)))
    declared = len(model.obstacles)
    for effect in model.effects:
        if not isinstance(effect, ContactEffect):
            continue
        own = effect.surface(model.gravity) is not None
        if own or effect.obstacle < declared:
            (parameter,) = effect.parameters(model.cable)
            column = model.names.index(f"{effect.label}.{parameter.name}")
            found[effect.obstacle + own * declared, column] = 1.0
    return found


def surfaces_at(model: CableModel, p: FloatArray) -> tuple[Obstacle, ...]:
    """All surfaces that the cable may touch, shifted outwards by parameters p (n_parameters,)."""
    offsets = (outwards(model) @ p).tolist()
    return tuple(x.grown(y) for x, y in zip(model.surfaces, offsets, strict=True))


def forces_on_other_mesh(lam: FloatArray, model: CableModel, other: CableModel) -> FloatArray:
    """Forces on obstacles (m, K) [N] at another mesh's nodes, with the same force per length."""
    old, new = (one.chain.h * (np.arange(_count(one)) + 1) for one in (model, other))
    sizes = np.maximum(lam[:, model.n_lam :], 0.0).reshape((-1, _count(model)))
    there = [np.interp(new, old, row, 0.0, 0.0) for row in sizes]
    return np.array(there).reshape((len(lam), -1)) * (other.chain.h / model.chain.h)


def _count(model: CableModel) -> int:
    """Number of nodes that may touch one obstacle."""
    return model.n_contacts // len(model.surfaces)


def gap_per_force(model: CableModel, gap: float) -> float:
    """Gap per force [m/N]: a gap in lengths for the cable's weight plus bending forces."""
    return gap * model.cable.length / model.force_scale
