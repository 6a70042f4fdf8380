"""The start of a fit to poses with readings of forces and moments alone, which show no shape.

Such a pose has several equilibria, and only its readings tell in which of them it was measured.
Shapes and unknowns are found in turn: each pose takes that of all its equilibria which is nearest
to its readings, then the unknowns move to their minimum, until no pose takes another one. At first
readings count as noisy as the cable's forces are large, so that a pose in a wrong equilibrium
hardly pulls the unknowns. They begin at the minimum of the poses that have points; without any, at
a stiffness at which a cable that is straight at rest gives readings as large as those measured, or
half or twice as large ones, and at several rolls of its end, until a start explains the readings.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.equilibrium.equilibrium import NEARBY, with_equilibrium
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import MISFIT_GAIN, NEARLY, descend
from dlo_casadi.estimation.measured_shapes import measured_shapes
from dlo_casadi.estimation.prediction import predict_every, predict_poses
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import FOLLOWED, ROLLS, SearchSettings
from dlo_casadi.estimation.unknowns import Unknowns, Values
from dlo_casadi.estimation.variances import first_reading_noise
from dlo_casadi.model.cable_model import END_ROLL

# Noise of the readings in the first search, relative to the forces in the cable.
LOOSE = 1.0
# Mean square of the readings over that noise below which a start explains them. Evidence: of 100
# starts of five sessions, right minima left 0.003 to 0.01, wrong ones 0.5 to 2.6.
EXPLAINED = 0.05
# First stiffnesses, relative to that at which readings are as large as measured.
STIFFER = (1.0, 0.5, 2.0)
# Largest factor in one step to that stiffness; logarithm of a factor that ends the search.
FARTHEST, NEAR = 30.0, 0.2
# Maximum number of times that poses take another equilibrium, at each noise; of these steps.
ROUNDS = 8


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
        problem, theta = _by_size(problem, theta)
        starts = [*_starts(unknowns, theta)]
    begun: list[Fit] = []
    loose = _loosened(problem, starts[0])
    for start in starts:
        values = Values(start, *measured_shapes(problem))
        if near is not None:
            values = _with_shapes_of(near, problem, values)
        loose = loose if loose.weights else loose.weighed(values)
        fit = _alternated(loose, values, known=False)
        begun += [] if fit is None else [fit]
        if fit and fit.point.data < EXPLAINED * loose.n_residuals:
            begun = [fit]
            break
    if not begun:
        names = [item.pose.name for item in problem.fit_poses if not item.has_points]
        raise EstimationError(
            "poses with readings alone have no equilibrium where the search begins, at a bending "
            f"stiffness of {unknowns.p(starts[0])[0]:.3g} N m^2: {', '.join(names)}.\n"
            "  Try: check the units of mass, length and readings, and the ends of these poses."
        )
    likely = sorted(begun, key=lambda fit: fit.point.objective)[:FOLLOWED]
    problem = problem.weighed(likely[0].point)
    found = [_alternated(problem, fit.point, known=True) for fit in likely]
    best = min((fit for fit in found if fit), key=lambda fit: fit.point.objective, default=None)
    return best or likely[0].reweighed(problem.noise)


def _by_size(problem: Problem, theta: FloatArray) -> tuple[Problem, FloatArray]:
    """Start of the unknowns by readings alone, with a first guess of their noise there.

    The stiffness at which a cable that is straight at rest gives readings as large as those
    measured. That of least squares is too small, to any degree: what a rest curvature adds to the
    readings hardly resembles those of a straight cable.
    """
    unknowns, model, own = problem.unknowns, problem.unknowns.model, problem.noise.readings
    plain = replace(model, cable=replace(model.cable, straight=True), effects=(), priors={})
    plain = plain.with_mesh(min(model.n, SearchSettings.of(model).mesh))
    p, rest = plain.nominal.copy(), np.zeros(plain.chain.n_rests)
    for _ in range(ROUNDS):
        found = predict_poses(plain, p, rest, [item.pose for item in problem.history])
        both = [
            (np.array(pair) * (model.cable.length if "force" in name else 1.0)).reshape((2, -1))
            for k, item in zip(problem.fitted, problem.fit_poses, strict=True)
            if (one := found[k]) is not None
            for name, pair in item.readings_beside(one.seen).items()
        ]
        sizes = [np.linalg.norm(part) for part in np.hstack(both)] if both else [1.0, 1.0]
        ratio = float(np.clip(sizes[0] / max(sizes[1], 1e-300), 1 / FARTHEST, FARTHEST))
        p[plain.stiffness_indices] *= ratio
        if abs(np.log(ratio)) < NEAR:
            break
    start = unknowns.p(theta)
    start[model.stiffness_indices] *= p[0] / start[0]
    known = (own.force if own.force_known else None, own.moment if own.moment_known else None)
    noise = first_reading_noise(model, *known, stiffness=float(p[0]))
    problem = replace(problem, noise=replace(problem.noise, readings=noise), weights=None)
    return problem, unknowns.pack(start, unknowns.coefficients(theta))


def _starts(unknowns: Unknowns, theta: FloatArray) -> Iterator[FloatArray]:
    """Theta (size,) with each first stiffness and trial roll of the cable in its end clamp."""
    own = unknowns.names.index(END_ROLL) if END_ROLL in unknowns.names else None
    for factor in STIFFER:
        p = unknowns.p(theta)
        p[unknowns.model.stiffness_indices] *= factor
        for roll in ROLLS if own is not None else ROLLS[:1]:
            start = unknowns.pack(p, unknowns.coefficients(theta))
            if own is not None:
                start[own] += roll / unknowns.scales[own]
            yield start


def _loosened(problem: Problem, theta: FloatArray) -> Problem:
    """The problem with a noise of its readings that is as large as the cable's forces."""
    unknowns, own = problem.unknowns, problem.noise.readings
    size = first_reading_noise(unknowns.model, stiffness=unknowns.p(theta)[0], share=LOOSE)
    force, moment = max(own.force, size.force), max(own.moment, size.moment)
    noise = replace(problem.noise, readings=replace(own, force=force, moment=moment))
    return replace(problem, noise=noise, weights=None)


def _alternated(problem: Problem, values: Values, known: bool) -> Fit | None:
    """Minimum after poses and unknowns have moved in turn; None without equilibria to begin at.

    `known`: whether the poses are in equilibria at these values.
    """
    best = None
    for _ in range(ROUNDS):
        values, moved = _nearest(problem, values, known or best is not None)
        if best and not moved:
            break
        point = problem.balanced(values)
        fit = (
            None
            if point is None
            else descend(Fit(problem, point), tolerance=NEARLY, share=MISFIT_GAIN)
        )
        if fit is None or (best and fit.point.objective > best.point.objective - NEARLY):
            break
        best, values = fit, fit.point
    return best


def _nearest(problem: Problem, values: Values, known: bool) -> tuple[Values, bool]:
    """Values with poses of readings alone in the equilibria nearest to them; whether any moved.

    `known`: whether they are in equilibria now, which they leave only for nearer others.
    """
    model, (shapes, p, rest) = problem.unknowns.model, problem.state(values)
    if model.has_state and known:
        return values, False
    every = predict_every(model, p, rest, [item.pose for item in problem.history])
    own = ((problem.own_deviations(values) / problem.deviation_std) ** 2).sum(axis=1)
    seen, moved = problem.observed(values), False
    for k, (j, item) in enumerate(zip(problem.used, problem.fit_poses, strict=True)):
        if item.has_points:
            continue
        least = _misread(problem, k, seen[j]) + float(own[k]) if known else np.inf
        for other in every[problem.fitted[k]]:
            left, eq = _misread(problem, k, other.seen), other.equilibrium
            if left < least and not (known and model.node.same(eq.x, shapes.x[j], NEARBY)):
                least, moved = left, True
                shapes = with_equilibrium(shapes, j, eq)
    return replace(values, shapes=shapes), moved


def _misread(problem: Problem, k: int, seen: Observed) -> float:
    """Sum of squares that the readings of fitted pose k leave beside those predicted."""
    residual = problem.fit_poses[k].residual(seen, np.zeros(0))
    return float(((problem.whitening[k] @ residual) ** 2).sum())


def _with_shapes_of(near: Fit, problem: Problem, values: Values) -> Values:
    """Values with the shapes and the places of points of those poses that another fit has."""
    shapes, places = values.shapes, [*values.projections]
    known = [j for j, k in enumerate(near.problem.indices) if k in near.problem.fitted]
    at = np.array([problem.indices.index(near.problem.indices[j]) for j in known])
    shapes = shapes.replaced(at, near.point.shapes.subset(np.array(known)))
    for k, place in zip(near.problem.fitted, near.point.projections, strict=True):
        places[problem.fitted.index(k)] = place
    return replace(values, shapes=shapes, projections=places)
