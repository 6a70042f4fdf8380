"""Gauss-Newton for the batch problem, with the equilibria eliminated pose by pose.

    min over theta, deviations of
        1/2 sum_j |W_j e_j|^2 + 1/2 sum_j |deviation_j / std|^2
        + 1/2 (theta - mean)^T P (theta - mean)
    subject to every pose being an equilibrium

with the residuals e_j of the pose's sensors, of a line N_j (x_j - r_j(s_j)). The projections s_j of
its points move with the curve; there the normal distance does not change to first order with s, so
that the Jacobian at fixed projections is the exact one. A Schur complement eliminates the
deviations of a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.equilibrium.spread import modes_in
from dlo_casadi.estimation.linearization import Linearization, Normal, Point, Values
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.assembly import Shapes, Tangents
from dlo_casadi.model.cable_model import Tolerances
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.rest_curvature import MODES, RestScatter
from dlo_casadi.rod.band import Vector
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

FloatArray = NDArray[np.floating]

# Precision in scaled units below which a direction counts as undetermined.
NO_INFORMATION = 1e-6
# Farther than so [rad] no node is moved along its derivative: equilibria are not that linear.
LONGEST_MOVE = 1.5
# Cables come back to the same shape, unless the data tell otherwise.
NO_REST_SCATTER = RestScatter()
# A step that lowers the objective by less has converged: one standard deviation of one parameter is
# a decrease of 1/2.
CONVERGED = 1e-4
# A descent creeps where so many steps together gain no more than the last one may.
CREEPING = 4
# Steps that may follow one uphill before it is taken back, and how far up it may lead.
WATCHED, WORSE = 2, 3.0


class BatchProblem:
    """The batch problem of one model, one noise model and one prior.

    Parameters
    ----------
    unknowns : Unknowns
    measured : sequence of MeasuredPose
        All poses in order, the `history`; those held out or unreadable are among the problem's
        own poses, `measured`, only if the model carries a state. The poses that are fitted are
        `history[k] for k in fitted`, the same as `measured[j] for j in used`.
    noise : NoiseModel
    tolerances : Tolerances
    roughness_std : float
        Prior of the rest curvature, see `Unknowns.prior_precision`.
    scatter : (n_deviations,), optional
        Standard deviations of a pose's own deviations; the tolerances by default.
    rest_scatter : RestScatter
        Rest curvature of each hanging's own; none by default.
    equilibria : BatchEquilibrium, optional
        Reused when only noise or priors have changed.
    """

    def __init__(
        self,
        unknowns: Unknowns,
        measured: Sequence[MeasuredPose],
        noise: NoiseModel,
        tolerances: Tolerances,
        roughness_std: float = 1.0,
        scatter: FloatArray | None = None,
        rest_scatter: RestScatter = NO_REST_SCATTER,
        equilibria: BatchEquilibrium | None = None,
    ) -> None:
        self.unknowns = unknowns
        self.history = tuple(measured)
        self.fitted = [
            k for k, item in enumerate(self.history) if item.readable and not item.held_out
        ]
        # Poses that are not fitted matter only where they leave something behind in the cable.
        coupled = unknowns.model.has_state
        self.indices = list(range(len(self.history))) if coupled else self.fitted
        self.used = self.fitted if coupled else list(range(len(self.fitted)))
        self.measured = tuple(self.history[k] for k in self.indices)
        self.noise = noise
        self.tolerances = tolerances
        self.roughness_std = roughness_std
        self.equilibria = equilibria or BatchEquilibrium(
            unknowns.model, [item.pose for item in self.measured]
        )
        self.precision = unknowns.prior_precision(roughness_std)
        self.mean = unknowns.prior_mean(self.precision)
        self.scatter = tolerances.deviation(unknowns.model.node) if scatter is None else scatter
        self.rest_scatter = rest_scatter
        self.deviation_std = self.scatter[self.equilibria.used_deviations]
        self._whitening: dict[int, FloatArray] = {}

    @property
    def n_residuals(self) -> int:
        """Number of residuals of the fitted poses.

        In the plane one of a point, two of a marker; one of each component of a reading.
        """
        return sum(self.measured[j].n_residuals for j in self.used)

    # ---- evaluation --------------------------------------------------------------------------

    def observed(self, theta: FloatArray, shapes: Shapes) -> list[Observed]:
        """All poses as the sensors see them."""
        return self.equilibria.seen(shapes, self.unknowns.p(theta), self.unknowns.rest(theta))

    @property
    def observed_size(self) -> int:
        """Numbers that residuals depend on: those of a measured curve, and of readings."""
        model = self.unknowns.model
        curve = (model.chain.n + 1) * int(functions_of(model).station.size1_out(0))
        return curve + int(functions_of(model).readings.size1_out(0))

    def whitening(self, j: int) -> FloatArray:
        """Whitening matrix (R_j, R_j) of pose j, as of the last `refresh`."""
        return self._whitening[j]

    def refresh(self, theta: FloatArray, shapes: Shapes, projections: Sequence[FloatArray]) -> None:
        """Take the weights of the residuals at these unknowns, equilibria and projections.

        The covariance of pose j is that of its noise plus E_j E_j^T, where E_j is what a standard
        deviation of each mode of its own rest curvature does to the residuals.
        """
        self._whitening = {
            j: self.measured[j].whitening(self.noise, s)
            for j, s in zip(self.used, projections, strict=True)
        }
        if self.rest_scatter.std == 0:
            return
        moved = self.moved_by_rest(theta, shapes, projections)
        for j, way in zip(self.used, moved, strict=True):
            sizes = np.tile(self.rest_scatter.sizes, way.shape[1] // MODES)
            seen = self._whitening[j] @ (way * sizes)
            factor = np.linalg.cholesky(np.eye(len(seen)) + seen @ seen.T)
            self._whitening[j] = solve_triangular(factor, self._whitening[j], lower=True)

    def moved_by_rest(
        self, theta: FloatArray, shapes: Shapes, projections: Sequence[FloatArray]
    ) -> list[FloatArray]:
        """Change (R_j, axes MODES) of the fitted residuals by rest curvatures of the poses' own."""
        p, rest = self.unknowns.p(theta), self.unknowns.rest(theta)
        along = self.equilibria.by_rest(shapes, p, rest, modes_in(self.unknowns.model))
        seen = self.equilibria.observe(shapes, p, rest, along)
        out = []
        for j, s in zip(self.used, projections, strict=True):
            now, change = seen.pose(j, self.unknowns.model.cable.length)
            out.append(self.measured[j].linearized(now, s, change)[1])
        return out

    @property
    def has_weights(self) -> bool:
        """Whether the weights of the residuals have been taken."""
        return bool(self._whitening)

    def share_weights(self, other: BatchProblem) -> None:
        """Take over the weights of a problem of the same fitted poses: objectives compare then."""
        self._whitening = {
            mine: other._whitening[theirs]
            for mine, theirs in zip(self.used, other.used, strict=True)
        }

    def taken_over(self, near: Point) -> Point:
        """Return a point of a problem that weighs otherwise in this one, with the weights there."""
        self.refresh(near.theta, near.shapes, near.projections)
        return self.evaluate(near.theta, near.shapes, near.projections)

    def located(self, seen: list[Observed], projections: list[FloatArray]) -> list[FloatArray]:
        """Arc lengths (K_j,) [m] at which the fitted poses' points are compared, near those given.

        `seen` are all poses.
        """
        places = zip(self.used, projections, strict=True)
        return [self.measured[j].located(seen[j], guess) for j, guess in places]

    def evaluate(self, theta: FloatArray, shapes: Shapes, projections: list[FloatArray]) -> Point:
        """Objective at given unknowns and equilibria."""
        seen = self.observed(theta, shapes)
        moved = self.located(seen, projections)
        residuals: list[FloatArray] = [
            self.whitening(j) @ self.measured[j].residual(seen[j], s)
            for j, s in zip(self.used, moved, strict=True)
        ]
        data = float(sum(white @ white for white in residuals))
        gap = theta - self.mean
        used = shapes.deviation[np.ix_(self.used, self.equilibria.used_deviations)]
        prior = float(gap @ self.precision @ gap + ((used / self.deviation_std) ** 2).sum())
        return Point(theta, shapes, moved, (data + prior) / 2, data, residuals)

    def linearize(self, point: Point) -> Linearization:
        """Whitened residuals and their exact first derivatives."""
        along = self.equilibria.directions(
            point.shapes,
            self.unknowns.p(point.theta),
            self.unknowns.rest(point.theta),
            self.unknowns.slopes(point.theta),
            self.unknowns.rest_slopes,
        )
        return self.linearize_along(point, along)

    def linearize_along(
        self, point: Values, along: Tangents, correction: Vector | None = None
    ) -> Linearization:
        """Residuals and derivatives for given derivatives of the shapes and parameters.

        Parameters
        ----------
        correction : Vector, optional
            How the shapes are about to move, one column; the residuals are those afterwards, to
            first order.
        """
        p, rest = self.unknowns.p(point.theta), self.unknowns.rest(point.theta)
        ways = along if correction is None else along.and_step(correction)
        seen = self.equilibria.observe(point.shapes, p, rest, ways)
        out = Linearization([], [], [], [], [], along)
        size, length = self.unknowns.size, self.unknowns.model.cable.length
        for j, s in zip(self.used, point.projections, strict=True):
            (now, change), item = seen.pose(j, length), self.measured[j]
            white = self.whitening(j)
            d, directions = item.linearized(now, s, change)
            if correction is not None:
                d, directions = d + directions[:, -1], directions[:, :-1]
            whitened = white @ directions
            out.residuals.append(white @ d)
            out.by_theta.append(whitened[:, :size])
            out.by_deviation.append(whitened[:, size:])
            out.raw.append(d)
            out.raw_directions.append(directions)
        return out

    def normal_equations(self, point: Point, lin: Linearization) -> Normal:
        """Gauss-Newton normal equations of theta, deviations eliminated."""
        gap = point.theta - self.mean
        hessian = self.precision.copy()
        gradient = self.precision @ gap
        inner: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        precision = np.diag(1 / self.deviation_std**2)
        columns = self.equilibria.used_deviations
        for k, j in enumerate(self.used):
            e, a, b = lin.residuals[k], lin.by_theta[k], lin.by_deviation[k]
            hessian += a.T @ a
            gradient += a.T @ e
            if b.shape[1]:
                block = b.T @ b + precision
                cross = b.T @ a
                slope = b.T @ e + precision @ point.shapes.deviation[j, columns]
                solved = np.linalg.solve(block, np.column_stack([cross, slope]))
                hessian -= cross.T @ solved[:, :-1]
                gradient -= cross.T @ solved[:, -1]
                inner.append((block, cross, slope))
        return Normal(hessian, gradient, inner)

    def _step(self, point: Point, normal: Normal, damping: float) -> tuple[FloatArray, FloatArray]:
        """Damped step of theta within its reach, and the deviations that go with it."""
        lower, upper = self.unknowns.reach(point.theta)
        scale = np.maximum(np.diag(normal.hessian), 1e-12)
        # A direction without any information (the place of a mass of zero) must not move.
        matrix = normal.hessian + damping * np.diag(scale) + NO_INFORMATION * np.eye(len(scale))
        step = -np.linalg.solve(matrix, normal.gradient)
        new = point.theta + step
        if np.any(new < lower) or np.any(new > upper):
            step = _bounded_step(matrix, normal.gradient, lower - point.theta, upper - point.theta)
        deviation = point.shapes.deviation.copy()
        columns = self.equilibria.used_deviations
        for j, (block, cross, slope) in zip(self.used, normal.inner, strict=False):
            deviation[j, columns] -= np.linalg.solve(block, cross @ step + slope)
        return step, deviation

    # ---- solution ----------------------------------------------------------------------------

    def descend(
        self, point: Point, max_iterations: int = 40, tolerance: float = CONVERGED
    ) -> tuple[Point, bool]:
        """Levenberg-Marquardt from an equilibrium point.

        Parameters
        ----------
        tolerance : float
            Decrease of the objective at which the fit has converged, see CONVERGED.

        Returns
        -------
        Point, bool
            The minimum and whether it converged: a descent that creeps, or has run out of
            iterations, has not.
        """
        damping, gains = 0.0, [np.inf] * CREEPING
        lin = self.linearize(point)
        for _ in range(max_iterations):
            limit = point.objective + 1e-9 * abs(point.objective)
            before, trial = damping, self._ahead(point, lin, damping, limit, WATCHED)
            least = self.least_decrease(point, tolerance)
            if trial is None and self._promised(point, lin) < least:
                # What a pose's deviations do to the poses after it, through a state, is left out.
                return point, True
            while trial is None:
                damping = max(10 * damping, 1e-4)
                if damping > 1e8:
                    return point, False
                trial = self._ahead(point, lin, damping, limit, WATCHED)
            gains = [*gains[1:], point.objective - trial.objective]
            if damping == before:
                damping = damping / 10 if damping > 1e-6 else 0.0
            point = trial
            least = self.least_decrease(point, tolerance)
            if gains[-1] < least and damping < 1e-2:
                return point, True
            if sum(gains) < least:
                return point, False
            lin = self.linearize(point)
        return point, False

    def least_decrease(self, point: Point, tolerance: float = CONVERGED) -> float:
        """Decrease of the objective about a point that is worth a step.

        Where the residual exceeds the noise, so does a standard deviation's decrease.
        """
        return tolerance * max(1.0, point.data / max(self.n_residuals, 1))

    def _promised(self, point: Point, lin: Linearization) -> float:
        """Decrease of the objective that an undamped step promises."""
        normal = self.normal_equations(point, lin)
        matrix = normal.hessian + NO_INFORMATION * np.eye(len(normal.hessian))
        shared = normal.gradient @ np.linalg.solve(matrix, normal.gradient)
        own = sum(slope @ np.linalg.solve(block, slope) for block, _, slope in normal.inner)
        return float(shared + own) / 2

    def _ahead(
        self, point: Point, lin: Linearization, damping: float, limit: float, more: int
    ) -> Point | None:
        """A point below a limit, in one step or with some more beyond one above it; else None.

        The valley of stiffness against rest curvature, whose product is what shapes know, is
        curved: a full step along it leads up its side, the next one back to its bottom.

        References
        ----------
        The watchdog technique: Chamberlain et al., Math. Programming Study 16 (1982).
        """
        normal = self.normal_equations(point, lin)
        trial = self._try(point, lin, *self._step(point, normal, damping))
        if trial is None or trial.objective <= limit:
            return trial
        if not more or trial.objective > WORSE * limit:
            return None
        return self._ahead(trial, self.linearize(trial), damping, limit, more - 1)

    def _try(
        self, point: Point, lin: Linearization, step: FloatArray, deviation: FloatArray
    ) -> Point | None:
        """Equilibria and objective after a step; None if some pose loses its equilibrium."""
        theta = point.theta + step
        change = self.shape_step(lin.shapes, step, deviation - point.shapes.deviation)
        if float(np.abs(change.x).max()) > LONGEST_MOVE:
            return None
        guess = replace(self.equilibria.moved(point.shapes, change), deviation=deviation)
        shapes, converged = self.equilibria.settled(
            guess, self.unknowns.p(theta), self.unknowns.rest(theta), reach=1.0
        )
        if not converged.all():
            return None
        return self.evaluate(theta, shapes, point.projections)

    def shape_step(self, along: Tangents, step: FloatArray, deviation: FloatArray) -> Vector:
        """How the shapes move with a step of theta and of the deviations, one column."""
        own = deviation[:, self.equilibria.used_deviations]
        both = np.concatenate([np.broadcast_to(step, (len(own), len(step))), own], axis=1)
        return Vector(along.x @ both[:, None, :, None], along.lam @ both[:, :, None])

    def thinned(self, most: int) -> BatchProblem:
        """Return the problem of at most so many of the fitted poses, evenly picked.

        Not for models with a state, whose poses depend on those before them.
        """
        kept = self.fitted[:: -(-len(self.fitted) // most)]
        return self.of(self.unknowns, [self.history[k] for k in kept])

    def of(
        self,
        unknowns: Unknowns,
        measured: Sequence[MeasuredPose] | None = None,
        scatter: FloatArray | None = None,
        equilibria: BatchEquilibrium | None = None,
    ) -> BatchProblem:
        """Return a problem with the same noise, roughness and scatter, unless it is given here."""
        return BatchProblem(
            unknowns,
            self.history if measured is None else measured,
            self.noise,
            self.tolerances,
            self.roughness_std,
            self.scatter if scatter is None else scatter,
            self.rest_scatter,
            equilibria,
        )

    def changed(
        self,
        noise: NoiseModel,
        roughness_std: float,
        scatter: FloatArray,
        rest_scatter: RestScatter,
    ) -> BatchProblem:
        """Return the same problem with another noise, roughness or scatter."""
        return BatchProblem(
            self.unknowns,
            self.history,
            noise,
            self.tolerances,
            roughness_std,
            scatter,
            rest_scatter,
            self.equilibria,
        )


def _bounded_step(
    matrix: FloatArray, gradient: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Minimise the quadratic model within bounds."""
    # The matrix, a Schur complement, is positive but for rounding.
    values, vectors = np.linalg.eigh(matrix)
    root = np.sqrt(np.maximum(values, NO_INFORMATION))
    factor, target = root[:, None] * vectors.T, -(vectors.T @ gradient) / root
    low, high = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
    high = np.where(high - low < 1e-14, low + 1e-14, high)
    return np.asarray(lsq_linear(factor, target, bounds=(low, high), method="bvls").x)
