"""Noise of measured points: white plus correlated along the cable.

    cov(d_i, d_k) = std^2 w_i w_k [ (1 - share) delta_ik / c_i + share k(|s_i - s_k| / l) ]

for one component d of the errors at arc lengths s with relative weights w. A point may be the mean
of c measured neighbours, whose white errors average out. The likelihood decides whether the
correlated part is rough (exponential), once differentiable (Matern 3/2) or smooth (squared
exponential).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from dlo_casadi.arrays import FloatArray
from dlo_casadi.rod.quantities import QUANTITIES, Quantity

Kernel = Literal["exponential", "matern", "gaussian"]
Count = FloatArray | float
Source = Literal["declared", "repeats", "estimated", "misfit"]
# Number of slow sines per pose, the displacements that a missing effect may cause.
SLOW_MODES = 6


def correlation(kernel: Kernel, ratio: FloatArray) -> FloatArray:
    """Correlation at the distance `ratio` correlation lengths."""
    if kernel == "exponential":
        return np.exp(-ratio)
    if kernel == "matern":
        scaled = np.sqrt(3.0) * ratio
        return (1 + scaled) * np.exp(-scaled)
    return np.exp(-0.5 * ratio**2)


def correlation_slope(kernel: Kernel, ratio: FloatArray) -> FloatArray:
    """Derivative of `correlation` by the logarithm of the correlation length."""
    if kernel == "exponential":
        return ratio * np.exp(-ratio)
    if kernel == "matern":
        return 3.0 * ratio**2 * np.exp(-np.sqrt(3.0) * ratio)
    return ratio**2 * np.exp(-0.5 * ratio**2)


@dataclass(frozen=True)
class ReadingNoise:
    """Standard deviations of one component of a measured force [N] and of a moment [N m].

    `force_known`, `moment_known`: whether they are declared; otherwise they are estimated.
    """

    force: float
    moment: float
    force_known: bool = False
    moment_known: bool = False

    def of(self, quantity: Quantity) -> float:
        """Standard deviation of one component of what is read."""
        return float(getattr(self, quantity.name))

    def known(self, quantity: Quantity) -> bool:
        """Whether it is declared."""
        return bool(getattr(self, f"{quantity.name}_known"))

    def with_std(self, stds: Mapping[Quantity, float]) -> Self:
        """The same with other standard deviations."""
        changed: dict[str, Any] = {x.name: std for x, std in stds.items()}
        return replace(self, **changed)


@dataclass(frozen=True)
class NoiseModel:
    """Covariance of one component of the errors of a pose's points, and of wrench measurements.

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
        Origin: declared, difference between repeated poses, or estimated from the residual. With
        "misfit" it is not noise but the error of a model that lacks an effect, used to weigh the
        points in a fit of that model.
    slow_dof : float
        Degrees of freedom of the chi-square distribution of the slow modes' estimated variance.
    readings : ReadingNoise, optional
        Noise of forces and moments on the fixtures, if these are measured.
    before : NoiseModel, optional
        For a misfit: the noise itself.
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
        """The known noise if this is a misfit, otherwise this noise."""
        return self.before if self.before is not None and self.before.known else self

    @property
    def beside_repeats(self) -> float:
        """Std of points [m] in addition to the scatter of repeats; 0 if that includes it."""
        return 0.0 if self.source == "repeats" else self.std

    @property
    def white(self) -> float:
        """Standard deviation of the errors that points do not share [m]."""
        return self.std * float(np.sqrt(1 - self.share))

    @property
    def known(self) -> bool:
        """Whether the noise does not depend on the model that is fitted."""
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

        Each point is the mean of `count` measured ones. Errors that are otherwise white are
        correlated over `correlation_length` [m], by a Gaussian.
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

    def correlation_slopes(
        self, distance: FloatArray, correlation_length: float = 0.0, count: Count = 1.0
    ) -> FloatArray:
        """Derivatives (2, K, K) of `correlation` by logit(share) and log(length), if correlated."""
        if self.share == 0:
            return np.zeros((0, *distance.shape))
        ratio, white = distance / self.length, replace(self, share=0.0)
        apart = correlation(self.kernel, ratio)
        apart -= white.correlation(distance, correlation_length, count)
        by_length = self.share * correlation_slope(self.kernel, ratio)
        return np.stack([self.share * (1 - self.share) * apart, by_length])

    def units(self, kinds: NDArray[np.str_]) -> FloatArray:
        """Metres (R,) per unit of each residual, such that its std becomes that of a point.

        One for points, m/N for forces, 1/N for moments.
        """
        own = {"point": self.std} | {x.name: self.readings.of(x) for x in QUANTITIES}
        return self.std / np.array([own[kind] for kind in kinds])

    def doubted(self, std: float) -> "NoiseModel":
        """White noise of this size [m] if it is larger; noise of wrenches is scaled alike."""
        factor, own = std / self.std, self.readings
        if factor <= 1:
            return self
        grown = own.with_std({x: factor * own.of(x) for x in QUANTITIES})
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
