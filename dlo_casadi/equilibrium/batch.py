"""Equilibria of many poses at once: one Newton method over the stacked poses.

All poses share the parameters; a state carries the rest curvature from pose to pose. The Newton
step eliminates all poses' band matrices together and passes changes of the rest curvature on in
order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.curve import NodeCurve, Observed, ObservedChange
from dlo_casadi.equilibrium.descent import descend
from dlo_casadi.equilibrium.equilibrium import JOINT_BOUND
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.model.assembly import Assembly, CurveSlopes, Inputs, Shapes, Tangents, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import BandMatrix, Vector

FloatArray = NDArray[np.floating]

# Newton's method for many poses: longest step of a node, and how far nodes may move from where it
# started [rad].
LONGEST_STEP = 0.5
REACH = 1.5
# Steps by a matrix that is kept shrink by this factor at least, or it is evaluated anew: five
# gradients cost less than one matrix. Steps longer than NEAR [rad] change the matrix too much.
CONTRACTION = 0.2
NEAR = 0.1
# Iterations of a descent to a minimum: the poses of one session in space took 7 to 23.
DOWNHILL = 40


@dataclass(frozen=True)
class Observations:
    """What sensors would see of m poses, and how it changes along q directions.

    Measured curves `z` (m, n + 1, d or 2 d) and `readings` (m, n_reactions), see
    `ends.REACTIONS`; `slopes` and `reading_slopes` (..., q).
    """

    z: FloatArray
    slopes: FloatArray
    readings: FloatArray
    reading_slopes: FloatArray

    def pose(self, j: int, length: float) -> tuple[Observed, ObservedChange]:
        """Of one pose, of a cable of that length [m]."""
        return (
            Observed(NodeCurve.of(length, self.z[j]), self.readings[j]),
            ObservedChange(self.slopes[j], self.reading_slopes[j]),
        )


class BatchEquilibrium:
    """A model evaluated over m poses at once.

    Parameters
    ----------
    model : CableModel
    poses : sequence of Pose
        In the order in which they were taken.
    """

    def __init__(self, model: CableModel, poses: Sequence[Pose]) -> None:
        self.model = model
        self.poses = tuple(poses)
        self.m = len(self.poses)
        self.assembly = assembly_of(model)
        self.node = self.assembly.node
        self._ends = np.array([pose.vector for pose in self.poses])
        self.used_deviations = [model.deviation_names.index(name) for name in model.deviations]

    def start_shapes(self, x: FloatArray) -> Shapes:
        """Shapes of these nodes (m, n_nodes, coordinates), without forces and deviations."""
        return Shapes.declared(x, np.zeros((self.m, self.model.n_border)))

    # ---- state -----------------------------------------------------------------------------------

    def rests(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Rest curvature (m, n_rests) that each pose finds, from the first on.

        A `rest` that is given per pose already, (m, n_rests), is returned as it is.
        """
        if rest.ndim == 2:
            return rest
        out = np.repeat(rest[None], self.m, axis=0)
        # Poses that leave what they find need not be gone through in order.
        if self.model.has_state and not self._stays(shapes, p, out):
            for j in range(self.m - 1):
                out[j + 1] = self._after(j, shapes, p, out)[0]
        return out

    def _stays(self, shapes: Shapes, p: FloatArray, rests: FloatArray) -> bool:
        """Whether every pose leaves the rest curvature that it finds."""
        after = self.assembly.state_after(shapes, Inputs.of(p, rests, self._ends))[0]
        return bool(np.all(after == rests))

    def _after(self, j: int, shapes: Shapes, p: FloatArray, rests: FloatArray) -> FloatArray:
        """Rest curvature (1, n_rests) after pose j."""
        here = [j]
        given = Inputs.of(p, rests[here], self._ends[here])
        return self.assembly.state_after(shapes.subset(here), given)[0]

    def rest_after_last(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Rest curvature (n_rests,) that the last pose leaves behind."""
        return self._after(self.m - 1, shapes, p, self.rests(shapes, p, rest))[0]

    def bends(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Size (m, n_cells) [1/m] of curvature minus the rest curvature that each pose finds."""
        given = self._given(shapes, p, rest)
        bends = self.assembly.strain(shapes, given) - given.rest
        return np.asarray(np.linalg.norm(self.assembly.chain.curvatures(bends), axis=1))

    def _given(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> Inputs:
        return Inputs.of(p, self.rests(shapes, p, rest), self._ends)

    # ---- equilibria ------------------------------------------------------------------------------

    def balance(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> tuple[Vector, BandMatrix]:
        """Imbalance and tangent matrices; `rest` is that before the first pose, or of each."""
        return self.assembly.balance(shapes, self._given(shapes, p, rest))[1:]

    def imbalance(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> Vector:
        """Imbalance alone, for a small part of the cost."""
        return self.assembly.imbalance(shapes, self._given(shapes, p, rest))

    def moved(self, shapes: Shapes, step: Vector, share: FloatArray | float = 1.0) -> Shapes:
        """Shapes after a share (m,) of a step of one column."""
        s = np.broadcast_to(share, (len(shapes.x),))
        x = self.node.moved(shapes.x, s[:, None, None] * step.x[..., 0])
        return replace(shapes, x=x, lam=shapes.lam + s[:, None] * step.y[..., 0])

    def solve(
        self,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        max_iterations: int = 25,
        tolerance: float = 1e-10,
        reach: float = REACH,
        tangent: BandMatrix | None = None,
    ) -> tuple[Shapes, NDArray[np.bool_]]:
        """Newton's method from nearby shapes, for each pose until it has converged or is lost.

        A pose's tangent matrix is kept while its steps shrink fivefold; see `CONTRACTION`.

        Parameters
        ----------
        shapes : Shapes
            Where to start; deviations are kept.
        p : (n_parameters,) or (m, n_parameters)
        rest : (n_rests,) or (m, n_rests) [1/m]
            Before the first pose, or of each pose.
        tolerance : float [rad]
            Largest step at convergence.
        reach : float [rad]
            A pose whose nodes move farther is lost: it runs for another equilibrium, or none.
        tangent : BandMatrix, optional
            Tangent matrices of equilibria close by, to begin with.

        Returns
        -------
        Shapes, (m,) bool
            The shapes, and which poses have converged; the others stay where they started. Where
            a state couples the poses, all have converged or none.
        """
        now = Shapes(shapes.x.copy(), shapes.lam.copy(), shapes.deviation)
        converged = np.zeros(self.m, dtype=bool)
        coupled = self.model.has_state and rest.ndim == 1
        active, last = np.arange(self.m), np.full(self.m, np.inf)
        matrix = None if coupled else tangent
        stale = np.full(self.m, matrix is None)
        for _ in range(max_iterations):
            given = self._given(now, p, rest).subset(active)
            here = now.subset(active)
            fresh = stale[active] | coupled
            force, matrix = self._linearized(here, given, active, fresh, matrix)
            try:
                step = self._newton(here, given, force, matrix.subset(active), coupled)
            except np.linalg.LinAlgError:
                break
            size = np.abs(step.x).max(axis=(1, 2, 3))
            if coupled:
                size[:] = size.max()
            share = np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-300))
            there = self.moved(here, step, share)
            now.x[active], now.lam[active] = there.x, there.lam
            done = _settled(size, last[active], tolerance, fresh)
            stale[active] = ~(size < CONTRACTION * last[active]) & np.isfinite(last[active])
            stale[active] |= size > NEAR
            way = self.node.difference(shapes.x[active], there.x)
            lost = ~(np.abs(way).max(axis=(1, 2)) <= reach)
            converged[active[done & ~lost]] = True
            last[active] = size
            if coupled and lost.any():
                break
            active = active[~(done | lost)]
            if not len(active):
                break
        now.x[~converged], now.lam[~converged] = shapes.x[~converged], shapes.lam[~converged]
        return now, converged

    def settled(
        self, shapes: Shapes, p: FloatArray, rest: FloatArray, **options: Any
    ) -> tuple[Shapes, NDArray[np.bool_]]:
        """As `solve`; in space, poses that are lost go downhill to a minimum from where they were.

        Newton's method alone loses a pose of ten wherever frames have far to turn.
        """
        now, converged = self.solve(shapes, p, rest, **options)
        lost = np.flatnonzero(~converged)
        if not len(lost) or not self.model.in_space or self.model.has_state:
            return now, converged
        given = self._given(shapes, p, rest).subset(lost)
        found = descend(self.assembly, shapes.subset(lost), given, DOWNHILL)
        kept = lost[found.converged]
        now.x[kept] = found.shapes.x[found.converged]
        now.lam[kept] = found.shapes.lam[found.converged]
        converged[kept] = True
        return now, converged

    def _linearized(
        self,
        here: Shapes,
        given: Inputs,
        active: NDArray[np.intp],
        fresh: NDArray[np.bool_],
        matrix: BandMatrix | None,
    ) -> tuple[Vector, BandMatrix]:
        """Imbalance of the active poses, and all poses' matrices, of some of them evaluated."""
        if fresh.all():
            _, force, new = self.assembly.balance(here, given)
            if len(active) == self.m or matrix is None:
                return force, new
            return force, matrix.replaced(active, new)
        assert matrix is not None
        force = self.assembly.imbalance(here, given)
        if fresh.any():
            _, _, new = self.assembly.balance(here.subset(fresh), given.subset(fresh))
            matrix = matrix.replaced(active[fresh], new)
        return force, matrix

    def _newton(
        self, here: Shapes, given: Inputs, force: Vector, matrix: BandMatrix, coupled: bool
    ) -> Vector:
        """Newton step of one column; not finite where the shape is not."""
        finite = np.flatnonzero(np.isfinite(matrix.diagonal).all(axis=(1, 2, 3)))
        right = Vector(-force.x, -force.y)
        if len(finite) == len(matrix.diagonal):
            step = matrix.factor().solve(right)
        else:
            step = Vector(np.full_like(force.x, np.nan), np.full_like(force.y, np.nan))
            if len(finite):
                found = (
                    matrix.subset(finite).factor().solve(Vector(right.x[finite], right.y[finite]))
                )
                step.x[finite], step.y[finite] = found.x, found.y
        return self._pass_on(here, given, matrix, step) if coupled else step

    def _pass_on(self, here: Shapes, given: Inputs, matrix: BandMatrix, step: Vector) -> Vector:
        """Newton step with the change of rest curvature handed from pose to pose."""
        a, n_p = self.assembly, given.p.shape[1]
        change: FloatArray = np.zeros((1, given.rest.shape[1], 1))
        none = np.zeros((1, n_p, 1))
        x, y = step.x.copy(), step.y.copy()
        after = a.state_after(here, given)
        if not after[1].any():
            return step
        for j in range(len(x)):
            one = np.array([j])
            if change.any():
                along = _still(a, 1, change, none)
                load = a.imbalance_by(here.subset(one), given.subset(one), along)
                more = matrix.subset(one).factor().solve(load)
                x[j] -= more.x[0]
                y[j] -= more.y[0]
            slopes = tuple(part[one] for part in after)
            change = a.state_along(slopes, x[one], change, none)
        return Vector(x, y)

    # ---- derivatives -----------------------------------------------------------------------------

    def directions(
        self,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        slopes: FloatArray,
        rest_slopes: FloatArray,
    ) -> Tangents:
        """How the equilibria move with the unknowns and with each pose's own deviations.

        By the implicit function theorem: -K^-1 d(imbalance).

        Parameters
        ----------
        slopes : (n_parameters, size)
            dp/dtheta.
        rest_slopes : (n_rests, size)
            d rest / d theta before the first pose.

        Returns
        -------
        Tangents
            Columns: the unknowns, then the model's deviations.
        """
        given = self._given(shapes, p, rest)
        _, _, matrix = self.assembly.balance(shapes, given)
        size, own = slopes.shape[1], len(self.used_deviations)
        q, m = size + own, self.m
        p_along = np.zeros((m, slopes.shape[0], q))
        p_along[:, :, :size] = slopes
        rest_along = np.zeros((m, rest_slopes.shape[0], q))
        rest_along[:, :, :size] = rest_slopes
        deviation = np.zeros((m, len(self.model.deviation_names), q))
        deviation[:, self.used_deviations, size + np.arange(own)] = 1.0
        still = replace(_still(self.assembly, m, rest_along, p_along), deviation=deviation)
        if self.model.has_state:
            slopes_after = self.assembly.state_after(shapes, given)
            if slopes_after[1].any() or not self.assembly.rest_stays(slopes_after):
                return replace(
                    self._carried(shapes, given, matrix, still, slopes_after), tangent=matrix
                )
            # A state that is not there yet hands on what it finds, and its own parameters' part.
            left = slopes_after[3] @ p_along
            still.rest[1:] += left[:-1].cumsum(axis=0)
        return self._solved(shapes, given, matrix, still)

    def by_rest(
        self, shapes: Shapes, p: FloatArray, rest: FloatArray, modes: FloatArray
    ) -> Tangents:
        """How each equilibrium moves with its own rest curvature along modes (n_cells, q)."""
        given = self._given(shapes, p, rest)
        _, _, matrix = self.assembly.balance(shapes, given)
        along = np.broadcast_to(modes, (self.m, *modes.shape))
        none = np.zeros((self.m, given.p.shape[1], modes.shape[1]))
        return self._solved(shapes, given, matrix, _still(self.assembly, self.m, along, none))

    def _solved(
        self, shapes: Shapes, given: Inputs, matrix: BandMatrix, still: Tangents
    ) -> Tangents:
        load = self.assembly.imbalance_by(shapes, given, still)
        found = matrix.factor().solve(load)
        return replace(still, x=-found.x, lam=-found.y, tangent=matrix)

    def _carried(
        self,
        shapes: Shapes,
        given: Inputs,
        matrix: BandMatrix,
        along: Tangents,
        after: tuple[FloatArray, ...],
    ) -> Tangents:
        """`directions` in order: a pose finds the rest curvature that the one before has left."""
        x, lam, rest = along.x.copy(), along.lam.copy(), along.rest.copy()
        size = rest.shape[2] - len(self.used_deviations)
        for j in range(self.m):
            one = np.array([j])
            now = Tangents(x[one], lam[one], along.p[one], rest[one], along.deviation[one])
            now = self._solved(shapes.subset(one), given.subset(one), matrix.subset(one), now)
            x[j], lam[j] = now.x[0], now.lam[0]
            if j + 1 < self.m:
                slopes = tuple(part[one] for part in after)
                change = self.assembly.state_along(slopes, now.x, now.rest, now.p)[0]
                # What a pose's own deviation leaves behind is left out of the later ones.
                rest[j + 1, :, :size] = change[:, :size]
        return replace(along, x=x, lam=lam, rest=rest)

    def observe(
        self, shapes: Shapes, p: FloatArray, rest: FloatArray, along: Tangents
    ) -> Observations:
        """Measured curves and readings, and their derivatives along directions."""
        given = self._given(shapes, p, rest)
        slopes = self.assembly.curve_slopes(shapes, given)
        return Observations(
            slopes.z,
            slopes.along(along),
            self.assembly.readings(shapes, given),
            self.assembly.readings_along(shapes, given, along),
        )

    def curve_slopes(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> CurveSlopes:
        """Measured curves and what their derivatives are made of."""
        return self.assembly.curve_slopes(shapes, self._given(shapes, p, rest))

    def seen(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> list[Observed]:
        """What sensors see of each pose."""
        given, length = self._given(shapes, p, rest), self.model.cable.length
        both = zip(
            self.assembly.curve(shapes, given), self.assembly.readings(shapes, given), strict=True
        )
        return [Observed(NodeCurve.of(length, z), readings) for z, readings in both]

    def stable(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> NDArray[np.bool_]:
        """Whether each pose is a strict minimum of the energy under its end conditions."""
        _, matrix = self.balance(shapes, p, rest)
        negative = matrix.negative()
        bends = self.node.difference(shapes.x[:, :-1], shapes.x[:, 1:])
        free = np.abs(bends).max(axis=(1, 2)) < JOINT_BOUND
        return np.asarray((negative == self.model.n_multipliers) & free)


def _still(a: Assembly, m: int, rest: FloatArray, p: FloatArray) -> Tangents:
    """Directions along which nodes, multipliers and deviations stay."""
    q = rest.shape[2]
    return Tangents(
        np.zeros((m, a.n, a.b, q)),
        np.zeros((m, a.k, q)),
        p,
        rest,
        np.zeros((m, len(a.model.deviation_names), q)),
    )


def _settled(
    size: FloatArray, last: FloatArray, tolerance: float, fresh: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Whether Newton's method has converged with steps of this size after the last ones.

    Steps that shrink quadratically, by fresh matrices, or linearly, by those kept, need no
    further one to show that it would be too small; steps at rounding no longer shrink.
    """
    rate = size / last
    ahead = size * np.where(fresh, rate**2, rate)
    quadratic = np.isfinite(last) & (size < 1e-4) & (ahead < tolerance / 100)
    return (size < tolerance) | quadratic | ((size < 1e-7) & (size > 0.5 * last))
