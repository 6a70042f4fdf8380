"""The result of a fit: parameters that explain the measured poses, and how well they are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from dlo_casadi.arrays import BoolArray, Brief, FloatArray
from dlo_casadi.effects.mass_error import MASS_FACTOR
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.estimation.problem import FIRST_ROUGHNESS, Priors, Problem
from dlo_casadi.estimation.unknowns import REST_TURNS_STD, Linearization, Point, Unknowns
from dlo_casadi.linear_mixed import NO_INFORMATION, LinearMixed, Normal
from dlo_casadi.model.cable_model import FREE_LENGTH, CableModel
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.thresholds import LEAST_NOISE_DEGREES

# Roughness at which `marginal_covariance` is evaluated: from the smallest estimate to thirty scales
# of its prior, which is flat below one scale and falls with the square above.
ROUGHNESSES = np.geomspace(1e-3, 30 * FIRST_ROUGHNESS, 40)


@dataclass(frozen=True, repr=False)
class Fit(Brief):
    """Parameters that explain the measured poses best, and how well they are known.

    Parameters
    ----------
    problem : Problem
        The problem with the estimated noise and roughness.
    point : Point
        Unknowns, shapes and objective at the minimum, or at an intermediate point.
    """

    problem: Problem
    point: Point
    converged: bool = False

    def __getstate__(self) -> dict[str, Any]:
        """State without cached values: another process recomputes them, with the same rounding."""
        return {"problem": self.problem, "point": self.point, "converged": self.converged}

    def reweighed(self, noise: NoiseModel | None = None, priors: Priors | None = None) -> Fit:
        """The same point with another noise or other priors; raises as `Problem.taken_over`."""
        noise, priors = noise or self.noise, priors or self.problem.priors
        problem = replace(self.problem, noise=noise, priors=priors, weights=None)
        return Fit(*problem.taken_over(self.point, self.problem))

    def weighed_as(self, other: Fit) -> Fit:
        """The same point with noise, priors and weights of another fit of the same points."""
        own = other.problem
        problem = replace(self.problem, noise=own.noise, priors=own.priors, weights=own.weights)
        return Fit(*problem.taken_over(self.point, self.problem))

    @property
    def model(self) -> CableModel:
        """The model that was fitted."""
        return self.problem.unknowns.model

    @property
    def mass(self) -> float:
        """Mass of the cable [kg], declared or estimated."""
        known = self.model.cable.mass
        return known * self.value(MASS_FACTOR) if MASS_FACTOR in self.model.names else known

    @property
    def noise(self) -> NoiseModel:
        """Noise of the measured lines."""
        return self.problem.noise

    @property
    def beyond_noise(self) -> bool:
        """Whether more than noise is left: chi-square two std too high, or a scatter of poses."""
        excess = 2 * np.sqrt(2 / self.degrees_of_freedom)
        return self.scatters or self.chi2_per_dof > 1 + excess

    @property
    def scatters(self) -> bool:
        """Whether something differs at random from pose to pose."""
        return self.problem.priors.pose_scatter.std > 0

    @property
    def errors_known(self) -> bool:
        """Whether no noise or scatter was estimated from the residuals themselves."""
        return self.noise.known and not self.scatters

    @property
    def p(self) -> FloatArray:
        """Parameter vector, in the order of `model.names` (SI)."""
        return self.problem.unknowns.p(self.point.theta)

    @property
    def coefficients(self) -> FloatArray:
        """Rest-curvature coefficients [1/m]."""
        return self.problem.unknowns.coefficients(self.point.theta)

    @property
    def rest(self) -> FloatArray:
        """Rest curvature of the bending cells before the first pose [1/m]."""
        return self.problem.unknowns.rest(self.point.theta)

    @cached_property
    def linearization(self) -> Linearization:
        """Residuals and Jacobians at the minimum."""
        return self.problem.linearize(self.point)

    @cached_property
    def mixed(self) -> LinearMixed:
        """The fit to first order about the minimum."""
        return self.problem.mixed(self.point, self.linearization)

    @cached_property
    def beside(self) -> dict[int, Equilibrium]:
        """Equilibria of poses that the fit did not need, by their index, as they were asked for."""
        return {}

    @property
    def normal(self) -> Normal:
        """Normal equations at the minimum."""
        return self.mixed.normal

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (size, size) of theta: inverse of the reduced Hessian plus `_by_bounds`.

        The uncertainty of the place of a mass of zero is that of its bounds.
        """
        return self._inverse(self._by_bounds)

    @cached_property
    def marginal_covariance(self) -> FloatArray:
        """Covariance (size, size) of theta with the roughness of the rest curvature integrated out.

            sum_k w_k (c C_k + d_k d_k^T),   w_k ~ prior(roughness_k) evidence(roughness_k)

        C_k: `covariance` at another roughness; d_k: how far theta moves; both follow from the
        normal equations. c: the residual's excess over the noise, which also divides the log
        evidence; bounds do not have it. Where shapes hardly tell the rest curvature, its likeliest
        roughness is small, and `covariance` is that of a rest curvature known to be smooth. In the
        prior the shrinkage 1 / (1 + roughness^2 / FIRST_ROUGHNESS^2) is uniform: small variances
        are as likely as one another, for which intervals hold the truth as often as they say. One
        that is flat in the roughness itself favours smooth ones: intervals of EI held it in 91 of
        100 simulated lines between pins, with this one in 96.

        References
        ----------
        Daniels, Canadian J. Statistics 27 (1999); Morris, J. Am. Stat. Assoc. 78 (1983).
        """
        unknowns, excess = self.problem.unknowns, self.inflation**2
        bounds, n = excess * self._by_bounds, unknowns.n_parameters
        if unknowns.n_rest < 3:
            return excess * self._inverse(bounds)
        known, theta = self.problem.priors.roughness_std, self.point.theta
        rough = np.zeros((unknowns.size, unknowns.size))
        rough[n:, n:] = self.model.roughness.T @ self.model.roughness
        curvatures = np.maximum(np.linalg.eigvalsh(rough[n:, n:]), 0.0)
        logs, covariances = [], []
        for std in ROUGHNESSES:
            more = 1 / std**2 - 1 / known**2
            own = self._inverse(bounds + more * rough)
            moved = -more * own @ rough @ theta
            energy = more * theta @ rough @ theta + more * theta @ rough @ moved
            prior = np.log(curvatures / std**2 + 1 / REST_TURNS_STD**2).sum()
            evidence = (prior + np.linalg.slogdet(own)[1] - energy / excess) / 2
            # On a grid of equal ratios a density of the variance is weighed by the variance.
            logs.append(evidence + 2 * np.log(std / (1 + (std / FIRST_ROUGHNESS) ** 2)))
            covariances.append(excess * own + np.outer(moved, moved))
        weights = np.exp(np.array(logs) - max(logs))
        return np.asarray(np.average(covariances, axis=0, weights=weights))

    def _inverse(self, more: FloatArray) -> FloatArray:
        """Inverse of the reduced Hessian with more precision on its diagonal."""
        total = self.normal.hessian + more
        size = np.sqrt(np.maximum(np.diag(total), np.diag(more)))
        values, vectors = np.linalg.eigh(total / np.outer(size, size))
        scaled = (vectors / np.maximum(values, np.finfo(float).eps)) @ vectors.T
        return np.asarray(scaled / np.outer(size, size))

    @property
    def _by_bounds(self) -> FloatArray:
        """Precision (size, size) of theta that its bounds alone give."""
        return np.diag(1 / self.problem.unknowns.widest**2)

    def is_determined(self, name: str) -> bool | None:
        """Whether residuals and priors narrow a parameter beyond its bounds; None if fixed."""
        unknowns = self.problem.unknowns
        if name not in unknowns.names:
            return None
        k = unknowns.names.index(name)
        return bool(2 * self.marginal_covariance[k, k] < unknowns.widest[k] ** 2)

    @cached_property
    def determined_unknowns(self) -> float:
        """Effective number of unknowns that the residuals determine, given the priors."""
        return float(sum(each.sum() for each in self.leverages))

    @cached_property
    def leverages(self) -> list[FloatArray]:
        """Share, 0 to 1, of each fitted residual (R_j,) that the unknowns absorb."""
        return self.mixed.leverages(self.covariance)

    @property
    def own_deviations(self) -> FloatArray:
        """Deviations (fitted poses, n_deviations) of each fitted pose's own."""
        return self.problem.own_deviations(self.point)

    def variance_degrees(self, name: str) -> float:
        """Degrees of freedom with which the variance of a parameter's estimate is known.

            1 / degrees = sum_c (v_c / v)^2 / degrees_c

        The parts v_c of the variance v come from the noise and from each repeat's own rest
        curvature; degrees_c are those of their sizes. At least LEAST_NOISE_DEGREES; inf if both are
        declared. The fixtures' scatter counts as known.

        References
        ----------
        Satterthwaite, Biometrics Bulletin 2 (1946).
        """
        problem, rest = self.problem, self.problem.priors.pose_scatter
        index = problem.unknowns.names.index(name)
        column = self.covariance[index]
        errors, own = 0.0, 0.0
        for k, (white, way) in enumerate(zip(problem.whitening, self._own_errors, strict=True)):
            by_errors = self.mixed.taken(k, self.linearization.by_theta[k] @ column[:, None])[:, 0]
            errors += float(by_errors @ by_errors)
            own += float(((by_errors @ white @ way) ** 2).sum())
        # The weights contain a random rest curvature; all else is an unknown of each pose.
        noise = errors - own if rest.rest_std else errors
        parts = noise**2 / self.noise.slow_dof + own**2 / rest.dof
        parts /= column[index] ** 2
        return max(LEAST_NOISE_DEGREES, 1 / parts) if parts > 0 else np.inf

    @property
    def degrees_of_freedom(self) -> float:
        """Number of residuals minus the effective number of unknowns that they determine."""
        return max(self.problem.n_residuals - self.determined_unknowns, 1.0)

    @property
    def chi2_per_dof(self) -> float:
        """Sum of squares of the whitened residuals per degree of freedom."""
        return self.point.data / self.degrees_of_freedom

    @property
    def rest_now(self) -> FloatArray:
        """Rest curvature (n_rests,) [1/m] that the session's last pose leaves behind."""
        if not self.model.has_state:
            return self.rest
        return self.problem.equilibria.rest_after_last(self.point.shapes, self.p, self.rest)

    @property
    def chi2_of_points(self) -> float:
        """`chi2_per_dof` with the noise of the points, even if the fit weighs by its misfit."""
        return self.chi2_per_dof * (self.noise.std / self.noise.of_points.std) ** 2

    @property
    def has_points(self) -> bool:
        """Whether any fitted pose has points; otherwise all have readings alone."""
        return self._n_points > 0

    @cached_property
    def residual_rms(self) -> float:
        """Root mean square residual of the fitted points [m]; zero without points."""
        if not self.has_points:
            return 0.0
        rows = [raw[on] for raw, on in zip(self.linearization.raw, self._on_points, strict=True)]
        return float(np.sqrt((np.concatenate(rows) ** 2).mean()))

    def _rms_of_points(self, squares: Sequence[FloatArray]) -> float:
        """Root mean square [m] over points, given squared residuals (R_j,); zero without points."""
        if not self.has_points:
            return 0.0
        rows = [square[on] for square, on in zip(squares, self._on_points, strict=True)]
        return float(np.sqrt(np.concatenate(rows).sum() / self._n_points))

    @cached_property
    def fixture_error(self) -> float:
        """RMS displacement of points [m] caused by deviations of the ends from declared values.

        It is the scatter of ends and headings, propagated to the curve through the equilibrium. The
        fit estimates the deviations of each fitted pose; those of a predicted pose are unknown.
        """
        return self._rms_of_points(self._by_fixtures)

    @property
    def _by_fixtures(self) -> list[FloatArray]:
        """Variance (R_j,) of each residual caused by the deviations of a pose's ends."""
        size, names = self.problem.unknowns.size, self.problem.equilibria.model.deviations
        std = self.problem.fixture_std * [name != FREE_LENGTH for name in names]
        return [
            ((directions[:, size:] * std) ** 2).sum(axis=1)
            for directions in self.linearization.raw_directions
        ]

    @cached_property
    def repeat_error(self) -> float:
        """RMS displacement of points [m] caused by what differs at random from pose to pose."""
        return self._rms_of_points(self._by_rest)

    @property
    def _by_rest(self) -> list[FloatArray]:
        """Variance (R_j,) of each residual caused by what differs at random from pose to pose."""
        return [(way**2).sum(axis=1) for way in self._own_errors]

    @cached_property
    def _own_errors(self) -> list[FloatArray]:
        return self.problem.own_errors(self.point)

    @property
    def _on_points(self) -> list[BoolArray]:
        return [item.on_points for item in self.problem.fit_poses]

    @property
    def failed(self) -> bool:
        """Whether the fit stopped so far from a minimum that its numbers may be wrong.

        That is so if a Gauss-Newton step within the bounds would still lower the objective by more
        than one standard deviation of one parameter does: 1/2, if the residual is noise.
        """
        if self.converged:
            return False
        (lower, upper), theta = self.problem.unknowns.bounds, self.point.theta
        slope = self.normal.gradient
        free = np.where(slope > 0, theta > lower, theta < upper)
        slope, hessian = slope[free], self.normal.hessian[np.ix_(free, free)]
        step = np.linalg.solve(hessian + NO_INFORMATION * np.eye(len(slope)), slope)
        return bool(slope @ step > self.inflation**2)

    @property
    def _n_points(self) -> int:
        return sum(len(item.points) for item in self.problem.fit_poses)

    @cached_property
    def expected_error(self) -> float:
        """RMS error [m] expected of a predicted pose if the model lacks nothing.

        It covers distances of points and wrench measurements, converted by `NoiseModel.units`.
        Causes: noise, scatter of the fixtures, uncertain parameters, and how the cable repeats.
        """
        covariance = self.marginal_covariance / self.inflation**2
        return self.expected_with([covariance] * len(self.problem.used))

    def expected_with(self, covariances: Sequence[FloatArray]) -> float:
        """`expected_error`, but with a given covariance of the unknowns for each fitted pose.

        Parameters
        ----------
        covariances : sequence of (size, size)
            Covariance of the unknowns for each fitted pose.
        """
        problem, size = self.problem, self.problem.unknowns.size
        square, count = problem.n_residuals * self.noise.std**2, self._n_points
        directions = (by[:, :size] for by in self.linearization.raw_directions)
        own = (problem.fit_poses, self._by_fixtures, self._by_rest)
        rows = zip(covariances, directions, *own, strict=True)
        for covariance, by, item, fixtures, rest in rows:
            variance = self.inflation**2 * ((by @ covariance) * by).sum(axis=1)
            variance += fixtures + rest
            units = self.noise.units(item.kinds)
            square += float((units**2 * variance).sum())
            count += int((~item.on_points).sum())
        return float(np.sqrt(square / count))

    @property
    def inflation(self) -> float:
        """Factor on standard deviations where the residual exceeds the noise."""
        return float(np.sqrt(max(1.0, self.chi2_per_dof)))

    def std(self, name: str) -> float:
        """Standard deviation of a parameter (SI), the residual's excess included."""
        unknowns = self.problem.unknowns
        if name not in unknowns.names:
            return 0.0
        k = unknowns.names.index(name)
        slope = unknowns.derivatives(self.point.theta)[k]
        return float(abs(slope) * np.sqrt(self.marginal_covariance[k, k]))

    @property
    def named_covariance(self) -> tuple[tuple[str, ...], FloatArray]:
        """Names and covariance of all unknowns in SI units, the residual's excess included.

        The unknowns are scaled or logarithmic: C = D C_theta D with D = dp/dtheta.
        """
        unknowns = self.problem.unknowns
        slopes = unknowns.derivatives(self.point.theta)
        scaled = self.marginal_covariance * np.outer(slopes, slopes)
        return unknowns.names, np.asarray((scaled + scaled.T) / 2)

    def value(self, name: str) -> float:
        """Value of a parameter (SI)."""
        return float(self.p[self.model.names.index(name)])

    def problem_in(
        self, model: CableModel, given: Mapping[str, float] = MappingProxyType({})
    ) -> Problem:
        """The problem of a similar model; for its parameters see `free_in` and `values_in`."""
        unknowns = Unknowns(model, self.free_in(model), self.values_in(model, given))
        return replace(self.problem, unknowns=unknowns)

    def values_in(
        self, model: CableModel, given: Mapping[str, float] = MappingProxyType({})
    ) -> FloatArray:
        """Parameter vector of a similar model: values given, else this fit's, else nominal."""
        known = {**dict(zip(self.model.names, self.p, strict=True)), **given}
        return np.array([known.get(q.name, q.nominal) for q in model.parameters])

    def free_in(self, model: CableModel) -> BoolArray:
        """Whether each parameter of a similar model is estimated: all except those fixed here."""
        free = dict(zip(self.model.names, self.problem.unknowns.free, strict=True))
        return np.array([free.get(name, True) for name in model.names], dtype=bool)

    @cached_property
    def stable(self) -> BoolArray:
        """Whether each pose is a stable equilibrium at the fitted parameters."""
        return self.problem.equilibria.stable(*self.problem.state(self.point))

    @cached_property
    def log_evidence(self) -> float:
        """Log marginal likelihood by Laplace's approximation, see `LinearMixed.log_evidence`."""
        white = sum(float(np.linalg.slogdet(weight)[1]) for weight in self.problem.whitening)
        return self.mixed.log_evidence + white
