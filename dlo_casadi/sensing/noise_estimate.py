"""Size and correlation of the noise, estimated from residuals of all poses."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.linalg.lapack import dtrtri
from scipy.optimize import Bounds, minimize
from scipy.special import expit

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EstimationError
from dlo_casadi.linear_mixed import OBSERVED, eliminated
from dlo_casadi.sensing.noise import SLOW_MODES, Count, Kernel, NoiseModel, smooth_modes

KERNELS: tuple[Kernel, ...] = ("exponential", "matern", "gaussian")
# Singular value, relative to the largest, below which directions count as dependent: the square
# root of the rounding error of their products, 1e-8, and two digits.
_DEPENDENT = 1e-6
# Correlated share of the variance above which noise counts as smooth and points are thinned,
# because points closer than the correlation length determine the kernel's shape, not the slow
# errors. On rendered photographs the variance of slow errors with 80 points a pose was 0.9 of that
# with 54, and 0.37 of it with 160.
SMOOTH = 0.9
# Smallest number of points, beyond its own directions, of a pose used for the noise; smallest
# number of degrees of freedom of all poses for a size and a correlation.
_SPARE_POINTS, _LEAST_DEGREES = 5, 6
# Logit of the share and log of length over the cable's: start of the search, then its limits.
_START = np.log([0.5, 0.04])
_LIMITS = np.array([[-8.0, np.log(0.002)], [8.0, np.log(0.1)]])
# Step of the differences that give the spread, large enough to cover the width of a likelihood that
# is no parabola; curvature of a prior that makes a length beyond the limits unlikely.
_STEP, _BEYOND = 0.4, 20.0
# Maximum number of poses used for the correlation, evenly spaced; the size of the noise uses all.
_MOST_POSES = 60


@dataclass(frozen=True)
class NoiseSample:
    """Residuals of one pose's points, and the directions of them that are not noise.

    Parameters
    ----------
    residuals : (R,) [m]
        Distances to a curve near the measured one, `per_point` for each point, point by point.
    places : (K,) [m]
        Arc lengths of the points.
    weight : (K,)
        Relative standard deviations.
    own : (R, a)
        Directions in which this pose's curve alone may change; they are projected out.
    shared : (R, b)
        Directions in which all poses change together; they are projected out. Stacked over the
        poses they are independent of each other and of the poses' own directions.
    correlation_length : scalar [m]
        Length over which the otherwise white errors are correlated.
    count : (K,) or one for all
        Number of measured points of which each point is the mean.
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

        Some directions of a pose may leave the points of one of its photographs unchanged.
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
        """Number of residuals per point."""
        return len(self.residuals) // len(self.places)

    @cached_property
    def distance(self) -> FloatArray:
        """Distances (K, K) [m] between the points along the cable."""
        return np.abs(self.places[:, None] - self.places[None])

    @cached_property
    def scaled(self) -> FloatArray:
        """Own and shared directions, residuals (K, per_point, a + b + 1), over the weights."""
        stacked = np.column_stack([self.own, self.shared, self.residuals])
        by_point = stacked.reshape((len(self.places), self.per_point, -1))
        return np.asarray(by_point / self.weight[:, None, None])


# Slope at which a search ends, with parameters in units of their standard errors.
_FLAT = 0.01
# Deviance returned for sizes whose sums are lost in rounding.
_LOST = 1e30


@dataclass(frozen=True)
class Deviance:
    """D = -2 log restricted likelihood up to a constant, and its gradient (k,) by the parameters.

        D = log |V| + log |X^T V^-1 X| + y^T P y,   P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1
        dD/dq_j = tr(P V_j) - y^T P V_j P y,   d2D/dq_j dq_k ~ y^T P V_j P V_k P y

    of observations y with covariance V(q), V_j = dV/dq_j; whatever effects of X may explain is
    excluded. The average of the observed and the expected second derivative needs no trace.

    References
    ----------
    Patterson and Thompson, Biometrika 58 (1971); Gilmour, Thompson and Cullis, Biometrics 51
    (1995).
    """

    value: float
    gradient: FloatArray


Found = TypeVar("Found", bound=Deviance)


def most_likely(
    deviance: Callable[[FloatArray], Found], start: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, Found]:
    """Parameters (k,) of least deviance within bounds, as logits or logarithms; that deviance.

    Uses L-BFGS-B. Newton steps with the average information need more evaluations: far from the
    optimum that is a tenth of the second derivative. Raises EstimationError if rounding leaves no
    covariance that can be factorised where the search ends.
    """

    def sloped(q: FloatArray) -> tuple[float, FloatArray]:
        try:
            found = deviance(q)
        except np.linalg.LinAlgError:
            return _LOST, np.zeros(len(q))
        return found.value, found.gradient

    found = minimize(
        sloped,
        start.astype(float),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(low.astype(float), high.astype(float)),
        options={"gtol": _FLAT, "ftol": 1e-7},
    )
    q = np.clip(found.x, low, high)
    try:
        return q, deviance(q)
    except np.linalg.LinAlgError as error:
        raise EstimationError(
            "noise and scatter from pose to pose cannot be estimated: rounding leaves no "
            "covariance that can be factorised, as of a fit that has run away.\n"
            "  Try: the units of mass and length, the noise as measurement.std."
        ) from error


@dataclass(frozen=True)
class Profile(Deviance):
    """By logit(share) and log(length), if correlated, with the scale `std` [m] profiled out."""

    std: float


def restricted_deviance(unit: NoiseModel, samples: list[NoiseSample]) -> Profile:
    """Restricted deviance of noise with a given correlation, of any size, see `Deviance`.

    The directions of the fitted curves are projected out, and the degrees of freedom are reduced
    accordingly, so that a good fit does not make the noise look smaller.
    """
    logdet, count, groups = 0.0, 0, []
    gram = np.zeros((samples[0].shared.shape[1] + 1,) * 2)
    for sample in samples:
        points, each, columns = sample.scaled.shape
        at = (sample.distance, sample.correlation_length, sample.count)
        factor = np.linalg.cholesky(unit.correlation(*at))
        white = dtrtri(factor, lower=1)[0]
        seen = (white @ sample.scaled.reshape((points, -1))).reshape((points * each, columns))
        own = eliminated(seen.T @ seen, np.zeros((columns - len(gram),) * 2))
        logdet += 2 * each * float(np.log(factor.diagonal() * sample.weight).sum()) + own.logdet
        gram += own.left
        count += len(seen) - len(own.block)
        groups.append((white, seen, own, unit.correlation_slopes(*at)))
    ridge = 1e-9 * np.trace(gram[:-1, :-1]) / max(len(gram) - 1, 1)
    shared = eliminated(gram, ridge * np.eye(len(gram) - 1))
    count -= len(gram) - 1
    variance = float(shared.left[0, 0]) / count
    known, gradient = shared.joint(*OBSERVED), np.zeros(len(groups[0][-1]))
    for white, seen, own, slopes in groups if len(gradient) else ():
        # Second moments of the coefficients, hence of the noise: Fisher's identity.
        mean, covariance = own.joint(*known)
        weighed = (white.T @ seen.reshape((len(white), -1))).reshape((len(white), -1, len(mean)))
        moved = weighed @ (covariance + np.outer(mean, mean) / variance)
        error = moved.reshape((len(white), -1)) @ weighed.reshape((len(white), -1)).T
        each = len(seen) // len(white)
        gradient += ((each * white.T @ white - error) * slopes).sum(axis=(1, 2))
    logdet += shared.logdet
    return Profile(count * np.log(variance) + logdet, gradient, float(np.sqrt(variance)))


def estimate_noise(
    samples: list[NoiseSample], cable_length: float, max_points: int = 80
) -> NoiseModel:
    """Estimate size and correlation of the noise from the residuals of all poses.

    Parameters
    ----------
    cable_length : float [m]
    max_points : int
        Maximum number of points used per pose, evenly spaced; fewer if the noise is smooth.

    See Also
    --------
    tell_of_noise : whether there are enough points for the estimate.
    """
    samples = [sample.thinned(max_points) for sample in _telling(samples)]
    everything, samples = samples, samples[:: max(1, -(-len(samples) // _MOST_POSES))]
    # A weak correlation is kept, because without it smooth residuals would look significant.
    # The likelihood alone decides, without a penalty on the number of parameters.
    found = [_white(samples, cable_length)]
    found += [_correlated(samples, cable_length, kernel) for kernel in KERNELS]
    best = min(found, key=lambda item: item.deviance)
    # The average along the cable is part of `correlation_length`, not of the kernel.
    smooth = best.noise.share > SMOOTH and not samples[0].correlation_length
    apart = int(cable_length / best.noise.length) if smooth else max_points
    thinned = [sample.thinned(apart) for sample in everything] if apart < max_points else []
    if tell_of_noise(thinned):
        wider = estimate_noise(everything, cable_length, apart)
        if wider.length >= best.noise.length:
            return wider
        # Farther points are independent. White noise of all points would average out: the near
        # ones tell how long errors last, these how large they are.
        size = restricted_deviance(replace(best.noise, std=1.0), thinned).std
        return replace(best.noise, std=size, slow_dof=wider.slow_dof)
    noise = replace(best.noise, slow_dof=_slow_dof(found))
    if len(everything) == len(samples):
        return noise
    return replace(noise, std=restricted_deviance(replace(noise, std=1.0), everything).std)


def tell_of_noise(samples: list[NoiseSample], least: float = _LEAST_DEGREES) -> bool:
    """Whether enough degrees of freedom are left for `estimate_noise` after the projection.

    `least`: smallest number of degrees of freedom.
    """
    kept = _telling(samples)
    return bool(kept) and _degrees(kept) >= least


def _telling(samples: list[NoiseSample]) -> list[NoiseSample]:
    """Samples of the poses that have enough points."""
    return [x for x in samples if len(x.residuals) > x.own.shape[1] + _SPARE_POINTS]


@dataclass(frozen=True)
class _Estimate:
    """Most likely noise of one kernel, and the estimated variance of slow modes."""

    noise: NoiseModel
    deviance: float
    log_slow: float  # logarithm of that variance, relative to the other estimates
    spread: Callable[[], float]  # computes the variance of that logarithm


def _white(samples: list[NoiseSample], cable_length: float) -> _Estimate:
    found = restricted_deviance(NoiseModel(1.0), samples)
    noise = NoiseModel(found.std)
    log_slow = _log_slow(noise, samples, cable_length)
    return _Estimate(noise, found.value, log_slow, lambda: 2 / _degrees(samples))


def _correlated(samples: list[NoiseSample], cable_length: float, kernel: Kernel) -> _Estimate:
    """Most likely share and length; their spread from the curvature of the deviance there."""

    def unit(q: FloatArray) -> NoiseModel:
        return NoiseModel(1.0, float(expit(q[0])), cable_length * float(np.exp(q[1])), kernel)

    def deviance(q: FloatArray) -> Profile:
        # Uniform prior of the share: as slow modes are projected out, the likelihood alone gave
        # slow errors of 0.11 mm instead of 0.015 mm on photographs, with a smooth kernel.
        found, share = restricted_deviance(unit(q), samples), expit(q[0])
        value = found.value - 2 * float(np.log(4 * share * (1 - share)))
        return replace(found, value=value, gradient=found.gradient + np.array([4 * share - 2, 0.0]))

    def beside(q: FloatArray) -> tuple[float, FloatArray]:
        at = np.clip(q, *_LIMITS)
        found = deviance(at)
        noise = replace(unit(at), std=found.std)
        return _log_slow(noise, samples, cable_length), found.gradient + _BEYOND * (q - at)

    def spread() -> float:
        steps = _STEP * np.eye(2)
        ahead, behind = ([beside(q + way * step) for step in steps] for way in (1, -1))
        slope, bend = (
            np.array([a[k] - b[k] for a, b in zip(ahead, behind, strict=True)]) / (2 * _STEP)
            for k in (0, 1)
        )
        # The covariance is twice the inverse Hessian of -2 log likelihood; at least the prior's.
        values, vectors = np.linalg.eigh((bend + bend.T) / 2)
        along = vectors.T @ slope
        return 2 / _degrees(samples) + 2 * float((along**2 / np.maximum(values, 0.04)).sum())

    q, found = most_likely(deviance, _START, *_LIMITS)
    noise = replace(unit(q), std=found.std)
    return _Estimate(noise, found.value, _log_slow(noise, samples, cable_length), spread)


def _degrees(samples: list[NoiseSample]) -> float:
    """Number of residuals minus that of the directions that are projected out."""
    own = sum(len(sample.residuals) - sample.own.shape[1] for sample in samples)
    return float(max(own - samples[0].shared.shape[1], 1))


def _log_slow(noise: NoiseModel, samples: list[NoiseSample], cable_length: float) -> float:
    """Log of the geometric mean of the variances of slow modes, evaluated for the middle pose."""
    sample = samples[len(samples) // 2]
    # Points at the fixtures, where sines vanish, determine no mode.
    count = min(SLOW_MODES, max(1, len(sample.places) - 3))
    modes = smooth_modes(sample.places, cable_length, count, free_end=False)
    at = (sample.places, sample.weight, sample.correlation_length, sample.count)
    seen = noise.whitening(*at) @ modes
    known = np.linalg.eigvalsh(seen.T @ seen)
    # In a fit that has run away all points may be at a fixture.
    return -float(np.log(np.maximum(known, 1e-300)).sum()) / count


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
    within = np.array([item.spread() for item in found])
    variance = float(weight @ (within + (mean - weight @ mean) ** 2))
    return 2 / variance
