"""What recorded motions tell of the parameters, their own unknowns eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.estimation.motion_start import FittedMotion
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, DAMPING_TIME

# How far parameters of motions repeat those of still poses, relative. Two independent discrete rods
# with the same parameters, of 40 elements, differ by 0.1 % in frequency: 0.5 % in EI where weight
# holds the cable, too. Without it motions claim EI to 0.02 %.
REPEATED = {BENDING_STIFFNESS: 5e-3, DAMPING_TIME: 1.5e-2}
# Share of the largest eigenvalue of the scaled Hessian below which motions tell nothing.
_SHOWN = 1e-10


@dataclass(frozen=True)
class Told:
    """What a motion tells of theta, its own unknowns eliminated: H, g, and how these follow."""

    hessian: FloatArray
    gradient: FloatArray
    block: FloatArray
    cross: FloatArray
    slope: FloatArray

    @classmethod
    def of(cls, item: FittedMotion, unknowns: Unknowns, std: float, damping: float = 0.0) -> Told:
        """What it tells with this noise [m]; `damping`: of its own unknowns, relative."""
        prior = 1 / item.recording.own_std(unknowns.model) ** 2
        a, b, e = (x / std for x in (item.seen.by_theta, item.seen.by_own, item.seen.residual))
        block, cross = b.T @ b + np.diag(prior), b.T @ a
        block += damping * np.diag(np.diag(block))
        slope = b.T @ e + prior * item.own
        solved = np.linalg.solve(block, np.column_stack([cross, slope]))
        hessian, gradient = a.T @ a - cross.T @ solved[:, :-1], a.T @ e - cross.T @ solved[:, -1]
        return cls(hessian, gradient, block, cross, slope)

    def own_step(self, step: FloatArray) -> FloatArray:
        """Change of its own unknowns with a step of theta."""
        return -np.linalg.solve(self.block, self.cross @ step + self.slope)


def summed(
    motions: Sequence[FittedMotion], unknowns: Unknowns, std: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hessian (size, size) and gradient (size,) of the motions, and the gradient's variance."""
    told = [Told.of(item, unknowns, std) for item in motions]
    varied = [_varied(item, one, std) for item, one in zip(motions, told, strict=True)]
    each = [x.hessian for x in told], [x.gradient for x in told], varied
    hessian, gradient, total = (np.sum(x, axis=0) for x in each)
    return hessian, gradient, total


def rows_of(
    told: Sequence[Told],
    theta: FloatArray,
    damping: float,
    varied: FloatArray | None = None,
    loose: FloatArray | None = None,
) -> tuple[tuple[FloatArray, float], ...]:
    """Rows of `Priors.told` whose square is that of the motions, linearised at theta.

    `varied`: variance of the gradient, where it is larger than the Hessian; see `summed`.
    `loose` (size,): standard deviations of theta from the still poses to the motions.
    """
    hessian = sum((x.hessian for x in told), np.zeros((len(theta), len(theta))))
    gradient = sum((x.gradient for x in told), np.zeros(len(theta)))
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    scaled = hessian / np.outer(scale, scale) + damping * np.eye(len(theta))
    values, vectors = np.linalg.eigh(scaled)
    kept = values > _SHOWN * values[-1]
    roots, vectors = np.sqrt(values[kept]), vectors[:, kept]
    rows = (roots[:, None] * vectors.T) * scale
    pulled = (vectors.T @ (gradient / scale)) / roots
    if varied is not None:
        arm = (vectors.T / scale) / roots[:, None]
        sizes, axes = np.linalg.eigh(arm @ varied @ arm.T)
        share = axes.T / np.sqrt(np.maximum(sizes, 1.0))[:, None]
        rows, pulled = share @ rows, share @ pulled
    if loose is not None:
        looser = rows * loose
        sizes, axes = np.linalg.eigh(np.eye(len(rows)) + looser @ looser.T)
        share = axes.T / np.sqrt(sizes)[:, None]
        rows, pulled = share @ rows, share @ pulled
    return tuple((row, float(row @ theta - pull)) for row, pull in zip(rows, pulled, strict=True))


def repeated(unknowns: Unknowns, theta: FloatArray) -> FloatArray:
    """Standard deviations (size,) of theta from the still poses to the motions."""
    out, names = np.zeros(len(theta)), unknowns.names
    for name, std in REPEATED.items():
        if name in names:
            k = names.index(name)
            out[k] = std if name == BENDING_STIFFNESS else std * abs(theta[k])
    return out


def _varied(item: FittedMotion, told: Told, std: float) -> FloatArray:
    """Variance (size, size) of the gradient by theta, from the residuals themselves.

        J = sum_t s_t s_t' + sum_(l <= L) (1 - l / (L + 1)) sum_t (s_t s_(t+l)' + s_(t+l) s_t')

    s_t: the part of the gradient from time t. White noise gives the Hessian; what the model lacks
    lasts for a while and along the cable, and its parts add up. L is half a period of the first
    mode.

    References
    ----------
    Newey and West, Econometrica 55 (1987).
    """
    seen, times = item.seen, item.recording.times
    own = np.linalg.solve(told.block, told.cross)
    rows = (seen.by_theta - seen.by_own @ own) * (seen.residual / std**2)[:, None]
    mask = np.isfinite(item.recording.measured.points[: len(times), :, 0])
    dimension = len(rows) // int(mask.sum())
    at = np.repeat(np.repeat(np.arange(len(times)), mask.sum(axis=1)), dimension)
    scores = np.zeros((len(times), rows.shape[1]))
    np.add.at(scores, at, rows)
    lag = int(np.ceil(item.recording.period / 2 / np.median(np.diff(times))))
    total = scores.T @ scores
    for k in range(1, min(lag, len(times) - 1) + 1):
        both = scores[:-k].T @ scores[k:]
        total += (1 - k / (lag + 1)) * (both + both.T)
    return total
