"""Gauss-Newton for the batch problem: the Levenberg-Marquardt method with a watchdog."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Self

import numpy as np
from scipy.optimize import lsq_linear

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.solve import solve_after
from dlo_casadi.equilibrium.spans import first_guesses
from dlo_casadi.errors import EquilibriumError, EstimationError
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Point, Unknowns, Values
from dlo_casadi.linear_mixed import NO_INFORMATION, Normal
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import forces_on_other_mesh
from dlo_casadi.runtime.work import Bound, accounted_as, spend

# Longest step of a node along its derivative [rad]; beyond it the linearisation is poor.
LONGEST_MOVE = 1.5
# Decrease of the objective below which a step counts as converged; and the same for a fit that is
# only compared with others or refined later. For scale: one standard deviation of one parameter is
# a decrease of 1/2, and a nat of evidence one of 1.
CONVERGED, NEARLY = 1e-4, 1e-2
# First damping after an undamped step that failed: in five sessions 68 of 99 steps with 1e-4 then
# failed, too.
FIRST_DAMPING = 1e-3
# A descent has stalled if this many steps together gain less than one converged step may.
STALLED = 4
# Share of the objective that STALLED steps have to gain together if the model lacks something. One
# percent of it is half a percent of the distances. Without this limit, such descents took 13 to 40
# steps in four sessions in space.
MISFIT_GAIN = 1e-2
# A descent is hopeless if its minimum is predicted above a ceiling in this many steps in a row, or
# if the remaining steps cannot reach the ceiling with the largest of the last STALLED gains.
HOPELESS = 3
# Maximum number of trial steps of a descent, per iteration that it may take.
TRIALS = 3
# Uphill steps allowed before backtracking; largest rise of the objective allowed.
WATCHED, WORSE = 2, 3.0


@accounted_as("fits")
def descend(
    fit: Fit,
    steps: int = 40,
    tolerance: float = CONVERGED,
    ceiling: float = np.inf,
    share: float = 0.0,
) -> Fit:
    """Levenberg-Marquardt from a problem's point, which has to be an equilibrium.

    Parameters
    ----------
    fit : Fit
        The problem, with its weights, and the starting point.
    steps : int
        Maximum number of iterations.
    tolerance : float
        Decrease of the objective at which the fit has converged, see CONVERGED.
    ceiling : float
        Objective above which the minimum is of no interest, see HOPELESS.
    share : float
        Share of the objective: a descent also ends once its last STALLED steps together gain less.
        By default it does not.

    Returns
    -------
    Fit
        The minimum, and whether it converged. A descent that stalls, is hopeless, runs out of
        iterations or of trial steps, or finds no worthwhile step although the gradient promises
        one, has not. One that ends by its `share` has, unless it is damped.
    """
    problem, damping, gains, above = fit.problem, 0.0, [np.inf] * STALLED, 0
    bound = Bound(TRIALS * steps)
    normal = problem.step_equations(fit.point, fit.linearization)
    curvature = Curvature(np.zeros_like(normal.hessian))
    for done in range(1, steps + 1):
        limit = fit.point.objective + 1e-9 * abs(fit.point.objective)
        model, before = curvature.added(normal), damping
        trial = _ahead(fit, model, damping, limit)
        least = least_decrease(problem, fit.point, tolerance)
        if trial is None and normal.promised() < least:
            return Fit(problem, fit.point, converged=True)
        while trial is None:
            damping = max(10 * damping, FIRST_DAMPING)
            if bound.met or damping > 1e8 or model.promised(damping) < least:
                return Fit(problem, fit.point)
            trial = _ahead(fit, model, damping, limit)
        gains = [*gains[1:], fit.point.objective - trial.point.objective]
        if damping == before:
            damping = damping / 10 if damping > 1e-6 else 0.0
        least = least_decrease(problem, trial.point, tolerance)
        if gains[-1] < least and damping < 1e-2:
            return Fit(problem, trial.point, converged=True)
        small = share > 0 and sum(gains) < share * trial.point.objective
        if small or sum(gains) < least:
            return Fit(problem, trial.point, converged=small and damping < 1e-2)
        ahead = problem.step_equations(trial.point, trial.linearization)
        step = trial.point.theta - fit.point.theta
        curvature = curvature.after(step, normal, ahead, gains[-1])
        fit, normal = trial, ahead
        if ceiling < np.inf and done < steps:
            within = min(normal.promised(), max(gains) * (steps - done))
            above = above + 1 if fit.point.objective - within > ceiling else 0
        if above == HOPELESS:
            break
    return Fit(problem, fit.point)


@dataclass(frozen=True)
class Curvature:
    """Part of theta's Hessian that Gauss-Newton neglects: residuals times their curvature.

    If a model lacks something, residuals are large and Gauss-Newton steps oscillate. A secant
    update from gradients estimates this part; it is used while it predicts gains better.

    Parameters
    ----------
    matrix : (size, size)
        Zero at first: plain Gauss-Newton.

    References
    ----------
    Dennis, Gay and Welsch, An adaptive nonlinear least-squares algorithm, ACM TOMS 7 (1981).
    """

    matrix: FloatArray
    used: bool = False

    def added(self, normal: Normal) -> Normal:
        """Normal equations plus this part, if it is used and they stay convex."""
        if not self.used:
            return normal
        hessian = normal.hessian + self.matrix
        scale = np.sqrt(np.maximum(np.diag(normal.hessian), 1e-12))
        convex = np.linalg.eigvalsh(hessian / np.outer(scale, scale))[0] > 0
        return replace(normal, hessian=hessian) if convex else normal

    def after(self, step: FloatArray, before: Normal, ahead: Normal, gain: float) -> Self:
        """Update after a step of theta that lowered the objective by `gain`."""
        change = ahead.gradient - before.gradient
        if step @ change <= 0:
            return self
        told = -(before.gradient @ step + step @ before.hessian @ step / 2)
        more = told - step @ self.matrix @ step / 2
        used = bool(abs(more - gain) <= abs(told - gain)) if self.matrix.any() else True
        missing = change - ahead.hessian @ step
        own = float(step @ self.matrix @ step)
        sized = self.matrix * min(1.0, abs(float(step @ missing) / own) if own else 1.0)
        gap, slope = missing - sized @ step, float(change @ step)
        both = np.outer(gap, change)
        twice = float(step @ gap) * np.outer(change, change) / slope**2
        return replace(self, matrix=sized + (both + both.T) / slope - twice, used=used)


def least_decrease(problem: Problem, point: Point, tolerance: float = CONVERGED) -> float:
    """Decrease of the objective at a point below which a further step is not worthwhile.

    It grows with the residual's excess over the noise, as does one standard deviation's decrease.
    """
    return tolerance * max(1.0, point.data / max(problem.n_residuals, 1))


def _ahead(
    fit: Fit, normal: Normal, damping: float, limit: float, more: int = WATCHED
) -> Fit | None:
    """A fit below a limit, by one step or by further steps from one above it; else None.

    Shapes determine mainly the product of stiffness and rest curvature, so the objective has a
    curved valley: a full step along it leads up its side, and the next one back to its bottom.

    References
    ----------
    The watchdog technique: Chamberlain et al., Math. Programming Study 16 (1982).
    """
    trial = _stepped(fit, normal, damping)
    if trial is None or trial.point.objective <= limit:
        return trial
    if not more or trial.point.objective > WORSE * limit:
        return None
    normal = trial.problem.step_equations(trial.point, trial.linearization)
    return _ahead(trial, normal, damping, limit, more - 1)


def _stepped(fit: Fit, normal: Normal, damping: float) -> Fit | None:
    """Fit after a damped step within reach; None if some pose loses its equilibrium."""
    spend()
    problem, point = fit.problem, fit.point
    lower, upper = problem.unknowns.reach(point.theta)
    matrix = normal.damped(damping)
    step = -np.linalg.solve(matrix, normal.gradient)
    new = point.theta + step
    if np.any(new < lower) or np.any(new > upper):
        step = _bounded_step(matrix, normal.gradient, lower - point.theta, upper - point.theta)
    change, deviation = problem.moved(fit.linearization.shapes, normal, step)
    if float(np.abs(change.x).max()) > LONGEST_MOVE:
        return None
    guess = problem.equilibria.moved(point.shapes, change)
    guess = replace(guess, deviation=point.shapes.deviation + deviation)
    values = Values(point.theta + step, guess, point.projections)
    found = problem.balanced(values, reach=1.0)
    return None if found is None else Fit(problem, found)


def _bounded_step(
    matrix: FloatArray, gradient: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Minimise the quadratic model within bounds."""
    # The matrix, a Schur complement, is positive except for rounding.
    values, vectors = np.linalg.eigh(matrix)
    root = np.sqrt(np.maximum(values, NO_INFORMATION))
    factor, target = root[:, None] * vectors.T, -(vectors.T @ gradient) / root
    low, high = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
    high = np.where(high - low < 1e-14, low + 1e-14, high)
    return np.asarray(lsq_linear(factor, target, bounds=(low, high), method="bvls").x)


# ---- from one fit to another model -------------------------------------------------------------


def refit(
    fit: Fit,
    model: CableModel,
    *,
    free: Sequence[str] | None = None,
    values: Mapping[str, float] = MappingProxyType({}),
    steps: int = 40,
    tolerance: float = CONVERGED,
    ceiling: float = np.inf,
) -> Fit:
    """Fit a similar model, or another mesh, starting from a fit's minimum with its weights.

    Parameters
    ----------
    free : sequence of str, optional
        Names of the parameters to estimate; by default all but those that the fit keeps fixed.
    values : mapping, optional
        Start values by name of parameters that the fit does not have, and fixed values of those
        that are not estimated; by default those of the fit, or nominal ones.
    steps, tolerance, ceiling
        As of `descend`.

    Raises
    ------
    EstimationError
        If the model has no equilibria near those of the fit.
    """
    chosen = fit.free_in(model) if free is None else np.isin(model.names, free)
    known = np.isin(model.names, fit.model.names)
    p = np.where(known & chosen, fit.values_in(model), fit.values_in(model, values))
    problem = replace(fit.problem, unknowns=Unknowns(model, chosen, p))
    theta = problem.unknowns.pack(p, fit.coefficients)
    start = Values(theta, carried_shapes(problem, fit), fit.point.projections)
    point = problem.balanced(start)
    if point is None:
        raise EstimationError("the shapes of the first fit are no equilibria of the second model")
    return descend(Fit(problem, point), steps, tolerance, ceiling)


def carried_shapes(problem: Problem, fit: Fit, *, relaxed: bool = False) -> Shapes:
    """Shapes of a problem's poses from those of a fit, on the problem's mesh.

    Poses that the fit did not need, because it carried no state, are predicted; beside a relaxed
    fit, which cannot predict, they start at a first guess. Raises EstimationError if such a pose
    has no equilibrium.
    """
    known = {index: k for k, index in enumerate(fit.problem.indices)}
    own, count = fit.point.shapes, len(fit.model.sliding)
    rows = []
    for index in problem.indices:
        if index in known:
            k = known[index]
            rows.append((own.x[k], own.lam[k], own.deviation[k], own.near_each(count)[k]))
            continue
        pose = problem.history[index].pose
        deviation = np.zeros_like(own.deviation[0])
        try:
            if index not in fit.beside:
                before = (problem.history[index - 1].pose, rows[-1][0]) if rows else None
                fit.beside[index] = solve_after(fit.model, fit.p, fit.rest, pose, before)
            found = fit.beside[index]
            rows.append((found.x, found.multipliers, deviation, found.near))
        except EquilibriumError as error:
            if not relaxed:
                raise EstimationError(error.message) from error
            guess = next(first_guesses(fit.model, fit.p, fit.rest, pose))
            rows.append((*guess, deviation, np.full(count, np.nan)))
    columns = (np.array(column) for column in zip(*rows, strict=True))
    models = fit.problem.equilibria.model, problem.equilibria.model
    return on_other_mesh(Shapes(*columns), *models)


def on_other_mesh(shapes: Shapes, model: CableModel, other: CableModel) -> Shapes:
    """Nodes and forces on obstacles interpolated from one model's mesh to another's."""
    moved = shapes.in_order_of(model, other)
    if model.chain == other.chain:
        return moved
    coarse, fine = model.chain.places, other.chain.places
    x = other.chain.kind.node.interpolated(fine, coarse, shapes.x)
    if model.surfaces and model.surfaces == other.surfaces:
        moved.lam[:, other.n_lam :] = forces_on_other_mesh(shapes.lam, model, other)
    return replace(moved, x=x)
