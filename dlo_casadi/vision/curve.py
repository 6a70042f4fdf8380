"""Smooth planar curves through scattered points: penalised B-splines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array, diags_array

from dlo_casadi.vision.view import Array

_DEGREE = 3


@dataclass(frozen=True)
class SmoothCurve:
    """A cubic B-spline r(t), with t close to arc length.

    Parameters
    ----------
    spline : BSpline
        Vector-valued spline, t [m] -> (x, y) [m].
    """

    spline: BSpline

    def position(self, t: Array) -> Array:
        """Points (K, 2) [m] at t (K,) [m]."""
        return np.asarray(self.spline(t))

    def normal(self, t: Array) -> Array:
        """Give the unit normals (K, 2), to the left of the direction of travel."""
        slope = np.asarray(self.spline(t, 1))
        slope /= np.linalg.norm(slope, axis=1, keepdims=True)
        return np.column_stack([-slope[:, 1], slope[:, 0]])


def chord_length(points: Array) -> Array:
    """Distance travelled (K,) [m] along points (K, 2) [m]."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def fit_curve(t: Array, points: Array, weights: Array, knot: float, smooth: float) -> SmoothCurve:
    """Fit a spline that bends no more than the points ask for.

        minimise  sum_k w_k |r(t_k) - p_k|^2  +  W (smooth / knot)^4 sum_i |D^2 c_i|^2

    with knots every `knot` metres, second differences D^2 of the coefficients c, and W the sum of
    the weights per coefficient. Gaps need no special case: there the curve bends least.

    Parameters
    ----------
    t : (K,) [m]
        Increasing parameter of the points.
    points : (K, 2) [m]
        What to pass near.
    weights : (K,)
        Inverse variances up to a factor; zero leaves a point out.
    knot : scalar [m]
        Spacing of the knots.
    smooth : scalar [m]
        Wavelengths (over 2 pi) well below it are smoothed away.
    """
    lower, upper = float(t[0]), float(t[-1])
    count = max(1, round((upper - lower) / knot))
    step = (upper - lower) / count
    knots = lower + step * np.arange(-_DEGREE, count + _DEGREE + 1)
    inside = np.clip(t, lower, upper - 1e-12 * (upper - lower))
    basis = csr_array(BSpline.design_matrix(inside, knots, _DEGREE))
    size = len(knots) - _DEGREE - 1
    weighted = csr_array(diags_array(weights) @ basis)
    normal = csr_array(basis.T @ weighted)
    banded = np.zeros((_DEGREE + 1, size))
    for offset in range(min(_DEGREE, size - 1) + 1):
        banded[_DEGREE - offset, offset:] = normal.diagonal(offset)
    penalty = (smooth / step) ** 4 * max(float(weights.sum()), 1e-12) / size
    for offset, row in enumerate(_second_differences(size)):
        banded[_DEGREE - offset, offset:] += penalty * row
    banded[_DEGREE] += 1e-12 * banded[_DEGREE].max()
    coefficients = solveh_banded(banded, np.asarray(weighted.T @ points))
    return SmoothCurve(BSpline(knots, coefficients, _DEGREE))


def _second_differences(size: int) -> list[Array]:
    """Diagonals 0, 1, 2 of D^T D for second differences of `size` coefficients."""
    if size < 3:
        return [np.zeros(size)]
    main, first = np.zeros(size), np.zeros(size - 1)
    for shift, value in enumerate((1.0, -2.0, 1.0)):
        main[shift : size - 2 + shift] += value**2
    first[: size - 2] += -2.0
    first[1:] += -2.0
    return [main, first, np.ones(size - 2)]
