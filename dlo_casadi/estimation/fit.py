"""Fit of a model to all measured poses: the best of some starts, or from a similar fit."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.gauss_newton import BatchProblem
from dlo_casadi.estimation.hyperparameters import (
    SCATTER_FLOOR,
    SMOOTH_MODES,
    errors_of,
    first_reading_noise,
    refine,
)
from dlo_casadi.estimation.linearization import Point
from dlo_casadi.estimation.repeats import different_poses, with_repeats
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.starting_points import DECADES, ROLLS, starting_points
from dlo_casadi.estimation.transfer import carried_projections, carried_shapes
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.cable_model import END_ROLL, CableModel, Tolerances
from dlo_casadi.model.rest_curvature import RestScatter
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise
from dlo_casadi.thresholds import DIFFERENT

FloatArray = NDArray[np.floating]

# Tried where from those nothing comes near, all twists either way round: a cable rolled by 2.05 rad
# was not found, nor one by 2.3 rad of which one pose's twist came within 0.1 rad of half a turn.
FAR_ROLLS = (0.0, 1.0, -1.0, 2.0, -2.0)
BETWEEN_DECADES = (-0.5, 0.5, -1.5, 1.5, -2.5, 2.5, -3.5, 3.5)
# Of many poses only so many, evenly picked, are searched for where to start with all.
POSES_OF_A_SEARCH = 40
# Iterations in which a start that is not the first has to come below the best minimum. In one
# session in space two rivals crept for 40 along a valley in which weight hardly tells. A
# judgement, not a measured limit.
STEPS_OF_A_RIVAL = 10
# Standard deviation of points in a search in space, over the length. Of three sessions in which an
# effect is missing, one (space_flat) found its minimum at the noise, too; at 3 mm two did, and one
# with a drift in neither. A judgement.
SEARCH_STD = 0.004
# RMS distance over length that a search in space leaves, from which on the model lacks something,
# and the standard deviation over length by which such a fit weighs the points. In four sessions in
# which an effect is missing the searches left 0.0025 to 0.0083, in three with nothing or little
# missing 0.0008 to 0.0013. Either stiffness of such a fit may be far off (a taper's torsion 0.0005
# of 0.005 N m^2): what is missing is looked for from the measured shapes.
MISFIT, MISFIT_STD = 0.002, 0.01
# RMS distance over length from which a search in the plane may have gone astray, because every
# hanging has a rest curvature of its own. Of 26 sessions 16 left less; no second search led
# elsewhere there.
ASTRAY = 0.001
# A first guess of an undeclared noise, only until it has been estimated.
FIRST_STD = 3e-4
ROUGHNESS_START = 0.3
# Rise of the objective from a mesh to the next finer one by which a fit has got stuck: of two poses
# in space 20 elements left 280 and 40 left 6327, while two meshes of a fit differ by a few percent.
STUCK = 2.0
# Turns per length, several times what heavy cables were measured to have, 0.1 to 0.3 1/m.
FIRST_REST_TURNS = 0.05


def fit_model(
    model: CableModel,
    measured: Sequence[MeasuredPose],
    tolerances: Tolerances,
    std: float | None = None,
    *,
    free: Sequence[str] | None = None,
    values: FloatArray | None = None,
    start: Fit | None = None,
    decades: Sequence[float] = DECADES,
    max_iterations: int = 40,
    readings: ReadingNoise | None = None,
) -> Fit:
    """Fit a model to all readable fit poses.

    Parameters
    ----------
    model : CableModel
    measured : sequence of MeasuredPose
        All poses in the order in which they were taken.
    tolerances : Tolerances
    std : float, optional [m]
        Declared noise of one coordinate; estimated, with its correlation, when absent.
    free : sequence of str, optional
        Names of the parameters to estimate; by default all but those that `start` keeps fixed.
    values : (n_parameters,), optional
        Where the parameters start, or stay if they are not estimated; by default where `start`
        has them, nominal where it does not know them.
    start : Fit, optional
        A fit of a similar model on the same mesh to start from; its noise is kept, and what it
        has found of the parameters that are estimated.
    decades : sequence of float
        Stiffnesses to start from, powers of ten about the prior.
    max_iterations : int
        Of a fit that continues from `start`.
    readings : ReadingNoise, optional
        Noise of forces and moments on the fixtures; estimated by default.

    Raises
    ------
    EstimationError
        If there is no fit pose, or no start leads to an equilibrium near the measured shapes.
    """
    if not any(item.readable and not item.held_out for item in measured):
        raise EstimationError(
            "no pose to fit: every pose is held out or could not be read.\n"
            "  Try: role: fit for at least one pose."
        )
    if free is not None:
        chosen = np.array([name in free for name in model.names])
    else:
        chosen = np.ones(len(model.names), dtype=bool) if start is None else start.free_in(model)
    if values is not None:
        begin = values
    else:
        begin = model.nominal if start is None else start.values_in(model)
    unknowns = Unknowns(model, chosen, begin)
    if start is not None:
        return _continue(unknowns, measured, start, max_iterations)
    noise = NoiseModel(FIRST_STD)
    if std is not None:
        declared = NoiseModel(std, source="declared")
        noise = with_repeats(declared, measured, model.cable.length)
    noise = replace(noise, readings=readings or first_reading_noise(model))
    scatter = tolerances.deviation(model.node)
    count = sum(item.readable and not item.held_out for item in measured)
    if count == 1:
        # One pose does not deviate from others: what is wrong with it is wrong with the session.
        scatter = SCATTER_FLOOR * scatter
    problem = BatchProblem(unknowns, measured, noise, tolerances, ROUGHNESS_START, scatter)
    theta = unknowns.pack(begin, np.zeros(model.n_coefficients))
    fit = _searched(problem, theta, decades)
    different = different_poses(measured, model.cable.length)
    astray = fit.beyond_noise and fit.residual_rms > ASTRAY * model.cable.length
    if not model.in_space and different >= DIFFERENT and astray:
        # A fit that trusts each line to its noise bends rest shape and stiffness to whatever is
        # left: search once more as if every hanging had a rest curvature of its own.
        first = RestScatter(FIRST_REST_TURNS * model.cable.curvature_scale)
        noise = fit.noise if std is not None and fit.noise.source == "estimated" else noise
        loose = problem.changed(noise, ROUGHNESS_START, scatter, first)
        near = _found(loose, theta, decades)
        try:
            others = [_refined(loose, near)] if near and _scatters(loose, near) else []
        except EstimationError:
            return fit
        return max([fit, *others], key=lambda found: found.log_evidence)
    return fit


def _scatters(problem: BatchProblem, point: Point) -> bool:
    """Whether what a point leaves differs from hanging to hanging, and not as their shapes do."""
    lin, estimated = problem.linearize(point), not problem.noise.known
    return errors_of(problem, point, lin, estimated=estimated, repeats=False)[1].std > 0


def _searched(problem: BatchProblem, theta: FloatArray, decades: Sequence[float]) -> Fit:
    """The best minimum from starts over decades of stiffness, noise and scatters estimated."""
    model = problem.unknowns.model
    best = _found(problem, theta, decades)
    if best is None:
        raise EstimationError(
            f"no stiffness within {max(decades)} decades of {model.cable.bending_stiffness:.3g} "
            "N m^2 gives an equilibrium near the measured shapes.\n"
            "  Try: check the units of mass and length, the direction of gravity and the order "
            "of the poses."
        )
    if model.in_space and _misfits(problem, best):
        if END_ROLL in problem.unknowns.names:
            other = _search(problem, theta, decades, FAR_ROLLS, either_way=True)
            best = other if other is not None and other.objective < best.objective else best
        if _misfits(problem, best):
            return _fit_to_misfit(problem, best)
    return _refined(problem, best)


def _found(problem: BatchProblem, theta: FloatArray, decades: Sequence[float]) -> Point | None:
    """The best minimum from starts over decades of stiffness; of many poses, of a part first."""
    best = None
    if len(problem.used) > POSES_OF_A_SEARCH and not problem.unknowns.model.has_state:
        rough = _search(problem.thinned(POSES_OF_A_SEARCH), theta, decades)
        best = rough and _search(problem, rough.theta, (0,))
    return best or _search(problem, theta, decades)


def _refined(problem: BatchProblem, near: Point) -> Fit:
    """A minimum with noise, roughness and scatters estimated."""
    return Fit(*refine(problem, near, estimate=not problem.noise.known, first=True))


def _misfits(problem: BatchProblem, point: Point) -> bool:
    """Whether a point leaves more than MISFIT."""
    rms = Fit(problem, point, converged=False).residual_rms
    return rms > MISFIT * problem.unknowns.model.cable.length


def _search(
    problem: BatchProblem,
    theta: FloatArray,
    decades: Sequence[float],
    rolls: Sequence[float] = ROLLS,
    *,
    either_way: bool = False,
) -> Point | None:
    """The best of the minima that the starts over decades of stiffness lead to.

    In space the search takes the points for less sure than they are: where an effect is missing,
    shapes that are held to a fraction of a millimetre allow no way to the minimum.
    """
    loosely = problem.noise.doubted(SEARCH_STD * problem.unknowns.model.cable.length)
    if not problem.unknowns.model.in_space or loosely is problem.noise:
        return _best(problem, theta, decades, rolls, either_way=either_way)
    rest = problem.rest_scatter
    loose = problem.changed(loosely, problem.roughness_std, problem.scatter, rest)
    found = _best(loose, theta, decades, rolls, either_way=either_way)
    if found is None:
        return None
    return problem.taken_over(found)


def _fit_to_misfit(problem: BatchProblem, near: Point) -> Fit:
    """Fit a model that lacks something, its points taken for no surer than it can meet them.

    Where an effect is missing, a fit to a fraction of a millimetre bends all that it may bend and
    ends in folds of single poses.
    """
    model, known = problem.unknowns.model, problem.noise
    noise = replace(known.doubted(MISFIT_STD * model.cable.length), source="misfit", before=known)
    scatter = problem.tolerances.deviation(model.node)
    loose = problem.changed(noise, ROUGHNESS_START, scatter, RestScatter())
    point = loose.taken_over(near)
    return Fit(loose, *loose.descend(point))


def fitted_closely(fit: Fit) -> Fit:
    """A fit to its misfit, continued to the noise; itself where more than noise is left.

    Raises
    ------
    EstimationError
        If the points are hardly more than the unknowns that they determine.
    """
    problem, known = fit.problem, fit.noise.before
    assert known is not None
    length = fit.model.cable.length
    # Through the scale of the search: at the noise a first step would bend all that is left.
    loosely = known.doubted(SEARCH_STD * length)
    loose = problem.changed(loosely, problem.roughness_std, problem.scatter, problem.rest_scatter)
    near, _ = loose.descend(loose.taken_over(fit.point), STEPS_OF_A_RIVAL, tolerance=1e-2)
    if _misfits(loose, near):
        return fit
    scatter = problem.tolerances.deviation(fit.model.node)
    tight = problem.changed(known, ROUGHNESS_START, scatter, RestScatter())
    closely = _refined(tight, tight.taken_over(near))
    return fit if _misfits(closely.problem, closely.point) else closely


def _best(
    problem: BatchProblem,
    theta: FloatArray,
    decades: Sequence[float],
    rolls: Sequence[float] = ROLLS,
    *,
    either_way: bool = False,
) -> Point | None:
    """Descend from the most promising starts."""
    points: list[Point] = []
    for tried in (decades, BETWEEN_DECADES):
        points = points or starting_points(problem, theta, tried, rolls, either_way=either_way)
    best: Point | None = None
    for point in points:
        steps = STEPS_OF_A_RIVAL if best else 40
        candidate, _ = problem.descend(point, steps, tolerance=1e-2)
        if best is None or _better(problem, candidate, best):
            best = candidate
        elif abs(candidate.objective - best.objective) < 1.0:
            break
    return best


def _better(problem: BatchProblem, point: Point, other: Point) -> bool:
    """Whether a minimum is clearly lower than another, or only the other's GJ over EI is odd."""
    odd, others = (problem.unknowns.odd_ratio(one.theta) for one in (point, other))
    return others if odd != others else point.objective < other.objective - 0.5


def _continue(
    unknowns: Unknowns,
    measured: Sequence[MeasuredPose],
    start: Fit,
    max_iterations: int = 40,
) -> Fit:
    """Fit a similar model from the minimum of another one, with the noise found there."""
    model = unknowns.model
    known = np.array([name in start.model.names for name in model.names])
    p = np.where(known & unknowns.free, start.values_in(model), unknowns.fixed)
    unknowns = replace(unknowns, fixed=p)
    theta = unknowns.pack(p, start.coefficients)
    problem = start.problem.of(unknowns, measured)
    shapes, solved = problem.equilibria.solve(
        carried_shapes(problem, start), p, unknowns.rest(theta)
    )
    if not solved.all():
        raise EstimationError("the shapes of the first fit are no equilibria of the second model")
    projections = carried_projections(problem, start)
    problem.share_weights(start.problem)
    point = problem.evaluate(theta, shapes, projections)
    point, converged = problem.descend(point, max_iterations)
    return Fit(problem, point, converged)


def refine_mesh(fit: Fit, n: int, modes: int = SMOOTH_MODES) -> Fit:
    """Fit the same model on another mesh, from a fit's minimum.

    Parameters
    ----------
    modes : int
        Slow displacements kept out of the noise estimate, if the noise is estimated.
    """
    problem = fit.problem
    model = fit.model.with_mesh(n)
    unknowns = replace(problem.unknowns, model=model)
    moved = None
    with suppress(EstimationError):
        moved = _continue(unknowns, problem.history, fit)
    if moved is None or moved.point.objective > STUCK * fit.point.objective:
        # The coarse mesh was too far off, or a pose loses its stability on the way to this one, so
        # that no step leads on: start again from the measured shapes.
        names = [name for name, free in zip(model.names, unknowns.free, strict=True) if free]
        known = fit.noise.before or fit.noise
        std = known.std if known.source == "declared" else None
        return fit_model(
            model,
            problem.history,
            problem.tolerances,
            std,
            free=names,
            values=fit.p,
            readings=known.readings,
        )
    problem, point, converged = refine(
        moved.problem, moved.point, estimate=not fit.noise.known, rounds=2, modes=modes
    )
    return Fit(problem, point, converged)
