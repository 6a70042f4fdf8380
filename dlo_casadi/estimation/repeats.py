"""Poses taken more than once, and cables that do not come back to the same shape.

What differs between repeats of a pose no model can explain: it is pure error. Where many poses
differ, every repeat has something of its own instead. Most often a rest curvature,

    kappa_j(s) = kappa_0(s) + std sum_k sqrt(v_k) c_jk f_k(s),    c_jk ~ N(0, 1)
    f_0 = 1, f_k = sqrt(2) cos(k pi s / L),    v_k ~ exp(-(k pi l / L)^2 / 2),    sum_k v_k = 1

which friction between strands and set leave; or moments of pins, turns of clamps, places of the
end, lengths: the likeliest. To first order it moves the residuals of pose j by std E_j c_j, so that
their covariance is that of the noise plus std^2 E_j E_j^T.

A model that lacks something leaves residuals, too, but alike in poses that are alike. So a second
part, correlated over the poses' shapes, takes what is systematic while the size of the random one
is estimated:

    cov(c_j, c_k) = std^2 delta_jk + systematic^2 exp(-d_jk^2 / (2 range^2))

with d_jk the RMS distance of the two shapes. All sizes maximise the restricted likelihood.

References
----------
Patterson and Thompson, Biometrika 58 (1971); Kennedy and O'Hagan, J. R. Statist. Soc. B 63 (2001).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc, chdtri

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.pose_scatter import REST_CURVATURE, SMOOTHNESS, PoseScatter
from dlo_casadi.rod.node import Frame, Heading
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.sensing.noise_estimate import (
    Deviance,
    NoiseSample,
    estimate_noise,
    most_likely,
    tell_of_noise,
)
from dlo_casadi.thresholds import DIFFERENT, REPEATS_ARE_NOISE, SIGNIFICANCE

# Share of the length beside each fixture that is left out: repeats agree where they are held.
_BESIDE_FIXTURES = 0.02
# Largest difference of ends [lengths] and clamps [rad] of two poses that are held in the same way:
# the shape of any cable then moves by about this share of its length at most.
NEARLY = 1e-3
# Of the mean of repeats, a polyline.
_NODES = 201
# Ranges of what is systematic that are tried, shares of the RMS distance of the poses' shapes.
RANGES = (0.25, 1.0)
# Decrease of -2 log likelihood from which a size is not taken as zero: at that bound 5 % exceed it
# by chance. At 0.5 % the scatter of 3 of 17 simulated cables that do not repeat was taken as none,
# for decreases of 3.5 to 5.9; the stiffness of one of them was two standard deviations off.
TELLING = float(chdtri(1, 0.1))
# Maximum number of poses used, evenly spaced.
MOST_POSES = 40
# Smallest and largest size in units of the first guess that are looked at.
_LOWEST, _HIGHEST = np.log(1e-4), np.log(1e2)


def repeatability(measured: Sequence[MeasuredPose], length: float) -> float | None:
    """RMS distance [m] of a fit pose from the mean of the others held in the same way.

    The floor of any prediction of the next one; None where no pose was taken twice.
    """
    squares = [(gaps**2).sum(axis=2).mean(axis=1) for gaps, _ in _gaps(measured, length)]
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else None


def repeat_std(measured: Sequence[MeasuredPose], length: float, noise: float) -> float:
    """RMS of a coordinate [m] across the cable of what repeats of one pose differ by.

    From the mean of the others, as `repeatability`, less the noise of points [m] in both; 0 where
    no pose was taken twice.
    """
    squares = []
    for gaps, tangents in _gaps(measured, length):
        across = (gaps**2).sum(axis=2) - (gaps * tangents).sum(axis=2) ** 2
        of_points = noise**2 * len(gaps) / (len(gaps) - 1)
        squares.append(across.mean(axis=1) / (gaps.shape[2] - 1) - of_points)
    return float(np.sqrt(max(np.concatenate(squares).mean(), 0.0))) if squares else 0.0


def _gaps(
    measured: Sequence[MeasuredPose], length: float
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Of each repeated pose: gaps (m, K, d) from the mean of the others, its tangents (K, d)."""
    grid = np.linspace(_BESIDE_FIXTURES, 1 - _BESIDE_FIXTURES, 97) * length
    for group in _groups(measured, length):
        curves = np.array([_line(item, grid, length) for item in group])
        mean = curves.mean(axis=0)
        # From the mean of the others it is m / (m - 1) times as far as from the mean of all.
        gaps = (curves - mean) * len(group) / (len(group) - 1)
        # Beyond the points of a line its end stands still.
        yield gaps, unit(np.gradient(mean, axis=0))


def different_poses(measured: Sequence[MeasuredPose], length: float) -> int:
    """Number of fit poses that are held differently, wherever they stand."""
    return len(_held_alike(measured, length))


def with_repeats(noise: NoiseModel, measured: Sequence[MeasuredPose], length: float) -> NoiseModel:
    """Noise of one line, or of repeats of a pose or two where they differ by more than twice that.

    Pure error: the distances of repeats from their mean, sqrt(m / (m - 1)) larger for
    its loss of one degree of freedom in m, with their correlation along the cable. A fit that
    trusts each line to the noise of its points bends the rest shape to whatever is left, and may
    end in one whose lowest equilibrium is far from all that was measured.

    References
    ----------
    Draper and Smith, Applied Regression Analysis, section 2.1.
    """
    if different_poses(measured, length) >= DIFFERENT:
        return noise  # what differs between repeats has its own place there, see `pose_scatter`
    spread = repeatability(measured, length)
    if spread is None or spread <= REPEATS_ARE_NOISE * noise.std:
        return noise
    samples, groups = [], _groups(measured, length)
    nodes = np.linspace(0.0, length, _NODES)
    for group in groups:
        lines = [_line(other, nodes, length) for other in group]
        mean = NodeCurve(length, np.mean(lines, axis=0), None)
        for item in group:
            places = item.places(length)
            away = item.points - item.pose.start - mean.at(places)
            gap = np.sqrt(len(group) / (len(group) - 1)) * away
            residual = item.components(mean, places, gap[..., None])[:, 0]
            inside = np.abs(places / length - 0.5) < 0.5 - _BESIDE_FIXTURES
            for sensor, points, rows in item.slices:
                kept = np.repeat(inside[points], sensor.per_point)
                e, s = residual[rows][kept], places[points][inside[points]]
                none = np.zeros((len(e), 0))
                if len(s):
                    weight = sensor.weight[inside[points]]
                    samples.append(NoiseSample(e, s, weight, none, none, sensor.correlation_length))
    if not tell_of_noise(samples):
        return noise
    found = estimate_noise(samples, length)
    if found.std <= REPEATS_ARE_NOISE * noise.std:
        return noise
    # Of m distances from their mean m - 1 are free.
    free = 1 - len(groups) / sum(map(len, groups))
    return replace(found, source="repeats", slow_dof=free * found.slow_dof)


def _groups(measured: Sequence[MeasuredPose], length: float) -> list[list[MeasuredPose]]:
    """Measured lines of fit poses that were held in the same way, two or more each."""
    groups = [group for group in _held_alike(measured, length) if len(group) > 1]
    return [[item.traced for item in group] for group in groups]


def _held_alike(measured: Sequence[MeasuredPose], length: float) -> list[list[MeasuredPose]]:
    """Fit poses in groups, each of those that are held as its first one."""
    groups: list[list[MeasuredPose]] = []
    for item in measured:
        if item.readable and not item.held_out:
            alike = (group for group in groups if _alike(item.pose, group[0].pose, length))
            group = next(alike, None)
            if group is None:
                groups.append([item])
            else:
                group.append(item)
    return groups


def _alike(pose: HeldPose, other: HeldPose, length: float) -> bool:
    """Whether two poses hold a cable in the same way, up to where they stand."""
    chords = [np.subtract(one.end or one.start, one.start) / length for one in (pose, other)]
    node = Heading if len(pose.start) == 2 else Frame
    turned = np.abs(node.difference(np.stack(pose.frames), np.stack(other.frames))).max()
    near = max(np.abs(chords[0] - chords[1]).max(), turned) <= NEARLY
    return bool(near) and pose.turns == other.turns


def _line(item: MeasuredPose, s: FloatArray, length: float) -> FloatArray:
    """Places (K, d) [m] from the start of a measured line at arc lengths s (K,) [m]."""
    places, away = np.maximum.accumulate(item.places(length)), item.points - item.pose.start
    return np.stack([np.interp(s, places, column) for column in away.T], axis=1)


@dataclass(frozen=True)
class ScatterSample:
    """What one pose tells: residuals e, and what moves them, all whitened by the noise.

    Parameters
    ----------
    e : (R,)
    random : (R, q)
        By a unit of what differs from pose to pose, see `PoseScatter.ways`.
    own : (R, a)
        By what else is the pose's own, one standard deviation each.
    shared : (R, b)
        By the unknowns of all poses, in any units.
    """

    e: FloatArray
    random: FloatArray
    own: FloatArray
    shared: FloatArray


@dataclass(frozen=True)
class Variances:
    """Most likely sizes.

    Parameters
    ----------
    noise : float
        Factor on the standard deviation of the noise: where that is known, for what points are
        off beyond it, which is no rest curvature either.
    std, systematic : float [1/m]
    deviance : float
        -2 log restricted likelihood, up to a constant.
    degrees : float
        Degrees of freedom with which the variance std^2 is known: for k of them the curvature of
        -2 log likelihood by log(std) is 4 k.
    """

    noise: float
    std: float
    systematic: float
    deviance: float
    degrees: float


@dataclass(frozen=True)
class InformedDeviance(Deviance):
    """With the average information (k, k)."""

    information: FloatArray


class RestLikelihood:
    """Restricted likelihood of a session's poses.

    Parameters
    ----------
    distances : (m, m) [m]
        Between the poses' shapes, root mean square.
    source : str
        What differs from pose to pose, see `PoseScatter`.
    """

    def __init__(
        self,
        samples: Sequence[ScatterSample],
        distances: FloatArray,
        source: str = REST_CURVATURE,
    ) -> None:
        self.source = source
        self.m, self.modes = len(samples), samples[0].random.shape[1]
        self.count = sum(len(sample.e) for sample in samples)
        shared = np.concatenate([sample.shared for sample in samples])
        left, values, _ = np.linalg.svd(
            shared / np.maximum(np.abs(shared).max(axis=0), 1e-300), full_matrices=False
        )
        left = left[:, values > 1e-6 * max(values[:1].max(initial=0.0), 1e-300)]
        blocks = np.split(left, np.cumsum([len(sample.e) for sample in samples])[:-1])
        self.free = self.count - left.shape[1]
        fixed = [np.column_stack([x, s.e]) for x, s in zip(blocks, samples, strict=True)]
        self.fixed = np.array([x.T @ x for x in fixed]).sum(axis=0)
        random = [np.column_stack([s.random, s.own]) for s in samples]
        self.random = np.array([z.T @ z for z in random])
        self.cross = np.array([z.T @ x for z, x in zip(random, fixed, strict=True)])
        self.distances = distances
        square = (distances**2).sum() / max(self.m * (self.m - 1), 1)
        # Poses taken again and again are alike at any range.
        self.apart = max(float(np.sqrt(square)), 1e-9)

    def deviance(
        self, noise: float, std: float, systematic: float, smoothness: float, range_: float
    ) -> InformedDeviance:
        """Restricted deviance by the logarithms of the three sizes, see `sensing.restricted`.

        By Woodbury's identity in the random parts, V = noise^2 1 + Z B Z^T, pose by pose or, if
        poses are correlated, with those of all poses in one block.
        """
        m, q, r = self.m, self.random.shape[1], self.modes
        sizes = PoseScatter(1.0, smoothness, source=self.source).sizes(r) ** 2
        rest = np.diag(np.pad(sizes, (0, q - r)))
        own: FloatArray = np.diag((np.arange(q) >= r) * 1.0)
        by_std: FloatArray = 2 * std**2 * rest
        by_systematic: FloatArray = np.zeros((q, q))
        inside, cross = self.random, self.cross
        if systematic > 0 and m > 1:
            alike = np.exp(-((self.distances / range_) ** 2) / 2)
            by_systematic = 2 * systematic**2 * np.kron(alike, rest)
            by_std, own = np.kron(np.eye(m), by_std), np.kron(np.eye(m), own)
            inside, cross = block_diag(*inside)[None], cross.reshape((1, m * q, -1))
        between, count = own + (by_std + by_systematic) / 2, inside.shape[1]
        matrix = noise**2 * np.eye(count) + inside @ between
        solved = np.linalg.solve(matrix, np.concatenate([inside, cross], axis=2))
        inside, taken = solved[:, :, :count], solved[:, :, count:]  # Z^T V^-1 Z, Z^T V^-1 (X, y)
        gram = self.fixed - np.einsum("mqa,mqb->ab", between @ cross, taken)
        gram /= noise**2
        x, y, spare = gram[:-1, :-1], gram[:-1, -1:], self.count - len(matrix) * count
        root = np.linalg.cholesky(x + 1e-9 * np.trace(x) / max(len(x), 1) * np.eye(len(x)))
        explained = np.linalg.solve(root, y)
        hidden = np.linalg.solve(root, taken[:, :, :-1].transpose(0, 2, 1))
        pull = taken[:, :, -1] - (explained.T @ hidden)[:, 0]  # Z^T P y
        quadratic = float(gram[-1, -1] - (explained**2).sum())
        logdet = 2 * float(np.log(root.diagonal()).sum() + spare * np.log(noise))
        logdet += float(np.linalg.slogdet(matrix)[1].sum())

        ways = [between, by_std, by_systematic]
        diagonal = inside.sum(axis=0) - np.einsum("mpa,mpb->ab", hidden, hidden)
        traces = np.array([(diagonal * way).sum() for way in ways])
        moved = np.stack([pull @ way for way in ways])
        squares = np.einsum("jmq,mq->j", moved, pull)
        seen = np.einsum("mpq,jmq->jp", hidden, moved)
        bend = np.einsum("jmq,mqk,imk->ji", moved, inside, moved, optimize=True) - seen @ seen.T
        # P V P = P separates the part of the noise from that of all random parts.
        by_noise = 2 * (self.free - traces[0] - quadratic + squares[0])
        information = bend.copy()
        information[0] = information[:, 0] = 2 * (squares - bend[0])
        information[0, 0] = 4 * (quadratic - 2 * squares[0] + bend[0, 0])
        gradient = np.array([by_noise, *(traces - squares)[1:]])
        return InformedDeviance(logdet + quadratic, gradient, information)

    def best(
        self,
        smoothness: float,
        range_: float | None,
        std: bool = True,
        guess: float = 0.1,
        weight: float = 0.0,
    ) -> Variances:
        """Most likely sizes for a smoothness, and a range of what is systematic, or none.

        Parameters
        ----------
        std : bool
            Whether there may be a random part at all.
        guess : float [1/m]
            Where to start.
        weight : float
            Of a prior std^weight of the random part, which keeps it from zero.
        """
        sought = np.array([True, std, range_ is not None])
        start = np.log([1.0, guess if std else guess * np.exp(_LOWEST), guess])
        prior = 2 * weight * np.array([0.0, 1.0, 0.0])

        def deviance(q: FloatArray) -> InformedDeviance:
            noise, size, systematic = np.exp(q) * [1, 1, sought[2]]
            found = self.deviance(noise, size, systematic, smoothness, range_ or 1.0)
            value = found.value - float(prior @ q)
            return replace(found, value=value, gradient=found.gradient - prior)

        q, found = most_likely(deviance, start, start + sought * _LOWEST, start + sought * _HIGHEST)
        noise, size, systematic = (np.exp(q) * [1, 1, sought[2]]).tolist()
        known = float(max(found.information[1, 1] / 4, 1.0))
        return Variances(noise, size, systematic, found.value, known)


@dataclass(frozen=True)
class ScatterEstimate:
    """What a session shows of a cable that does not repeat.

    Parameters
    ----------
    noise : float
        Factor on the standard deviation of the noise.
    p_systematic : float
        Probability of as much that is alike in poses that are alike, if all is random.
    deviance : float
        -2 log restricted likelihood, up to a constant.
    """

    scatter: PoseScatter
    noise: float
    p_systematic: float
    deviance: float


def estimate_pose_scatter(likelihood: RestLikelihood, *, sparse: bool = False) -> ScatterEstimate:
    """Sizes of maximal restricted likelihood: only what differs between poses alike is random.

    Parameters
    ----------
    sparse : bool
        Whether a pose has no more points than a rest curvature has modes: they hardly tell noise
        from scatter. The likeliest scatter is none by chance then, and intervals are too narrow: a
        prior proportional to the scatter keeps it from there, by about a standard error.

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
    # The best of the ranges; at a bound of zero half of chi-square's probability.
    p_systematic = float(min(1.0, 0.5 * len(RANGES) * chdtrc(1, gain)))
    # What the verdict would not call systematic is random: see `Structure.p_noise`.
    if joint is not None and p_systematic < SIGNIFICANCE / 2:
        chosen, range_ = both[joint], joint
    without = likelihood.best(smoothness, range_, std=False, guess=guess)
    if not sparse and without.deviance - chosen.deviance < TELLING:
        return ScatterEstimate(PoseScatter(), without.noise, p_systematic, without.deviance)
    found = PoseScatter(chosen.std, smoothness, chosen.degrees, source)
    sizes = (chosen.noise, chosen.std, chosen.systematic)
    deviance = likelihood.deviance(*sizes, smoothness, range_ or 1.0).value
    return ScatterEstimate(found, chosen.noise, p_systematic, deviance)
