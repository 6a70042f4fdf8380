"""Smooth curves: penalised B-splines through scattered points in a plane, and in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array, diags_array

from dlo_casadi.vision.camera import Array

DEGREE = 3
FINE_GRID = np.linspace(0.0, 1.0, 1001)  # places along a line in space, closely spaced


def normals(steps: Array) -> Array:
    """Unit vectors (K, 2) to the left of steps (K, 2)."""
    sizes = np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
    return steps[:, ::-1] * [-1.0, 1.0] / sizes


def chord_length(points: Array) -> Array:
    """Distance travelled (K,) [m] along points (K, d) [m]."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def length_of(points: Array) -> float:
    """Length [m] of a polygon through points (K, d) [m]."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def fit_curve(t: Array, points: Array, weights: Array, knot: float, smooth: float) -> BSpline:
    """Fit a cubic spline r(t) that bends no more than the points ask for.

        minimise  sum_k w_k |r(t_k) - p_k|^2  +  W (smooth / knot)^4 sum_i |D^2 c_i|^2

    with knots every `knot` metres, second differences D^2 of the coefficients c, and W the sum of
    the weights per coefficient. Gaps need no special case: there the curve bends least.

    `t` (K,) [m] increases along the points (K, 2) [m]; the weights (K,) are inverse variances up to
    a factor. Wavelengths (over 2 pi) well below `smooth` are smoothed away.
    """
    lower, upper = float(t[0]), float(t[-1])
    count = max(1, round((upper - lower) / knot))
    step = (upper - lower) / count
    knots = lower + step * np.arange(-DEGREE, count + DEGREE + 1)
    inside = np.clip(t, lower, upper - 1e-12 * (upper - lower))
    basis = csr_array(BSpline.design_matrix(inside, knots, DEGREE))
    size = basis.shape[1]
    weighted = csr_array(diags_array(weights) @ basis)
    rough = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(size - 2, size))
    penalty = (smooth / step) ** 4 * max(float(weights.sum()), 1e-12) / size
    normal = csr_array(basis.T @ weighted + penalty * (rough.T @ rough))
    banded = np.array([np.pad(normal.diagonal(k), (k, 0)) for k in range(DEGREE, -1, -1)])
    banded[-1] += 1e-12 * banded[-1].max()
    coefficients = solveh_banded(banded, np.asarray(weighted.T @ points))
    return BSpline(knots, coefficients, DEGREE)


@dataclass(frozen=True)
class SpaceCurve:
    """A cubic B-spline r(t), 0 <= t <= 1, with t close to arc length over the whole."""

    coefficients: Array  # (n, 3) [m], in the board frame

    @property
    def knots(self) -> Array:
        """Knots (n + 4,), evenly spaced."""
        n = len(self.coefficients)
        return np.asarray(np.arange(-DEGREE, n + 1) / (n - DEGREE))

    def design(self, t: Array) -> Array:
        """Basis functions (K, n) at t (K,)."""
        inside = np.clip(t, 0.0, 1.0 - 1e-12)
        if not len(t):
            return np.zeros((0, len(self.coefficients)))
        return np.asarray(BSpline.design_matrix(inside, self.knots, DEGREE).toarray())

    def position(self, t: Array) -> Array:
        """Points (K, 3) [m]."""
        return self.design(t) @ self.coefficients

    def tangent(self, t: Array) -> Array:
        """Give the unit tangents (K, 3)."""
        slope = np.asarray(BSpline(self.knots, self.coefficients, DEGREE)(t, 1))
        return slope / np.linalg.norm(slope, axis=1, keepdims=True)

    @property
    def length(self) -> float:
        """Arc length [m]."""
        return length_of(self.position(FINE_GRID))

    def away_from(self, fixtures: Array) -> Array:
        """Distances [m] of its ends from the fixtures: one of the start alone, or both."""
        ends = self.position(np.array([0.0, 1.0]))[: len(fixtures)]
        return np.asarray(np.linalg.norm(ends - fixtures, axis=1))

    def evenly(self) -> SpaceCurve:
        """Give the same curve with t proportional to its arc length."""
        s = chord_length(self.position(FINE_GRID))
        at = np.interp(FINE_GRID * s[-1], s, FINE_GRID)
        even = np.linalg.lstsq(self.design(FINE_GRID), self.position(at), rcond=None)[0]
        return SpaceCurve(np.asarray(even, float))
