"""Fit of a model to all measured poses, on a mesh that is fine enough."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import Setup
from dlo_casadi.effects.cable import height_of
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import MISFIT_GAIN, descend, on_other_mesh, refit
from dlo_casadi.estimation.measured_shapes import measured_shapes
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.readings_alone import minimum_of_readings
from dlo_casadi.estimation.repeats import enough_poses, with_repeats
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import SearchSettings, begin, fit_from, weighed
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.estimation.variances import (
    SCATTER_FLOOR,
    SMOOTH_MODES,
    errors_of,
    first_reading_noise,
    refine,
)
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.chain import ELEMENTS
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise
from dlo_casadi.thresholds import BEYOND_EFFECTS, LACKING_SHARE, MESH_SHARE, NOTABLE, UNEXPLAINED

# Std of points over length used as weight in a fit whose model cannot meet them any better.
MISFIT_STD = 0.01
# First guess of an undeclared noise, used only until the noise has been estimated.
FIRST_STD = 3e-4
# Growth of the objective from a mesh to the next finer one above which a fit counts as stuck: two
# poses in space left 280 with 20 elements and 6327 with 40; usually meshes differ by a few percent.
STUCK = 2.0
# First std of each repeat's own rest curvature, in turns per length: several times that measured on
# heavy cables, 0.1 to 0.3 1/m.
FIRST_REST_TURNS = 0.05
# Largest chi-square per degree of freedom at which a fit explains its points: random turns of
# 0.06 rad left 1.25 when treated to first order, as random lengths and moments still are.
EXPLAINED = 1.5
FINEST_MESH = 160
# Maximum number of elements in the search for missing effects, which takes a hundred refits.
# Effects that it has found are tested on up to FINEST_MESH.
SEARCH_MESH = 80


def fit_model(
    model: CableModel,
    measured: Sequence[MeasuredPose],
    tolerances: Tolerances,
    std: float | None = None,
    *,
    free: Sequence[str] | None = None,
    values: FloatArray | None = None,
    readings: ReadingNoise | None = None,
    refined: bool = True,
) -> Fit:
    """Fit a model to all readable fit poses.

    Parameters
    ----------
    measured : sequence of MeasuredPose
        All poses in the order in which they were taken.
    std : float, optional [m]
        Declared noise of one coordinate; by default it is estimated, with its correlation.
    free : sequence of str, optional
        Names of the parameters to estimate; all by default.
    values : (n_parameters,), optional
        Start values of the parameters, kept for those not estimated; nominal by default.
    readings : ReadingNoise, optional
        Noise of forces and moments on the fixtures; estimated by default.
    refined : bool
        Whether noise, roughness and scatters are estimated from the residuals.

    Raises
    ------
    EstimationError
        If there is no fit pose, or no equilibrium is found near the measured shapes.
    """
    count = sum(item.readable and not item.held_out for item in measured)
    if not count:
        raise EstimationError(
            "no pose to fit: every pose is held out or could not be read.\n"
            "  Try: role: fit for at least one pose."
        )
    first = model.nominal if values is None else values
    chosen = np.isin(model.names, model.names if free is None else free)
    unknowns = Unknowns(model, chosen, first)
    noise = NoiseModel(FIRST_STD)
    if std is not None:
        declared = NoiseModel(std, source="declared")
        noise = with_repeats(declared, measured, model)
    noise = replace(noise, readings=readings or first_reading_noise(model))
    priors = Priors.of(tolerances, model)
    if count == 1:
        # A single pose has no deviations of its own: its errors are the same as the session's.
        priors = replace(priors, scatter=SCATTER_FLOOR * priors.scatter)
    problem = Problem(unknowns, tuple(measured), noise, priors)
    theta = unknowns.pack(first, np.zeros(model.n_coefficients))
    fit = _minimum(problem, theta)
    if not refined:
        return fit
    fit = fit_to_misfit(fit) if misfits(fit) else refine(fit, first=True)
    doubtful = fit.residual_rms > SearchSettings.of(model).other_minima * model.cable.length
    if enough_poses(measured, model) and fit.beyond_noise and doubtful:
        # A fit that trusts each line to its noise distorts rest shape and stiffness to fit whatever
        # is left: search again with a rest curvature of its own for each repeat.
        scatter = PoseScatter(FIRST_REST_TURNS * model.cable.curvature_scale)
        noise = fit.noise if std is not None and fit.noise.source == "estimated" else noise
        loose = replace(problem, noise=noise, priors=replace(priors, pose_scatter=scatter))
        near = fit_from(*begin(loose, theta))
        with suppress(EstimationError):
            # Residuals of a point must vary between repeats, not systematically with their shapes.
            if near and errors_of(near, estimated=not near.noise.known, repeats=False)[1].std > 0:
                return max(fit, refine(near, first=True), key=lambda found: found.log_evidence)
    return fit


def _minimum(problem: Problem, theta: FloatArray) -> Fit:
    """Minimum near the measured shapes; poses with readings alone begin at their predictions."""
    if all(item.has_points for item in problem.fit_poses):
        return _near_shapes(problem, theta)
    return minimum_of_readings(problem, theta, _near_shapes)


def _near_shapes(problem: Problem, theta: FloatArray) -> Fit:
    """Minimum near the measured shapes.

    In space the search uses a larger standard deviation of the points: if an effect is missing,
    shapes held to a fraction of a millimetre leave no path to the minimum.
    """
    cable, search = problem.unknowns.model.cable, SearchSettings.of(problem.unknowns.model)
    own = problem.unknowns.without_prior
    problem = loose = weighed(problem, theta)
    doubted = problem.noise.doubted(search.std * cable.length)
    if doubted is not problem.noise:
        loose = weighed(replace(problem, noise=doubted), theta)
    loose, begun = begin(loose, theta, own)
    fits = [fit_from(loose, begun, fixed=own)]
    if own.any():
        first = on_planes(loose, problem.unknowns.off_bounds(theta))
        fits.append(fit_from(*begin(loose, first)))
    best = min((fit for fit in fits if fit), key=lambda fit: fit.point.objective, default=None)
    if best is None:
        # If an effect is missing, any stiffness may result: start along the model's own equilibria.
        held = np.ones(len(theta), dtype=bool)
        best = fit_from(*begin(loose, problem.unknowns.off_bounds(theta), held), fixed=held)
    if best is None:
        raise EstimationError(
            "no equilibria were found near the measured shapes; their balance of forces led to a "
            f"bending stiffness of {problem.unknowns.p(begun.theta)[0]:.3g} N m^2.\n"
            "  Try: check the units of mass and length, the direction of gravity and the order "
            "of the poses."
        )
    return best.reweighed(problem.noise)


def misfits(fit: Fit) -> bool:
    """Whether the residuals are so large that the model must lack something."""
    return fit.residual_rms > SearchSettings.of(fit.model).misfit * fit.model.cable.length


def explains(fit: Fit) -> bool:
    """Whether a fit meets its points as closely as their noise allows."""
    return fit.noise.source != "misfit" and fit.chi2_per_dof < EXPLAINED


def fit_to_misfit(near: Fit) -> Fit:
    """Fit a model that lacks something, its points weighed by how well it can meet them.

    If an effect is missing, a fit to a fraction of a millimetre distorts every free unknown and
    ends where single poses lose their equilibrium (folds). The minimum is approximate, see
    MISFIT_GAIN.
    """
    doubted = near.noise.doubted(MISFIT_STD * near.model.cable.length)
    noise = replace(doubted, source="misfit", before=near.noise)
    priors = Priors.of(near.problem.priors.tolerances, near.model)
    # Ends that may deviate in each pose would absorb what is missing, and predict worse.
    priors = replace(priors, scatter=SCATTER_FLOOR * priors.scatter)
    return descend(near.reweighed(noise, priors), share=MISFIT_GAIN)


# ---- meshes ------------------------------------------------------------------------------------


def refine_mesh(fit: Fit, n: int) -> Fit:
    """Fit the same model on another mesh, from a fit's minimum."""
    moved = _moved(fit, n)
    return _anew(fit, n) if moved is None else refine(moved, rounds=2)


def _moved(fit: Fit, n: int) -> Fit | None:
    """The fit on another mesh, with its weights; None if its minimum is not reached there.

    The coarse mesh may be too far off, or a pose loses its stability on the way to this mesh.
    """
    with suppress(EstimationError):
        moved = refit(fit, fit.model.with_mesh(n))
        return moved if moved.point.objective <= STUCK * fit.point.objective else None
    return None


def _anew(fit: Fit, n: int) -> Fit:
    """The same model fitted on another mesh, from the measured shapes."""
    problem, known = fit.problem, fit.noise.before or fit.noise
    return fit_model(
        fit.model.with_mesh(n),
        problem.history,
        problem.priors.tolerances,
        known.std if known.source == "declared" else None,
        free=problem.unknowns.names,
        values=fit.p,
        readings=known.readings,
    )


def mesh_error(fit: Fit) -> float:
    """Largest RMS distance [m] between a pose on this mesh and on an infinitely fine one.

    4/3 times the difference to a mesh of half the element size, as the error falls at least with
    the square of the element size (Richardson). Infinite if the fitted parameters have no
    equilibria nearby on the finer mesh.
    """
    own = fit.problem.equilibria.model
    model = own.with_mesh(2 * own.n)
    equilibria = BatchEquilibrium(
        model, [item.pose for item in fit.problem.measured], wrenches=False
    )
    state = fit.p, model.rest_basis @ fit.coefficients
    start = on_other_mesh(fit.point.shapes, own, model)
    shapes, converged = equilibria.solve_or_descend(start, *state)
    if not converged.all():
        return float("inf")
    fine = equilibria.seen(shapes, *state)
    places = np.linspace(0.0, fit.model.cable.length, 101)
    worst = 0.0
    for true, seen in zip(fine, fit.problem.observed(fit.point), strict=True):
        gap = true.curve.at(places) - seen.curve.at(places)
        worst = max(worst, float(np.sqrt((gap**2).sum(axis=1).mean())))
    return 4 / 3 * worst


def fine_enough(fit: Fit, n: int, modes: int = SMOOTH_MODES, finest: int = FINEST_MESH) -> Fit:
    """Refine a fit's mesh, from n elements on, until its error is far below the noise.

    The noise is estimated again once a mesh is fine enough. If an effect is missing, the mesh error
    need only be small against the misfit.
    """
    known = fit  # the last fit whose noise was estimated on its mesh
    while fit.noise.source != "misfit":
        if n != fit.model.n:
            try:
                moved = _moved(fit, n)
                fit = moved or _anew(fit, n)
            except EstimationError:
                # The parameters have no equilibria near the measured shapes on a finer mesh.
                break
            known = known if moved else fit
            continue
        error = mesh_error(fit)
        largest = finest if np.isfinite(error) else SEARCH_MESH
        allowed = allowed_mesh_error(fit)
        if error > allowed and n < largest:
            # Even; cautious: as if a coarse mesh lost half of the order above the second.
            order = 1 + ELEMENTS[fit.model.element].order / 2
            finer = n * np.clip((error / allowed) ** (1 / order), 1.2, 2.0)
            n = min(2 * int(np.ceil(finer / 2)), largest)
        elif fit is known:
            return fit
        else:
            try:
                fit = known = refine(fit, rounds=2, modes=modes)
            except EstimationError:
                break
    if fit is not known:
        with suppress(EstimationError):
            known = refine(fit, rounds=2, modes=modes)
    return known


def compared_std(fit: Fit) -> float:
    """Standard deviation [m] of the compared data: of points, or of means of several points.

    Of readings alone the displacement of an end that changes one by its noise: a clamped end
    needs 12 EI / L^3 per metre, and has 6 EI / L^2 more moment.
    """
    noise, items = fit.noise, fit.problem.fit_poses
    if not fit.has_points:
        length, stiffness, own = fit.model.cable.length, float(fit.p[0]), noise.readings
        each = {"force": own.force * length / 12, "moment": own.moment / 6}
        kinds = {str(kind) for item in items for kind in item.kinds}
        return min(each[kind] for kind in kinds) * length**2 / stiffness
    white = float(np.median(np.concatenate([item.relative_white for item in items])))
    return noise.std * float(np.sqrt((1 - noise.share) * white**2 + noise.share))


def allowed_mesh_error(fit: Fit) -> float:
    """Mesh error [m] that is far below the noise, or far below the remaining misfit."""
    left = LACKING_SHARE if fit.beyond_noise else MESH_SHARE
    return max(MESH_SHARE * compared_std(fit), left * fit.residual_rms)


# ---- a plane of unknown height on which cables rest: what their shapes share ---------------------


def resting_height(problem: Problem) -> float | None:
    """Lowest height [m] that the measured shapes of several poses share, if there is one.

    Cables that lie on a table have the same lowest height in all poses. A cable's lowest place is
    no higher than its lowest point or end; the smooth curve through them may pass below these.
    """
    model = problem.unknowns.model
    if not (any(model.gravity) and model.chain.kind.smooth):
        return None
    length, rest = model.cable.length, np.zeros(model.chain.n_rests)
    places, (shapes, _) = np.linspace(0.0, length, 201), measured_shapes(problem)
    seen = problem.equilibria.seen(shapes, problem.unknowns.fixed, rest)
    heights = height_of([seen[j].curve.at(places) for j in problem.used], model.gravity)
    lowest, inside = heights.min(axis=1), heights.argmin(axis=1)
    ends = heights[:, [0, -1]] if model.end.place else heights[:, :1]
    highest = ends.min(axis=1)
    for k, item in enumerate(problem.fit_poses):
        known = height_of(item.traced.points, model.gravity) if item.has_line else heights[k]
        highest[k] = max(lowest[k], known.min(initial=highest[k]))
    # It decides whether a plane is tried, not whether it is found.
    least, most = UNEXPLAINED * length, BEYOND_EFFECTS * length
    apart = np.clip(NOTABLE * problem.noise.of_points.std, least, most)
    shared = (inside > 0) & (inside < len(places) - 1) & (lowest < highest.min() + apart)
    height = np.maximum(lowest, highest.min())[shared]
    return float(height.mean()) if len(height) > 1 else None


def on_planes(problem: Problem, theta: FloatArray) -> FloatArray:
    """Theta (size,) in which effects without derivative at zero start where the shapes rest."""
    unknowns = problem.unknowns
    model, p = unknowns.model, unknowns.p(theta)
    asked = [x for x in model.effects if not x.gradual]
    found = resting_height(problem) if asked else None
    if found is None:
        return theta
    for effect in asked:
        (start,) = effect.scans(Setup(model.cable, gravity=model.gravity, resting=found))
        for q in effect.parameters(model.cable):
            k = model.names.index(f"{effect.label}.{q.name}")
            if unknowns.fixed[k] == q.nominal:
                p[k] = start[q.name]
    return unknowns.pack(p, unknowns.coefficients(theta))
