"""Poses taken more than once: differences between them are pure error, which no model explains."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.sensing.noise_estimate import NoiseSample, estimate_noise, tell_of_noise
from dlo_casadi.thresholds import DIFFERENT, UNSEEN

# Share of the length beside each fixture that is left out: repeats agree where they are held.
_BESIDE_FIXTURES = 0.02
# Largest difference of ends [lengths] and clamps [rad] between poses that count as held alike: the
# shape of any cable then changes by at most about this share of its length.
NEARLY = 1e-3
# Number of nodes of the mean of repeats, a polyline, and of places at which lines are compared.
_NODES, _GRID = 201, 97


def repeatability(measured: Sequence[MeasuredPose], model: CableModel) -> float | None:
    """RMS distance [m] of a fit pose from the mean of the others held in the same way.

    No prediction of the next pose can be better; None if no pose was repeated.
    """
    squares = [(gaps**2).sum(axis=2).mean(axis=1) for gaps, _ in _gaps(measured, model)]
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else None


def repeat_std(measured: Sequence[MeasuredPose], model: CableModel, noise: float) -> float:
    """RMS difference [m] between repeats of one pose, per coordinate across the cable.

    Measured from the mean of the others, as in `repeatability`, less the noise of points [m] in
    both; 0 if no pose was repeated.
    """
    squares = []
    for gaps, tangents in _gaps(measured, model):
        across = (gaps**2).sum(axis=2) - (gaps * tangents).sum(axis=2) ** 2
        of_points = noise**2 * len(gaps) / (len(gaps) - 1)
        squares.append(across.mean(axis=1) / (gaps.shape[2] - 1) - of_points)
    return float(np.sqrt(max(np.concatenate(squares).mean(), 0.0))) if squares else 0.0


def _gaps(
    measured: Sequence[MeasuredPose], model: CableModel
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """For each repeated pose: gaps (m, K, d) from the mean of the others, its tangents (K, d)."""
    length = model.cable.length
    for group in _groups(measured, model):
        grid = _compared(group, length)
        if len(grid) < 2:
            continue
        curves = np.array([_line(item, grid, length) for item in group])
        mean = curves.mean(axis=0)
        # The gap from the mean of the others is m / (m - 1) times that from the mean of all.
        gaps = (curves - mean) * len(group) / (len(group) - 1)
        tangents = unit(np.gradient(mean, axis=0))
        if not all(sensor.marked for item in group for sensor in item.sensors):
            # Points of a line have no known place along it.
            gaps = gaps - (gaps * tangents).sum(axis=2, keepdims=True) * tangents
        yield gaps, tangents


def _compared(group: Sequence[MeasuredPose], length: float) -> FloatArray:
    """Arc lengths (K,) [m] at which repeats are compared: where each of them was measured.

    Those of the repeat with the fewest points if these are few: between points a line is only
    interpolated.
    """
    low, high = _measured_in_all(group, length)
    least = min((item.places(length) for item in group), key=len)
    grid = np.sort(least) if len(least) < _GRID else np.linspace(low, high, _GRID)
    return grid[(grid >= low) & (grid <= high)]


def _measured_in_all(group: Sequence[MeasuredPose], length: float) -> tuple[float, float]:
    """Arc lengths [m] between which all repeats were measured, away from the fixtures."""
    places = [item.places(length) for item in group]
    low, high = max(s.min() for s in places), min(s.max() for s in places)
    beside = _BESIDE_FIXTURES * length
    return max(low, beside), min(high, length - beside)


def different_poses(measured: Sequence[MeasuredPose], model: CableModel) -> int:
    """Number of fit poses that hold the cable in different ways."""
    return len(_held_alike(measured, model))


def enough_poses(measured: Sequence[MeasuredPose], model: CableModel) -> bool:
    """Whether there are enough different poses to show what differs between them."""
    return different_poses(measured, model) >= DIFFERENT


def with_repeats(
    noise: NoiseModel, measured: Sequence[MeasuredPose], model: CableModel
) -> NoiseModel:
    """Noise of one line; of few poses that of their repeats, if it is more than twice as large.

    Poses are few if fewer than DIFFERENT are different.

    Pure error: the distances of repeats from their mean, with their correlation along the cable,
    times sqrt(m / (m - 1)) because the mean of m takes one degree of freedom. A fit that
    trusts each line to the noise of its points distorts the rest shape to fit the rest; its lowest
    equilibrium may then be far from every measurement.

    References
    ----------
    Draper and Smith, Applied Regression Analysis, section 2.1.
    """
    if enough_poses(measured, model):
        return noise  # differences between repeats are then modelled by `pose_scatter`
    spread = repeatability(measured, model)
    if spread is None or spread <= UNSEEN * noise.std:
        return noise
    samples, groups, length = [], _groups(measured, model), model.cable.length
    nodes = np.linspace(0.0, length, _NODES)
    for group in groups:
        lines = [_line(other, nodes, length) for other in group]
        mean = NodeCurve(length, np.mean(lines, axis=0), None)
        low, high = _measured_in_all(group, length)
        for item in group:
            places = item.places(length)
            away = item.points - item.pose.start - mean.at(places)
            gap = np.sqrt(len(group) / (len(group) - 1)) * away
            residual = item.components(mean, places, gap[..., None])[:, 0]
            inside = (places >= low) & (places <= high)
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
    if found.std <= UNSEEN * noise.std:
        return noise
    # Of m distances from their mean, m - 1 are independent.
    free = 1 - len(groups) / sum(map(len, groups))
    return replace(found, source="repeats", slow_dof=free * found.slow_dof)


def _groups(measured: Sequence[MeasuredPose], model: CableModel) -> list[list[MeasuredPose]]:
    """Measured lines of fit poses that were held in the same way, two or more each."""
    groups = ([x.traced for x in group if x.has_points] for group in _held_alike(measured, model))
    return [group for group in groups if len(group) > 1]


def _held_alike(measured: Sequence[MeasuredPose], model: CableModel) -> list[list[MeasuredPose]]:
    """Fit poses in groups, each of poses that are held like its first one."""
    groups: list[list[MeasuredPose]] = []
    before: list[MeasuredPose] = []  # the group of the pose before
    for item in measured:
        if not item.readable or item.held_out:
            before = []
            continue
        pose, known = item.pose, groups
        if pose.branch == "previous":  # on the branch of the pose before, whatever that is
            known = [before] if before else []
            pose = replace(pose, branch=before[0].pose.branch if before else pose.branch)
        before = next((group for group in known if _alike(pose, group[0].pose, model)), [])
        if not before:
            groups.append(before)
        before.append(item)
    return groups


def _alike(pose: HeldPose, other: HeldPose, model: CableModel) -> bool:
    """Whether two poses hold a cable in the same way; without obstacles, wherever they stand.

    What a cable keeps of earlier poses makes each pose different.
    """
    if model.has_state:
        return False
    both, node = (pose, other), model.node

    def told(one: HeldPose) -> tuple[Any, ...]:
        clips = [(clip.kind, clip.at is None) for clip in one.clips]
        return one.turns, one.branch, one.over, one.tensions, one.free_length, clips

    if told(pose) != told(other):
        return False
    places, frames = [], []
    for one in both:
        away = np.array([one.end or one.start, *(clip.place for clip in one.clips)]) - one.start
        at = np.array([clip.at or 0.0 for clip in one.clips])
        stands = np.array(one.start) if model.surfaces else np.zeros(0)
        places.append(np.concatenate([away.ravel(), at, stands]) / model.cable.length)
        clamped = (clip.frame for clip in one.clips)
        frames.append(np.array([*one.frames, *(x for x in clamped if x is not None)]))
    turned = np.abs(node.difference(*frames)).max()
    return bool(max(np.abs(places[0] - places[1]).max(), turned) <= NEARLY)


def _line(item: MeasuredPose, s: FloatArray, length: float) -> FloatArray:
    """Places (K, d) [m] from the start of a measured line at arc lengths s (K,) [m]."""
    places, away = np.maximum.accumulate(item.places(length)), item.points - item.pose.start
    return np.stack([np.interp(s, places, column) for column in away.T], axis=1)
