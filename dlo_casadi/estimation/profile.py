"""Profile-likelihood interval of one parameter: everything else is refitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.composition import BENDING_STIFFNESS, STIFFNESSES
from dlo_casadi.effects.mass_error import MASS_FACTOR
from dlo_casadi.estimation.gauss_newton import Point
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.thresholds import IDENTIFIABLE, NORMAL_95, SYSTEMATIC_SHARE

FloatArray = NDArray[np.floating]

# Search for the interval's ends within this factor of the estimate, in steps growing by two.
LARGEST_LOG_STEP = float(np.log(1e4))


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


def threshold(fit: Fit) -> float:
    """Rise of twice the objective at the ends of the interval.

    (1.96 + b)^2 times the excess of the residual over the noise, where b, for a declared noise, is
    the length in its metric of a systematic error of SYSTEMATIC_SHARE of it in all points.
    """
    square = 0.0
    for j in fit.problem.used:
        if fit.noise.source != "declared":
            break
        item = fit.problem.measured[j]
        constant = np.zeros(item.n_residuals)
        constant[item.on_points] = item.relative_std[item.point_of]
        constant *= SYSTEMATIC_SHARE * fit.noise.std
        square += float(((fit.problem.whitening(j) @ constant) ** 2).sum())
    return (NORMAL_95 + np.sqrt(square)) ** 2 * fit.inflation**2


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
    log_ei = float(np.log(fit.value(name)))
    log_std = fit.std(name) / fit.value(name)
    limit = threshold(fit)

    def held(log_value: float, near: Point) -> tuple[Point, float] | None:
        tried = _held(fit, log_value, near, name)
        return None if tried is None else (tried[0], tried[1] - limit)

    def end(direction: int) -> float | None:
        near = _others(fit, name)
        low, f_low = 0.0, -limit
        step = min(max(np.sqrt(limit) * log_std, 1e-4), 0.7)
        while low < LARGEST_LOG_STEP:
            tried = held(log_ei + direction * (low + step), near)
            if tried is None:
                step /= 4
                if step < 1e-3:
                    break
                continue
            point, value = tried
            if value > 0:
                return _crossing(held, log_ei, direction, (low, f_low), (low + step, value), near)
            near, low, f_low = point, low + step, value
            step *= 2
        return None

    ends = [end(-1), end(1)]
    low, high = (None if e is None else float(np.exp(e)) for e in ends)
    return Interval(low, high)


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
    wanted = np.log(stiffness)
    here = float(np.log(fit.p[0]))
    rises = np.full(len(wanted), np.nan)
    order = np.argsort(wanted)
    # Outwards from the estimate, each refit from its neighbour's.
    for side in (order[wanted[order] >= here], order[wanted[order] < here][::-1]):
        near = _others(fit, BENDING_STIFFNESS)
        for k in side:
            tried = _held(fit, float(wanted[k]), near, BENDING_STIFFNESS)
            if tried is not None:
                near, rises[k] = tried
    return rises


def _others(fit: Fit, name: str) -> Point:
    """The fit's minimum without the stiffness among its unknowns."""
    names = np.array(fit.problem.unknowns.names)
    return replace(fit.point, theta=fit.point.theta[names != name])


def _held(fit: Fit, log_value: float, near: Point, name: str) -> tuple[Point, float] | None:
    """Refit with the stiffness held, from a neighbour; the rise of twice the objective."""
    model, found = fit.model, fit.problem.unknowns
    k = found.names.index(name)
    base = 2 * fit.point.objective - found.own_prior(fit.point.theta, k)
    others = np.array([other != name for other in model.names]) & found.free
    p = fit.p.copy()
    p[model.names.index(name)] = np.exp(log_value)
    unknowns = Unknowns(model, others, p, found.rest_free)
    problem = fit.problem.of(unknowns, sweep=fit.problem.sweep)
    problem.share_metric(fit.problem)
    theta = near.theta
    shapes, converged = problem.sweep.solve(near.shapes, unknowns.p(theta), unknowns.rest(theta))
    if not converged.all():
        return None
    point, _ = problem.descend(problem.evaluate(theta, shapes, near.feet), tolerance=1e-2)
    return point, 2 * point.objective - base


def _crossing(
    held: Callable[[float, Point], tuple[Point, float] | None],
    log_ei: float,
    direction: int,
    below: tuple[float, float],
    above: tuple[float, float],
    near: Point,
) -> float:
    """Place where the profile crosses the threshold, by two secant steps on its root."""
    (a, f_a), (b, f_b) = below, above
    for _ in range(2):
        # The profile is close to a parabola: from its lowest point its square root is linear.
        share = -f_a / (f_b - f_a)
        guess = b * np.sqrt(share) if a == 0 else a + (b - a) * share
        tried = held(log_ei + direction * guess, near)
        if tried is None:
            break
        if tried[1] > 0:
            b, f_b = guess, tried[1]
        else:
            a, f_a = guess, tried[1]
        if abs(tried[1]) < 0.05 * abs(f_a - f_b) or b - a < 1e-3:
            return float(log_ei + direction * guess)
    return float(log_ei + direction * (a + (b - a) * (-f_a) / (f_b - f_a)))
