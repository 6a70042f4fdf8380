"""Basis of B-splines of the rest curvature."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from dlo_casadi.arrays import FloatArray

_DEGREE = 3


@dataclass(frozen=True)
class RestCurvature:
    """kappa_0(s) = sum_k c_k B_k(s), clamped uniform B-splines on [0, L].

    They are cubic; with fewer than four coefficients a parabola, a line or a constant.

    Parameters
    ----------
    length : float [m]
    n_coefficients : int
        0 = straight at rest.
    """

    length: float
    n_coefficients: int

    @property
    def _spline(self) -> BSpline:
        degree = min(_DEGREE, self.n_coefficients - 1)
        inner = np.linspace(0.0, self.length, self.n_coefficients - degree + 1)
        knots = np.concatenate([[0.0] * degree, inner, [self.length] * degree])
        return BSpline(knots, np.eye(self.n_coefficients), degree)

    def basis(self, s: FloatArray) -> FloatArray:
        """Values (len(s), n_coefficients) of the basis functions at arc lengths s [m]."""
        if self.n_coefficients == 0:
            return np.zeros((len(s), 0))
        return self._spline(s)

    def cell_means(self, cells: FloatArray) -> FloatArray:
        """Means (n_cells, n_coefficients) of the basis functions over cells (n_cells, 2) [m].

        The mean, not the value in the middle, makes int (kappa - kappa_0)^2 ds of a curve of
        constant curvature per cell exact up to a constant.
        """
        if self.n_coefficients == 0:
            return np.zeros((len(cells), 0))
        primitive = self._spline.antiderivative()
        return (primitive(cells[:, 1]) - primitive(cells[:, 0])) / np.diff(cells, axis=1)

    @property
    def roughness(self) -> FloatArray:
        """Second differences (n_coefficients - 2, n_coefficients) of the coefficients."""
        return np.diff(np.eye(self.n_coefficients), n=2, axis=0)
