"""Unknowns and shapes of a batch problem, and what it is there to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.model.assembly import Shapes, Tangents

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Values:
    """Unknowns and shapes, in equilibrium or not.

    Parameters
    ----------
    theta : (size,)
    shapes : Shapes
    projections : list of (K_j,) [m]
        Arc lengths at which the fitted poses' points are compared.
    """

    theta: FloatArray
    shapes: Shapes
    projections: list[FloatArray]


@dataclass(frozen=True)
class Point(Values):
    """Everything at one value of the unknowns.

    Parameters
    ----------
    objective : float
        Half the sum of squares, priors included.
    data : float
        Sum of squares of the whitened residuals alone.
    residuals : list of (R_j,)
        These, whitened, of the fitted poses.
    """

    objective: float
    data: float
    residuals: list[FloatArray]


@dataclass(frozen=True)
class Linearization:
    """Residuals and Jacobians of the data at a point.

    Parameters
    ----------
    residuals : list of (R_j,)
        Whitened residuals of the sensors, measured minus model.
    by_theta : list of (R_j, size)
        Derivative of the residuals.
    by_deviation : list of (R_j, n_deviations)
    raw : list of (R_j,)
        Residuals, not whitened.
    raw_directions : list of (R_j, size + n_deviations)
        Their derivatives, not whitened.
    shapes : Tangents
        Derivatives of the equilibria, by the unknowns and by each pose's deviations.
    """

    residuals: list[FloatArray]
    by_theta: list[FloatArray]
    by_deviation: list[FloatArray]
    raw: list[FloatArray]
    raw_directions: list[FloatArray]
    shapes: Tangents


@dataclass(frozen=True)
class Normal:
    """Normal equations with the deviations eliminated: hessian @ step = -gradient."""

    hessian: FloatArray
    gradient: FloatArray
    inner: list[tuple[FloatArray, FloatArray, FloatArray]]
