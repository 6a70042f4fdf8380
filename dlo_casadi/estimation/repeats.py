"""Poses that were taken more than once: what differs between them no model can explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.estimation.noise import NoiseModel, NoiseSample, estimate_noise, tell_of_noise
from dlo_casadi.estimation.observation import MeasuredPose, chord_places
from dlo_casadi.thresholds import REPEATS_ARE_NOISE

FloatArray = NDArray[np.floating]

# Of the length: beside a fixture all repeats are where it holds them.
_BESIDE_FIXTURES = 0.02


def repeatability(measured: Sequence[MeasuredPose], length: float) -> float | None:
    """RMS distance [m] of a fit pose from the mean of the others held in the same way.

    The floor of any prediction of the next one; None where no pose was taken twice.
    """
    grid = np.linspace(_BESIDE_FIXTURES, 1 - _BESIDE_FIXTURES, 97) * length
    squares = []
    for group in _groups(measured):
        curves = np.array([_line(item, grid, length) for item in group])
        # From the mean of the others it is m / (m - 1) times as far as from the mean of all.
        gaps = (curves - curves.mean(axis=0)) * len(group) / (len(group) - 1)
        squares += list((gaps**2).sum(axis=2).mean(axis=1))
    return float(np.sqrt(np.mean(squares))) if squares else None


def with_repeats(noise: NoiseModel, measured: Sequence[MeasuredPose], length: float) -> NoiseModel:
    """Noise of one line, or of repeats of one pose where they differ by more than twice that.

    Pure error: the normal distances of repeats from their mean, sqrt(m / (m - 1)) larger for
    its loss of one degree of freedom in m, with their correlation along the cable. A fit that
    trusts each line to the noise of its points bends the rest shape to whatever is left, and may
    end in one whose lowest equilibrium is far from all that was measured.

    References
    ----------
    Draper and Smith, Applied Regression Analysis, section 2.1.
    """
    spread = repeatability(measured, length)
    if spread is None or spread <= REPEATS_ARE_NOISE * noise.std:
        return noise
    samples = []
    for group in _groups(measured):
        for item in group:
            places = chord_places(item, length)
            inside = np.abs(places / length - 0.5) < 0.5 - _BESIDE_FIXTURES
            s = places[inside]
            if len(s) < 2:
                continue
            mean = np.mean([_line(other, s, length) for other in group], axis=0)
            tangent = np.gradient(mean, axis=0)
            normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
            normal /= np.maximum(np.hypot(*tangent.T), 1e-300)[:, None]
            gap = ((item.points[inside] - mean) * normal).sum(axis=1)
            none = np.zeros((len(s), 0))
            grown = np.sqrt(len(group) / (len(group) - 1)) * gap
            samples.append(NoiseSample(grown, s, item.relative_std[inside], none, none))
    if not tell_of_noise(samples):
        return noise
    found = estimate_noise(samples, length)
    return replace(found, source="repeats") if found.std > REPEATS_ARE_NOISE * noise.std else noise


def _groups(measured: Sequence[MeasuredPose]) -> list[list[MeasuredPose]]:
    """Fit poses that were held in the same way, two or more each."""
    groups: dict[tuple[float, ...], list[MeasuredPose]] = {}
    for item in measured:
        if item.readable and not item.held_out:
            groups.setdefault(tuple(item.pose.ends), []).append(item)
    return [group for group in groups.values() if len(group) > 1]


def _line(item: MeasuredPose, s: FloatArray, length: float) -> FloatArray:
    """Places (K, 2) [m] of a measured line at arc lengths s (K,) [m]."""
    places = np.maximum.accumulate(chord_places(item, length))
    return np.stack([np.interp(s, places, item.points[:, i]) for i in (0, 1)], axis=1)
