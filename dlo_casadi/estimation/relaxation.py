"""Fit of shapes, forces and parameters at once, with the balance of forces as a penalty.

    min over theta and of every pose its nodes, multipliers and deviations
        1/2 sum_j |W_j e_j|^2 + 1/2 sum_j |deviation_j / std|^2
        + 1/2 (theta - mean)^T P (theta - mean) + 1/2 sum_j |S F_j|^2 / softness^2

F_j is the gradient of the Lagrangian of pose j. S scales it to the angle [rad] by which a node
would turn: h / EI for an unbalanced bending moment at a node, h / GJ for a twisting moment. The
measured shapes fix the nodes, and then the balance is linear in forces, loads and 1 / EI: neither
an equilibrium nor a stiffness has to be known. Steps are taken in compliances and in forces and
loads per stiffness; steps in log EI and newtons are nearly always refused if a stiffness is 50
times off. The softness is then reduced to nearly zero. If the model lacks something, the softness
can be kept at a value at which the shapes are still those measured: the remaining imbalance is
then what the model lacks.

References
----------
Ramsay et al., Parameter estimation for differential equations: a generalized smoothing approach,
J. R. Statist. Soc. B 69 (2007).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.relaxed_rows import Linearized, Reduced, bounded
from dlo_casadi.estimation.unknowns import Values
from dlo_casadi.linear_mixed import NO_INFORMATION, LinearMixed
from dlo_casadi.model.assembly import Assembly, Shapes, Tangents
from dlo_casadi.model.cable_model import STIFFNESSES
from dlo_casadi.model.contact import gap_per_force
from dlo_casadi.model.functions import functions_of
from dlo_casadi.rod.band import Vector
from dlo_casadi.runtime.work import accounted_as, spend

# Softness of the balance [rad], from first to last. The first is twice the noise of the angles
# between 12 markers of 0.3 mm on 1 m; the last leaves equilibria to Newton's method.
SOFTNESS = (3e-2, 1e-2, 3e-3, 1e-3, 1e-4)
# Error of an end condition that weighs as much as a unit of the balance, in lengths or [rad]. With
# 1e-5 at every softness, steps were refused because the conditions are curved.
END = 1 / 30
# Gap [lengths] that counts as much as a force of the cable's weight in deciding whether a node
# touches. Evidence: with 0.01 or 0.03 three fits of cables on planes reach the noise, with 0.3 one
# does not. Rounding of the corner between gap and force [lengths].
AT_A_DISTANCE, SHARP = 0.03, 1e-9
# Longest step of a node [rad]; largest change of the logarithm of a stiffness in one step.
LONGEST, LARGEST = 0.7, 1.0
# First and smallest damping of the nodes [1/rad]; damping of the fit's unknowns as a share of it.
FIRST_DAMPING, LEAST_DAMPING, OF_UNKNOWNS = 1.0, 0.1, 0.01
# Maximum number of trials of a step; each has ten times the damping of the one before.
REFUSED = 6
# Maximum number of iterations at each softness; they end below this relative decrease. Models that
# lack something creep by 1 or 2 % per step, the right one needs three to five steps: in three
# sessions in space that needed 90 to 120 s, 5e-3 took a seventh more for the same effects.
STEPS, CONVERGED = 20, 2e-2


# A relaxation, values of it, and some of its unknowns.
Further = tuple["Relaxation", Values, Sequence[int]]


@dataclass(frozen=True)
class Relaxation:
    """A batch problem in which the balance of forces is a penalty with a softness [rad].

    The problem has to be weighed. Poses may carry a state, the rest strains, to the next pose.
    """

    problem: Problem
    softness: float

    # ---- sizes -------------------------------------------------------------------------------

    @cached_property
    def _counts(self) -> tuple[int, int, int, int, int]:
        """Number of a pose's increments; plus multipliers; plus deviations; plus state; and all."""
        model = self.problem.unknowns.model
        nodes = model.chain.n_nodes * model.node.increment
        border = nodes + model.n_border
        own = border + len(self.problem.equilibria.used_deviations)
        known = own + (model.chain.n_rests if model.has_state else 0)
        return nodes, border, own, known, known + self.problem.unknowns.size

    def _rows_in(self, larger: "Relaxation") -> IntArray:
        """Rows of the balance of forces of a pose among those of a model with more conditions."""
        every = larger.problem.unknowns.model.border_names
        nodes, known = self._counts[0], self.problem.unknowns.model.border_names
        return np.concatenate([np.arange(nodes), [nodes + every.index(x) for x in known]])

    def _poses_in(self, larger: "Relaxation") -> dict[int, int]:
        """By pose of a larger model its pose here; a state is carried through unmeasured ones."""
        if self.problem.equilibria.m == larger.problem.equilibria.m:
            return {j: j for j in range(self.problem.equilibria.m)}
        return dict(zip(larger.problem.used, self.problem.used, strict=True))

    def _stiffness(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log stiffnesses (n b,) that scale the nodes' rows, and their derivatives by p.

        The torsional stiffness, or the bending stiffness at one turn per length: if the section
        softens, its stiffness at rest may have any value.
        """
        model, p = self.problem.unknowns.model, self.problem.unknowns.p(theta)
        log, by_p = self._bent(theta)
        torsion = model.stiffness_indices[-1]
        twists = np.eye(len(p))[torsion] / p[torsion]
        bent = np.array([name in model.node.curvatures for name in model.node.strains])
        rows = np.where(bent, log, np.log(p[torsion])), np.where(bent[:, None], by_p, twists)
        return np.tile(rows[0], model.chain.n_nodes), np.tile(rows[1], (model.chain.n_nodes, 1))

    def _weights(self, theta: FloatArray) -> FloatArray:
        """Weights (n b + k,) of the rows of F at these unknowns."""
        model, p = self.problem.unknowns.model, self.problem.unknowns.p(theta)
        force = model.weight + p[0] / model.cable.length**2
        # The row of a place is the balance of forces there [N], of a multiplier its condition.
        known = {"place": 1 / force, "distance": 1 / END / model.cable.length}
        border = [known.get(kind, 1 / END) for kind in model.border_kinds.values()]
        moments = model.chain.h / np.exp(self._stiffness(theta)[0])
        return np.concatenate([moments, border]) / self.softness

    # ---- contact -----------------------------------------------------------------------------

    def _at(self, values: Values) -> Assembly:
        """The model at these values; forces of obstacles act whatever the gaps."""
        return self.problem.equilibria.at(*self.problem.state(values)).felt_everywhere

    @cached_property
    def _contacts(self) -> slice:
        """Rows of the conditions of contacts."""
        nodes, border = self._counts[:2]
        return slice(nodes + self.problem.unknowns.model.n_lam, border)

    def _complementarity(
        self, left: FloatArray, shapes: Shapes
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual of f g = 0 for gaps g >= 0 and forces f >= 0: (m, K) [m].

            sqrt(g^2 + (c f)^2) - g - c f

        Its slope is not zero where neither is zero, so a force may grow at a distance. Its
        derivatives along -g and f follow. `left`: rows of all conditions; those of contacts are -g.

        References
        ----------
        Fischer, Optimization 24 (1992).
        """
        model = self.problem.unknowns.model
        per_force, gap = gap_per_force(model, AT_A_DISTANCE), -left[:, self._contacts]
        force = per_force * shapes.lam[:, model.n_lam :]
        root = np.sqrt(gap**2 + force**2 + (SHARP * model.cable.length) ** 2)
        return root - gap - force, 1 - gap / root, per_force * (force / root - 1)

    # ---- evaluation --------------------------------------------------------------------------

    def objectives(
        self, values: Values, seen: list[Observed] | None = None
    ) -> tuple[FloatArray, float]:
        """Twice the objective: the share of each pose (m,), and that of the prior.

        `seen`: the measurements predicted at these values, if they are known.
        """
        problem = self.problem
        shapes = values.shapes
        left = self._at(values).imbalance().rows[:, :, 0]
        left[:, self._contacts] = self._complementarity(left, shapes)[0]
        left *= self._weights(values.theta)
        own = shapes.deviation[:, problem.equilibria.used_deviations] / problem.deviation_std
        each = (left**2).sum(axis=1) + (own**2).sum(axis=1)
        seen = problem.observed(values) if seen is None else seen
        for white, j, s in zip(problem.whitening, problem.used, values.projections, strict=True):
            each[j] += float(((white @ problem.measured[j].residual(seen[j], s)) ** 2).sum())
        gap = values.theta - problem.mean
        return each, float(gap @ problem.precision @ gap)

    def objective(self, values: Values, seen: list[Observed] | None = None) -> float:
        """Twice the objective, see `objectives`; infinite where it is not a number."""
        each, prior = self.objectives(values, seen)
        total = float(each.sum()) + prior
        return total if np.isfinite(total) else np.inf

    def mixed(self, values: Values, further: Iterable[Further] = ()) -> LinearMixed:
        """The fit to first order, with the poses' own unknowns eliminated: one group of rows.

        `further`: unknowns of larger models at the same shapes, without priors; they come last.
        """
        linearized = self._linearized(values)
        for other, there, kept in further:
            among = other._rows_in(self), other._poses_in(self)
            linearized = linearized.and_columns(other._linearized(there), kept, *among)
        rows, none = self._reduced(linearized, 0.0).rows, np.zeros((1, 0))
        gap = values.theta - self.problem.mean
        own = [np.zeros((len(rows), 0))]
        given = none, none[0], gap, self.problem.precision
        n = len(gap)
        return LinearMixed([-rows[:, -1]], [rows[:, :n]], own, *given).beside([rows[:, n:-1]])

    def _along(self, values: Values) -> Tangents:
        """Directions: each own unknown of a pose, then of its state, then of theta."""
        unknowns, equilibria = self.problem.unknowns, self.problem.equilibria
        model, m = unknowns.model, equilibria.m
        nodes, border, own, known, q = self._counts
        unit = np.broadcast_to(np.eye(own, q), (m, own, q))
        deviation = np.zeros((m, values.shapes.deviation.shape[1], q))
        used = equilibria.used_deviations
        grown = values.shapes.deviation[:, used] * self._are_forces
        deviation[:, used] = unit[:, border:] + grown[:, :, None] * self._growth(values)
        p = np.zeros((m, len(model.parameters), q))
        p[:, :, known:] = unknowns.slopes(values.theta)
        rest = np.zeros((m, model.chain.n_rests, q))
        if model.has_state:
            rest[:, :, own:known] = np.eye(known - own)
        else:
            rest[:, :, known:] = unknowns.rest_slopes
        x = unit[:, :nodes].reshape((m, model.chain.n_nodes, -1, q))
        forces = values.shapes.lam * model.are_multipliers  # these scale with the stiffness
        lam = unit[:, nodes:border] + forces[:, :, None] * self._growth(values)
        return Tangents(x, lam, p, rest, deviation)

    @cached_property
    def _are_forces(self) -> BoolArray:
        """Whether each deviation (used,) is a force on the cable, which scales with stiffness."""
        model = self.problem.equilibria.model
        names = {name for effect in model.effects for name in effect.per_pose(model.cable)}
        return np.array([name in names for name in model.deviations], dtype=bool)

    def _growth(self, values: Values) -> FloatArray:
        """Change (q,) of log bending stiffness along a pose's unknowns and theta.

        All forces scale with this stiffness, so the balance at the measured shapes does not change.
        It is taken of the bent section: if that softens, EI may grow while its moments stay.
        """
        unknowns = self.problem.unknowns
        slope = self._bent(values.theta)[1] @ unknowns.slopes(values.theta)
        return np.concatenate([np.zeros(self._counts[3]), slope])

    def _bent(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Logarithm of the bending stiffness at one turn per length, and its derivatives by p."""
        unknowns = self.problem.unknowns
        log, by_p = functions_of(unknowns.model).bent_stiffness(unknowns.p(theta))
        return float(log), np.array(by_p).ravel()

    def _states(self, here: Assembly, along: Tangents) -> list[FloatArray]:
        """Change of each pose's state by the unknowns of the pose before, see `Linearized`."""
        problem = self.problem
        own, known, q = self._counts[2:]
        states = np.zeros((problem.equilibria.m, known - own, q + 1))
        if problem.unknowns.model.has_state:
            states[0, :, known:-1] = problem.unknowns.rest_slopes
            states[1:, :, :-1] = here.state_along(here.state_after(), along)[:-1]
        return list(states)

    def _linearized(self, values: Values) -> Linearized:
        """Derivatives and residuals of all terms of the objective."""
        problem = self.problem
        equilibria = problem.equilibria
        nodes, border, _, known, _ = self._counts
        here, along = self._at(values), self._along(values)
        _, force, matrix = here.balance()
        tangent = matrix.dense()
        rows = np.zeros((*tangent.shape[:2], along.p.shape[2]))
        rows[:, :, border:] = here.balance_along(along.numbers(slice(border, None))).rows
        rows[:, :, :nodes] += tangent[:, :, :nodes]
        rows += tangent[:, :, nodes:] @ along.lam
        weights, left = self._weights(values.theta), force.rows[:, :, 0]
        at = self._contacts
        left[:, at], by_gap, by_size = self._complementarity(left, values.shapes)
        rows[:, at] *= by_gap[..., None]
        rows[:, at] += by_size[..., None] * along.lam[:, at.start - nodes :]
        scaled = self._stiffness(values.theta)[1] @ problem.unknowns.slopes(values.theta)
        rows[:, :nodes, known:] -= left[:, :nodes, None] * scaled
        rows, left = rows * weights[:, None], left * weights
        std, used = problem.deviation_std, equilibria.used_deviations
        priors = along.deviation[:, used] / std[:, None]
        found = zip(problem.whitening, problem.residuals(values, along), strict=True)
        whitened = [(white @ change, white @ e) for white, (e, change) in found]
        data = dict(zip(problem.used, whitened, strict=True))
        stacked = []
        for j in range(equilibria.m):
            parts = [(rows[j], left[j]), (priors[j], values.shapes.deviation[j, used] / std)]
            parts += [data[j]] if j in data else []
            stacked.append(np.concatenate([np.column_stack([a, -e]) for a, e in parts]))
        root, gap = self._prior, values.theta - problem.mean
        states = self._states(here, along)
        return Linearized(stacked, states, np.column_stack([root, -root @ gap]))

    def _reduced(
        self,
        linearized: Linearized,
        damping: float,
        fixed: BoolArray | None = None,
    ) -> Reduced:
        """Orthogonal elimination of each pose's own unknowns and state, from the last pose on.

        The rest of a pose's rows depends on its state, hence on the unknowns of the pose before.
        """
        nodes, border, own, known, _ = self._counts
        q = linearized.prior.shape[1] - 1 + known
        free = np.ones(q - known, dtype=bool) if fixed is None else ~fixed
        kept = np.concatenate([np.ones(known, dtype=bool), free, [True]])
        model = self.problem.unknowns.model
        damped = np.eye(border, q + 1) * max(damping, NO_INFORMATION)
        damped[nodes:] *= NO_INFORMATION
        # Damp a contact force as its gap, in lengths: nothing else bounds it if neither is zero.
        of_contact = damping * gap_per_force(model, AT_A_DISTANCE) / model.cable.length
        damped[self._contacts, self._contacts] += of_contact * np.eye(border - nodes - model.n_lam)
        triangles: list[FloatArray] = []
        states = [rows[:, kept] for rows in linearized.states]
        later = np.zeros((0, int(kept.sum())))
        for rows, state in zip(linearized.poses[::-1], states[::-1], strict=True):
            stacked = np.concatenate([np.concatenate([rows, damped])[:, kept], later])
            triangle: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))
            triangles.insert(0, triangle[:own])
            left = triangle[own:, own:]
            later = left[:, : known - own] @ state
            later[:, known:] += left[:, known - own :]
        more = OF_UNKNOWNS * damping * np.eye(int(free.sum()), int(free.sum()) + 1)
        shared = [later[:, known:], linearized.prior[:, np.append(free, True)], more]
        left_over: FloatArray = np.asarray(np.linalg.qr(np.concatenate(shared), mode="r"))
        return Reduced(triangles, [x[:, :-1] for x in states], left_over, later[:, known:])

    @cached_property
    def _prior(self) -> FloatArray:
        """Root of the prior's precision."""
        sizes, vectors = np.linalg.eigh(self.problem.precision)
        return np.asarray(np.sqrt(np.maximum(sizes, 0.0))[:, None] * vectors.T)

    # ---- solution ----------------------------------------------------------------------------

    @accounted_as("relaxed fits")
    def solve(self, values: Values, fixed: BoolArray | None = None, steps: int = STEPS) -> Values:
        """Levenberg-Marquardt from any values.

        `fixed` (size,): entries of theta that do not change; none by default.
        """
        damping, least = FIRST_DAMPING, self.objective(values)
        for _ in range(steps):
            spend()
            found, reached, first = values, np.inf, damping
            linearized = self._scaled(self._linearized(values), values)
            for _ in range(REFUSED):
                try:
                    found = self._stepped(values, linearized, damping, fixed)
                    seen = self.problem.observed(found)
                    found = replace(found, projections=self.problem.located(found, seen))
                    reached = self.objective(found, seen)
                except np.linalg.LinAlgError:
                    reached = np.inf
                if reached < least:
                    break
                damping *= 10
            if not reached < least:
                break
            gain, values, least = least - reached, found, reached
            if damping == first:  # after a refusal it stays: a smaller one has just failed
                damping = max(damping / 10, LEAST_DAMPING)
            if gain < CONVERGED * reached:
                break
        return values

    def _scaled(self, linearized: Linearized, values: Values) -> Linearized:
        """Rows in scaled steps: loads grow with the bending stiffness, as all forces do."""
        unknowns = self.problem.unknowns
        if not unknowns.are_loads.any():
            return linearized
        grown = unknowns.are_loads * values.theta
        growth = self._growth(values)[-unknowns.size :]
        at = slice(-unknowns.size - 1, -1)

        def changed(rows: FloatArray) -> FloatArray:
            more = np.zeros_like(rows)
            more[:, at] = np.outer(rows[:, at] @ grown, growth)
            return rows + more

        poses, states = (
            [changed(rows) for rows in part] for part in (linearized.poses, linearized.states)
        )
        return Linearized(poses, states, changed(linearized.prior))

    def _stepped(
        self, values: Values, linearized: Linearized, damping: float, fixed: BoolArray | None
    ) -> Values:
        """Values after a damped step within reach, with the projections before it."""
        problem, reduced = self.problem, self._reduced(linearized, damping, fixed)
        unknowns, equilibria = problem.unknowns, problem.equilibria
        nodes, border, own, known, _ = self._counts
        free = np.ones(unknowns.size, dtype=bool) if fixed is None else ~fixed
        lower, upper = (end - values.theta for end in unknowns.reach(values.theta, LARGEST))
        # Step a stiffness by its compliance, in which the balance is linear.
        stiff = np.isin(unknowns.names, STIFFNESSES)
        lower[stiff], upper[stiff] = (-np.expm1(-end[stiff]) for end in (lower, upper))
        step = np.zeros(unknowns.size)
        step[free] = bounded(reduced.shared, lower[free], upper[free])
        m = equilibria.m
        change = np.zeros((m, own))
        before = np.zeros(known)
        for j, (triangle, state) in enumerate(zip(reduced.own, reduced.states, strict=True)):
            others = np.concatenate([state @ np.concatenate([before, step[free]]), step[free]])
            right = triangle[:, -1] - triangle[:, own:-1] @ others
            change[j] = np.linalg.solve(triangle[:, :own], right)
            before = np.concatenate([change[j], others[: known - own]])
        turned = change[:, :nodes]
        turned *= min(1.0, LONGEST / max(float(np.abs(turned).max()), 1e-300))
        x = turned.reshape((m, *values.shapes.x.shape[1:2], -1, 1))
        deviation = values.shapes.deviation.copy()
        taken = np.where(stiff, -np.log1p(-np.where(stiff, step, 0.0)), step)
        reached = np.clip(values.theta + taken, *unknowns.bounds)
        larger = float(np.exp(self._bent(reached)[0] - self._bent(values.theta)[0]))
        forces = change[:, nodes:border]
        forces += (larger - 1) * (forces + values.shapes.lam) * unknowns.model.are_multipliers
        of_pose = deviation[:, equilibria.used_deviations] + change[:, border:]
        of_pose[:, self._are_forces] *= larger
        deviation[:, equilibria.used_deviations] = of_pose
        shapes = equilibria.moved(values.shapes, Vector(x, forces[:, :, None]))
        shapes = replace(shapes, deviation=deviation)
        theta = values.theta + taken
        theta = np.clip(np.where(unknowns.are_loads, larger * theta, theta), *unknowns.bounds)
        return Values(theta, shapes, values.projections)
