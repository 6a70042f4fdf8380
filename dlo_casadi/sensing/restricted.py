"""Variances of largest restricted likelihood, with its gradient and average information.

    D = log |V| + log |X^T V^-1 X| + y^T P y,   P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1
    dD/dq_j = tr(P V_j) - y^T P V_j P y,   d2D/dq_j dq_k ~ y^T P V_j P V_k P y

of observations y with covariance V(q), V_j = dV/dq_j, what any effect of X may explain left out.
The average of the observed and the expected second derivative needs no trace.

References
----------
Patterson and Thompson, Biometrika 58 (1971); Gilmour, Thompson and Cullis, Biometrics 51 (1995).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.optimize import Bounds, minimize

from dlo_casadi.arrays import FloatArray

# Slope at which a search ends, by parameters in units of their standard errors.
_FLAT = 0.01
# D of sizes whose sums are lost in rounding.
_LOST = 1e30


@dataclass(frozen=True)
class Deviance:
    """D up to a constant, its gradient (k,) and average information (k, k) by the parameters."""

    value: float
    gradient: FloatArray
    information: FloatArray


Found = TypeVar("Found", bound=Deviance)


def most_likely(
    deviance: Callable[[FloatArray], Found], start: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, Found]:
    """Parameters (k,) of least deviance between bounds, and the deviance there.

    L-BFGS-B in units of the information at the start. Newton steps with the information itself
    take more evaluations: far from the optimum it is a tenth of the second derivative.
    """
    first = deviance(start)
    scale = 1 / np.sqrt(1 + np.diag(first.information))

    def scaled(z: FloatArray) -> tuple[float, FloatArray]:
        try:
            found = deviance(start + scale * z) if z.any() else first
        except np.linalg.LinAlgError:
            return _LOST, np.zeros(len(z))
        return found.value, np.asarray(scale * found.gradient)

    found = minimize(
        scaled,
        np.zeros(len(start)),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds((low - start) / scale, (high - start) / scale),
        options={"gtol": _FLAT, "ftol": 1e-7},
    )
    q = np.clip(start + scale * found.x, low, high)
    return q, deviance(q)
