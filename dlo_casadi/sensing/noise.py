"""Noise of measured points: white plus correlated along the cable.

    cov(d_i, d_k) = std^2 w_i w_k [ (1 - share) delta_ik / c_i + share k(|s_i - s_k| / l) ]

for one component d of the errors at arc lengths s with relative weights w. A point may be the mean
of c measured neighbours, whose white errors average out. Whether the correlated part is rough
(exponential), once differentiable (Matern 3/2) or smooth (squared exponential) is chosen by
likelihood.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dtrtrs
from scipy.optimize import minimize

from dlo_casadi.arrays import FloatArray

Kernel = Literal["exponential", "matern", "gaussian"]
Count = FloatArray | float
Source = Literal["declared", "repeats", "estimated", "misfit"]
KERNELS: tuple[Kernel, ...] = ("exponential", "matern", "gaussian")
# Number of slow sines per pose: displacements that a missing effect may cause.
SLOW_MODES = 6
# Singular value, relative to the largest, below which directions are dependent: the square root of
# the rounding error of their products, 1e-8, and two digits.
_DEPENDENT = 1e-6
# Correlated share of the variance above which noise counts as smooth, and points are thinned.
# Points closer than the correlation length determine the kernel's shape, not the slow errors: on
# rendered photographs the variance of slow errors was 0.9 with 80 points a pose, and 0.37 with 160,
# of that with 54.
SMOOTH = 0.9
# Fewest points, beyond its own directions, of a pose used for the noise; and fewest degrees of
# freedom of all poses together for a size and a correlation.
_SPARE_POINTS, _LEAST_DEGREES = 5, 6
# Maximum number of poses used for the correlation, evenly spaced; the size of the noise uses all.
_MOST_POSES = 60


def correlation(kernel: Kernel, ratio: FloatArray) -> FloatArray:
    """Correlation at the distance `ratio` correlation lengths."""
    if kernel == "exponential":
        return np.exp(-ratio)
    if kernel == "matern":
        scaled = np.sqrt(3.0) * ratio
        return (1 + scaled) * np.exp(-scaled)
    return np.exp(-0.5 * ratio**2)


@dataclass(frozen=True)
class ReadingNoise:
    """Standard deviations of one component of a measured force [N] and of a moment [N m].

    `force_known`, `moment_known`: whether they were declared; otherwise they are estimated.
    """

    force: float
    moment: float
    force_known: bool = False
    moment_known: bool = False


@dataclass(frozen=True)
class NoiseModel:
    """Covariance of one component of the errors of one pose's points, and of readings.

    Parameters
    ----------
    std : float [m]
        Standard deviation of one coordinate of a measured point of weight one.
    share : float, in [0, 1)
        Share of the variance that is correlated along the cable.
    length : float [m]
        Correlation length.
    kernel : "exponential", "matern" or "gaussian"
    source : "declared", "repeats", "estimated" or "misfit"
        Origin: declared, the difference of repeated poses, or estimated from the residual. With
        "misfit" it is no noise but the error of a model that lacks an effect, and weighs the
        points in a fit of it.
    slow_dof : float
        Degrees of freedom of the chi-square distribution of the slow modes' estimated variance.
    readings : ReadingNoise, optional
        Of forces and moments on the fixtures, where there are any.
    before : NoiseModel, optional
        Of a misfit: the noise itself.
    """

    std: float
    share: float = 0.0
    length: float = 0.0
    kernel: Kernel = "matern"
    source: Source = "estimated"
    slow_dof: float = np.inf
    readings: ReadingNoise = ReadingNoise(1.0, 1.0)
    before: Self | None = None

    @property
    def of_points(self) -> Self:
        """The known noise where this is a misfit, otherwise this noise itself."""
        return self.before if self.before is not None and self.before.known else self

    @property
    def beside_repeats(self) -> float:
        """Standard deviation of points [m] beside the scatter of repeats; 0 if that includes it."""
        return 0.0 if self.source == "repeats" else self.std

    @property
    def white(self) -> float:
        """Standard deviation of the errors that points do not share [m]."""
        return self.std * float(np.sqrt(1 - self.share))

    @property
    def known(self) -> bool:
        """Whether it is independent of the model that is fitted."""
        return self.source != "estimated"

    def covariance(
        self, s: FloatArray, weight: FloatArray, correlation_length: float = 0.0, count: Count = 1.0
    ) -> FloatArray:
        """Covariance matrix (K, K) [m^2] at arc lengths s."""
        unit = self.correlation(np.abs(s[:, None] - s[None]), correlation_length, count)
        return self.std**2 * unit * np.outer(weight, weight)

    def correlation(
        self, distance: FloatArray, correlation_length: float = 0.0, count: Count = 1.0
    ) -> FloatArray:
        """Covariance (K, K), over std^2, of points at distances (K, K) [m] along the cable.

        Each is the mean of `count` measured ones. Over `correlation_length` [m] they share the
        errors that are white otherwise, by a Gaussian.
        """
        if self.share > 0:
            unit = self.share * correlation(self.kernel, distance / self.length)
        else:
            unit = np.zeros_like(distance)
        if correlation_length:
            unit += (1 - self.share) * correlation("gaussian", distance / correlation_length)
        else:
            unit.flat[:: len(unit) + 1] += (1 - self.share) / count
        unit.flat[:: len(unit) + 1] += 1e-9
        return unit

    def units(self, kinds: NDArray[np.str_]) -> FloatArray:
        """Metres (R,) per unit of each residual, such that its std becomes that of a point.

        One of points, m/N of forces, 1/N of moments.
        """
        own = {"point": self.std, "force": self.readings.force, "moment": self.readings.moment}
        return self.std / np.array([own[kind] for kind in kinds])

    def doubted(self, std: float) -> "NoiseModel":
        """White noise of this size [m] if it is larger, with that of wrenches scaled alike."""
        factor, own = std / self.std, self.readings
        if factor <= 1:
            return self
        grown = replace(own, force=factor * own.force, moment=factor * own.moment)
        return NoiseModel(std, readings=grown)

    def whitening(
        self, s: FloatArray, weight: FloatArray, correlation_length: float = 0.0, count: Count = 1.0
    ) -> FloatArray:
        """Matrix W (K, K) with W cov W^T = 1."""
        if self.share == 0 and correlation_length == 0:
            return np.diag(np.sqrt(count) / (self.std * weight))
        factor = np.linalg.cholesky(self.covariance(s, weight, correlation_length, count))
        return solve_triangular(factor, np.eye(len(s)), lower=True)


def smooth_modes(s: FloatArray, length: float, count: int, free_end: bool) -> FloatArray:
    """Slow sines (K, count) along the cable, displacements that a missing effect may cause."""
    k = np.arange(1, count + 1) - (0.5 if free_end else 0.0)
    return np.sin(np.pi * np.outer(s / length, k))


@dataclass(frozen=True)
class NoiseSample:
    """Residuals of one pose's points, and the directions of them that are not noise.

    Parameters
    ----------
    residuals : (R,) [m]
        Distances to a curve close to the measured one, `per_point` of each point, point by point.
    places : (K,) [m]
        Arc lengths of the points.
    weight : (K,)
        Relative standard deviations.
    own : (R, a)
        Directions in which the curve of this pose alone may change; projected out.
    shared : (R, b)
        Directions in which all poses change together; projected out. Stacked over the poses
        they are independent of one another and of the poses' own directions.
    correlation_length : scalar [m]
        Length over which the otherwise white errors are correlated.
    count : (K,) or one for all
        Measured points of which each is the mean.
    """

    residuals: FloatArray
    places: FloatArray
    weight: FloatArray
    own: FloatArray
    shared: FloatArray
    correlation_length: float = 0.0
    count: Count = 1.0

    def thinned(self, most: int) -> "NoiseSample":
        """Keep at most `most` points, evenly spaced, and the own directions that change them.

        Some of a pose's directions may not change the points of one of its photographs.
        """
        step = max(1, -(-len(self.places) // most))
        kept = np.arange(0, len(self.places), step)
        rows = (kept[:, None] * self.per_point + np.arange(self.per_point)).ravel()
        basis, values, _ = np.linalg.svd(self.own[rows], full_matrices=False)
        return NoiseSample(
            self.residuals[rows],
            self.places[kept],
            self.weight[kept],
            basis[:, values > _DEPENDENT * values.max(initial=0.0)],
            self.shared[rows],
            self.correlation_length,
            np.broadcast_to(self.count, len(self.places))[kept],
        )

    @property
    def per_point(self) -> int:
        """Residuals of a point."""
        return len(self.residuals) // len(self.places)

    @cached_property
    def distance(self) -> FloatArray:
        """Distances (K, K) [m] between the points along the cable."""
        return np.abs(self.places[:, None] - self.places[None])

    @cached_property
    def scaled(self) -> FloatArray:
        """Residuals, shared, own directions (K, per_point, 1 + b + a) over the points' weights."""
        stacked = np.column_stack([self.residuals, self.shared, self.own])
        by_point = stacked.reshape((len(self.places), self.per_point, -1))
        return np.asarray(by_point / self.weight[:, None, None])


def restricted_deviance(unit: NoiseModel, samples: list[NoiseSample]) -> tuple[float, float]:
    """Restricted -2 log likelihood with the scale profiled out, and that scale [m].

    REML: the directions of the fitted curves are projected out and the degrees of freedom reduced
    accordingly, so that a good fit does not make the noise look smaller.

    References
    ----------
    Patterson and Thompson, Biometrika 58 (1971).
    """
    logdet, count = 0.0, 0
    gram = np.zeros((samples[0].shared.shape[1] + 1,) * 2)
    for sample in samples:
        factor = np.linalg.cholesky(
            unit.correlation(sample.distance, sample.correlation_length, sample.count)
        )
        points, each, columns = sample.scaled.shape
        # LAPACK itself: for matrices this small SciPy's checks take longer than the solution.
        y = dtrtrs(factor.T, sample.scaled.reshape((points, -1)), lower=0, trans=1)[0]
        y = y.reshape((points * each, columns))
        products, k = y.T @ y, len(gram)
        logdet += 2 * each * float(np.log(factor.diagonal() * sample.weight).sum())
        gram += products[:k, :k]
        if columns > k:
            own = np.linalg.cholesky(products[k:, k:])
            left = dtrtrs(own.T, products[k:, :k], lower=0, trans=1)[0]
            logdet += 2 * float(np.log(own.diagonal()).sum())
            gram -= left.T @ left
        count += len(y) - (columns - k)
    quadratic = gram[0, 0]
    if len(gram) > 1:
        shared, cross = gram[1:, 1:], gram[1:, 0]
        shared = shared + 1e-9 * np.trace(shared) / len(shared) * np.eye(len(shared))
        quadratic -= float(cross @ np.linalg.solve(shared, cross))
        logdet += float(np.linalg.slogdet(shared)[1])
        count -= len(shared)
    variance = quadratic / count
    return count * np.log(variance) + logdet, float(np.sqrt(variance))


def estimate_noise(
    samples: list[NoiseSample], cable_length: float, max_points: int = 80
) -> NoiseModel:
    """Estimate size and correlation of the noise from the residuals of all poses.

    Parameters
    ----------
    samples : list of NoiseSample
    cable_length : float [m]
    max_points : int
        Maximum number of points used per pose, evenly spaced; fewer where the noise is smooth.

    See Also
    --------
    tell_of_noise : whether there are enough points for it.
    """
    samples = [sample.thinned(max_points) for sample in _telling(samples)]
    everything, samples = samples, samples[:: max(1, -(-len(samples) // _MOST_POSES))]
    # A weak correlation must not be dropped: smooth residuals would then look significant. The
    # likelihood alone decides, without a penalty on the number of parameters.
    found = [_white(samples, cable_length)]
    found += [_correlated(samples, cable_length, kernel) for kernel in KERNELS]
    best = min(found, key=lambda item: item.deviance)
    # An average along the cable stands in `correlation_length`, not in the kernel.
    smooth = best.noise.share > SMOOTH and not samples[0].correlation_length
    apart = int(cable_length / best.noise.length) if smooth else max_points
    if apart < max_points and tell_of_noise([sample.thinned(apart) for sample in everything]):
        return estimate_noise(everything, cable_length, apart)
    noise = replace(best.noise, slow_dof=_slow_dof(found))
    if len(everything) == len(samples):
        return noise
    return replace(noise, std=restricted_deviance(replace(noise, std=1.0), everything)[1])


def tell_of_noise(samples: list[NoiseSample], least: float = _LEAST_DEGREES) -> bool:
    """Whether enough degrees of freedom are left for `estimate_noise` after the projection.

    Parameters
    ----------
    least : float
        Fewest degrees of freedom.
    """
    kept = _telling(samples)
    return bool(kept) and _degrees(kept) >= least


def _telling(samples: list[NoiseSample]) -> list[NoiseSample]:
    """Poses with points to spare."""
    return [x for x in samples if len(x.residuals) > x.own.shape[1] + _SPARE_POINTS]


@dataclass(frozen=True)
class _Estimate:
    """Most likely noise of one kernel, and the estimated variance of slow modes."""

    noise: NoiseModel
    deviance: float
    log_slow: float  # logarithm of that variance, relative to the other estimates
    log_slow_variance: float  # variance of that logarithm


def _white(samples: list[NoiseSample], cable_length: float) -> _Estimate:
    deviance, std = restricted_deviance(NoiseModel(1.0), samples)
    noise = NoiseModel(std)
    return _Estimate(
        noise, deviance, _log_slow(noise, samples, cable_length), 2 / _degrees(samples)
    )


def _correlated(samples: list[NoiseSample], cable_length: float, kernel: Kernel) -> _Estimate:
    """Nelder and Mead's search; the spread from the deviance's curvature at its minimum."""
    low, high = np.log(0.002), np.log(0.1)

    def unit(q: FloatArray) -> NoiseModel:
        length = cable_length * np.exp(np.clip(q[1], low, high))
        return NoiseModel(1.0, _logistic(q[0]), float(length), kernel)

    def noise_at(q: FloatArray) -> NoiseModel:
        return replace(unit(q), std=restricted_deviance(unit(q), samples)[1])

    def deviance(q: FloatArray) -> float:
        # Uniform prior of the share: slow modes are projected out, and on photographs the
        # likelihood alone gave slow errors of 0.11 mm instead of 0.015 mm, with a smooth kernel.
        share = _logistic(q[0])
        prior = -2 * np.log(4 * share * (1 - share))
        outside = 10 * float((q[1] - np.clip(q[1], low, high)) ** 2)
        return restricted_deviance(unit(q), samples)[0] + float(prior) + outside

    simplex = np.log([[0.5, 0.04], [2.0, 0.04], [0.7, 0.1]])
    found = minimize(
        deviance,
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.1, "fatol": 0.2, "maxfev": 40},
    )
    step = 0.4
    ahead, behind = found.x + step * np.eye(2), found.x - step * np.eye(2)
    slope = [
        _log_slow(noise_at(a), samples, cable_length)
        - _log_slow(noise_at(b), samples, cable_length)
        for a, b in zip(ahead, behind, strict=True)
    ]
    diagonal = [
        deviance(a) + deviance(b) - 2 * found.fun for a, b in zip(ahead, behind, strict=True)
    ]
    mixed = deviance(found.x + step) + deviance(found.x - step) - 2 * found.fun - sum(diagonal)
    hessian = np.array([[diagonal[0], mixed / 2], [mixed / 2, diagonal[1]]]) / step**2
    # The covariance is twice the inverse Hessian of -2 log likelihood, at least the prior's part.
    values, vectors = np.linalg.eigh(hessian)
    along = vectors.T @ (np.array(slope) / (2 * step))
    spread = 2 / _degrees(samples) + 2 * float((along**2 / np.maximum(values, 0.04)).sum())
    noise = noise_at(found.x)
    return _Estimate(noise, float(found.fun), _log_slow(noise, samples, cable_length), spread)


def _logistic(q: float) -> float:
    """Share whose logit is q, cut at 3e-4 from its limits."""
    return float(1 / (1 + np.exp(-np.clip(q, -8, 8))))


def _degrees(samples: list[NoiseSample]) -> float:
    """Number of residuals minus that of the directions that are projected out."""
    own = sum(len(sample.residuals) - sample.own.shape[1] for sample in samples)
    return float(max(own - samples[0].shared.shape[1], 1))


def _log_slow(noise: NoiseModel, samples: list[NoiseSample], cable_length: float) -> float:
    """Logarithm of the geometric mean of the variances of slow modes, taken of the middle pose."""
    sample = samples[len(samples) // 2]
    # Points at the fixtures, where sines vanish, determine no mode.
    count = min(SLOW_MODES, max(1, len(sample.places) - 3))
    modes = smooth_modes(sample.places, cable_length, count, free_end=False)
    seen = noise.whitening(sample.places, sample.weight, sample.correlation_length) @ modes
    return -float(np.linalg.slogdet(seen.T @ seen)[1]) / count


def _slow_dof(found: list[_Estimate]) -> float:
    """Degrees of freedom of the chi-square whose logarithm has the variance of `log_slow`.

    var(log slow) = E var(log slow | kernel) + var E(log slow | kernel), kernels weighted by their
    likelihood; var(log chi-square_k) = 2 / k.

    References
    ----------
    Satterthwaite, Biometrics Bulletin 2 (1946); Hoeting et al., Statistical Science 14 (1999).
    """
    deviance = np.array([item.deviance for item in found])
    weight = np.exp(-(deviance - deviance.min()) / 2)
    weight /= weight.sum()
    mean = np.array([item.log_slow for item in found])
    within = np.array([item.log_slow_variance for item in found])
    variance = float(weight @ (within + (mean - weight @ mean) ** 2))
    return 2 / variance
