"""How well the same pose repeats, and which declared values its shapes cannot tell apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.estimation.observation import MeasuredPose, chord_places
from dlo_casadi.estimation.result import Fit
from dlo_casadi.thresholds import ALIKE, REPEATS

FloatArray = NDArray[np.floating]


def repeatability(measured: Sequence[MeasuredPose], length: float) -> float | None:
    """RMS distance [m] of a fit pose from the mean of the others held in the same way.

    The floor of any prediction of the next one; None where no pose was taken twice.
    """
    groups: dict[tuple[float, ...], list[FloatArray]] = {}
    grid = np.linspace(0.02, 0.98, 97) * length
    for item in measured:
        if item.readable and not item.held_out:
            places = np.maximum.accumulate(chord_places(item, length))
            line = np.stack([np.interp(grid, places, item.points[:, i]) for i in (0, 1)], axis=1)
            groups.setdefault(tuple(item.pose.ends), []).append(line)
    squares = []
    for curves in groups.values():
        for k, curve in enumerate(curves):
            others = curves[:k] + curves[k + 1 :]
            if others:
                squares.append(((curve - np.mean(others, axis=0)) ** 2).sum(axis=1).mean())
    return float(np.sqrt(np.mean(squares))) if squares else None


def limiting_spread(fit: Fit) -> float | None:
    """How badly the same pose repeats [m], where that is what limits a prediction, else None."""
    spread = repeatability(fit.problem.measured, fit.model.cable.length)
    return spread if spread is not None and spread > REPEATS * fit.noise.std else None


def alike(fit: Fit) -> list[tuple[str, ...]]:
    """Groups of nuisances (length, scale, fixture, clamps) with one and the same effect.

    Read off the correlations of the estimates that the data alone would give.
    """
    names = fit.problem.unknowns.names
    held = [k for k, name in enumerate(names) if name in fit.model.priors]
    hessian: FloatArray = fit.normal.hessian.copy()
    hessian[np.ix_(held, held)] -= fit.problem.precision[np.ix_(held, held)]
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    scaled = hessian / np.outer(scale, scale) + 1e-6 * np.eye(len(scale))
    covariance = np.linalg.inv(scaled)[np.ix_(held, held)]
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = np.abs(covariance / np.outer(deviation, deviation))
    groups: list[set[int]] = []
    for i in range(len(held)):
        for j in range(i):
            if correlation[i, j] > ALIKE:
                joined = [group for group in groups if group & {i, j}]
                groups = [group for group in groups if not group & {i, j}]
                groups.append(set().union({i, j}, *joined))
    return [tuple(names[held[k]] for k in sorted(group)) for group in groups]
