"""Rest curvature: its basis of B-splines, and its random scatter from pose to pose."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from dlo_casadi.arrays import FloatArray

_DEGREE = 3
# Number of cosines of a random rest curvature, and its trial correlation lengths as shares of L.
MODES = 8
SMOOTHNESS = (0.5, 0.25, 0.12)


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


@dataclass(frozen=True)
class RestScatter:
    """Random rest curvature, a different one in each repeat of a pose.

    Parameters
    ----------
    std : float [1/m]
        Root mean square along the cable; 0 where the cable repeats.
    smoothness : float
        Correlation length as a share of the cable's.
    dof : float
        Degrees of freedom of the chi-square distribution of its estimated variance.
    """

    std: float = 0.0
    smoothness: float = SMOOTHNESS[0]
    dof: float = np.inf

    @property
    def sizes(self) -> FloatArray:
        """Standard deviation (MODES,) [1/m] of each mode's coefficient."""
        share = np.exp(-((np.arange(MODES) * np.pi * self.smoothness) ** 2) / 2)
        return self.std * np.sqrt(share / share.sum())


def modes_of(cells: FloatArray, length: float) -> FloatArray:
    """Means of the modes f_k over cells (n_cells, 2) [m]: (n_cells, MODES)."""
    k = np.arange(1, MODES)
    primitive = np.sin(np.pi / length * np.multiply.outer(cells, k)) * length / (k * np.pi)
    waves = (primitive[:, 1] - primitive[:, 0]) / (cells[:, 1] - cells[:, 0])[:, None]
    return np.column_stack([np.ones(len(cells)), np.sqrt(2.0) * waves])
