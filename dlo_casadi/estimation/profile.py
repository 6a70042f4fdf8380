"""Profile-likelihood interval of one parameter: everything else is refitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from dlo_casadi.effects.mass_error import MASS_FACTOR
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.problem import Point
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, STIFFNESSES
from dlo_casadi.thresholds import IDENTIFIABLE, SYSTEMATIC_SHARE

FloatArray = NDArray[np.floating]

# Probability below the upper end of a 95 % interval.
BELOW_HIGH_END = 0.975
# Search for the interval's ends within this factor of the estimate, threefold at most at a time.
LARGEST_LOG_STEP = float(np.log(1e4))
FARTHEST_AIM, MOST_REFITS = 3.0, 12
# A last aim that moves by this share of itself: what is left of it is of second order.
SAME_CROSSING = 0.03


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
    """Standard deviations of a parameter to either end of its 95 % interval."""
    return float(stdtrit(fit.variance_degrees(name), BELOW_HIGH_END))


def threshold(fit: Fit, name: str = BENDING_STIFFNESS) -> float:
    """Rise of twice the objective at the ends of a parameter's interval.

    (t + b)^2 times the excess of the residual over the noise, with Student's t of 95 % for what the
    sizes of noise and scatter are estimated from, 1.96 where they are declared; b, for a declared
    noise, is the length in its weights of a systematic error of SYSTEMATIC_SHARE in all points.
    """
    square = 0.0
    for j, white in zip(fit.problem.used, fit.problem.whitening, strict=True):
        if fit.noise.source != "declared":
            break
        item = fit.problem.measured[j]
        constant = np.zeros(item.n_residuals)
        constant[item.on_points] = item.relative_std[item.point_of]
        constant *= SYSTEMATIC_SHARE * fit.noise.std
        square += float(((white @ constant) ** 2).sum())
    return (student_95(fit, name) + np.sqrt(square)) ** 2 * fit.inflation**2


def profile_intervals(fit: Fit) -> dict[str, Interval]:
    """Intervals of the stiffnesses and of the mass's factor, as far as they are estimated."""
    wanted = (*STIFFNESSES, MASS_FACTOR)
    free = [name for name in wanted if name in fit.problem.unknowns.names]
    return {name: profile_interval(fit, name) for name in free}


def profile_interval(fit: Fit, name: str = BENDING_STIFFNESS) -> Interval:
    """Profile-likelihood interval of a positive parameter, such as a stiffness [N m^2].

    It is held, everything else refitted; its own prior does not count.

    Parameters
    ----------
    name : str
        The bending stiffness by default.
    """
    limit = threshold(fit, name)
    std = fit.std(name) / fit.inflation / fit.value(name)
    first = min(max(np.sqrt(limit) * std, 1e-4), 0.7)
    ends = [_crossing(_Profile(fit, name), limit, direction * first) for direction in (-1, 1)]
    low, high = (None if end is None else float(np.exp(end) * fit.value(name)) for end in ends)
    return Interval(low, high)


def _crossing(profile: _Profile, limit: float, first: float) -> float | None:
    """Place where a profile crosses its limit; None where it does not within LARGEST_LOG_STEP.

    A profile is close to a parabola: the square root of its rise is all but linear, and the
    secant of that root is followed until the place moves by less than SAME_CROSSING of itself.
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
    """Rise of twice the objective where the stiffness is held and everything else refitted.

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
    # Outwards from the estimate, each refit from its neighbour's.
    for side in (order[wanted[order] >= 0], order[wanted[order] < 0][::-1]):
        near = profile.lowest
        for k in side:
            tried = profile.refitted(float(wanted[k]), near)
            if tried is not None:
                near, rises[k] = tried, tried.rise
    return rises


@dataclass(frozen=True)
class _Refit:
    """Everything else refitted where a parameter is held: at the log of its ratio to the fit's."""

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

    def _held(self, place: float) -> Unknowns:
        model, found = self.fit.model, self.fit.problem.unknowns
        others = np.array([other != self.name for other in model.names]) & found.free
        p = self.fit.p.copy()
        p[model.names.index(self.name)] *= np.exp(place)
        return Unknowns(model, others, p)

    def refitted(self, place: float, near: _Refit) -> _Refit | None:
        """Hold the parameter at a place, from a neighbour; None without equilibria there."""
        fit, k = self.fit, self._k
        base = 2 * fit.point.objective - fit.problem.unknowns.own_prior(fit.point.theta, k)
        problem = replace(fit.problem, unknowns=self._held(place))
        for theta in (self._along(place, near), near.point.theta):
            point = problem.balanced(replace(near.point, theta=theta))
            if point is not None:
                found = descend(Fit(problem, point), tolerance=1e-2)
                return _Refit(place, found.point, 2 * found.point.objective - base)
        return None

    def _along(self, place: float, near: _Refit) -> FloatArray:
        """Where the other unknowns go with the parameter, to first order about the fit."""
        fit, k = self.fit, self._k
        whole = fit.problem.unknowns
        p = np.stack([self._held(at).fixed for at in (near.place, place)])
        before, after = (whole.pack(row, fit.coefficients)[k] for row in p)
        slope = np.delete(fit.covariance[:, k], k) / fit.covariance[k, k]
        lower, upper = self._held(place).bounds
        return np.clip(near.point.theta + slope * (after - before), lower, upper)
