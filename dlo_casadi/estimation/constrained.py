"""Fits under one more condition: a parameter fixed, or the measured equilibria the lowest.

The profile likelihood of a parameter fixes that parameter and refits all others. A pose that names
no branch is predicted in its stable equilibrium of lowest energy. The shapes alone may not tell
which equilibrium that is: for a stiff cable in a single pose, a rest curvature that predicts the
other side fits as well. The observation that the cable was in a certain equilibrium is then one
more measurement of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects.mass_error import MASS_FACTOR
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.spread import SolvedCable, energy_slope
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import NEARLY, descend
from dlo_casadi.estimation.prediction import Prediction, measured_elsewhere, predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Point, Unknowns
from dlo_casadi.estimation.variances import settle
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, STIFFNESSES
from dlo_casadi.thresholds import EVIDENCE_APART, IDENTIFIABLE, SYSTEMATIC_SHARE

# Probability below the upper end of a 95 % interval.
BELOW_HIGH_END = 0.975
# Largest log ratio of an interval's end to the estimate; one trial at most triples that logarithm.
LARGEST_LOG_STEP = float(np.log(1e4))
FARTHEST_AIM, MOST_REFITS = 3.0, 12
# Relative change of a crossing below which the search ends: the remaining error is of second order.
SAME_CROSSING = 0.03
# Target gap of the measured equilibrium below the predicted one, and the tolerance on that target,
# in standard deviations of the gap. Evidence: 8 of 9 simulated one-pose sessions predicted another
# equilibrium than the measured one; one round corrected all 8; chi-square rose by 2.5 at most.
BELOW, KEPT = 0.2, 0.03
ROUNDS = 4
# Step of numerical derivatives of the energy, in units of the directions. The energy is quadratic
# in stiffnesses and rest curvatures, so central differences are exact.
_STEP = 1e-4


@dataclass(frozen=True)
class Interval:
    """A 95 % interval [SI]; None = unbounded within four decades."""

    low: float | None
    high: float | None

    @property
    def identifiable(self) -> bool:
        """Whether it is bounded and spans no more than a factor of ten."""
        if self.low is None or self.high is None:
            return False
        return self.high <= IDENTIFIABLE * self.low


def student_95(fit: Fit, name: str) -> float:
    """Half width of a parameter's 95 % interval in standard deviations (Student's t)."""
    return float(stdtrit(fit.variance_degrees(name), BELOW_HIGH_END))


def threshold(fit: Fit, name: str = BENDING_STIFFNESS, *, systematic: bool = False) -> float:
    """Rise of twice the objective at the ends of a parameter's interval.

    (t + b)^2 times the parameter's marginal variance over that at the given noise and roughness,
    at which all refits are made. t is Student's t of 95 % where the sizes of noise and scatter are
    estimated, and 1.96 where they are declared. b is zero unless `systematic` and the noise is
    declared: then the whitened norm of an error of SYSTEMATIC_SHARE in all points, in the direction
    that changes the parameter most.
    """
    k = fit.problem.unknowns.names.index(name)
    more = fit.marginal_covariance[k, k] / fit.covariance[k, k]
    square = 0.0
    if systematic and fit.noise.source == "declared":
        for item, white in zip(fit.problem.fit_poses, fit.problem.whitening, strict=True):
            constant = np.zeros(item.n_residuals)
            constant[item.on_points] = item.relative_std[item.point_of]
            constant *= SYSTEMATIC_SHARE * fit.noise.std
            square += float(((white @ constant) ** 2).sum())
    return float((student_95(fit, name) + np.sqrt(square)) ** 2 * more)


def profiled(fit: Fit) -> list[str]:
    """Names of the stiffnesses and the mass factor, if they are estimated."""
    return [name for name in (*STIFFNESSES, MASS_FACTOR) if name in fit.problem.unknowns.names]


def profile_intervals(fit: Fit) -> dict[str, Interval]:
    """Profile-likelihood interval of each parameter in `profiled`."""
    return {name: profile_interval(fit, name) for name in profiled(fit)}


def profile_interval(fit: Fit, name: str = BENDING_STIFFNESS) -> Interval:
    """Profile-likelihood interval of a positive parameter, such as a stiffness [N m^2].

    The parameter is fixed and everything else refitted; its own prior does not count. The interval
    allows for a systematic error of a declared noise if the parameter is not identifiable with it:
    its value then rests on averages far below the noise. The default `name` is the bending
    stiffness.
    """
    limit, allowing = threshold(fit, name), threshold(fit, name, systematic=True)
    found = _cut(fit, name, limit)
    # The logarithm of an interval's width grows about as the root of its limit.
    widest = np.log(found.high / found.low) if found.low and found.high else np.inf
    if 2 * np.sqrt(allowing / limit) * widest < np.log(IDENTIFIABLE):
        return found
    wide = found if allowing == limit else _cut(fit, name, allowing)
    return found if wide.identifiable else wide


def _cut(fit: Fit, name: str, limit: float) -> Interval:
    """Where a parameter's profile has risen to a limit."""
    k = fit.problem.unknowns.names.index(name)
    first = min(max(np.sqrt(limit * fit.covariance[k, k]), 1e-4), 0.7)
    ends = [_crossing(_Profile(fit, name), limit, direction * first) for direction in (-1, 1)]
    low, high = (None if end is None else float(np.exp(end) * fit.value(name)) for end in ends)
    return Interval(low, high)


def _crossing(profile: _Profile, limit: float, first: float) -> float | None:
    """Position at which a profile crosses its limit; None if not within LARGEST_LOG_STEP.

    A profile is close to a parabola, so the square root of its rise is nearly linear. The secant
    method on that root stops when the relative change of the position is below SAME_CROSSING.
    """
    root, aim, near = np.sqrt(limit), first, profile.lowest
    low: tuple[float, float] = (0.0, 0.0)
    high: tuple[float, float] | None = None
    for _ in range(MOST_REFITS):
        if abs(aim) > LARGEST_LOG_STEP:
            return None
        tried = profile.refitted(aim, near)
        if tried is None:
            if high is not None:
                return aim
            aim = low[0] + (aim - low[0]) / 4
            if abs(aim - low[0]) < 1e-3:
                return None
            continue
        here = aim, float(np.sqrt(max(tried.rise, 0.0)))
        if here[1] < root:
            low, near = here, tried
            onward = min(root / max(here[1], 1e-300), FARTHEST_AIM) * aim
        else:
            high = here
        if high is not None:
            onward = low[0] + (root - low[1]) * (high[0] - low[0]) / (high[1] - low[1])
        if abs(onward - aim) < SAME_CROSSING * abs(onward):
            return float(onward)
        aim = onward
    return aim if high is not None else None


def stiffness_profile(fit: Fit, stiffness: FloatArray) -> FloatArray:
    """Rise of twice the objective where the stiffness is fixed and everything else refitted.

    Parameters
    ----------
    stiffness : (k,) [N m^2]
        In any order.

    Returns
    -------
    (k,)
        To be compared with `threshold`; NaN where no equilibria were found.
    """
    wanted = np.log(stiffness / fit.p[0])
    rises = np.full(len(wanted), np.nan)
    order = np.argsort(wanted)
    profile = _Profile(fit, BENDING_STIFFNESS)
    # Outwards from the estimate: each refit starts from its neighbour.
    for side in (order[wanted[order] >= 0], order[wanted[order] < 0][::-1]):
        near = profile.lowest
        for k in side:
            tried = profile.refitted(float(wanted[k]), near)
            if tried is not None:
                near, rises[k] = tried, tried.rise
    return rises


@dataclass(frozen=True)
class _Refit:
    """Refit with one parameter fixed; `place` is the log of its ratio to the fitted value."""

    place: float
    point: Point
    rise: float


@dataclass(frozen=True)
class _Profile:
    """Rise of twice the objective along one parameter of a fit."""

    fit: Fit
    name: str

    @property
    def _k(self) -> int:
        return self.fit.problem.unknowns.names.index(self.name)

    @property
    def lowest(self) -> _Refit:
        """The fit's minimum without the parameter among its unknowns."""
        theta = np.delete(self.fit.point.theta, self._k)
        return _Refit(0.0, replace(self.fit.point, theta=theta), 0.0)

    def _fixed_at(self, place: float) -> Unknowns:
        model, found = self.fit.model, self.fit.problem.unknowns
        others = np.array([other != self.name for other in model.names]) & found.free
        p = self.fit.p.copy()
        p[model.names.index(self.name)] *= np.exp(place)
        return Unknowns(model, others, p)

    def refitted(self, place: float, near: _Refit) -> _Refit | None:
        """Refit with the parameter fixed, from a neighbour; None without equilibria there."""
        fit, k = self.fit, self._k
        base = 2 * fit.point.objective - fit.problem.unknowns.own_prior(fit.point.theta, k)
        fixed, priors = self._fixed_at(place), fit.problem.priors
        value = fit.problem.unknowns.pack(fixed.fixed, fit.coefficients)[k]
        told = tuple((np.delete(row, k), x - float(row[k] * value)) for row, x in priors.told)
        problem = replace(fit.problem, unknowns=fixed, priors=replace(priors, told=told))
        for theta in (self._along(place, near), near.point.theta):
            point = problem.balanced(replace(near.point, theta=theta))
            if point is not None:
                found = descend(Fit(problem, point), tolerance=NEARLY)
                return _Refit(place, found.point, 2 * found.point.objective - base)
        return None

    def _along(self, place: float, near: _Refit) -> FloatArray:
        """Values of the other unknowns as the parameter moves, to first order about the fit."""
        fit, k = self.fit, self._k
        whole = fit.problem.unknowns
        p = np.stack([self._fixed_at(at).fixed for at in (near.place, place)])
        before, after = (whole.pack(row, fit.coefficients)[k] for row in p)
        slope = np.delete(fit.covariance[:, k], k) / fit.covariance[k, k]
        lower, upper = self._fixed_at(place).bounds
        return np.clip(near.point.theta + slope * (after - before), lower, upper)


@dataclass(frozen=True)
class EnergyGap:
    """Energy of one equilibrium of a pose above another one.

    Parameters
    ----------
    value : float [J]
    slope : (q,) [J]
        Along q directions of the parameters, without the part that grows with the bending
        stiffness: a poorly known stiffness does not determine the sign of the gap.
    std : float [J]
        Standard deviation of the value: the smaller of those with and without that part.
    """

    value: float
    slope: FloatArray
    std: float

    @classmethod
    def between(
        cls,
        held: SolvedCable,
        other: Equilibrium,
        along: tuple[FloatArray, FloatArray],
        covariance: FloatArray,
    ) -> EnergyGap:
        """Energy of another equilibrium in the pose of a solved cable, minus that of its own.

        Parameters
        ----------
        along : (n_parameters, q), (n_rests, q)
            Directions of the parameters and the rest curvature.
        covariance : (q, q)
            Covariance along these directions.
        """
        value = other.energy - held.equilibrium.energy
        beyond = energy_slope(replace(held, equilibrium=other), along, _STEP)
        whole = beyond - energy_slope(held, along, _STEP)
        slope = whole - value * along[0][0] / held.p[0]
        variances = [max(float(way @ covariance @ way), 0.0) for way in (whole, slope)]
        return cls(value, slope, float(np.sqrt(min(variances))))


def as_measured(fit: Fit) -> Fit:
    """Refit so that every measured equilibrium is the predicted one; unchanged if all already are.

    The unknowns are refitted only as far as this requires; their covariance stays that of the
    shapes. If the evidence against the refit is very strong, the fit is returned unchanged: the
    model then lacks something.
    """
    found = fit
    for _ in range(ROUNDS):
        gaps = _gaps(found)
        if not gaps:
            break
        try:
            found = _refitted(found, gaps)
        except EstimationError:
            return fit
    else:
        if _gaps(found):
            return fit
    return found if fit.log_evidence - found.log_evidence < EVIDENCE_APART else fit


def _gaps(fit: Fit) -> list[EnergyGap]:
    """Energy of each fitted pose as measured, minus that of its prediction, along the unknowns.

    A gap that no unknown changes is left out: without weight all energies grow with EI alone.
    """
    problem, unknowns = fit.problem, fit.problem.unknowns
    own = _predicted_next(fit)
    nodes = {x.pose.name: fit.point.shapes.x[j] for j, x in enumerate(problem.measured)}
    others = measured_elsewhere(fit.model, fit.p, fit.rest, problem.measured, own, nodes)
    along = unknowns.slopes(fit.point.theta), unknowns.rest_slopes
    gaps = []
    for j in problem.used:
        there, known = others[j], own[j]
        if there is not None and known is not None:
            gaps.append(EnergyGap.between(known, there.equilibrium, along, fit.covariance))
    return [gap for gap in gaps if gap.std > 0]


def _predicted_next(fit: Fit) -> list[Prediction | None]:
    """Predictions of a problem's own poses, each after those before it in their fitted equilibria.

    Where a cable carries a state, one pose that is predicted in another equilibrium than it was in
    would lead all later ones astray.
    """
    problem, poses = fit.problem, [item.pose for item in fit.problem.history]
    if not fit.model.has_state:
        predictions = predict_poses(fit.model, fit.p, fit.rest, poses)
        return [predictions[k] for k in problem.indices]
    fitted, out, last, rest = [*fit.point.shapes.x], [], slice(0, 0), fit.rest
    for k, known in enumerate(predict_poses(fit.model, fit.p, fit.rest, poses, fitted)):
        near = [*poses[last], poses[k]], [*fitted[last], None]
        out.append(predict_poses(fit.model, fit.p, rest, *near)[-1])
        if known is not None:
            last, rest = slice(k, k + 1), known.rest
    return out


def _refitted(fit: Fit, gaps: Sequence[EnergyGap]) -> Fit:
    """Refit with further measurements that all gaps are below zero, to first order."""
    problem, told = fit.problem, []
    for gap in gaps:
        row = gap.slope / (KEPT * gap.std)
        aim = -BELOW * gap.std - gap.value
        told.append((row, float(row @ fit.point.theta) + aim / (KEPT * gap.std)))
    knowing = settle(fit.reweighed(priors=replace(problem.priors, told=tuple(told))))
    plain = knowing.reweighed(priors=replace(knowing.problem.priors, told=()))
    return replace(plain, converged=True)
