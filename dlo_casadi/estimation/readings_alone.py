"""The start of a fit to poses with readings of forces and moments alone, which show no shape.

Such a pose begins at the equilibrium that is predicted from its ends. The unknowns begin at the
minimum of the poses that have points; without any, at the stiffness with which a cable that is
straight at rest explains the readings best, and at several rolls of its end. A pose may be
predicted in another equilibrium than it was measured in as long as the unknowns are far off: poses
whose readings stand out are predicted again by the fit of the others.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import NEARLY, descend
from dlo_casadi.estimation.measured_shapes import measured_shapes
from dlo_casadi.estimation.prediction import predict_each, predict_poses
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import APART, FOLLOWED, ROLLS, SearchSettings
from dlo_casadi.estimation.stiffness import fit_stiffness
from dlo_casadi.estimation.unknowns import Point, Unknowns, Values
from dlo_casadi.estimation.variances import first_reading_noise
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import END_ROLL

# Rounds in which outlying poses are predicted again.
ROUNDS = 3
# Share of the poses that may stand out; if more do, nothing leads back to them.
FEW = 0.5


def minimum_of_readings(
    problem: Problem, theta: FloatArray, near_shapes: Callable[[Problem, FloatArray], Fit]
) -> Fit:
    """Minimum of a problem in which some fit poses have readings alone.

    Parameters
    ----------
    theta : (size,)
        Start of the unknowns; any stiffness will do.
    near_shapes : callable
        Finds the minimum of a problem whose fit poses all have points.

    Raises
    ------
    EstimationError
        If poses have no equilibrium where the search begins.
    """
    unknowns, near, starts = problem.unknowns, None, [theta]
    history = tuple(x if x.has_points else replace(x, sensors=()) for x in problem.history)
    shown = replace(problem, history=history)
    if shown.fitted:
        near = near_shapes(shown, theta)
        starts = [near.point.theta]
    else:
        problem, theta = _by_stiffness(problem, theta)
        starts = [*_rolled(unknowns, theta)]
    begun: list[Point] = []
    unseen = np.array([not item.has_points for item in problem.measured])
    for start in starts:
        values = _predicted(problem, Values(start, *measured_shapes(problem)), unseen)
        if near is not None:
            values = _with_shapes_of(near, problem, values)
        problem = problem if problem.weights else problem.weighed(values)
        point = problem.balanced(values)
        begun += [] if point is None else [point]
    if not begun:
        names = [item.pose.name for item in problem.fit_poses if not item.has_points]
        raise EstimationError(
            "poses with readings alone have no equilibrium where the search begins, at a bending "
            f"stiffness of {unknowns.p(starts[0])[0]:.3g} N m^2: {', '.join(names)}.\n"
            "  Try: check the units of mass, length and readings, and the ends of these poses."
        )
    likely = sorted(begun, key=lambda point: point.objective)[:FOLLOWED]
    found = [descend(Fit(problem, point), tolerance=NEARLY) for point in likely]
    best = min(found, key=lambda fit: fit.point.objective)
    for _ in range(ROUNDS):
        other = _predicted_again(best)
        if other is None or other.point.objective > best.point.objective - NEARLY:
            break
        best = other
    return best


def _by_stiffness(problem: Problem, theta: FloatArray) -> tuple[Problem, FloatArray]:
    """Start of the unknowns by readings alone, with a first guess of their noise there."""
    unknowns, model, own = problem.unknowns, problem.unknowns.model, problem.noise.readings
    plain = replace(model, cable=replace(model.cable, straight=True), effects=(), priors={})
    mesh = min(model.n, SearchSettings.of(model).mesh)
    found = fit_stiffness(plain.with_mesh(mesh), problem.history, own)
    p = unknowns.p(theta)
    p[model.stiffness_indices] *= found.EI / p[0]
    known = (own.force if own.force_known else None, own.moment if own.moment_known else None)
    noise = first_reading_noise(model, *known, stiffness=found.EI)
    problem = replace(problem, noise=replace(problem.noise, readings=noise), weights=None)
    return problem, unknowns.pack(p, unknowns.coefficients(theta))


def _rolled(unknowns: Unknowns, theta: FloatArray) -> Iterator[FloatArray]:
    """Theta (size,) with each trial roll of the cable in its end clamp, if it has one."""
    own = unknowns.names.index(END_ROLL) if END_ROLL in unknowns.names else None
    for roll in ROLLS if own is not None else ROLLS[:1]:
        rolled = theta.copy()
        if own is not None:
            rolled[own] += roll / unknowns.scales[own]
        yield rolled


def _predicted(problem: Problem, values: Values, among: BoolArray) -> Values:
    """Values with the poses `among` (m,) as predicted from their ends; those without stay."""
    model, (shapes, p, rest) = problem.unknowns.model, problem.state(values)
    poses = [item.pose for item in problem.history]
    wanted = [k for k, taken in zip(problem.indices, among, strict=True) if taken]
    if model.has_state or any(pose.branch == "previous" for pose in poses):
        found = predict_poses(model, p, rest, poses)
        predictions = {k: found[k] for k in wanted}
    else:
        predictions = dict(
            zip(wanted, predict_each(model, p, rest, [poses[k] for k in wanted]), strict=True)
        )
    x, lam, deviation = shapes.x.copy(), shapes.lam.copy(), shapes.deviation.copy()
    for j, k in enumerate(problem.indices):
        one = predictions.get(k)
        if one is not None:
            x[j], lam[j], deviation[j] = one.equilibrium.x, one.equilibrium.multipliers, 0.0
    return replace(values, shapes=Shapes(x, lam, deviation))


def _with_shapes_of(near: Fit, problem: Problem, values: Values) -> Values:
    """Values with the shapes and the places of points of those poses that another fit has."""
    shapes, places = values.shapes, [*values.projections]
    known = [j for j, k in enumerate(near.problem.indices) if k in near.problem.fitted]
    at = np.array([problem.indices.index(near.problem.indices[j]) for j in known])
    shapes = shapes.replaced(at, near.point.shapes.subset(np.array(known)))
    for k, place in zip(near.problem.fitted, near.point.projections, strict=True):
        places[problem.fitted.index(k)] = place
    return replace(values, shapes=shapes, projections=places)


def _outlying(fit: Fit) -> BoolArray:
    """Which fitted poses (used,) with readings alone leave far more than most poses do."""
    left = np.array([residual @ residual / len(residual) for residual in fit.point.residuals])
    unseen = np.array([not item.has_points for item in fit.problem.fit_poses])
    usual = float(np.quantile(left, 1 - FEW, method="lower"))
    return np.asarray(unseen & (left > APART * max(1.0, usual)))


def _predicted_again(fit: Fit) -> Fit | None:
    """The minimum after outlying poses are predicted by a fit of the others; None without any.

    Not where a pose leaves its mark on the next one.
    """
    problem, apart = fit.problem, _outlying(fit)
    if problem.unknowns.model.has_state or not apart.any() or apart.all():
        return None
    index = np.array(problem.used)
    led = _fitted_to(fit, np.flatnonzero(~apart))
    values = replace(fit.point, theta=led.point.theta)
    again = _predicted(problem, values, np.isin(np.arange(problem.equilibria.m), index[apart]))
    shapes = again.shapes.replaced(index[~apart], led.point.shapes)
    point = problem.balanced(replace(again, shapes=shapes))
    return None if point is None else descend(Fit(problem, point), tolerance=NEARLY)


def _fitted_to(fit: Fit, chosen: IntArray) -> Fit:
    """The minimum of some of the fitted poses, from a fit of all."""
    problem, point = fit.problem, fit.point
    few = replace(
        problem,
        history=tuple(problem.fit_poses[k] for k in chosen),
        weights=tuple(problem.whitening[k] for k in chosen),
    )
    values = Values(
        point.theta,
        point.shapes.subset(np.array([problem.used[k] for k in chosen])),
        [point.projections[k] for k in chosen],
    )
    return descend(Fit(few, few.evaluate(values)), tolerance=NEARLY)
