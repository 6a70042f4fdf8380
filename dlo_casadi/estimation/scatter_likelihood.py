"""How much a cable differs at random from pose to pose: restricted likelihood of what is left.

If there are many different poses, each repeat has a random quantity of its own. Most often it is a
rest curvature,

    kappa_j(s) = kappa_0(s) + std sum_k sqrt(v_k) c_jk f_k(s),    c_jk ~ N(0, 1)
    f_0 = 1, f_k = sqrt(2) cos(k pi s / L),    v_k ~ exp(-(k pi l / L)^2 / 2),    sum_k v_k = 1

left by friction between strands and by set. It may also be moments of pins, turns of clamps, places
of the end, or lengths: the likeliest is chosen. To first order it changes the residuals of pose j
by std E_j c_j, so their covariance is that of the noise plus std^2 E_j E_j^T.

A model that lacks something leaves residuals, too, but they are alike in poses that are alike. A
second part, correlated over the poses' shapes, therefore absorbs what is systematic while the size
of the random part is estimated:

    cov(c_j, c_k) = std^2 delta_jk + systematic^2 exp(-d_jk^2 / (2 range^2))

with d_jk the RMS distance of the two shapes. All sizes maximise the restricted likelihood.

References
----------
Patterson and Thompson, Biometrika 58 (1971); Kennedy and O'Hagan, J. R. Statist. Soc. B 63 (2001).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc, chdtri

from dlo_casadi.arrays import FloatArray
from dlo_casadi.linear_mixed import OBSERVED, eliminated
from dlo_casadi.model.pose_scatter import REST_CURVATURE, SMOOTHNESS, PoseScatter
from dlo_casadi.sensing.noise_estimate import Deviance, most_likely
from dlo_casadi.thresholds import SIGNIFICANCE

# Trial ranges of the systematic part, as shares of the RMS distance between the poses' shapes.
RANGES = (0.25, 1.0)
# Decrease of -2 log likelihood above which a size counts as nonzero: chance exceeds it in 5 % of
# cases. Evidence: at 0.5 %, 3 of 17 simulated cables that do not repeat were judged to repeat
# (decreases 3.5 to 5.9), and the stiffness of one of them was two standard deviations off.
TELLING = float(chdtri(1, 0.1))
# Maximum number of poses used, evenly spaced.
MOST_POSES = 40
# Smallest and largest size searched, in units of the first guess.
_LOWEST, _HIGHEST = np.log(1e-4), np.log(1e2)


@dataclass(frozen=True)
class ScatterSample:
    """Data of one pose: residuals e, and the effects that change them, all whitened by the noise.

    Parameters
    ----------
    e : (R,)
    random : (R, q)
        Change by a unit of what differs from pose to pose, see `PoseScatter.ways`.
    own : (R, a)
        Change by one standard deviation of each other quantity of this pose alone.
    shared : (R, b)
        Change by the unknowns that all poses share, in any units.
    """

    e: FloatArray
    random: FloatArray
    own: FloatArray
    shared: FloatArray


@dataclass(frozen=True)
class Variances:
    """Most likely sizes of noise, random part and systematic part.

    Parameters
    ----------
    noise : float
        Factor on the standard deviation of the noise. If the noise is known, it stands for errors
        of points beyond it, which are not a rest curvature either.
    std, systematic : float [1/m]
    deviance : float
        -2 log restricted likelihood, up to a constant.
    degrees : float
        Degrees of freedom with which the variance std^2 is known: k degrees give -2 log
        likelihood the curvature 4 k by log(std).
    """

    noise: float
    std: float
    systematic: float
    deviance: float
    degrees: float


@dataclass(frozen=True)
class InformedDeviance(Deviance):
    """Deviance with the average information by the logarithm of the random part's size."""

    information: float


class ScatterLikelihood:
    """Restricted likelihood of a session's poses.

    Parameters
    ----------
    distances : (m, m) [m]
        Between the poses' shapes, root mean square.
    source : str
        What differs from pose to pose, see `PoseScatter`.
    most : float
        Largest size of the random part.
    """

    def __init__(
        self,
        samples: Sequence[ScatterSample],
        distances: FloatArray,
        source: str = REST_CURVATURE,
        most: float = np.inf,
    ) -> None:
        self.source, self.most = source, most
        self.m, self.modes = len(samples), samples[0].random.shape[1]
        self.count = sum(len(sample.e) for sample in samples)
        shared = np.concatenate([sample.shared for sample in samples])
        left, values, _ = np.linalg.svd(
            shared / np.maximum(np.abs(shared).max(axis=0), 1e-300), full_matrices=False
        )
        left = left[:, values > 1e-6 * max(values[:1].max(initial=0.0), 1e-300)]
        blocks = np.split(left, np.cumsum([len(sample.e) for sample in samples])[:-1])
        both = zip(samples, blocks, strict=True)
        columns = [np.column_stack([one.own, one.random, x, one.e]) for one, x in both]
        self.own, self.shared = samples[0].own.shape[1], left.shape[1]
        self.products = np.array([a.T @ a for a in columns])  # of (U, Z, X, y)
        self.distances = distances
        square = (distances**2).sum() / max(self.m * (self.m - 1), 1)
        # If all poses are repeats of one, they are alike at any range.
        self.apart = max(float(np.sqrt(square)), 1e-9)

    def deviance(
        self, noise: float, std: float, systematic: float, smoothness: float, range_: float
    ) -> InformedDeviance:
        """Restricted deviance by the logarithms of the three sizes, see `Deviance`.

            V = noise^2 1 + U U^T + Z (K x sizes^2) Z^T,   K = std^2 1 + systematic^2 alike

        The other quantities U of each pose are integrated out first, then the random ones, pose by
        pose, or in one block of all poses if these are correlated; then what all poses share. The
        slopes are means over all of these of the slopes of their joint density (Fisher's identity).
        """
        m, r, a = self.m, self.modes, self.own
        sizes = PoseScatter(1.0, smoothness, source=self.source).sizes(r)
        joined = systematic > 0 and m > 1
        alike = np.exp(-((self.distances / range_) ** 2) / 2) if joined else np.zeros((m, m))
        between = std**2 * np.eye(m) + systematic**2 * alike
        inverse = np.linalg.inv(between)
        scales = np.concatenate([np.ones(a), sizes, np.ones(self.shared + 1)]) / noise
        own = eliminated(self.products * np.outer(scales, scales), np.eye(a))
        known = np.kron(inverse, np.eye(r)) if joined else np.eye(r) / std**2
        random = eliminated(self._in_one(own.left) if joined else own.left, known)
        gram = random.left.sum(axis=0)
        ridge = 1e-9 * np.trace(gram[:-1, :-1]) / max(self.shared, 1)
        shared = eliminated(gram, ridge * np.eye(self.shared))
        quadratic = float(shared.left[0, 0])
        value = quadratic + own.logdet + random.logdet + shared.logdet
        value += r * float(np.linalg.slogdet(between)[1]) + 2 * self.count * float(np.log(noise))

        # Second moments of the random quantities by pairs of poses, and of all others' energy.
        mean, covariance = random.joint(*shared.joint(*OBSERVED))
        spread = covariance[:, : len(known), : len(known)]
        if joined:
            spread = np.trace(spread.reshape((m, r, m, r)), axis1=1, axis2=3)
            after = np.tile(np.arange(m * r, mean.shape[1]), (m, 1))
            rows = np.hstack([np.arange(m * r).reshape((m, r)), after])
            mean, covariance = mean[0, rows], covariance[0, rows[:, :, None], rows[:, None]]
        else:
            spread = np.diag(np.trace(spread, axis1=1, axis2=2))
        moments = mean[:, :r] @ mean[:, :r].T + spread
        others, variance = own.joint(mean, covariance)
        energy = (others[:, :a] ** 2).sum() + variance[:, range(a), range(a)].sum()
        unknowns = m * (a + r) + self.shared
        by_noise = 2 * (self.count - unknowns - quadratic + energy + (inverse * moments).sum())
        excess = inverse @ (r * between - moments) @ inverse
        by_std = 2 * std**2 * np.trace(excess)
        by_systematic = 2 * systematic**2 * (alike * excess).sum()

        # The derivative of V by log(std), times P y, is Z way.
        way = 2 * std**2 * (inverse @ mean[:, :r]).reshape((-1, len(known), 1))
        pull = known @ way
        cross = (random.arm[:, :, :-1].swapaxes(1, 2) @ pull).sum(axis=0)
        information = (pull * (way - np.linalg.solve(random.block, pull))).sum()
        information -= (cross * np.linalg.solve(shared.block, cross)).sum()
        gradient = np.array([by_noise, by_std, by_systematic], dtype=float)
        return InformedDeviance(value, gradient, float(information))

    def _in_one(self, products: FloatArray) -> FloatArray:
        """Products (m, k, k) of all poses in one group, whose random quantities are apart."""
        r = self.modes
        apart, cross = block_diag(*products[:, :r, :r]), np.concatenate(products[:, :r, r:])
        return np.block([[apart, cross], [cross.T, products[:, r:, r:].sum(axis=0)]])[None]

    def best(
        self,
        smoothness: float,
        range_: float | None,
        std: bool = True,
        guess: float = 0.1,
        weight: float = 0.0,
    ) -> Variances:
        """Most likely sizes for a smoothness and a range of the systematic part, or without one.

        Parameters
        ----------
        std : bool
            Whether a random part is allowed.
        guess : float [1/m]
            Start value.
        weight : float
            Exponent of a prior std^weight of the random part, which keeps it from zero.
        """
        sought = np.array([True, std, range_ is not None])
        begun = min(guess, self.most)
        start = np.log([1.0, begun if std else begun * np.exp(_LOWEST), guess])
        low, high = start + sought * _LOWEST, start + sought * _HIGHEST
        high[1] = min(high[1], np.log(self.most))
        prior = 2 * weight * np.array([0.0, 1.0, 0.0])

        def deviance(q: FloatArray) -> InformedDeviance:
            noise, size, systematic = np.exp(q) * [1, 1, sought[2]]
            found = self.deviance(noise, size, systematic, smoothness, range_ or 1.0)
            value = found.value - float(prior @ q)
            return replace(found, value=value, gradient=found.gradient - prior)

        q, found = most_likely(deviance, start, low, high)
        noise, size, systematic = (np.exp(q) * [1, 1, sought[2]]).tolist()
        known = max(found.information / 4, 1.0)
        return Variances(noise, size, systematic, found.value, known)


@dataclass(frozen=True)
class ScatterEstimate:
    """Evidence in a session that a cable does not repeat.

    Parameters
    ----------
    noise : float
        Factor on the standard deviation of the noise.
    p_systematic : float
        Probability that alike poses share that much if all of it is random.
    deviance : float
        -2 log restricted likelihood, up to a constant.
    """

    scatter: PoseScatter
    noise: float
    p_systematic: float
    deviance: float


def estimate_pose_scatter(
    likelihood: ScatterLikelihood, *, sparse: bool = False
) -> ScatterEstimate:
    """Sizes of maximal restricted likelihood; what alike poses share does not count as random.

    Parameters
    ----------
    sparse : bool
        Whether a pose has no more points than a rest curvature has modes, which hardly separates
        noise from scatter. The likeliest scatter may then be zero by chance, with too narrow
        intervals: a prior proportional to the scatter keeps it off zero by about one std error.

    References
    ----------
    Chung et al., Psychometrika 78 (2013).
    """
    weight, source = float(sparse), likelihood.source
    trials = SMOOTHNESS if source == REST_CURVATURE else SMOOTHNESS[:1]
    alone = {s: likelihood.best(s, None, weight=weight) for s in trials}
    smoothness = min(alone, key=lambda s: alone[s].deviance)
    chosen, range_, guess = alone[smoothness], None, alone[smoothness].std
    ranges = [r * likelihood.apart for r in RANGES] if likelihood.m > 2 else []
    both = {r: likelihood.best(smoothness, r, guess=guess, weight=weight) for r in ranges}
    joint = min(both, key=lambda r: both[r].deviance, default=None)
    gain = 0.0 if joint is None else max(chosen.deviance - both[joint].deviance, 0.0)
    # Best of all ranges; a size bounded by zero takes half of chi-square's probability.
    p_systematic = float(min(1.0, 0.5 * len(RANGES) * chdtrc(1, gain)))
    # What the verdict would not call systematic counts as random: see `Structure.p_noise`.
    if joint is not None and p_systematic < SIGNIFICANCE / 2:
        chosen, range_ = both[joint], joint
    without = likelihood.best(smoothness, range_, std=False, guess=guess)
    if not sparse and without.deviance - chosen.deviance < TELLING:
        return ScatterEstimate(PoseScatter(), without.noise, p_systematic, without.deviance)
    sizes = (chosen.noise, chosen.std, chosen.systematic)
    deviance = likelihood.deviance(*sizes, smoothness, range_ or 1.0).value
    shown = without.deviance - deviance >= TELLING
    found = PoseScatter(chosen.std, smoothness, chosen.degrees, source, shown=shown)
    return ScatterEstimate(found, chosen.noise, p_systematic, deviance)
