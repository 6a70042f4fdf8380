"""Equilibria of many poses at once: one Newton method over the stacked poses.

All poses share the parameters; a state carries the rest curvature from pose to pose. A Newton step
eliminates the band matrices of all poses at once, then passes the changes of the rest curvature
from pose to pose.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat
from typing import Any

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.equilibrium.curve import Observed, ObservedChange, curves_of
from dlo_casadi.equilibrium.equilibrium import END_TOLERANCE, JOINT_BOUND
from dlo_casadi.equilibrium.minima import (
    KEEPING_SIDE,
    TOLERANCE,
    at_saddles,
    damped,
    descend_to_contact,
    kept_by,
    leave_saddles,
    size_of,
    stepped,
    violation,
)
from dlo_casadi.equilibrium.newton import Factored
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spans import border_of
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes, Tangents
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.band import BandMatrix, Vector

# Largest distance of a node from the start of Newton's method [rad].
REACH = 1.5
# Relative change of the rest curvatures after poses that counts as rounding.
ROUNDING = 1e-14
# The matrix is kept while successive steps shrink by this ratio and the step is below NEAR [rad];
# otherwise it is evaluated again. Five gradients cost less than one matrix.
CONTRACTION = 0.2
NEAR = 0.1
# Depth [lengths] of obstacles here, see `contact.DEPTH`. They are as soft as the cable between two
# of 80 nodes, so contacts hardly depend on each other, and a cable that lies on a table with all
# its weight sinks in by a millionth of its length.
SOFT_DEPTH = 1e-4
# Maximum number of iterations of a descent to a minimum: poses of a session in space took 7 to 23.
DOWNHILL = 40
# Maximum number of times that saddles are left if a state couples the poses; else once.
SADDLES = 3


class BatchEquilibrium:
    """A model evaluated over m poses at once.

    Parameters
    ----------
    poses : sequence of HeldPose
        In the order in which they were taken.
    wrenches : bool
        Whether wrench measurements are predicted, too.
    """

    def __init__(
        self, model: CableModel, poses: Sequence[HeldPose], *, wrenches: bool = True
    ) -> None:
        self.model, self.wrenches = model, wrenches
        self.poses = tuple(poses)
        self.m = len(self.poses)
        self.node = model.node
        self._ends = np.array([pose.vector for pose in self.poses])
        self.used_deviations = [model.deviation_names.index(name) for name in model.deviations]
        self._last: tuple[tuple[FloatArray, ...], Assembly] | None = None

    def start_shapes(self, x: FloatArray) -> Shapes:
        """Shapes with these nodes (m, n_nodes, coordinates), without forces and deviations."""
        border = [border_of(self.model, *each) for each in zip(self.poses, x, strict=True)]
        still = np.zeros((self.m, len(self.model.deviation_names)))
        return Shapes(x, np.array(border).reshape((self.m, -1)), still)

    def at(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> Assembly:
        """The model at shapes; `rest` (n_rests,) before the first pose, or (m, n_rests) each's."""
        inputs = shapes.x, shapes.lam, shapes.deviation, shapes.near, p, rest
        # The same shapes are evaluated, observed and linearised. Replaced as a whole: threads may
        # share a batch.
        last = self._last
        if last is None or not all(map(np.array_equal, last[0], inputs)):
            known = tuple(part.copy() for part in inputs)
            shapes, (p, rest) = Shapes(*known[:4]), known[4:]
            given = Inputs.of(p, self._rests(shapes, p, rest), self._ends)
            self._last = last = known, Assembly(self.model, shapes, given, SOFT_DEPTH)
        return last[1]

    # ---- state -----------------------------------------------------------------------------------

    def rests(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Rest curvature (m, n_rests) before each pose, from that before the first one.

        If `rest` is already given for each pose, (m, n_rests), these are the same.
        """
        return self.at(shapes, p, rest).given.rest.copy()

    def _rests(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """As `rests`, computed from pose to pose."""
        if rest.ndim == 2:
            return rest
        out = np.repeat(rest[None], self.m, axis=0)
        if not self.model.has_state:
            return out
        # Newton's method for all poses at once: if a law is linear in the rest curvature, one step;
        # of any law each step makes at least one more pose exact.
        strains = len(self.node.strains)
        for _ in range(self.m):
            here = Assembly(self.model, shapes, Inputs.of(p, out, self._ends), SOFT_DEPTH)
            after, _, by_rest, *_ = here.state_after()
            change, slopes = after[:-1] - out[1:], by_rest.reshape((self.m, strains, -1, strains))
            for j in range(1, self.m - 1):
                before = change[j - 1].reshape((strains, -1))
                change[j] += np.einsum("ick,kc->ic", slopes[j], before).ravel()
            out[1:] += change
            sizes = [np.abs(x[np.isfinite(x)]).max(initial=0.0) for x in (change, out)]
            if not sizes[0] > ROUNDING * sizes[1]:
                break
        return out

    def rest_after_last(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Rest curvature (n_rests,) after the last pose."""
        return self.at(shapes, p, rest).state_after()[0][-1]

    def bends(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Size (m, n_cells) [1/m] of the curvature minus the rest curvature before each pose."""
        here = self.at(shapes, p, rest)
        bends = self.model.chain.curvatures(here.strain() - here.given.rest)
        return np.asarray(np.linalg.norm(bends, axis=1))

    # ---- equilibria ------------------------------------------------------------------------------

    def balance(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> tuple[Vector, BandMatrix]:
        """Imbalance and tangent matrices; `rest` is that before the first pose, or each pose's."""
        return self.at(shapes, p, rest).balance()[1:]

    def moved(self, shapes: Shapes, step: Vector) -> Shapes:
        """Shapes after a step of one column."""
        x = self.node.moved(shapes.x, step.x[..., 0])
        return replace(shapes, x=x, lam=shapes.lam + step.y[..., 0])

    def _coupled(self, rest: FloatArray) -> bool:
        """Whether a pose's rest curvature depends on the poses before it: see `rests`."""
        return self.model.has_state and rest.ndim == 1

    def solve(
        self,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        max_iterations: int = 25,
        tolerance: float = TOLERANCE,
        reach: float = REACH,
    ) -> tuple[Shapes, BoolArray]:
        """Newton's method from nearby shapes; each pose ends when it has converged or is lost.

        The tangent matrix of a pose is kept while its steps shrink fivefold; see `CONTRACTION`.

        Parameters
        ----------
        shapes : Shapes
            Start; deviations are kept.
        p : (n_parameters,) or (m, n_parameters)
        rest : (n_rests,) or (m, n_rests) [1/m]
            Before the first pose, or for each pose.
        tolerance : float [rad]
            Largest step at convergence.
        reach : float [rad]
            A pose whose nodes move farther is lost: it would reach another equilibrium, or none.

        Returns
        -------
        Shapes, (m,) bool
            The shapes, and whether each pose has converged; the others are as at the start. If a
            state couples the poses, either all have converged or none.
        """
        now = shapes
        converged = np.zeros(self.m, dtype=bool)
        coupled = self._coupled(rest)
        active, last = np.arange(self.m), np.full(self.m, np.inf)
        stale, matrix = np.ones(self.m, dtype=bool), None
        factored: Factored | None = None
        for _ in range(max_iterations):
            here = self.at(now, p, rest).subset(active)
            fresh = stale[active] | coupled
            force, matrix = self._linearized(here, active, fresh, matrix)
            try:
                if factored is None or not factored.of(matrix, active):
                    factored = Factored.made(matrix, active)
                own = factored.newton(force)
                step = self._handed_on(here, matrix, own) if coupled else own
            except np.linalg.LinAlgError:
                break
            size = size_of(self.model, step)
            if coupled:
                size[:] = size.max()
            there = stepped(here, *damped(self.model, step, size, last[active])).shapes
            now = now.replaced(active, there)
            done = _settled(size, last[active], tolerance, fresh)
            # Of conditions that depend on each other a step leaves what they contradict.
            ended = np.flatnonzero(done)
            closed = matrix.subset(active[ended]).of_border(own.x[ended], own.y[ended])
            done[ended] = violation(self.model, closed + force.y[ended]) <= END_TOLERANCE
            stale[active] = ~(size < CONTRACTION * last[active]) & np.isfinite(last[active])
            # A contact that starts or ends changes the matrix.
            stale[active] |= (size > NEAR) | bool(self.model.surfaces)
            way = self.node.difference(shapes.x[active], now.x[active])
            lost = ~(np.abs(way).max(axis=(1, 2)) <= reach)
            if coupled and lost.any():
                break
            converged[active[done & ~lost]] = True
            last[active] = size
            active = active[~(done | lost)]
            if not len(active):
                break
        return now.replaced(~converged, shapes.subset(~converged)), converged

    def solve_or_descend(
        self, shapes: Shapes, p: FloatArray, rest: FloatArray, **options: Any
    ) -> tuple[Shapes, BoolArray]:
        """As `solve`, but lost poses descend from their start, and no pose stays at a saddle.

        Newton's method alone loses one pose in ten when frames have far to rotate, and ends at
        saddles: a cable between ball joints, rolled about its own axis against its rest curvature.
        No cable stays there. If a state couples the poses, a lost one stays lost.
        """
        now, converged = self.solve(shapes, p, rest, **options)
        coupled, lost = self._coupled(rest), np.flatnonzero(~converged)
        if len(lost) and not coupled:
            start = self.at(shapes, p, rest).subset(lost)
            found = descend_to_contact(start, KEEPING_SIDE, DOWNHILL)
            converged[lost] = kept = kept_by(start, found)
            now = now.replaced(lost[kept], found.shapes.subset(kept))
        for _ in range(SADDLES if coupled else 1):
            here = self.at(now, p, rest)
            falling = at_saddles(here, converged)
            if not falling.any():
                break
            found = leave_saddles(here.subset(np.flatnonzero(falling)), DOWNHILL)
            now = now.replaced(falling, found.shapes)
            converged[falling] = found.converged
            if coupled:  # other shapes leave another rest curvature to later poses
                now, converged = self.solve(now, p, rest, **options)
        else:
            converged &= not (coupled and at_saddles(self.at(now, p, rest), converged).any())
        return now, converged

    @staticmethod
    def _linearized(
        here: Assembly, active: IntArray, fresh: BoolArray, matrix: BandMatrix | None
    ) -> tuple[Vector, BandMatrix]:
        """Imbalance of the active poses, and matrices of all poses, evaluated again for some."""
        if matrix is not None and not fresh.any():
            return here.imbalance(), matrix
        if fresh.all():
            _, force, new = here.balance()
        else:
            force = here.imbalance()
            _, _, new = here.subset(fresh).balance()
        return force, new if matrix is None else matrix.replaced(active[fresh], new)

    def _handed_on(self, here: Assembly, matrix: BandMatrix, step: Vector) -> Vector:
        """Newton step including the change of the rest curvature by the poses before."""
        after = here.state_after()
        if not after[1].any():
            return step
        still = self._still(np.zeros((self.model.chain.n_rests, 1)))
        ways = self._in_order(here, matrix, replace(still, x=step.x, lam=step.y), after)
        return Vector(ways.x, ways.lam)

    # ---- derivatives -----------------------------------------------------------------------------

    def directions(
        self,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        slopes: FloatArray,
        rest_slopes: FloatArray,
        *,
        deviations: bool = True,
    ) -> Tangents:
        """Derivatives of the equilibria by the unknowns and by each pose's own deviations.

        From the implicit function theorem: -K^-1 d(imbalance).

        Parameters
        ----------
        slopes : (n_parameters, size)
            dp/dtheta.
        rest_slopes : (n_rests, size)
            d rest / d theta before the first pose.

        Returns
        -------
        Tangents
            Columns: the unknowns, then, with `deviations`, the model's deviations; if poses leave a
            state behind, those of the first pose, of the second, ...
        """
        here = self.at(shapes, p, rest)
        used = self.used_deviations if deviations else []
        size, own = slopes.shape[1], len(used)
        deviation = np.zeros((len(self.model.deviation_names), size + own))
        deviation[used, size + np.arange(own)] = 1.0
        by_p, by_rest = (np.pad(part, [(0, 0), (0, own)]) for part in (slopes, rest_slopes))
        still = self._still(by_rest, by_p, deviation)
        if not self.model.has_state:
            return self._solved(here, still)
        after = here.state_after()
        if after[1].any() or not here.rest_stays(after):
            more = [(0, 0), (0, (self.m - 1) * own)]
            still = self._still(*(np.pad(part, more) for part in (by_rest, by_p, deviation)))
            for j in range(1, self.m):
                still.deviation[j] = np.roll(still.deviation[j], own * j, axis=1)
            _, _, matrix = here.balance()
            found = self._in_order(here, matrix, still, after)
            return replace(found, tangent=matrix)
        # A state effect that is still zero leaves the rest unchanged, but its parameters change it.
        left = after[3] @ still.p
        still.rest[1:] += left[:-1].cumsum(axis=0)
        return self._solved(here, still)

    def by_rest(
        self,
        shapes: Shapes,
        p: FloatArray,
        rest: FloatArray,
        modes: FloatArray,
        by_p: FloatArray | None = None,
        by_deviation: FloatArray | None = None,
    ) -> Tangents:
        """Derivatives of each equilibrium by its own rest curvature along modes (n_rests, q).

        A mode may also change the parameters (n_parameters, q) and deviations (n_deviations, q).
        """
        here = self.at(shapes, p, rest)
        return self._solved(here, self._still(modes, by_p, by_deviation))

    def _still(
        self,
        by_rest: FloatArray,
        by_p: FloatArray | None = None,
        by_deviation: FloatArray | None = None,
    ) -> Tangents:
        """Directions (rows, q) at fixed nodes and multipliers, the same for all poses."""
        model, q = self.model, by_rest.shape[1]
        counts = (len(model.parameters), len(by_rest), len(model.deviation_names))
        p, rest, deviation = (
            np.repeat((np.zeros((count, q)) if part is None else part)[None], self.m, axis=0)
            for count, part in zip(counts, (by_p, by_rest, by_deviation), strict=True)
        )
        x = np.zeros((self.m, model.chain.n_nodes, model.node.increment, q))
        return Tangents(x, np.zeros((self.m, model.n_border, q)), p, rest, deviation)

    @staticmethod
    def _solved(here: Assembly, still: Tangents) -> Tangents:
        """Directions, completed by the resulting change of nodes and multipliers."""
        _, _, matrix = here.balance()
        found = matrix.factor().solve(here.balance_along(still))
        return replace(still, x=still.x - found.x, lam=still.lam - found.y, tangent=matrix)

    def _in_order(
        self, here: Assembly, matrix: BandMatrix, along: Tangents, after: tuple[FloatArray, ...]
    ) -> Tangents:
        """As `_solved`; the rest curvature of each pose is computed from the pose before."""
        x, lam, rest = along.x.copy(), along.lam.copy(), along.rest.copy()
        factor, by_inputs = matrix.factor(), here.balance_slopes()
        for j in range(self.m):
            one = np.array([j])
            parts = (x[one], lam[one], along.p[one], rest[one], along.deviation[one])
            # Deviations of later poses do not move this one.
            moving = np.any([part.any(axis=tuple(range(part.ndim - 1))) for part in parts], axis=0)
            now = Tangents(*(part[..., moving] for part in parts))
            if now.p.any() or now.rest.any() or now.deviation.any():
                own = [y[one] for y in by_inputs]
                change = here.subset(one).balance_along(now, own)
                found = factor.subset(one).solve(change)
                now = replace(now, x=now.x - found.x, lam=now.lam - found.y)
            x[j][..., moving], lam[j][..., moving] = now.x[0], now.lam[0]
            if j + 1 < self.m:
                slopes = tuple(part[one] for part in after)
                rest[j + 1][..., moving] = here.state_along(slopes, now)[0]
        return replace(along, x=x, lam=lam, rest=rest)

    def observe(
        self, shapes: Shapes, p: FloatArray, rest: FloatArray, along: Tangents
    ) -> list[tuple[Observed, ObservedChange]]:
        """Predicted measurements of each pose, and their derivatives along directions."""
        here = self.at(shapes, p, rest)
        rows, moved = here.curve_along(along)
        felt: FloatArray = np.zeros((self.m, 0))
        changes: FloatArray = np.zeros((self.m, 0, along.x.shape[3]))
        if self.wrenches:
            felt, changes = here.readings(), here.readings_along(along)
        knots = here.knots_along(along) if self.model.moves_nodes else repeat(None)
        each = zip(curves_of(here, rows), felt, moved, changes, knots, strict=False)
        return [
            (Observed(curve, readings), ObservedChange(*change))
            for curve, readings, *change in each
        ]

    def seen(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> list[Observed]:
        """Predicted measurements of each pose."""
        here = self.at(shapes, p, rest)
        felt = here.readings() if self.wrenches else np.zeros((self.m, 0))
        return [Observed(*both) for both in zip(curves_of(here), felt, strict=True)]

    def readings(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> FloatArray:
        """Wrench measurements (m, n_reactions) [N, N m] that each pose would give."""
        return self.at(shapes, p, rest).readings()

    def stable(self, shapes: Shapes, p: FloatArray, rest: FloatArray) -> BoolArray:
        """Whether each pose is a strict minimum of the energy under its end conditions.

        In a plane its joints must be within their bound, too.
        """
        _, matrix = self.balance(shapes, p, rest)
        minimum = matrix.negative() == self.model.n_multipliers
        if self.model.in_space:
            return np.asarray(minimum)
        bends = np.abs(np.diff(shapes.x[..., 0], axis=1))
        return np.asarray(minimum & (bends.max(axis=1) < JOINT_BOUND))


def _settled(size: FloatArray, last: FloatArray, tolerance: float, fresh: BoolArray) -> BoolArray:
    """Whether Newton's method has converged, given the sizes of this step and the last one.

    Steps shrink quadratically with a fresh matrix and linearly with a kept one. This predicts the
    size of the next step, which need not be made; steps at rounding level no longer shrink.
    """
    rate = size / last
    ahead = size * np.where(fresh, rate**2, rate)
    quadratic = np.isfinite(last) & (size < 1e-4) & (ahead < tolerance / 100)
    return (size < tolerance) | quadratic | ((size < 1e-7) & (size > 0.5 * last))
