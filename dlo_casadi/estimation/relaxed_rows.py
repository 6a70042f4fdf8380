"""Rows of a Gauss-Newton step of a relaxed fit, and least squares within bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from dlo_casadi.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Linearized:
    """Rows of a Gauss-Newton step: derivatives by a pose's unknowns, its state, theta; then target.

    Parameters
    ----------
    poses : list of (n_j, own + r + size + 1)
        One array per pose; the balance of forces comes first, in the order of the unknowns.
    states : list of (r, own + r + size + 1)
        Derivatives of each pose's state by the unknowns of the pose before; r = 0 without a state.
    prior : (size, size + 1)
    """

    poses: list[FloatArray]
    states: list[FloatArray]
    prior: FloatArray

    def and_columns(
        self, other: Linearized, kept: Sequence[int], rows: IntArray, pose: Mapping[int, int]
    ) -> Linearized:
        """With some unknowns of another model at the same shapes, without priors.

        `rows`: those of its balance of forces among those of this model, which has more conditions;
        `pose`: its pose by this model's one, which may have more that are not measured.
        """
        at = np.array(kept) - len(other.prior) - 1

        def joined(own: FloatArray, more: FloatArray, balance: IntArray) -> FloatArray:
            skipped = len(own) - len(more)
            to = np.concatenate([balance, skipped + np.arange(len(balance), len(more))])
            found = np.zeros((len(own), len(at)))
            found[to[: len(more)]] = more[:, at]
            return np.concatenate([own[:, :-1], found, own[:, -1:]], axis=1)

        none, nothing = np.zeros(0, dtype=int), np.zeros((0, other.prior.shape[1]))

        def each(own: list[FloatArray], more: list[FloatArray], on: IntArray) -> list[FloatArray]:
            pairs = ((x, more[pose[j]] if j in pose else nothing) for j, x in enumerate(own))
            return [joined(x, y, on if len(y) else none) for x, y in pairs]

        poses = each(self.poses, [x[:, -other.prior.shape[1] :] for x in other.poses], rows)
        states = each(self.states, [x[:, -other.prior.shape[1] :] for x in other.states], none)
        return Linearized(poses, states, joined(self.prior, nothing, none))


@dataclass(frozen=True)
class Reduced:
    """Triangular factors of a Gauss-Newton step: each pose's own unknowns, and the rest for theta.

    It also holds the states' derivatives by the free unknowns, without their target, and the rows
    for theta alone, without its prior and damping.
    """

    own: list[FloatArray]
    states: list[FloatArray]
    shared: FloatArray
    rows: FloatArray


def bounded(rows: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Least squares within bounds, of stacked rows whose last column is the target."""
    step = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-12)[0]
    if np.all(step >= lower) and np.all(step <= upper):
        return np.asarray(step)
    low = np.minimum(lower, 0.0)
    high = np.maximum(np.maximum(upper, 0.0), low + 1e-12)
    return np.asarray(lsq_linear(rows[:, :-1], rows[:, -1], (low, high), method="bvls").x)
