"""Noise of a measured centre-line: white plus correlated along the cable.

    cov(d_i, d_k) = std^2 w_i w_k [ (1 - share) delta_ik + share k(|s_i - s_k| / l) ]

for normal distances d at arc lengths s with relative weights w. Whether the correlated part is
rough (exponential) or smooth (squared exponential) is chosen by likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

FloatArray = NDArray[np.floating]
Kernel = Literal["exponential", "matern", "gaussian"]
KERNELS: tuple[Kernel, ...] = ("exponential", "matern", "gaussian")


def correlation(kernel: Kernel, ratio: FloatArray) -> FloatArray:
    """Correlation at the distance `ratio` correlation lengths."""
    if kernel == "exponential":
        return np.exp(-ratio)
    if kernel == "matern":
        scaled = np.sqrt(3.0) * ratio
        return (1 + scaled) * np.exp(-scaled)
    return np.exp(-0.5 * ratio**2)


@dataclass(frozen=True)
class NoiseModel:
    """Covariance of the normal distances of one pose.

    Parameters
    ----------
    std : float [m]
        Standard deviation of one coordinate of a point of weight one.
    share : float, in [0, 1)
        Share of the variance that is correlated along the cable.
    length : float [m]
        Correlation length.
    kernel : "exponential", "matern" or "gaussian"
    declared : bool
        Whether the standard deviation was declared instead of estimated.
    """

    std: float
    share: float = 0.0
    length: float = 0.0
    kernel: Kernel = "matern"
    declared: bool = False

    def covariance(self, s: FloatArray, weight: FloatArray) -> FloatArray:
        """Covariance matrix (K, K) [m^2] at arc lengths s."""
        unit = np.eye(len(s)) * (1 - self.share + 1e-9)
        if self.share > 0:
            distance = np.abs(s[:, None] - s[None])
            unit += self.share * correlation(self.kernel, distance / self.length)
        return self.std**2 * unit * np.outer(weight, weight)

    def whitening(self, s: FloatArray, weight: FloatArray) -> FloatArray:
        """Matrix W (K, K) with W cov W^T = 1."""
        if self.share == 0:
            return np.diag(1 / (self.std * weight))
        factor = np.linalg.cholesky(self.covariance(s, weight))
        return solve_triangular(factor, np.eye(len(s)), lower=True)


def smooth_modes(s: FloatArray, length: float, count: int, free_end: bool) -> FloatArray:
    """Displacements (K, count) that a missing effect may cause: slow sines along the cable."""
    k = np.arange(1, count + 1) - (0.5 if free_end else 0.0)
    return np.sin(np.pi * np.outer(s / length, k))


@dataclass(frozen=True)
class NoiseSample:
    """What one pose tells about the noise.

    Parameters
    ----------
    distances : (K,) [m]
        Normal distances to a curve close to the measured one.
    places : (K,) [m]
        Arc lengths of the points.
    weight : (K,)
        Relative standard deviations.
    own : (K, a)
        Directions that the curve of this pose alone may take; projected out.
    shared : (K, b)
        Directions along which all poses move together; projected out.
    """

    distances: FloatArray
    places: FloatArray
    weight: FloatArray
    own: FloatArray
    shared: FloatArray

    def thinned(self, most: int) -> NoiseSample:
        """Keep at most so many points, evenly picked."""
        step = max(1, -(-len(self.distances) // most))
        return NoiseSample(
            self.distances[::step],
            self.places[::step],
            self.weight[::step],
            self.own[::step],
            self.shared[::step],
        )


def restricted_deviance(unit: NoiseModel, samples: list[NoiseSample]) -> tuple[float, float]:
    """Restricted -2 log likelihood with the scale profiled out, and that scale [m].

    REML: the directions that the fitted curves may take are projected out and their loss of
    degrees of freedom is counted, so that a good fit does not make the noise look smaller.

    References
    ----------
    Patterson and Thompson, Biometrika 58 (1971).
    """
    logdet, count = 0.0, 0
    gram = np.zeros((samples[0].shared.shape[1] + 1,) * 2)
    for sample in samples:
        factor = np.linalg.cholesky(unit.covariance(sample.places, sample.weight))
        stacked = np.column_stack([sample.distances, sample.shared, sample.own])
        y = solve_triangular(factor, stacked, lower=True)
        head, own = y[:, : len(gram)], y[:, len(gram) :]
        logdet += 2 * float(np.log(np.diag(factor)).sum())
        if own.shape[1]:
            basis, triangle = np.linalg.qr(own)
            head = head - basis @ (basis.T @ head)
            logdet += 2 * float(np.log(np.abs(np.diag(triangle))).sum())
        gram += head.T @ head
        count += len(sample.distances) - own.shape[1]
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
    samples: list[NoiseSample], cable_length: float, max_points: int = 80, max_poses: int = 60
) -> NoiseModel:
    """Estimate size and correlation of the noise from normal distances of all poses.

    Parameters
    ----------
    samples : list of NoiseSample
    cable_length : float [m]
    max_points : int
        Points used per pose; evenly thinned beyond that.
    max_poses : int
        Poses from which the correlation is estimated, evenly picked; its size is that of all.
    """
    samples = [sample.thinned(max_points) for sample in samples]
    samples = [sample for sample in samples if len(sample.distances) > sample.own.shape[1] + 5]
    everything, samples = samples, samples[:: max(1, -(-len(samples) // max_poses))]
    white_deviance, white_std = restricted_deviance(NoiseModel(1.0), samples)
    # A correlation that is there but weak must not be dropped: it makes smooth residuals
    # look significant. So the likelihood alone decides, without a price on the parameters.
    best, best_deviance = NoiseModel(white_std), white_deviance
    low, high = np.log(0.002), np.log(0.1)
    for kernel in KERNELS:

        def unit(q: FloatArray, kernel: Kernel = kernel) -> NoiseModel:
            share = 0.98 / (1 + np.exp(-np.clip(q[0], -8, 8)))
            return NoiseModel(1.0, share, cable_length * np.exp(np.clip(q[1], low, high)), kernel)

        def deviance(q: FloatArray) -> float:
            outside = 10 * float((q[1] - np.clip(q[1], low, high)) ** 2) + 0.02 * float(q[0] ** 2)
            return restricted_deviance(unit(q), samples)[0] + outside

        simplex = np.log([[0.5, 0.04], [2.0, 0.04], [0.7, 0.1]])
        found = minimize(
            deviance,
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 0.1, "fatol": 0.2, "maxfev": 40},
        )
        if found.fun < best_deviance:
            best_deviance = float(found.fun)
            model = unit(found.x)
            _, std = restricted_deviance(model, samples)
            best = NoiseModel(std, float(model.share), float(model.length), kernel)
    if len(everything) == len(samples):
        return best
    return replace(best, std=restricted_deviance(replace(best, std=1.0), everything)[1])
