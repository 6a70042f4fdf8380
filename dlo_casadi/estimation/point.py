"""Unknowns and shapes of a batch problem, and what is computed there.

The objective and residuals, their Jacobians, and the normal equations of one Gauss-Newton step.
"""

from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.assembly import Shapes, Tangents

# Precision in scaled units below which a direction counts as undetermined.
NO_INFORMATION = 1e-6


@dataclass(frozen=True)
class Values:
    """Unknowns and shapes, whether in equilibrium or not.

    Parameters
    ----------
    theta : (size,)
    projections : list of (K_j,) [m]
        Arc lengths at which the fitted poses' points are compared.
    """

    theta: FloatArray
    shapes: Shapes
    projections: list[FloatArray]


@dataclass(frozen=True)
class Point(Values):
    """Unknowns and shapes with the objective and the residuals there.

    Parameters
    ----------
    objective : float
        Half the sum of squares, priors included.
    data : float
        Sum of squares of the whitened residuals alone.
    residuals : list of (R_j,)
        Whitened residuals of the fitted poses.
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
        Derivative by the pose's own deviations.
    by_all : list of (R_j, fitted poses x n_deviations)
        Derivative by the deviations of all fitted poses, if poses carry a state; else empty.
    raw : list of (R_j,)
        Residuals, not whitened.
    raw_directions : list of (R_j, size + n_deviations)
        Derivatives of the raw residuals.
    shapes : Tangents
        Derivatives of the equilibria, see `BatchEquilibrium.directions`.
    """

    residuals: list[FloatArray]
    by_theta: list[FloatArray]
    by_deviation: list[FloatArray]
    by_all: list[FloatArray]
    raw: list[FloatArray]
    raw_directions: list[FloatArray]
    shapes: Tangents


@dataclass(frozen=True)
class Normal:
    """Normal equations with the deviations eliminated: hessian @ step = -gradient.

    `inner`: for each fitted pose the block of its own deviations, its coupling to theta, and its
    gradient; of size zero if the model has no deviations.
    """

    hessian: FloatArray
    gradient: FloatArray
    inner: list[tuple[FloatArray, FloatArray, FloatArray]]

    def own_covariances(self, covariance: FloatArray) -> list[FloatArray]:
        """Covariance of each fitted pose's own deviations, given that of theta (size, size)."""
        out: list[FloatArray] = []
        for block, cross, _ in self.inner:
            inverse = np.linalg.inv(block)
            arm = inverse @ cross
            out.append(inverse + arm @ covariance @ arm.T)
        return out

    def promised(self, damping: float = 0.0) -> float:
        """Decrease of the objective predicted for a damped step, deviations included."""
        step = np.linalg.solve(self.damped(damping), self.gradient)
        held = damping * self.scale @ step**2
        own = (slope @ np.linalg.solve(block, slope) for block, _, slope in self.inner)
        return float(self.gradient @ step + held) / 2 + float(sum(own)) / 2

    @property
    def scale(self) -> FloatArray:
        """Diagonal of the Hessian, positive."""
        return np.maximum(np.diag(self.hessian), 1e-12)

    def damped(self, damping: float) -> FloatArray:
        """Hessian for damped steps.

        A direction without information, such as the place of a mass of zero, does not move.
        """
        return self.hessian + np.diag(damping * self.scale + NO_INFORMATION)
