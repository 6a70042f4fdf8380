"""How well the same pose repeats, and which declared values its shapes cannot tell apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.estimation.repeats import different_poses, repeatability
from dlo_casadi.estimation.result import Fit
from dlo_casadi.thresholds import ALIKE, DIFFERENT, REPEATS

FloatArray = NDArray[np.floating]


def limiting_spread(fit: Fit) -> float | None:
    """How badly the same pose repeats [m], where that is what limits a prediction, else None."""
    if different_poses(fit.problem.history, fit.model.cable.length) >= DIFFERENT:
        return None
    spread = repeatability(fit.problem.history, fit.model.cable.length)
    if spread is None or fit.noise.source == "repeats":
        return spread
    floor = noise_distance(fit.problem.history, fit.noise.std)
    return spread if spread > REPEATS * floor else None


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
