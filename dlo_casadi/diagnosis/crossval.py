"""Cross-validation over whole poses, mostly without fitting again.

Leaving pose j out of the normal equations gives the unknowns without it in one Gauss-Newton step,

    theta_(-j) = theta - (H - H_j)^-1 (g - g_j)

(exact for a linear model). Pose j is then predicted from its declared end conditions and, if poses
leave a state behind, from the state before it. If this is far less likely than the linear model
says, as where a tether's stiffness and anchor act as a product, the step was too long. The other
poses are then fitted again, or the linear model counts if the fit does not explain its points. A
pose at a fold of its equilibria tells nothing about the model, if chance would predict it as far
off: it is not counted. If there is one pose only, stretches of its arc take the place of poses.

References
----------
Beirami et al., On optimal generalizability in parametric learning, NeurIPS 2017.
Vehtari, Gelman and Gabry, Practical Bayesian model evaluation, Statistics and Computing 27 (2017).
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import stdtr

from dlo_casadi.arrays import FloatArray, root_of
from dlo_casadi.equilibrium.curve import Observed
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import NEARLY, descend
from dlo_casadi.estimation.fit import explains
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Values
from dlo_casadi.linear_mixed import NO_INFORMATION, Normal, log_density
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.runtime.work import accounted_as
from dlo_casadi.thresholds import EVIDENCE_APART

# Number of stretches into which the arc of a single pose is cut.
STRETCHES = 5
# Draws of the unknowns that show how far chance moves a left-out pose: it is at a fold if one of
# them moves it as far as it was predicted off. Evidence: a complete model predicted one pose of a
# clean cable 43 mm off, 3 mm were expected on average, and 7 of 20 draws moved it farther.
DRAWS = 20
# Smallest share of a tolerance's variance that counts as told by the poses.
LEAST_LEFT = 1e-3


@dataclass(frozen=True)
class CrossValidation:
    """Prediction errors of left-out data.

    Parameters
    ----------
    squares : (folds,) [m^2]
        Sum of squared errors of each fold: distances of its points, and wrench measurements
        converted by `NoiseModel.units`; infinite if it could not be predicted.
    counts : (folds,)
        Number of points and of wrench components of each fold; zero if it is not counted.
    of_points : float [m]
        Root mean square distance over all points of the folds that could be predicted and count.
    expected : float [m]
        Expected error of everything, to first order: from noise, fixtures, the cable's scatter and
        the parameters' uncertainty given the other folds. Not given for stretches of a single pose.
    densities : (folds,)
        Log density of each fold under the covariance from which `expected` comes. If a fold could
        not be predicted, not even after a refit, or one step led too far and the fit does not
        explain its points, or the fold is not counted, its first order, which is an upper estimate.
    """

    squares: FloatArray
    counts: FloatArray
    of_points: float
    expected: float = 0.0
    densities: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def complete(self) -> bool:
        """Whether every fold could be predicted."""
        return not np.isinf(self.squares).any()

    @property
    def error(self) -> float:
        """Root mean square error of everything [m]; infinite if a fold could not be predicted."""
        counts = self.counts.sum()
        return float(np.sqrt(self.squares.sum() / counts)) if counts else float("inf")

    @property
    def error_of_most(self) -> float:
        """`error` of the folds that could be predicted [m]; infinite if most could not.

        A pose at the edge of stability has no equilibrium nearby, whatever the model.
        """
        counted, known = self.counts > 0, np.isfinite(self.squares)
        if 2 * (counted & known).sum() <= counted.sum():
            return float("inf")
        return float(np.sqrt(self.squares[known].sum() / self.counts[known].sum()))

    @property
    def rmse(self) -> float:
        """Root mean square distance over all points [m]; infinite as `error` is."""
        return self.of_points if np.isfinite(self.error) else float("inf")

    @property
    def log_density(self) -> float:
        """Log predictive density of all left-out data, as estimated in `densities`."""
        return float(self.densities.sum())

    def loses_most_of(self, other: CrossValidation) -> bool:
        """Whether most folds that the other validation predicts are not predicted."""
        known = np.isfinite(other.squares) & (other.counts > 0)
        return bool(2 * np.isinf(self.squares[known]).sum() > known.sum())

    def chance_of_gain(self, other: CrossValidation) -> float:
        """Probability of a gain as large as the other's if the other predicts no better.

        One-sided paired t test over the folds; 1 if there is only one fold.
        """
        gap = other.densities - self.densities
        if len(gap) < 2:
            return 1.0
        t = gap.mean() / max(gap.std(ddof=1) / np.sqrt(len(gap)), 1e-300)
        return float(stdtr(len(gap) - 1, -t))


@accounted_as("left-out poses")
def cross_validate(fit: Fit) -> CrossValidation:
    """Leave each fit pose out once (of a single pose, each stretch of its arc).

    All folds are solved together.
    """
    if len(fit.problem.used) == 1:
        return _stretches(fit)
    problem, mixed = fit.problem, fit.mixed
    steps = [_stepped(fit, mixed.without(k)) for k in range(len(problem.used))]
    thetas, covariances = zip(*steps, strict=True)
    predicted = _predicted(fit, dict(enumerate(thetas)))
    near = _at_own_deviations(fit, dict(enumerate(thetas)), predicted)
    linear = [
        _density(fit, k, _first_order(fit, k, theta), covariances[k])
        for k, theta in enumerate(thetas)
    ]
    densities = [_density_of(fit, k, near[k], covariances[k]) for k in range(len(thetas))]
    missed = [k for k, density in enumerate(densities) if density < linear[k] - EVIDENCE_APART]
    if not explains(fit):
        # Such a fit misses most poses, and fits without each of them would take minutes.
        densities = [linear[k] if k in missed else x for k, x in enumerate(densities)]
        missed = []
    refitted = {k: z for k in missed if (z := _fitted_without(fit, k)) is not None}
    again = _predicted(fit, refitted)
    predicted |= again
    for k, seen in _at_own_deviations(fit, refitted, again).items():
        densities[k] = _density_of(fit, k, seen, covariances[k])
    at_folds = [
        k
        for k in missed
        if densities[k] < linear[k] - EVIDENCE_APART
        and (seen := predicted[k]) is not None
        and _as_far_by_chance(fit, k, seen, refitted.get(k, thetas[k]), covariances[k])
    ]
    densities = [
        known if k in at_folds or not np.isfinite(x) else x
        for k, (x, known) in enumerate(zip(densities, linear, strict=True))
    ]
    errors = [
        None if seen is None else (item.distances(seen.curve), item.misread(seen, fit.noise))
        for item, seen in zip(problem.fit_poses, predicted.values(), strict=True)
    ]
    for k in at_folds:
        errors[k] = np.zeros(0), np.zeros(0)
    found, expected = _validation(errors), fit.expected_with(covariances)
    return replace(found, expected=expected, densities=np.array(densities))


def density_of_declared(fit: Fit, names: Container[str]) -> float:
    """Log predictive density of values declared for nuisances, each left out, up to a constant.

    A tolerance t is a measurement of a nuisance v, as poses are: with the variance S that v has,

        log p = -z^2 / 2 - log(t / sqrt(1 - h)),   z^2 = v^2 / (t^2 (1 - h)),   h = S / t^2

    where the fit holds v to it; where it does not, with t^2 + S in place of t^2 (1 - h), and its
    scale for t, as in the evidence. All in units of the scale; v is zero as declared. Poses alone
    do not judge an error of the setup, which is the same in each: a camera's frame 20 times its
    tolerance off predicts left-out poses as well as one without a tolerance.
    """
    unknowns = fit.problem.unknowns
    kept = [k for k, name in enumerate(unknowns.names) if name in names]
    v = (fit.point.theta - fit.problem.mean)[kept]
    variance = np.diag(fit.covariance)[kept]
    tolerance = np.array([fit.model.priors.get(unknowns.names[k], np.inf) for k in kept])
    held = np.isfinite(tolerance)
    square = np.where(held, tolerance / unknowns.scales[kept], 1.0) ** 2
    left = np.maximum(1 - variance / square, LEAST_LEFT)
    spread = np.where(held, square * left, square + variance)
    own = np.where(held, square / left, spread)
    return float(-(v**2 / spread + np.log(own)).sum()) / 2


def _as_far_by_chance(
    fit: Fit, k: int, seen: Observed, theta: FloatArray, covariance: FloatArray
) -> bool:
    """Whether unknowns that the other poses allow move the k-th pose as far as it is off.

    `seen`: predicted at `theta`, to which `covariance` belongs.
    """
    item, curve = fit.problem.fit_poses[k], seen.curve
    s, (lower, upper) = item.nearest(curve), fit.problem.unknowns.bounds
    error = float(np.sqrt((item.distances(curve) ** 2).mean()))
    generator, ways = np.random.default_rng(0), root_of(covariance)
    for _ in range(DRAWS):
        other = theta + ways @ generator.standard_normal(ways.shape[1])
        moved = _predicted(fit, {k: np.clip(other, lower, upper)})[k]
        if moved is None:
            return True
        way = np.linalg.norm(moved.curve.at(s) - curve.at(s), axis=1)
        if np.sqrt((way**2).mean()) >= error:
            return True
    return False


def _fitted_without(fit: Fit, k: int) -> FloatArray | None:
    """Unknowns fitted to all poses but the k-th fitted one; None if poses are lost."""
    problem, shapes = fit.problem, fit.point.shapes
    history = list(problem.history)
    history[problem.fitted[k]] = replace(history[problem.fitted[k]], held_out=True)
    kept = [i for i in range(len(problem.used)) if i != k]
    if fit.model.has_state:  # the pose is still in the history, but no point shows its deviations
        own = shapes.deviation.copy()
        own[problem.used[k]] = 0.0
        shapes = replace(shapes, deviation=own)
    else:
        shapes = shapes.subset(kept)
    places = [fit.point.projections[i] for i in kept]
    others = replace(problem, history=history, weights=tuple(problem.whitening[i] for i in kept))
    with suppress(EstimationError, np.linalg.LinAlgError):
        point = others.balanced(Values(fit.point.theta, shapes, places))
        if point is not None:
            return descend(Fit(others, point), tolerance=NEARLY).point.theta
    return None


def _first_order(fit: Fit, k: int, theta: FloatArray) -> FloatArray:
    """Whitened residuals (R_k,) of the k-th fitted pose at other unknowns, without deviations."""
    lin, a = fit.linearization, fit.linearization.by_theta[k]
    own = lin.by_deviation[k] @ fit.own_deviations[k]
    return np.asarray(lin.residuals[k] + a @ (theta - fit.point.theta) - own)


def _density(fit: Fit, k: int, off: FloatArray, covariance: FloatArray) -> float:
    """Log density of whitened residuals of the k-th fitted pose.

    `covariance`: of the unknowns without it, to first order about the fit.
    """
    white = float(np.linalg.slogdet(fit.problem.whitening[k])[1])
    return fit.mixed.density(k, off, covariance) + white


def _density_of(fit: Fit, k: int, seen: Observed | None, covariance: FloatArray) -> float:
    """`_density` of the k-th pose, seen as in `_at_own_deviations`; -inf without an equilibrium."""
    if seen is None:
        return -np.inf
    item = fit.problem.fit_poses[k]
    off = fit.problem.whitening[k] @ item.residual(
        seen, item.located(seen, fit.point.projections[k])
    )
    if fit.problem.random_std.any():
        off = off - fit.linearization.by_deviation[k] @ fit.own_deviations[k]
    return _density(fit, k, off, covariance)


def _validation(errors: Sequence[tuple[FloatArray, FloatArray] | None]) -> CrossValidation:
    """Validation from each fold's errors [m] of points and wrenches; None if not predicted."""
    both = [np.zeros(1) if fold is None else np.concatenate(fold) for fold in errors]
    squares = np.array([float((fold**2).sum()) for fold in both])
    squares[[fold is None for fold in errors]] = np.inf
    points = np.concatenate([np.zeros(0), *(fold[0] for fold in errors if fold is not None)])
    rmse = float(np.sqrt((points**2).sum() / max(len(points), 1)))
    return CrossValidation(squares, np.array([float(len(fold)) for fold in both]), rmse)


def _stepped(fit: Fit, normal: Normal) -> tuple[FloatArray, FloatArray]:
    """Unknowns after one step of normal equations without part of the data; their covariance."""
    unknowns = fit.problem.unknowns
    lower, upper = unknowns.bounds
    # A direction without information (e.g. the place of a mass of zero) has its bounds as prior.
    ridge = 1e-9 * np.diag(np.diag(fit.normal.hessian)) + np.diag(1 / unknowns.widest**2)
    covariance = np.linalg.inv(normal.hessian + ridge)
    return np.clip(fit.point.theta - covariance @ normal.gradient, lower, upper), covariance


def _at_own_deviations(
    fit: Fit, thetas: Mapping[int, FloatArray], predicted: dict[int, Observed | None]
) -> dict[int, Observed | None]:
    """As `predicted`, but with each pose's random deviations as fitted.

    Turns of 0.05 rad have effects of second order far above the noise: predicted from declared
    ends, the density of a pose was e^105 too low.
    """
    if not fit.problem.random_std.any():
        return predicted
    return _predicted(fit, thetas, fit.point.shapes)


def _predicted(
    fit: Fit, thetas: Mapping[int, FloatArray], start: Shapes | None = None
) -> dict[int, Observed | None]:
    """Predicted measurements of fitted poses at their own unknowns.

    `start`: shapes with the deviations to predict with; by default none.
    The state before a pose is that of the fit, to which its first-order change is added.
    """
    problem, equilibria, unknowns = fit.problem, fit.problem.equilibria, fit.problem.unknowns
    if not thetas:
        return {}
    p = np.repeat(fit.p[None], equilibria.m, axis=0)
    rest = equilibria.rests(fit.point.shapes, fit.p, fit.rest)
    at = {k: problem.used[k] for k in thetas}
    for k, j in at.items():
        p[j] = unknowns.p(thetas[k])
        by_theta = fit.linearization.shapes.rest[j][:, : unknowns.size]
        rest[j] += by_theta @ (thetas[k] - fit.point.theta)
    if start is None:
        shapes = fit.point.shapes
        start = replace(shapes, deviation=np.zeros_like(shapes.deviation))
    # Without its random moment a pose is far off. Any other pose that Newton's method loses is at
    # the edge of stability: a descent would end in another equilibrium, an error of any model.
    random = fit.problem.random_std.any()
    solved, converged = (equilibria.solve_or_descend if random else equilibria.solve)(
        start, p, rest
    )
    seen = equilibria.seen(solved, p, rest)
    return {k: seen[j] if converged[j] else None for k, j in at.items()}


def _stretches(fit: Fit) -> CrossValidation:
    """Cross-validation along the arc of a single pose."""
    problem, lin, size = fit.problem, fit.linearization, fit.problem.unknowns.size
    (item,), (raw,) = problem.fit_poses, lin.raw
    points = np.argsort(fit.point.projections[0], kind="stable")  # a stretch of all photographs
    by_theta, by_own = np.split(lin.raw_directions[0], [size], axis=1)
    root = np.linalg.inv(problem.whitening[0])
    noise = root @ root.T
    errors: list[tuple[FloatArray, FloatArray] | None] = []
    densities = []
    for left_out in np.array_split(points, min(STRETCHES, len(points))):
        kept = np.ones(item.n_residuals, dtype=bool)
        kept[item.on_points] = ~np.isin(item.point_of, left_out)
        # Correlated noise: the fit's weights would mix left-out points into those beside them.
        white = _whitening(noise[np.ix_(kept, kept)])
        e, a, b = ([white @ part[kept]] for part in (raw, by_theta, by_own))
        normal = replace(fit.mixed, residuals=e, by_shared=a, by_own=b).normal
        hessian = normal.hessian + 1e-9 * np.diag(np.diag(normal.hessian))
        covariance = np.linalg.inv(hessian + NO_INFORMATION * np.eye(size))
        step = -covariance @ normal.gradient
        both = np.append(step, 1.0), np.pad(covariance, (0, 1))
        (mean,), (covariance,) = normal.own.joint(*both)
        lower, upper = problem.unknowns.bounds
        theta = np.clip(fit.point.theta + step, lower, upper)
        seen = _predicted(fit, {0: theta})[0]
        missed = None if seen is None else item.misses(seen.curve)[left_out]
        errors.append(None if missed is None else (missed, np.zeros(0)))
        columns = np.column_stack([by_own, by_theta, raw])
        off: FloatArray = columns @ mean
        if seen is not None:
            off = item.residual(seen, item.located(seen, fit.point.projections[0]))
        ways = columns[~kept] @ root_of(covariance)
        white = _whitening(noise[np.ix_(~kept, ~kept)])
        told = log_density(white @ off[~kept], white @ ways)
        densities.append(told + float(np.linalg.slogdet(white)[1]))
    return replace(_validation(errors), densities=np.array(densities))


def _whitening(covariance: FloatArray) -> FloatArray:
    """Matrix W (K, K) with W covariance W^T = 1."""
    factor = np.linalg.cholesky(covariance)
    return np.asarray(solve_triangular(factor, np.eye(len(factor)), lower=True))
