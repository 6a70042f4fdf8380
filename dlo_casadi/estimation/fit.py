"""Fit of a model to all measured poses: the best of some starts, on a mesh that is fine enough."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend, on_other_mesh, refit
from dlo_casadi.estimation.problem import Priors, Problem, Values
from dlo_casadi.estimation.relaxation import SOFTNESS, relaxed
from dlo_casadi.estimation.repeats import different_poses, with_repeats
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import ROLLS, starting_points
from dlo_casadi.estimation.unknowns import DECADES, Search, Unknowns
from dlo_casadi.estimation.variances import (
    SCATTER_FLOOR,
    SMOOTH_MODES,
    errors_of,
    first_reading_noise,
    refine,
)
from dlo_casadi.model.cable_model import END_ROLL, CableModel, Tolerances
from dlo_casadi.model.rest_curvature import RestScatter
from dlo_casadi.rod.chain import ELEMENTS
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise
from dlo_casadi.thresholds import DIFFERENT, LACKING_SHARE, MESH_SHARE

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
# Standard deviation of points over length by which a fit weighs them that meets them no better.
MISFIT_STD = 0.01
# A first guess of an undeclared noise, only until it has been estimated.
FIRST_STD = 3e-4
# Rise of the objective from a mesh to the next finer one by which a fit has got stuck: of two poses
# in space 20 elements left 280 and 40 left 6327, while two meshes of a fit differ by a few percent.
STUCK = 2.0
# Turns per length, several times what heavy cables were measured to have, 0.1 to 0.3 1/m.
FIRST_REST_TURNS = 0.05
FINEST_MESH = 160
# The search for missing effects, a hundred refits, runs on at most so many elements.
SEARCH_MESH = 80


def fit_model(
    model: CableModel,
    measured: Sequence[MeasuredPose],
    tolerances: Tolerances,
    std: float | None = None,
    *,
    free: Sequence[str] | None = None,
    values: FloatArray | None = None,
    decades: Sequence[float] = DECADES,
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
        Names of the parameters to estimate; all by default.
    values : (n_parameters,), optional
        Where the parameters start, or stay if they are not estimated; nominal by default.
    decades : sequence of float
        Stiffnesses to start from, powers of ten about the prior.
    readings : ReadingNoise, optional
        Noise of forces and moments on the fixtures; estimated by default.

    Raises
    ------
    EstimationError
        If there is no fit pose, or no start leads to an equilibrium near the measured shapes.
    """
    count = sum(item.readable and not item.held_out for item in measured)
    if not count:
        raise EstimationError(
            "no pose to fit: every pose is held out or could not be read.\n"
            "  Try: role: fit for at least one pose."
        )
    begin = model.nominal if values is None else values
    chosen = np.isin(model.names, model.names if free is None else free)
    unknowns = Unknowns(model, chosen, begin)
    noise = NoiseModel(FIRST_STD)
    if std is not None:
        declared = NoiseModel(std, source="declared")
        noise = with_repeats(declared, measured, model.cable.length)
    noise = replace(noise, readings=readings or first_reading_noise(model))
    priors = Priors.of(tolerances, model)
    if count == 1:
        # One pose does not deviate from others: what is wrong with it is wrong with the session.
        priors = replace(priors, scatter=SCATTER_FLOOR * priors.scatter)
    problem = Problem(unknowns, tuple(measured), noise, priors)
    theta = unknowns.pack(begin, np.zeros(model.n_coefficients))
    fit = _searched(problem, theta, decades)
    different = different_poses(measured, model.cable.length)
    astray = fit.residual_rms > Search.of(model).astray * model.cable.length
    if different >= DIFFERENT and fit.beyond_noise and astray:
        # A fit that trusts each line to its noise bends rest shape and stiffness to whatever is
        # left: search once more as if every repeat had a rest curvature of its own.
        first = RestScatter(FIRST_REST_TURNS * model.cable.curvature_scale)
        noise = fit.noise if std is not None and fit.noise.source == "estimated" else noise
        loose = replace(problem, noise=noise, priors=replace(priors, rest_scatter=first))
        near = _found(loose, theta, decades)
        try:
            others = [refine(near, first=True)] if near and _scatters(near) else []
        except EstimationError:
            return fit
        return max([fit, *others], key=lambda found: found.log_evidence)
    return fit


def _scatters(fit: Fit) -> bool:
    """Whether what a point leaves differs from repeat to repeat, and not as their shapes do."""
    return errors_of(fit, estimated=not fit.noise.known, repeats=False)[1].std > 0


def _searched(problem: Problem, theta: FloatArray, decades: Sequence[float]) -> Fit:
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
    if misfits(best):
        if END_ROLL in problem.unknowns.names:
            other = _search(problem, theta, decades, FAR_ROLLS, either_way=True)
            lower = other is not None and other.point.objective < best.point.objective
            best = other if other is not None and lower else best
        if misfits(best):
            return _fit_to_misfit(best)
    return refine(best, first=True)


def _found(problem: Problem, theta: FloatArray, decades: Sequence[float]) -> Fit | None:
    """The best minimum from starts over decades of stiffness; of many poses, of a part first."""
    best = None
    if len(problem.used) > POSES_OF_A_SEARCH and not problem.unknowns.model.has_state:
        kept = problem.fitted[:: -(-len(problem.fitted) // POSES_OF_A_SEARCH)]
        thinned = replace(problem, history=tuple(problem.history[k] for k in kept))
        rough = _search(thinned, theta, decades)
        best = rough and _search(problem, rough.point.theta, (0,))
    return best or _search(problem, theta, decades)


def misfits(fit: Fit) -> bool:
    """Whether a fit leaves so much that its model lacks something."""
    return fit.residual_rms > Search.of(fit.model).misfit * fit.model.cable.length


def _search(
    problem: Problem,
    theta: FloatArray,
    decades: Sequence[float],
    rolls: Sequence[float] = ROLLS,
    *,
    either_way: bool = False,
) -> Fit | None:
    """The best of the minima that the starts over decades of stiffness lead to.

    In space the search takes the points for less sure than they are: where an effect is missing,
    shapes that are held to a fraction of a millimetre allow no way to the minimum.
    """
    noise, loosely = problem.noise, loosened(problem.noise, problem.unknowns.model)
    begun = replace(problem, noise=loosely)
    starts: list[Fit] = []
    for tried in (decades, BETWEEN_DECADES):
        starts = starts or starting_points(begun, theta, tried, rolls, either_way=either_way)
    found = fit_from(starts)
    return found if found is None or loosely is noise else found.reweighed(noise)


def loosened(noise: NoiseModel, model: CableModel) -> NoiseModel:
    """Noise by which a search weighs the points."""
    return noise.doubted(Search.of(model).std * model.cable.length)


def fit_relaxed(
    problem: Problem, values: Values, softness: Sequence[float] = SOFTNESS
) -> Fit | None:
    """The minimum that relaxed values lead to; None if some pose has no equilibrium there."""
    point = problem.balanced(relaxed(problem, values, softness), max_iterations=40)
    return None if point is None else descend(Fit(problem, point), tolerance=1e-2)


def fit_from(starts: Sequence[Fit]) -> Fit | None:
    """The best minimum that some starts lead to, the most promising first."""
    best: Fit | None = None
    for start in starts:
        found = descend(start, STEPS_OF_A_RIVAL if best else 40, tolerance=1e-2)
        if best is None or _better(found, best):
            best = found
        elif abs(found.point.objective - best.point.objective) < 1.0:
            break
    return best


def _better(fit: Fit, other: Fit) -> bool:
    """Whether a minimum is clearly lower than another, or only the other's GJ over EI is odd."""
    odd, others = (one.problem.unknowns.odd_ratio(one.point.theta) for one in (fit, other))
    return others if odd != others else fit.point.objective < other.point.objective - 0.5


def _fit_to_misfit(near: Fit) -> Fit:
    """Fit a model that lacks something, its points taken for no surer than it can meet them.

    Where an effect is missing, a fit to a fraction of a millimetre bends all that it may bend and
    ends in folds of single poses.
    """
    doubted = near.noise.doubted(MISFIT_STD * near.model.cable.length)
    noise = replace(doubted, source="misfit", before=near.noise)
    return descend(near.reweighed(noise, _first_priors(near)))


def _first_priors(fit: Fit) -> Priors:
    return Priors.of(fit.problem.priors.tolerances, fit.model)


# ---- meshes ------------------------------------------------------------------------------------


def refine_mesh(fit: Fit, n: int, modes: int = SMOOTH_MODES) -> Fit:
    """Fit the same model on another mesh, from a fit's minimum.

    Parameters
    ----------
    modes : int
        Slow displacements kept out of the noise estimate, if the noise is estimated.
    """
    model, moved = fit.model.with_mesh(n), None
    with suppress(EstimationError):
        moved = refit(fit, model)
    if moved is None or moved.point.objective > STUCK * fit.point.objective:
        # The coarse mesh was too far off, or a pose loses its stability on the way to this one, so
        # that no step leads on: start again from the measured shapes.
        problem, known = fit.problem, fit.noise.before or fit.noise
        return fit_model(
            model,
            problem.history,
            problem.priors.tolerances,
            known.std if known.source == "declared" else None,
            free=problem.unknowns.names,
            values=fit.p,
            readings=known.readings,
        )
    return refine(moved, rounds=2, modes=modes)


def mesh_error(fit: Fit) -> float:
    """Largest RMS distance [m] between a pose on this mesh and on an infinitely fine one.

    The difference to the mesh of half the element size, times 4/3: the error falls at least with
    the square of the element size (Richardson). Infinite if the fitted parameters have no
    equilibria nearby on the finer mesh.
    """
    model = fit.model.with_mesh(2 * fit.model.n)
    equilibria = BatchEquilibrium(model, [item.pose for item in fit.problem.measured])
    state = fit.p, model.rest_basis @ fit.coefficients
    start = on_other_mesh(fit.point.shapes, fit.model, model)
    shapes, converged = equilibria.solve(start, *state)
    if not converged.all():
        return float("inf")
    fine = equilibria.seen(shapes, *state)
    places = np.linspace(0.0, fit.model.cable.length, 101)
    worst = 0.0
    for true, seen in zip(fine, fit.problem.observed(fit.point), strict=True):
        gap = true.curve.at(places) - seen.curve.at(places)
        worst = max(worst, float(np.sqrt((gap**2).sum(axis=1).mean())))
    return 4 / 3 * worst


def fine_enough(
    fit: Fit, n: int, modes: int = SMOOTH_MODES, finest: int = FINEST_MESH
) -> tuple[Fit, float]:
    """Refine a fit's mesh, from n elements on, until its error [m] is far below the noise.

    Where an effect is missing, the mesh need not be much finer than what is missing.
    """
    while True:
        if fit.noise.source == "misfit":
            return fit, mesh_error(fit)
        if n != fit.model.n:
            fit = refine_mesh(fit, n, modes)
        error = mesh_error(fit)
        largest = finest if np.isfinite(error) else SEARCH_MESH
        allowed = allowed_mesh_error(fit)
        if error <= allowed or n >= largest:
            return fit, error
        # Even; carefully: as if half of what lies above the second order were lost on a coarse
        # mesh.
        order = 1 + ELEMENTS[fit.model.element].order / 2
        finer = n * np.clip((error / allowed) ** (1 / order), 1.2, 2.0)
        n = min(2 * int(np.ceil(finer / 2)), largest)


def allowed_mesh_error(fit: Fit) -> float:
    """Error of the mesh [m] that is far below the noise, or below what else is left."""
    left = LACKING_SHARE if fit.beyond_noise else MESH_SHARE
    return max(MESH_SHARE * fit.compared_std, left * fit.residual_rms)
