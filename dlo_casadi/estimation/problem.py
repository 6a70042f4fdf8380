"""The batch problem of one model, with the equilibria eliminated pose by pose.

    min over theta, deviations of
        1/2 sum_j |W_j e_j|^2 + 1/2 sum_j |deviation_j / std|^2
        + 1/2 (theta - mean)^T P (theta - mean)
    subject to every pose being an equilibrium

with the residuals e_j of the pose's sensors; for a line N_j (x_j - r_j(s_j)). The projections s_j
of its points move with the curve, but the normal distance is stationary in s there, so the Jacobian
at fixed projections is exact. A Schur complement eliminates a pose's deviations. A problem never
changes: its weights W_j are computed once at some values (`Problem.weighed`), or taken over from
another problem of the same poses with `replace`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.unknowns import Linearization, Point, Unknowns, Values
from dlo_casadi.linear_mixed import LinearMixed, Normal
from dlo_casadi.model.assembly import Shapes, Tangents
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.band import Vector
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

# Roughness of the rest curvature until it has been estimated.
FIRST_ROUGHNESS = 0.3
NO_SCATTER = PoseScatter()
# Shares of random deviations on the way to equilibria without them: moments of pins move a cable by
# centimetres.
VANISHING = (0.5, 0.2, 0.0)


@dataclass(frozen=True, eq=False)
class Priors:
    """What is known besides the measurements, and how much poses differ from one another.

    Parameters
    ----------
    scatter : (n_deviations,)
        Standard deviations of a pose's own deviations within the tolerances, of the model without
        what is random besides.
    roughness_std : float
        Prior of the rest curvature, see `Unknowns.prior`.
    pose_scatter : PoseScatter
        What else differs at random between repeats. By default nothing: the cable returns to the
        same shape unless the data show otherwise.
    told : tuple of (row (size,), value)
        Other knowledge of theta: row @ theta is `value`, with a standard deviation of one.
    """

    tolerances: Tolerances
    scatter: FloatArray
    roughness_std: float = FIRST_ROUGHNESS
    pose_scatter: PoseScatter = NO_SCATTER
    told: tuple[tuple[FloatArray, float], ...] = ()

    @classmethod
    def of(cls, tolerances: Tolerances, model: CableModel) -> Priors:
        """Priors for a model's poses, which differ as much as the tolerances allow."""
        return cls(tolerances, tolerances.deviation(model))


@dataclass(frozen=True, eq=False)
class Problem:
    """The batch problem of one model, its priors and measurements; it does not change.

    Parameters
    ----------
    history : sequence of MeasuredPose
        All poses in order. Those held out or unreadable are among the problem's own poses,
        `measured`, only if the model carries a state. The fitted poses are
        `history[k] for k in fitted`, the same as `measured[j] for j in used`.
    weights : tuple of (R_j, R_j), optional
        Whitening matrices W_j of the fitted poses, see `weighed`. Objectives of two problems can
        be compared only if both have the same weights and priors of the deviations.
    """

    unknowns: Unknowns
    history: Sequence[MeasuredPose]
    noise: NoiseModel
    priors: Priors
    weights: tuple[FloatArray, ...] | None = None

    @cached_property
    def fitted(self) -> list[int]:
        """Indices of the fitted poses in the history."""
        return [k for k, x in enumerate(self.history) if x.readable and not x.held_out]

    @property
    def indices(self) -> list[int]:
        """Indices of the problem's own poses in the history.

        Poses that are not fitted are included only if they change the state of the cable.
        """
        coupled = self.unknowns.model.has_state
        return list(range(len(self.history))) if coupled else self.fitted

    @cached_property
    def used(self) -> list[int]:
        """Indices of the fitted poses among the problem's own poses."""
        coupled = self.unknowns.model.has_state
        return self.fitted if coupled else list(range(len(self.fitted)))

    @cached_property
    def measured(self) -> tuple[MeasuredPose, ...]:
        """The problem's own poses."""
        return tuple(self.history[k] for k in self.indices)

    @property
    def fit_poses(self) -> list[MeasuredPose]:
        """The fitted poses."""
        return [self.history[k] for k in self.fitted]

    @cached_property
    def equilibria(self) -> BatchEquilibrium:
        """The model over the problem's own poses; random effects are deviations of each pose."""
        scatter, model = self.priors.pose_scatter, self.unknowns.model
        return self._equilibria_of(scatter.within(model) if scatter.std else model)

    def _equilibria_of(self, model: CableModel) -> BatchEquilibrium:
        wrenches = any(item.reactions for item in self.measured)
        return BatchEquilibrium(model, [item.pose for item in self.measured], wrenches=wrenches)

    @cached_property
    def _prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and precision of the prior of theta, including what else is known (`told`)."""
        mean, precision = self.unknowns.prior(self.priors.roughness_std)
        told = self.priors.told
        if told:
            rows = np.array([row for row, _ in told])
            precision = precision + rows.T @ rows
            pulled = sum((row * (value - row @ mean) for row, value in told), np.zeros_like(mean))
            mean = mean + np.linalg.pinv(precision, hermitian=True) @ pulled
        return mean, precision

    @property
    def mean(self) -> FloatArray:
        """Mean (size,) of the prior of theta."""
        return self._prior[0]

    @property
    def precision(self) -> FloatArray:
        """Precision matrix (size, size) of the prior of theta."""
        return self._prior[1]

    @cached_property
    def fixture_std(self) -> FloatArray:
        """Scatter of the fixtures within their tolerances; zero for deviations by random effects.

        In the order of `BatchEquilibrium.used_deviations`, as the two below.
        """
        others = len(self.equilibria.model.deviation_names) - len(self.priors.scatter)
        return np.pad(self.priors.scatter, (0, others))[self.equilibria.used_deviations]

    @cached_property
    def random_std(self) -> FloatArray:
        """Scatter from pose to pose beyond the tolerances, see `pose_scatter`."""
        scatter = self.priors.pose_scatter
        random = np.isin(self.equilibria.model.deviations, scatter.deviations(self.unknowns.model))
        return np.where(random, scatter.std, 0.0)

    @cached_property
    def deviation_std(self) -> FloatArray:
        """Standard deviations of the deviations that the poses have."""
        return np.hypot(self.fixture_std, self.random_std)

    @property
    def n_residuals(self) -> int:
        """Number of residuals of the fitted poses.

        In the plane one per point and two per marker; one per component of a wrench measurement.
        """
        return sum(item.n_residuals for item in self.fit_poses)

    # ---- weights -----------------------------------------------------------------------------

    @property
    def whitening(self) -> tuple[FloatArray, ...]:
        """The weights; an error if they have not been computed."""
        assert self.weights is not None, "Problem.weighed has not been called"
        return self.weights

    def weighed(self, values: Values) -> Problem:
        """Return the problem with the weights of the residuals computed at these values.

        The covariance of pose j is that of its noise plus E_j E_j^T. Column k of E_j is the change
        of the residuals by one standard deviation of component k of what differs at random.
        All but a rest curvature is instead an unknown of the pose: its effect may be far from
        linear.
        """
        weights = [
            item.whitening(self.noise, s)
            for item, s in zip(self.fit_poses, values.projections, strict=True)
        ]
        random = self.own_errors(values) if self.priors.pose_scatter.rest_std else []
        for k, way in enumerate(random):
            if not way.size:
                continue
            seen = weights[k] @ way
            factor = np.linalg.cholesky(np.eye(len(seen)) + seen @ seen.T)
            weights[k] = solve_triangular(factor, weights[k], lower=True)
        return replace(self, weights=tuple(weights))

    def moved_by(self, values: Values, *scatters: PoseScatter) -> list[list[FloatArray]]:
        """Change (R_j, q) of the fitted residuals by a unit of a pose's random quantities.

        One list of poses for each of `scatters`. All are evaluated in one model, which is cheaper.
        """
        if not scatters:
            return []
        model = own = self.equilibria.model
        for scatter in scatters:
            model = scatter.within(model)
        larger = self._equilibria_of(model)
        ways = [scatter.ways(model) for scatter in scatters]
        by_own, by_rest = (np.concatenate(parts, axis=1) for parts in zip(*ways, strict=True))
        shapes, p, rest = self.state(values)
        shapes = shapes.in_order_of(own, model)
        along = larger.by_rest(shapes, p, rest, by_rest, by_deviation=by_own)
        seen = larger.observe(shapes, p, rest, along)
        edges = np.cumsum([columns.shape[1] for columns, _ in ways])[:-1]
        moved = [
            np.split(self.measured[j].linearized(seen[j][0], s, seen[j][1])[1], edges, axis=1)
            for j, s in zip(self.used, values.projections, strict=True)
        ]
        return [list(each) for each in zip(*moved, strict=True)]

    def own_errors(self, values: Values) -> list[FloatArray]:
        """`moved_by` for one standard deviation of each; (R_j, 0) if the cable repeats."""
        scatter = self.priors.pose_scatter
        if scatter.std == 0:
            return [np.zeros((item.n_residuals, 0)) for item in self.fit_poses]
        (moved,) = self.moved_by(values, scatter)
        return [way * scatter.sizes(way.shape[1]) for way in moved]

    # ---- evaluation --------------------------------------------------------------------------

    def state(self, values: Values) -> tuple[Shapes, FloatArray, FloatArray]:
        """Shapes, parameters and rest curvature before the first pose, for `equilibria`."""
        return values.shapes, self.unknowns.p(values.theta), self.unknowns.rest(values.theta)

    def observed(self, values: Values) -> list[Observed]:
        """All poses as the sensors see them."""
        return self.equilibria.seen(*self.state(values))

    def located(self, values: Values, seen: list[Observed]) -> list[FloatArray]:
        """Arc lengths (K_j,) [m] at which the fitted poses' points are compared, near those given.

        `seen` holds the measurements predicted for all poses.
        """
        places = zip(self.used, values.projections, strict=True)
        return [self.measured[j].located(seen[j], guess) for j, guess in places]

    def residuals(self, values: Values, along: Tangents) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Residuals (R_j,) of each fitted pose, not whitened, and derivatives along directions."""
        seen = self.equilibria.observe(*self.state(values), along)
        for j, s in zip(self.used, values.projections, strict=True):
            now, change = seen[j]
            yield self.measured[j].linearized(now, s, change)

    def evaluate(self, values: Values) -> Point:
        """Objective at given unknowns and equilibria."""
        seen = self.observed(values)
        moved = self.located(values, seen)
        residuals: list[FloatArray] = [
            white @ self.measured[j].residual(seen[j], s)
            for white, j, s in zip(self.whitening, self.used, moved, strict=True)
        ]
        data = float(sum(white @ white for white in residuals))
        gap, own = values.theta - self.mean, self.own_deviations(values)
        prior = float(gap @ self.precision @ gap + ((own / self.deviation_std) ** 2).sum())
        return Point(values.theta, values.shapes, moved, (data + prior) / 2, data, residuals)

    def own_deviations(self, values: Values) -> FloatArray:
        """Deviations (fitted poses, n_deviations) of each fitted pose's own."""
        used = np.ix_(self.used, self.equilibria.used_deviations)
        return np.asarray(values.shapes.deviation[used])

    def balanced(self, values: Values, **options: Any) -> Point | None:
        """Objective at equilibria of all poses near some values; None if a pose has none there.

        `options`: of `BatchEquilibrium.solve_or_descend`.
        """
        shapes, converged = self.equilibria.solve_or_descend(*self.state(values), **options)
        if not converged.all():
            return None
        point = self.evaluate(Values(values.theta, shapes, values.projections))
        return point if np.isfinite(point.objective) else None

    def taken_over(self, values: Values, other: Problem) -> tuple[Problem, Point]:
        """Return the problem with weights, and its objective at values of another problem.

        Both have the same model; their poses may have different random deviations. New ones are
        zero; those that this problem lacks vanish in steps, from equilibrium to equilibrium. If
        the problem has no weights, they are computed at the values.

        Raises
        ------
        EstimationError
            If a pose has no equilibrium without them.
        """
        own, model = other.equilibria.model, self.equilibria.model
        lost, shapes = ~np.isin(own.deviation_names, model.deviation_names), values.shapes
        if shapes.deviation[:, lost].any():
            shapes = other._without(values, lost)
        values = Values(values.theta, shapes.in_order_of(own, model), values.projections)
        problem = self if self.weights else self.weighed(values)
        return problem, problem.evaluate(values)

    def _without(self, values: Values, lost: BoolArray) -> Shapes:
        """Equilibria without some deviations (n_deviations,), see `taken_over`."""
        shapes, p, rest = self.state(values)
        first, converged = shapes.deviation, np.ones(self.equilibria.m, dtype=bool)
        for share in VANISHING:
            shapes = replace(shapes, deviation=np.where(lost, share * first, first))
            shapes, converged = self.equilibria.solve_or_descend(shapes, p, rest)
        if not converged.all():
            name = self.measured[int(converged.argmin())].pose.name
            raise EstimationError(
                f"{name} has no equilibrium near its shape without its own random deviations"
            )
        return shapes

    # ---- derivatives -------------------------------------------------------------------------

    def linearize(self, point: Values) -> Linearization:
        """Whitened residuals and their exact first derivatives."""
        slopes = self.unknowns.slopes(point.theta), self.unknowns.rest_slopes
        along = self.equilibria.directions(*self.state(point), *slopes)
        out = Linearization([], [], [], [], [], [], along)
        size, own = self.unknowns.size, len(self.equilibria.used_deviations)
        coupled = along.p.shape[2] > size + own
        fitted = np.concatenate([size + own * j + np.arange(own) for j in self.used])
        rows = zip(self.used, self.whitening, self.residuals(point, along), strict=True)
        for j, white, (d, directions) in rows:
            if coupled:
                out.by_all.append(white @ directions[:, fitted])
                first = size + own * j
                kept = [*range(size), *range(first, first + own)]
                directions = directions[:, kept]
            whitened = white @ directions
            out.residuals.append(white @ d)
            out.by_theta.append(whitened[:, :size])
            out.by_deviation.append(whitened[:, size:])
            out.raw.append(d)
            out.raw_directions.append(directions)
        return out

    def mixed(self, point: Values, lin: Linearization, *, joined: bool = False) -> LinearMixed:
        """The fit to first order; what the poses have of their own are their deviations.

        `joined`: whether all poses are one group where they carry a state, by which a deviation
        also moves all later poses.
        """
        e, a, b = lin.residuals, lin.by_theta, lin.by_deviation
        own, std = self.own_deviations(point), self.deviation_std
        if joined and lin.by_all:
            e, a, b = ([np.concatenate(rows)] for rows in (e, a, lin.by_all))
            own, std = own.reshape((1, -1)), np.tile(std, len(own))
        return LinearMixed(e, a, b, own, std, point.theta - self.mean, self.precision)

    def step_equations(self, point: Values, lin: Linearization) -> Normal:
        """Normal equations of a descent."""
        return self.mixed(point, lin, joined=True).normal

    def moved(self, along: Tangents, normal: Normal, step: FloatArray) -> tuple[Vector, FloatArray]:
        """Change of shapes (one column) and deviations (m, n_deviations) by a step of theta."""
        own = np.zeros((self.equilibria.m, len(self.equilibria.used_deviations)))
        found = -normal.own.arm @ np.append(step, 1.0)
        own[self.used] = found.reshape((len(self.used), -1))
        coupled = along.p.shape[2] > len(step) + own.shape[1]
        each = np.broadcast_to(own.ravel(), (len(own), own.size)) if coupled else own
        both = np.concatenate([np.broadcast_to(step, (len(own), len(step))), each], axis=1)
        shapes = Vector(along.x @ both[:, None, :, None], along.lam @ both[:, :, None])
        deviation = np.zeros((len(own), len(self.equilibria.model.deviation_names)))
        deviation[:, self.equilibria.used_deviations] = own
        return shapes, deviation
