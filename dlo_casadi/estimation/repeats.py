"""Poses that were taken more than once: what differs between them no model can explain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.rod.node import Frame, Heading
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, NoiseSample, estimate_noise, tell_of_noise
from dlo_casadi.thresholds import DIFFERENT, REPEATS_ARE_NOISE

FloatArray = NDArray[np.floating]

# Of the length: beside a fixture all repeats are where it holds them.
_BESIDE_FIXTURES = 0.02
# Ends so near [lengths], and clamps [rad], hold a pose in the same way: whatever the cable, its
# shape moves by no more than about that share of its length.
NEARLY = 1e-3
# Of the mean of repeats, a polyline.
_NODES = 201


def repeatability(measured: Sequence[MeasuredPose], length: float) -> float | None:
    """RMS distance [m] of a fit pose from the mean of the others held in the same way.

    The floor of any prediction of the next one; None where no pose was taken twice.
    """
    squares = [(gaps**2).sum(axis=2).mean(axis=1) for gaps, _ in _gaps(measured, length)]
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else None


def hanging_std(measured: Sequence[MeasuredPose], length: float, noise: float) -> float:
    """RMS of a coordinate [m] across the cable of what hangings of one pose differ by.

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
        slopes = np.gradient(mean, axis=0)
        # From the mean of the others it is m / (m - 1) times as far as from the mean of all.
        gaps = (curves - mean) * len(group) / (len(group) - 1)
        # Beyond the points of a line its end stands still.
        yield gaps, slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-300)


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
        return noise  # what differs between hangings has its own place there, see `rest_scatter`
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


def _alike(pose: Pose, other: Pose, length: float) -> bool:
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
