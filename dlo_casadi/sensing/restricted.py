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
from dlo_casadi.errors import EstimationError

# Slope at which a search ends, by parameters in units of their standard errors.
_FLAT = 0.01
# D of sizes whose sums are lost in rounding.
_LOST = 1e30


@dataclass(frozen=True)
class Deviance:
    """D up to a constant, and its gradient (k,) by the parameters."""

    value: float
    gradient: FloatArray


Found = TypeVar("Found", bound=Deviance)


def most_likely(
    deviance: Callable[[FloatArray], Found], start: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, Found]:
    """Parameters (k,) of least deviance between bounds, logits or logarithms, and the deviance.

    By L-BFGS-B. Newton steps with the average information take more evaluations: far from the
    optimum it is a tenth of the second derivative.

    Raises
    ------
    EstimationError
        If rounding leaves no covariance that can be factorised where the search ends.
    """

    def sloped(q: FloatArray) -> tuple[float, FloatArray]:
        try:
            found = deviance(q)
        except np.linalg.LinAlgError:
            return _LOST, np.zeros(len(q))
        return found.value, found.gradient

    found = minimize(
        sloped,
        start.astype(float),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(low.astype(float), high.astype(float)),
        options={"gtol": _FLAT, "ftol": 1e-7},
    )
    q = np.clip(found.x, low, high)
    try:
        return q, deviance(q)
    except np.linalg.LinAlgError as error:
        raise EstimationError(
            "noise and scatter from pose to pose cannot be estimated: rounding leaves no "
            "covariance that can be factorised, as of a fit that has run away.\n"
            "  Try: the units of mass and length, the noise as measurement.std."
        ) from error
