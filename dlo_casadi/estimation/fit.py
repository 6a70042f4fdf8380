"""Fit of a model to all measured poses: noise, roughness, parameters and their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium import solve_equilibrium
from dlo_casadi.errors import EquilibriumError, EstimationError
from dlo_casadi.estimation.gauss_newton import (
    BatchProblem,
    Linearization,
    Normal,
    Point,
    Tolerances,
)
from dlo_casadi.estimation.noise import (
    NoiseModel,
    NoiseSample,
    estimate_noise,
    smooth_modes,
    tell_of_noise,
)
from dlo_casadi.estimation.observation import MeasuredPose
from dlo_casadi.estimation.start import all_at_once, measured_shapes
from dlo_casadi.estimation.sweep import Shapes
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.executors import InProcess
from dlo_casadi.model import DEVIATIONS, CableModel
from dlo_casadi.parallel import map_in_order

FloatArray = NDArray[np.floating]

# Decades about the prior stiffness from which fits are started.
DECADES = (0, -1, 1, -2, 2, -3, 3)
BETWEEN_DECADES = (-0.5, 0.5, -1.5, 1.5, -2.5, 2.5, -3.5, 3.5)
# Of many poses only so many, evenly picked, are searched for where to start with all.
POSES_OF_A_SEARCH = 40
# Slow displacements per pose that are kept out of the noise estimate: many while an effect may
# be missing, few once the model is taken as complete, because noise is slow, too.
SMOOTH_MODES = 5
SETTLED_MODES = 2
# A first guess of an undeclared noise, only until it has been estimated.
FIRST_STD = 3e-4
# Degrees of freedom from which the size of the noise can be estimated.
LEAST_SPARE = 3.0
ROUGHNESS_START = 0.3
ROUGHNESS_FLOOR = 1e-3
# Smallest scatter of the poses' ends, as a share of the tolerance.
SCATTER_FLOOR = 0.05


@dataclass(frozen=True)
class Fit:
    """Parameters that explain the measured poses best, and how well they are known.

    Parameters
    ----------
    problem : BatchProblem
        With the noise and the roughness found.
    point : Point
        Unknowns, shapes and objective at the minimum.
    converged : bool
    """

    problem: BatchProblem
    point: Point
    converged: bool

    @property
    def model(self) -> CableModel:
        """The model that was fitted."""
        return self.problem.unknowns.model

    @property
    def noise(self) -> NoiseModel:
        """Noise of the measured lines."""
        return self.problem.noise

    @property
    def p(self) -> FloatArray:
        """Parameter vector, in the order of `model.names` (SI)."""
        return self.problem.unknowns.p(self.point.theta)

    @property
    def coefficients(self) -> FloatArray:
        """Rest-curvature coefficients [1/m]."""
        return self.problem.unknowns.coefficients(self.point.theta)

    @property
    def rest(self) -> FloatArray:
        """Rest curvature of the bending cells before the first pose [1/m]."""
        return self.problem.unknowns.rest(self.point.theta)

    @cached_property
    def linearization(self) -> Linearization:
        """Residuals and Jacobians at the minimum."""
        return self.problem.linearize(self.point)

    @cached_property
    def normal(self) -> Normal:
        """Normal equations at the minimum."""
        return self.problem.normal_equations(self.point, self.linearization)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (size, size) of theta: inverse of the reduced Hessian."""
        return np.asarray(np.linalg.pinv(self.normal.hessian, hermitian=True))

    @cached_property
    def determined_unknowns(self) -> float:
        """Effective number of unknowns that the points determine, priors being what they are."""
        problem = self.problem
        effective = problem.unknowns.size - float(np.trace(self.covariance @ problem.precision))
        precision = np.diag(1 / problem.deviation_std**2)
        for block, cross, _ in self.normal.inner:
            inverse = np.linalg.inv(block)
            arm = inverse @ cross
            full = inverse + arm @ self.covariance @ arm.T
            effective += len(block) - float(np.trace(full @ precision))
        return effective

    @property
    def degrees_of_freedom(self) -> float:
        """Number of points minus the effective number of unknowns that they determine."""
        return max(self.problem.n_points - self.determined_unknowns, 1.0)

    @property
    def chi2_per_dof(self) -> float:
        """Sum of squares of the whitened residuals per degree of freedom."""
        return self.point.data / self.degrees_of_freedom

    @cached_property
    def residual_rms(self) -> float:
        """Root mean square normal distance of the fitted points [m]."""
        return float(np.sqrt((np.concatenate(self.linearization.raw) ** 2).mean()))

    @cached_property
    def fixture_error(self) -> float:
        """RMS displacement of a shape [m] by what its ends differ from where they are declared.

        The scatter of the poses' ends and headings, carried to the curve by the equilibrium. The
        fit estimates each pose's own; of a pose that is only predicted nobody knows them.
        """
        size, std = self.problem.unknowns.size, self.problem.deviation_std
        moved = [
            ((directions[:, size:] * std) ** 2).sum(axis=1)
            for directions in self.linearization.raw_directions
        ]
        return float(np.sqrt(np.concatenate(moved).mean()))

    @property
    def inflation(self) -> float:
        """Factor on standard deviations where the residual exceeds the noise."""
        return float(np.sqrt(max(1.0, self.chi2_per_dof)))

    def std(self, name: str) -> float:
        """Standard deviation of a parameter (SI), the residual's excess included."""
        unknowns = self.problem.unknowns
        if name not in unknowns.names:
            return 0.0
        k = unknowns.names.index(name)
        slope = unknowns.scales[k]
        if name in self.model.names:
            slope = unknowns.slopes(self.point.theta)[self.model.names.index(name), k]
        return float(abs(slope) * np.sqrt(max(self.covariance[k, k], 0.0)) * self.inflation)

    def value(self, name: str) -> float:
        """Value of a parameter (SI)."""
        return float(self.p[self.model.names.index(name)])

    @cached_property
    def stable(self) -> NDArray[np.bool_]:
        """Whether each pose is a stable equilibrium at the fitted parameters."""
        return self.problem.sweep.stable(self.point.shapes, self.p, self.rest)

    @cached_property
    def log_evidence(self) -> float:
        """Laplace's approximation of the log marginal likelihood, constants dropped.

        -objective + 1/2 log|P+| - 1/2 log|H| - 1/2 sum log|block| - log|noise|
        """
        problem = self.problem
        eigen = np.linalg.eigvalsh(problem.precision)
        prior = float(np.log(eigen[eigen > 1e-12]).sum())
        hessian = float(np.linalg.slogdet(self.normal.hessian)[1])
        inner = sum(
            float(np.linalg.slogdet(block)[1]) + 2 * float(np.log(problem.deviation_std).sum())
            for block, _, _ in self.normal.inner
        )
        return -self.point.objective + (prior - hessian - inner) / 2


def settle(fit: Fit) -> Fit:
    """Estimate noise, roughness and scatter anew for a model that is taken as complete."""
    problem, point, converged = refine(
        fit.problem,
        fit.point,
        estimate=not fit.noise.declared,
        rounds=2,
        modes=SETTLED_MODES,
    )
    return Fit(problem, point, converged)


def starting_points(
    problem: BatchProblem,
    theta: FloatArray,
    decades: Sequence[float] = DECADES,
    executor: Executor | None = None,
) -> list[Point]:
    """Equilibria near the measured shapes for stiffnesses over decades, best first.

    A start takes 0.02 to 0.1 s, less than a process takes to begin: they run in this one unless
    an executor is given.
    """
    starts = [theta.copy() for _ in decades]
    for start, decade in zip(starts, decades, strict=True):
        start[0] += decade * np.log(10)
    shapes, feet = measured_shapes(problem)
    problem.refresh(feet)
    held = np.zeros(problem.unknowns.size, dtype=bool)
    held[: problem.unknowns.n_parameters] = True
    begin = partial(all_at_once, problem, shapes, feet, held=held)
    found = map_in_order(executor or InProcess(), begin, starts)
    points = [point for point in found if point is not None and np.isfinite(point.objective)]
    return sorted(points, key=lambda point: point.objective)


def refine(
    problem: BatchProblem,
    point: Point,
    *,
    estimate: bool,
    rounds: int = 3,
    modes: int = SMOOTH_MODES,
) -> tuple[BatchProblem, Point, bool]:
    """Alternate between the fit, the noise, the roughness of the rest curvature and the scatter.

    Roughness and scatter (how much the poses' ends differ from one another, within the
    tolerances) maximise the marginal likelihood (MacKay's fixed point).

    References
    ----------
    MacKay, Neural Computation 4 (1992).
    """
    point, converged = problem.descend(point, tolerance=1e-2)
    for round_ in range(rounds):
        lin = problem.linearize(point)
        noise = problem.noise
        if estimate and round_ < 2:
            noise = noise_of(problem, point, lin, modes)
        roughness = roughness_of(problem, point, lin)
        scatter = scatter_of(problem, point, lin)
        moved = max(
            abs(np.log(roughness / problem.roughness_std)),
            float(np.abs(np.log(scatter[:4] / problem.scatter[:4])).max()),
        )
        changed = abs(np.log(noise.std / problem.noise.std))
        problem = problem.changed(noise, roughness, scatter)
        problem.refresh(point.feet)
        point = problem.evaluate(point.theta, point.shapes, point.feet)
        point, converged = problem.descend(point)
        if moved < 0.1 and changed < 0.02:
            break
    return problem, point, converged


def noise_of(
    problem: BatchProblem, point: Point, lin: Linearization, modes: int = SMOOTH_MODES
) -> NoiseModel:
    """Noise estimated from the residuals with all that the shape may do projected out.

    Lines of few points leave nothing over then: fewer slow displacements are projected out of
    them, and at last the noise is white, of the size that the residuals have for each degree of
    freedom.

    Raises
    ------
    EstimationError
        If the points are hardly more than the unknowns that they determine.
    """
    for count in range(modes, -1, -1):
        samples = _noise_samples(problem, point, lin, count)
        if tell_of_noise(samples):
            return estimate_noise(samples, problem.unknowns.model.cable.length)
    return _white_noise(problem, point)


def _white_noise(problem: BatchProblem, point: Point) -> NoiseModel:
    """White noise of the size of the residuals over their degrees of freedom."""
    fit = Fit(problem, point, converged=True)
    spare = problem.n_points - fit.determined_unknowns
    if spare < LEAST_SPARE:
        raise EstimationError(
            f"the {problem.n_points} points of {len(problem.used)} fit poses determine "
            f"{fit.determined_unknowns:.1f} unknowns (stiffness, rest curvature, deviations within "
            f"the tolerances): {max(spare, 0.0):.1f} degrees of freedom are left to estimate the "
            f"noise from, {LEAST_SPARE:g} are needed.\n"
            "  Try: more points on each line, more poses, the noise as measurement.std, or "
            "rest_shape: straight."
        )
    weight = np.concatenate([problem.measured[j].relative_std for j in problem.used])
    raw = np.concatenate(fit.linearization.raw) / weight
    return NoiseModel(float(np.sqrt((raw**2).sum() / spare)), slow_dof=spare)


def _noise_samples(
    problem: BatchProblem, point: Point, lin: Linearization, modes: int
) -> list[NoiseSample]:
    """Residuals of each pose beside the directions that its curve may take."""
    model = problem.unknowns.model
    length = model.cable.length
    size = problem.unknowns.size
    bases, left_over = [], []
    scale = np.max([np.abs(x[:, :size]).max(axis=0) for x in lin.raw_directions], axis=0)
    for directions, s in zip(lin.raw_directions, point.feet, strict=True):
        own = directions[:, size:] / np.maximum(np.abs(directions[:, size:]).max(axis=0), 1e-300)
        slow = smooth_modes(s, length, modes, model.end == "free")
        basis, values, _ = np.linalg.svd(np.concatenate([own, slow], axis=1), full_matrices=False)
        basis = basis[:, values > 1e-3 * values[0]]
        shared = directions[:, :size] / np.maximum(scale, 1e-300)
        bases.append(basis)
        left_over.append(shared - basis @ (basis.T @ shared))
    # A direction that the poses' own ones hold already costs no further degree of freedom.
    left, values, _ = np.linalg.svd(np.concatenate(left_over), full_matrices=False)
    blocks = np.split(left[:, values > 1e-6], np.cumsum([len(s) for s in point.feet])[:-1])
    return [
        NoiseSample(lin.raw[k], s, problem.measured[problem.used[k]].relative_std, own, block)
        for k, (s, own, block) in enumerate(zip(point.feet, bases, blocks, strict=True))
    ]


def roughness_of(problem: BatchProblem, point: Point, lin: Linearization) -> float:
    """One fixed-point update of the roughness of the rest curvature."""
    unknowns = problem.unknowns
    if unknowns.n_rest < 3:
        return problem.roughness_std
    rest = slice(unknowns.n_parameters, unknowns.size)
    rough = unknowns.model.rest.roughness
    hessian = problem.normal_equations(point, lin).hessian
    covariance = np.linalg.pinv(hessian, hermitian=True)[rest, rest]
    prior = rough.T @ rough / problem.roughness_std**2
    well_determined = len(rough) - float(np.trace(covariance @ prior))
    energy = float(((rough @ point.theta[rest]) ** 2).sum())
    return float(max(np.sqrt(energy / max(well_determined, 1e-2)), ROUGHNESS_FLOOR))


def scatter_of(problem: BatchProblem, point: Point, lin: Linearization) -> FloatArray:
    """One fixed-point update of the scatter of ends and headings, never above the tolerance."""
    columns = problem.sweep.used_deviations
    if not columns or len(problem.used) == 1:
        return problem.scatter
    normal = problem.normal_equations(point, lin)
    covariance = np.linalg.pinv(normal.hessian, hermitian=True)
    variance = []
    for block, cross, _ in normal.inner:
        inverse = np.linalg.inv(block)
        arm = inverse @ cross
        variance.append(np.diag(inverse + arm @ covariance @ arm.T))
    square = (point.shapes.deviation[np.ix_(problem.used, columns)] ** 2).sum(axis=0)
    determined = (1 - np.array(variance) / problem.deviation_std**2).sum(axis=0)
    scatter = problem.scatter.copy()
    limits = problem.tolerances.deviation
    # Both coordinates of an end share one scatter, and so do both headings.
    for group in ((0, 1), (2, 3)):
        members = [k for k, column in enumerate(columns) if column in group]
        if members:
            found = np.sqrt(square[members].sum() / max(determined[members].sum(), 1e-3))
            for column in group:
                scatter[column] = np.clip(found, SCATTER_FLOOR * limits[column], limits[column])
    return scatter


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
    start : Fit, optional
        A fit of a similar model on the same mesh to start from; its noise is kept.
    decades : sequence of float
        Stiffnesses to start from, powers of ten about the prior.
    max_iterations : int
        Of a fit that continues from `start`.

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
    chosen = np.array([free is None or name in free for name in model.names])
    begin = model.nominal if values is None else values
    unknowns = Unknowns(model, chosen, begin)
    if start is not None:
        return _continue(unknowns, measured, tolerances, start, max_iterations)
    noise = NoiseModel(std or FIRST_STD, declared=std is not None)
    scatter = tolerances.deviation
    if sum(item.readable and not item.held_out for item in measured) == 1:
        # One pose does not deviate from others: what is wrong with it is wrong with the session.
        scatter = SCATTER_FLOOR * scatter
    problem = BatchProblem(unknowns, measured, noise, tolerances, ROUGHNESS_START, scatter)
    theta = unknowns.pack(begin, np.zeros(model.rest.n_coefficients))
    best = None
    if len(problem.used) > POSES_OF_A_SEARCH and not model.has_state:
        rough = _search(problem.thinned(POSES_OF_A_SEARCH), theta, decades)
        best = rough and _search(problem, rough.theta, (0,))
    best = best or _search(problem, theta, decades)
    if best is None:
        raise EstimationError(
            f"no stiffness within {max(decades)} decades of {model.cable.bending_stiffness:.3g} "
            "N m^2 gives an equilibrium near the measured shapes.\n"
            "  Try: check the units of mass and length, the direction of gravity and the order "
            "of the poses."
        )
    problem, point, converged = refine(problem, best, estimate=std is None)
    return Fit(problem, point, converged)


def _search(problem: BatchProblem, theta: FloatArray, decades: Sequence[float]) -> Point | None:
    """The best of the minima that the starts over decades of stiffness lead to."""
    points = starting_points(problem, theta, decades) or starting_points(
        problem, theta, BETWEEN_DECADES
    )
    best: Point | None = None
    for point in points[:3]:
        candidate, _ = problem.descend(point, tolerance=1e-2)
        if best is None or candidate.objective < best.objective - 0.5:
            best = candidate
        elif abs(candidate.objective - best.objective) < 1.0:
            break
    return best


def _continue(
    unknowns: Unknowns,
    measured: Sequence[MeasuredPose],
    tolerances: Tolerances,
    start: Fit,
    max_iterations: int = 40,
) -> Fit:
    """Fit a similar model from the minimum of another one, with the noise found there."""
    model = unknowns.model
    p = unknowns.fixed.copy()
    for i, name in enumerate(model.names):
        if name in start.model.names and unknowns.free[i]:
            p[i] = start.value(name)
    unknowns = replace(unknowns, fixed=p)
    theta = unknowns.pack(p, start.coefficients)
    problem = BatchProblem(
        unknowns,
        measured,
        start.noise,
        tolerances,
        start.problem.roughness_std,
        start.problem.scatter,
    )
    shapes, solved = problem.sweep.solve(carried_shapes(problem, start), p, unknowns.rest(theta))
    if not solved.all():
        raise EstimationError("the shapes of the first fit are no equilibria of the second model")
    feet = _feet_for(problem, start)
    problem.refresh(feet)
    point = problem.evaluate(theta, shapes, feet)
    point, converged = problem.descend(point, max_iterations)
    return Fit(problem, point, converged)


def carried_shapes(problem: BatchProblem, start: Fit) -> Shapes:
    """Shapes of a problem's poses from those of a fit, on the problem's mesh.

    Poses that the fit did not need, because it carried no state, are predicted.

    Raises
    ------
    EstimationError
        If such a pose has no equilibrium.
    """
    known = {index: k for k, index in enumerate(start.problem.indices)}
    own = start.point.shapes
    rows = []
    for index in problem.indices:
        if index in known:
            k = known[index]
            rows.append((own.phi[k], own.lam[k], own.deviation[k]))
            continue
        try:
            found = solve_equilibrium(start.model, start.p, start.rest, problem.history[index].pose)
        except EquilibriumError as error:
            raise EstimationError(error.message) from error
        rows.append((found.phi, found.multipliers, np.zeros(len(DEVIATIONS))))
    phi, lam, deviation = (np.array(column) for column in zip(*rows, strict=True))
    return on_other_mesh(Shapes(phi, lam, deviation), start.model, problem.unknowns.model)


def on_other_mesh(shapes: Shapes, model: CableModel, other: CableModel) -> Shapes:
    """Headings interpolated from one model's mesh to another's."""
    if model.chain == other.chain:
        return shapes
    coarse, fine = model.chain.heading_places, other.chain.heading_places
    phi = np.array([np.interp(fine, coarse, row) for row in shapes.phi])
    lam = shapes.lam
    if lam.shape[1] != other.n_conditions:
        lam = np.zeros((len(phi), other.n_conditions))
    return Shapes(phi, lam, shapes.deviation)


def refine_mesh(fit: Fit, n: int, modes: int = SMOOTH_MODES) -> Fit:
    """Fit the same model on another mesh, from a fit's minimum.

    Parameters
    ----------
    modes : int
        Slow displacements kept out of the noise estimate, if the noise is not declared.
    """
    problem = fit.problem
    model = fit.model.with_mesh(n)
    unknowns = replace(problem.unknowns, model=model)
    try:
        moved = _continue(unknowns, problem.history, problem.tolerances, fit)
    except EstimationError:
        # The coarse mesh was too far off to be followed: start again from the measured shapes.
        names = [name for name, free in zip(model.names, unknowns.free, strict=True) if free]
        std = fit.noise.std if fit.noise.declared else None
        return fit_model(model, problem.history, problem.tolerances, std, free=names, values=fit.p)
    problem, point, converged = refine(
        moved.problem, moved.point, estimate=not fit.noise.declared, rounds=2, modes=modes
    )
    return Fit(problem, point, converged)


def _feet_for(problem: BatchProblem, start: Fit) -> list[FloatArray]:
    """Feet of the problem's fitted poses, by the pose's place in the session."""
    places = [start.problem.indices[j] for j in start.problem.used]
    known = dict(zip(places, start.point.feet, strict=True))
    return [known[problem.indices[j]] for j in problem.used]
