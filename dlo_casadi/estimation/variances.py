"""Noise, roughness of the rest curvature and scatter of the fixtures, estimated from the data."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EstimationError, counted
from dlo_casadi.estimation.descent import NEARLY, descend
from dlo_casadi.estimation.repeats import enough_poses, with_repeats
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.scatter_likelihood import (
    MOST_POSES,
    ScatterEstimate,
    ScatterLikelihood,
    ScatterSample,
    estimate_pose_scatter,
)
from dlo_casadi.estimation.start import SearchSettings
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import MODES, PoseScatter, sources_in
from dlo_casadi.rod.quantities import FORCE, MOMENT, QUANTITIES
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise, smooth_modes
from dlo_casadi.sensing.noise_estimate import NoiseSample, estimate_noise, tell_of_noise
from dlo_casadi.thresholds import EVIDENCE_APART, NOTABLE, SCATTERED_DEGREES

# Number of slow displacements per pose kept out of the noise estimate: many while an effect may be
# missing, few once the model is taken as complete, because noise is also slow.
SMOOTH_MODES = 5
SETTLED_MODES = 2
# First guess of the noise of wrench measurements, relative to the forces in the cable.
FIRST_FORCE = 0.01
# Minimum number of degrees of freedom to estimate the size of the noise.
LEAST_SPARE = 3.0
# Least roughness that is estimated, and the one of a rest curvature that is held to a line.
ROUGHNESS_FLOOR, A_LINE = 1e-3, 1e-4
# Smallest scatter of the poses' ends, as a share of the tolerance.
SCATTER_FLOOR = 0.05


def settle(fit: Fit) -> Fit:
    """Estimate noise, roughness and scatter again for a model that is taken as complete."""
    return refine(fit, rounds=2, modes=SETTLED_MODES)


def refine(fit: Fit, rounds: int = 3, modes: int = SMOOTH_MODES, *, first: bool = False) -> Fit:
    """Alternate between the fit, the noise, the roughness of the rest curvature and the scatter.

    Roughness and scatter (how much the poses' ends differ from one another, within the
    tolerances) maximise the marginal likelihood (MacKay's fixed point).

    Parameters
    ----------
    modes : int
        Number of slow displacements kept out of the noise estimate, if noise is estimated.
    first : bool
        Whether two questions are still open: does the cable return to the same shape, and do the
        points scatter as their declared noise says? If they scatter more, noise is estimated.

    References
    ----------
    MacKay, Neural Computation 4 (1992).
    """
    repeats = fit.problem.priors.pose_scatter.std == 0 and not first
    rough, estimated = first and SearchSettings.of(fit.model).converged_first, not fit.noise.known
    near = descend(fit, tolerance=NEARLY)
    fit = near if near.converged or not rough else replace(fit, converged=False)
    for round_ in range(rounds):
        priors, noise = fit.problem.priors, fit.noise
        if first and round_ == 0 and noise.source == "declared":
            estimated = contradicted(fit)
        rest = priors.pose_scatter
        if round_ < 2:
            noise, rest = errors_of(fit, modes, estimated=estimated, repeats=repeats)
        roughness, scatter = roughness_of(fit), scatter_of(fit)
        ends = np.isfinite(scatter)
        moved = max(
            abs(np.log(roughness / priors.roughness_std)),
            float(np.abs(np.log(scatter[ends] / priors.scatter[ends])).max()),
        )
        changed = abs(np.log(noise.std / fit.noise.std))
        known = priors.pose_scatter
        same = abs(rest.std - known.std) <= 0.05 * max(rest.std, known.std)
        same &= rest.source == known.source or not rest.std
        found = replace(priors, roughness_std=roughness, scatter=scatter, pose_scatter=rest)
        try:
            near = fit.reweighed(noise, found)
        except EstimationError:  # a pose has no equilibrium without what was random
            near = fit.reweighed(noise, replace(found, pose_scatter=known))
        fit = descend(near)
        if moved < 0.1 and changed < 0.02 and same:
            break
        if rough and not fit.converged:
            # What is missing is not noise: estimating the noise once more leads farther off.
            break
    return fit


def contradicted(fit: Fit) -> bool:
    """Whether the points scatter more than their declared noise.

    Only the white part of the residuals counts, beside all that the shapes may do: the error of
    an incomplete model is smooth along the cable. Readings alone do not.
    """
    if not fit.has_points:
        return False
    samples = _noise_samples(fit, SMOOTH_MODES)
    if not tell_of_noise(samples, SCATTERED_DEGREES):
        return False
    found = estimate_noise(samples, fit.model.cable.length)
    return found.white > (1 + NOTABLE / np.sqrt(2 * SCATTERED_DEGREES)) * fit.noise.std


def errors_of(
    fit: Fit, modes: int = SMOOTH_MODES, *, estimated: bool, repeats: bool
) -> tuple[NoiseModel, PoseScatter]:
    """Noise of the points and what differs at random from pose to pose, from the residuals.

    The noise is estimated with all changes of shape projected out. If lines have too few points
    for that, fewer slow displacements are projected out; in the last resort the noise is white,
    and its size is estimated together with that of the rest curvatures. It is never smaller than
    the `least` of the poses.

    Parameters
    ----------
    estimated : bool
        Whether the noise is estimated; otherwise it is taken as it is.
    repeats : bool
        Whether the cable repeats. This is a property of the specimen: a scatter that appears only
        after an effect was added to the declared model is an error of that effect.

    Raises
    ------
    EstimationError
        If there are hardly more points than unknowns that they determine.
    """
    noise, together, length = fit.noise, False, fit.model.cable.length
    if not fit.has_points:
        # A few numbers of each pose do not tell their noise from a scatter of the cable.
        own = reading_noise_of(fit)
        declared = all(own.known(x) for x in QUANTITIES)
        dof = np.inf if declared else fit.degrees_of_freedom
        return replace(noise, readings=own, slow_dof=dof), PoseScatter()
    if estimated:
        for count in range(modes, -1, -1):
            samples = _noise_samples(fit, count)
            if tell_of_noise(samples):
                noise = with_repeats(
                    estimate_noise(samples, length), fit.problem.history, fit.model
                )
                break
        else:
            noise, together = _white_noise(fit), True
        least = max(item.least for item in fit.problem.fit_poses)
        noise = replace(noise, std=max(noise.std, least))
    noise = replace(noise, readings=reading_noise_of(fit))
    if repeats:
        return noise, PoseScatter()
    found = pose_scatter_of(fit, noise)
    return replace(noise, std=found.noise * noise.std) if together else noise, found.scatter


def first_reading_noise(
    model: CableModel,
    force: float | None = None,
    moment: float | None = None,
    stiffness: float | None = None,
    share: float = FIRST_FORCE,
) -> ReadingNoise:
    """Noise of forces [N] and moments [N m]: as declared, else a first guess.

    `share` times the forces of such a cable as it hangs and bends; lever arm: length / 10.
    `stiffness` [N m^2]: bending stiffness; the first guess by default.
    """
    if stiffness is not None:
        model = replace(model, cable=replace(model.cable, bending_stiffness=stiffness))
    guess = share * model.force_scale
    arm = model.cable.length / 10
    return ReadingNoise(
        FORCE.scale(guess, arm) if force is None else force,
        MOMENT.scale(guess, arm) if moment is None else moment,
        force is not None,
        moment is not None,
    )


def reading_noise_of(fit: Fit) -> ReadingNoise:
    """Noise of forces and of moments where it is not declared: one fixed-point update.

        std^2 = (sum of squares + guess^2) / (components - what of them the unknowns explain + 1)

    so that the first guess counts as one component.

    References
    ----------
    MacKay, Neural Computation 4 (1992).
    """
    own = fit.noise.readings
    guess = first_reading_noise(fit.model, stiffness=float(fit.p[0]))
    kinds = np.concatenate([item.kinds for item in fit.problem.fit_poses])
    if (kinds == "point").all():
        return own
    free = 1 - np.concatenate(fit.leverages)
    square = np.concatenate(fit.linearization.raw) ** 2

    def std(kind: str, first: float) -> float:
        of = kinds == kind
        return updated(square[of].sum(), free[of].sum(), 1.0, first)

    unknown = [x for x in QUANTITIES if not own.known(x)]
    return own.with_std({x: std(x.name, guess.of(x)) for x in unknown})


def updated(square: float, known: float, more: float = 0.0, std: float = 0.0) -> float:
    """Size of a random part by one step of MacKay's fixed point.

    `square`: sum of squares of its components, of which the data determine `known`. `more`: number
    of further components of a size that is known, `std`.
    """
    return float(np.sqrt((square + more * std**2) / (known + more)))


def pose_scatter_of(fit: Fit, noise: NoiseModel) -> ScatterEstimate:
    """Likeliest random quantity of each repeat and its size; see `estimate_pose_scatter`."""
    if not enough_poses(fit.problem.history, fit.model):
        return ScatterEstimate(PoseScatter(), 1.0, 1.0, 0.0)
    (found,) = _scatters_of(fit, noise, [PoseScatter()])
    if found.scatter.std == 0 and not (fit.beyond_noise or _beyond_tolerances(fit)):
        return found
    others = _scatters_of(fit, noise, [PoseScatter(source=x) for x in sources_in(fit.model)])
    best, *others = sorted((found, *others), key=lambda item: item.deviance)
    near = [x.scatter for x in others if x.deviance < best.deviance + 2 * EVIDENCE_APART]
    alike = tuple(one for one in near if one.std > 0)
    return replace(best, scatter=replace(best.scatter, rivals=alike))


def _beyond_tolerances(fit: Fit) -> bool:
    """Whether the poses' ends deviate from declared values significantly beyond their scatter."""
    std = fit.problem.fixture_std
    own = fit.own_deviations[:, std > 0] / std[std > 0]
    return bool((own**2).sum() > own.size + 2 * np.sqrt(2 * own.size))


def _scatters_of(
    fit: Fit, noise: NoiseModel, scatters: Sequence[PoseScatter]
) -> list[ScatterEstimate]:
    """Size of each random quantity of a repeat, estimated as the only one."""
    problem, point, lin = fit.problem, fit.point, fit.linearization
    size, std = problem.unknowns.size, problem.fixture_std
    kept = range(0, len(problem.used), -(-len(problem.used) // MOST_POSES))
    poses = []
    for k in kept:
        white = problem.measured[problem.used[k]].whitening(noise, point.projections[k])
        shared, own = np.split(white @ lin.raw_directions[k], [size], axis=1)
        # The poses' deviations are random, too: take the residual without them.
        e = white @ lin.raw[k] - own @ fit.own_deviations[k]
        poses.append((white, e, own * std, shared))
    seen = problem.observed(point)
    shapes = np.array([seen[problem.used[k]].curve.nodes for k in kept])
    shapes = shapes - shapes[:, :1]
    gap = shapes[:, None] - shapes[None]
    distances = np.sqrt((gap**2).sum(axis=3).mean(axis=2))
    sparse = max(len(s) for s in point.projections) <= MODES
    found = []
    for scatter, moved in zip(scatters, problem.moved_by(point, *scatters), strict=True):
        samples = [
            ScatterSample(e, white @ moved[k], own, shared)
            for k, (white, e, own, shared) in zip(kept, poses, strict=True)
        ]
        likelihood = ScatterLikelihood(samples, distances, scatter.source, scatter.most(fit.model))
        found.append(estimate_pose_scatter(likelihood, sparse=sparse))
    return found


def _white_noise(fit: Fit) -> NoiseModel:
    """White noise: size of the residuals over their degrees of freedom."""
    problem = fit.problem
    items = problem.fit_poses
    on_points = np.concatenate([item.on_points for item in items])
    free = 1 - np.concatenate(fit.leverages)
    spare = problem.n_residuals - fit.determined_unknowns - float(free[~on_points].sum())
    if round(spare, 1) < LEAST_SPARE:  # as the message shows it
        raise EstimationError(
            f"the {counted(int(on_points.sum()), 'distance')} of "
            f"{counted(len(problem.used), 'fit pose')} determine "
            f"{fit.determined_unknowns:.1f} unknowns (stiffness, rest curvature, deviations within "
            f"the tolerances): {max(spare, 0.0):.1f} degrees of freedom are left to estimate the "
            f"noise from, {LEAST_SPARE:g} are needed.\n"
            "  Try: more points on each line, more poses, the noise as measurement.std, or "
            "rest_shape: straight."
        )
    weight = np.concatenate([x.relative_white[x.point_of] for x in items])
    raw = np.concatenate(fit.linearization.raw)[on_points] / weight
    return NoiseModel(float(np.sqrt((raw**2).sum() / spare)), slow_dof=spare)


def _noise_samples(fit: Fit, modes: int) -> list[NoiseSample]:
    """Residuals of each pose, with the directions in which its curve may change."""
    problem, point, lin, model = fit.problem, fit.point, fit.linearization, fit.model
    length = model.cable.length
    size = problem.unknowns.size
    bases, left_over = [], []
    scatter = problem.priors.pose_scatter
    rest = problem.moved_by(point, scatter)[0] if scatter.rest_std > 0 else None
    shown = [k for k, item in enumerate(problem.fit_poses) if item.has_points]
    items = [problem.fit_poses[k] for k in shown]
    kept = [item.on_points for item in items]
    raws = [lin.raw[k][on] for k, on in zip(shown, kept, strict=True)]
    ways = [lin.raw_directions[k][on] for k, on in zip(shown, kept, strict=True)]
    places = [point.projections[k] for k in shown]
    scale = np.max([np.abs(x[:, :size]).max(axis=0) for x in ways], axis=0)
    for item, on, directions, s, k in zip(items, kept, ways, places, shown, strict=True):
        own = directions[:, size:] / np.maximum(np.abs(directions[:, size:]).max(axis=0), 1e-300)
        sines = smooth_modes(s, length, modes, not model.end.place)
        slow = item.slow_rows(sines)[on]
        if rest is not None:
            way = rest[k][on]
            slow = np.concatenate([slow, way / np.abs(way).max()], axis=1)
        basis, values, _ = np.linalg.svd(np.concatenate([own, slow], axis=1), full_matrices=False)
        basis = basis[:, values > 1e-3 * values.max(initial=0.0)]
        shared = directions[:, :size] / np.maximum(scale, 1e-300)
        bases.append(basis)
        left_over.append(shared - basis @ (basis.T @ shared))
    # A direction already among the poses' own ones takes no further degree of freedom.
    left, values, _ = np.linalg.svd(np.concatenate(left_over), full_matrices=False)
    blocks = np.split(left[:, values > 1e-6], np.cumsum([len(raw) for raw in raws])[:-1])
    rows = zip(items, raws, places, bases, blocks, strict=True)
    return [
        NoiseSample(e[at], s[on], x.weight, own[at], block[at], x.correlation_length, x.count)
        for item, e, s, own, block in rows
        for x, on, at in item.slices
    ]


def roughness_of(fit: Fit) -> float:
    """One fixed-point update of the roughness of the rest curvature; A_LINE stays one."""
    unknowns, roughness_std = fit.problem.unknowns, fit.problem.priors.roughness_std
    if unknowns.n_rest < 3 or roughness_std <= A_LINE:
        return roughness_std
    rest = slice(unknowns.n_parameters, unknowns.size)
    rough = unknowns.model.roughness
    covariance = np.linalg.pinv(fit.normal.hessian, hermitian=True)[rest, rest]
    prior = rough.T @ rough / roughness_std**2
    well_determined = len(rough) - float(np.trace(covariance @ prior))
    energy = float(((rough @ fit.point.theta[rest]) ** 2).sum())
    return max(updated(energy, max(well_determined, 1e-2)), ROUGHNESS_FLOOR)


def scatter_of(fit: Fit) -> FloatArray:
    """One fixed-point update of the scatter of ends and headings, never above the tolerance.

        std^2 = (sum of squares + u tolerance^2) / (determined + u),   u = 1 - determined / all

    over the components of the poses, of which `determined` are known from the data. The tolerance
    acts as one more component to the extent that they are not. The likeliest scatter alone was too
    small, and so were intervals: of ten random cables in space five lay more than two std off, one
    4.6; with the tolerance none of these and nine more does, at most 1.85.
    """
    problem = fit.problem
    columns = problem.equilibria.used_deviations
    if not columns or len(problem.used) == 1:
        return problem.priors.scatter
    covariance = np.linalg.pinv(fit.normal.hessian, hermitian=True)
    each = range(len(columns))
    variance = fit.mixed.covariances(covariance)[:, each, each]
    square = (fit.own_deviations**2).sum(axis=0)
    determined = (1 - variance / problem.deviation_std**2).sum(axis=0)
    scatter = problem.priors.scatter.copy()
    node = problem.unknowns.model.node
    limits = problem.priors.tolerances.deviation(problem.unknowns.model)
    # The coordinates of an end share one scatter, the turns of both clamps another, and all clips
    # a third.
    d, b = node.dimension, node.increment
    for group in (range(d), range(d, d + 2 * b), range(2 * (d + b) + 1, len(scatter))):
        # Where they differ at random beyond the tolerance, nothing tells the tolerance's part.
        random = problem.random_std > 0
        members = [k for k, column in enumerate(columns) if column in group and not random[k]]
        if members:
            known = max(determined[members].sum(), 0.0)
            unknown = max(1 - known / (len(members) * len(problem.used)), 1e-6)
            for column in group:
                found = updated(square[members].sum(), known, unknown, limits[column])
                scatter[column] = np.clip(found, SCATTER_FLOOR * limits[column], limits[column])
    return scatter
