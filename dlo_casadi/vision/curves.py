"""Smooth planar curves through scattered points: penalised B-splines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array, diags_array

from dlo_casadi.vision.camera import Array

_DEGREE = 3


@dataclass(frozen=True)
class SmoothCurve:
    """A cubic B-spline r(t), with t close to arc length."""

    spline: BSpline  # t [m] -> (x, y) [m]

    def position(self, t: Array) -> Array:
        """Points (K, 2) [m] at t (K,) [m]."""
        return np.asarray(self.spline(t))

    def normal(self, t: Array) -> Array:
        """Give the unit normals (K, 2), to the left of the direction of travel."""
        return normals(self.spline(t, 1))


def normals(steps: Array) -> Array:
    """Unit vectors (K, 2) to the left of steps (K, 2)."""
    sizes = np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
    return steps[:, ::-1] * [-1.0, 1.0] / sizes


def chord_length(points: Array) -> Array:
    """Distance travelled (K,) [m] along points (K, 2) [m]."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def length_of(points: Array) -> float:
    """Length [m] of a polygon through points (K, d) [m]."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def fit_curve(t: Array, points: Array, weights: Array, knot: float, smooth: float) -> SmoothCurve:
    """Fit a spline that bends no more than the points ask for.

        minimise  sum_k w_k |r(t_k) - p_k|^2  +  W (smooth / knot)^4 sum_i |D^2 c_i|^2

    with knots every `knot` metres, second differences D^2 of the coefficients c, and W the sum of
    the weights per coefficient. Gaps need no special case: there the curve bends least.

    `t` (K,) [m] increases along the points (K, 2) [m]; the weights (K,) are inverse variances up to
    a factor. Wavelengths (over 2 pi) well below `smooth` are smoothed away.
    """
    lower, upper = float(t[0]), float(t[-1])
    count = max(1, round((upper - lower) / knot))
    step = (upper - lower) / count
    knots = lower + step * np.arange(-_DEGREE, count + _DEGREE + 1)
    inside = np.clip(t, lower, upper - 1e-12 * (upper - lower))
    basis = csr_array(BSpline.design_matrix(inside, knots, _DEGREE))
    size = basis.shape[1]
    weighted = csr_array(diags_array(weights) @ basis)
    rough = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(size - 2, size))
    penalty = (smooth / step) ** 4 * max(float(weights.sum()), 1e-12) / size
    normal = csr_array(basis.T @ weighted + penalty * (rough.T @ rough))
    banded = np.array([np.pad(normal.diagonal(k), (k, 0)) for k in range(_DEGREE, -1, -1)])
    banded[-1] += 1e-12 * banded[-1].max()
    coefficients = solveh_banded(banded, np.asarray(weighted.T @ points))
    return SmoothCurve(BSpline(knots, coefficients, _DEGREE))
