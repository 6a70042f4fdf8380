"""Unknowns of a fit with their Gaussian prior, and what a batch problem gives at their values.

That is the objective and residuals, their Jacobians, and the normal equations of one Gauss-Newton
step.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.effects import Load
from dlo_casadi.effects.cable import Parameter
from dlo_casadi.model.assembly import Shapes, Tangents
from dlo_casadi.model.cable_model import STIFFNESS_RATIO_STD, STIFFNESSES, CableModel

# Units of parameters that are the size of a load; others are places and directions.
LOAD_UNITS = ("N", "N/m", "kg")

# Weak prior std of the rest curvature: one turn per length.
REST_TURNS_STD = 1.0
# Bounds of the scaled rest coefficients, turns per length.
LARGEST_REST = 20.0
# Largest change of a logarithm in one step: a factor of 20. Without it, where shapes hardly
# determine a stiffness, a step led to bounds at which rounding loses equilibria: 40 steps, not 7.
FARTHEST = 3.0


@dataclass(frozen=True)
class Unknowns:
    """The vector theta of a fit: free parameters (scaled or logarithmic), then rest coefficients.

    Parameters
    ----------
    free : (n_parameters,) bool
        Which parameters are estimated; the others stay at `fixed`.
    fixed : (n_parameters,)
        Parameter values of what is not estimated (SI).
    """

    model: CableModel
    free: BoolArray
    fixed: FloatArray

    @cached_property
    def _used(self) -> IntArray:
        return np.flatnonzero(self.free)

    @cached_property
    def _parameters(self) -> list[Parameter]:
        return [self.model.parameters[i] for i in self._used]

    @property
    def n_parameters(self) -> int:
        """Number of free parameters."""
        return len(self._used)

    def off_bounds(self, theta: FloatArray) -> FloatArray:
        """Theta with each parameter that vanishes at a bound moved one typical change off it."""
        vanish = [q.lower == q.nominal and not q.log for q in self._parameters]
        own = np.array(vanish + [False] * self.n_rest, dtype=bool)
        return np.where(own & (theta <= self.bounds[0]), theta + 1, theta)

    @property
    def without_prior(self) -> BoolArray:
        """Entries (size,) of theta without a prior: parameters of declared effects."""
        known = [np.isfinite(q.prior_std) or q.name in STIFFNESSES for q in self._parameters]
        return ~np.array(known + [True] * self.n_rest, dtype=bool)

    @property
    def n_rest(self) -> int:
        """Number of rest-curvature coefficients."""
        return self.model.n_coefficients

    @property
    def size(self) -> int:
        """Length of theta."""
        return self.n_parameters + self.n_rest

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta."""
        names = [self.model.names[i] for i in self._used]
        return (*names, *(f"rest_curvature[{k}]" for k in range(self.n_rest)))

    @cached_property
    def _logs(self) -> BoolArray:
        """Which entries of theta are logarithms."""
        return np.array([q.log for q in self._parameters] + [False] * self.n_rest, dtype=bool)

    @cached_property
    def are_loads(self) -> BoolArray:
        """Whether each entry (size,) of theta is the size of a load."""
        loads = [effect for effect in self.model.effects if isinstance(effect, Load)]
        names = {
            f"{effect.label}.{q.name}"
            for effect in loads
            for q in effect.parameters(self.model.cable)
            if q.unit in LOAD_UNITS and not q.log
        }
        return np.array([name in names for name in self.names], dtype=bool)

    @cached_property
    def scales(self) -> FloatArray:
        """SI value per unit of theta; 1 for logarithmic parameters."""
        scales = [1.0 if q.log else q.scale for q in self._parameters]
        return np.array(scales + [self.model.cable.curvature_scale] * self.n_rest)

    def pack(self, p: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Theta of parameter values and rest coefficients."""
        values = np.concatenate([p[self._used], coefficients])
        theta = values / self.scales
        theta[self._logs] = np.log(values[self._logs])
        return np.asarray(theta)

    def p(self, theta: FloatArray) -> FloatArray:
        """Parameter vector of the model (SI)."""
        values = theta * self.scales
        values[self._logs] = np.exp(theta[self._logs])
        p = self.fixed.copy()
        p[self._used] = values[: self.n_parameters]
        return p

    def derivatives(self, theta: FloatArray) -> FloatArray:
        """SI value per unit of theta at theta (size,)."""
        out = self.scales.copy()
        out[self._logs] = np.exp(theta[self._logs])
        return out

    def slopes(self, theta: FloatArray) -> FloatArray:
        """dp/dtheta (n_parameters of the model, size)."""
        out = np.zeros((len(self.model.parameters), self.size))
        n = self.n_parameters
        out[self._used, np.arange(n)] = self.derivatives(theta)[:n]
        return out

    def coefficients(self, theta: FloatArray) -> FloatArray:
        """Rest-curvature coefficients [1/m]."""
        return theta[self.n_parameters :] * self.model.cable.curvature_scale

    def rest(self, theta: FloatArray) -> FloatArray:
        """Rest curvature of the bending cells before the first pose [1/m]."""
        return self.model.rest_basis @ self.coefficients(theta)

    def symbolic_p(self, theta: ca.SX) -> ca.SX:
        """Parameter vector of the model as an expression of theta."""
        p = ca.SX(ca.DM(self.fixed))
        for k, i in enumerate(self._used):
            p[i] = ca.exp(theta[k]) if self._logs[k] else theta[k] * self.scales[k]
        return p

    @property
    def rest_slopes(self) -> FloatArray:
        """Derivative of the rest curvature by theta (n_rests, size)."""
        out = np.zeros((self.model.chain.n_rests, self.size))
        out[:, self.n_parameters :] = self.model.rest_basis * self.model.cable.curvature_scale
        return out

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of theta."""
        rest = np.full(self.n_rest, LARGEST_REST * self.model.cable.curvature_scale)
        p = np.array([(q.lower, q.upper) for q in self.model.parameters]).T
        return self.pack(p[0], -rest), self.pack(p[1], rest)

    @cached_property
    def widest(self) -> FloatArray:
        """Standard deviations of theta if only its bounds are known: a uniform distribution.

        Those of rest coefficients, which have a prior, are infinite.
        """
        ranges = [(*q.range, q) for q in self._parameters]
        width = [np.log(high / low) if q.log else (high - low) / q.scale for low, high, q in ranges]
        return np.concatenate([np.array(width) / np.sqrt(12), np.full(self.n_rest, np.inf)])

    def reach(self, theta: FloatArray, farthest: float = FARTHEST) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of theta after a step: logarithms change by `farthest` at most."""
        far = np.where(self._logs, farthest, np.inf)
        lower, upper = self.bounds
        return np.maximum(lower, theta - far), np.minimum(upper, theta + far)

    @cached_property
    def _nominal(self) -> FloatArray:
        return self.pack(self.model.nominal, np.zeros(self.n_rest))

    @cached_property
    def _stiffnesses(self) -> tuple[int | None, int | None]:
        """Entries of the logarithms of EI and GJ; None where they are not estimated."""
        found = [self.names.index(name) if name in self.names else None for name in STIFFNESSES]
        return found[0], found[1]

    def own_prior(self, theta: FloatArray, k: int) -> float:
        """Contribution of the prior of entry k alone to twice the objective."""
        gap = theta - self._nominal
        bending, torsion = self._stiffnesses
        if k == torsion:
            of_bending = gap[bending] if bending is not None else 0.0
            return float(((gap[k] - of_bending) / STIFFNESS_RATIO_STD) ** 2)
        return float((gap[k] * self.scales[k] / self._parameters[k].prior_std) ** 2)

    def prior(self, roughness_std: float) -> tuple[FloatArray, FloatArray]:
        """Mean (size,) and precision matrix (size, size) of the Gaussian prior of theta.

        `roughness_std`: standard deviation of second differences of the scaled rest coefficients.
        """
        mean, n = self._nominal.copy(), self.n_parameters
        std = np.array([q.prior_std for q in self._parameters]) / self.scales[:n]
        precision = np.zeros((self.size, self.size))
        precision[range(n), range(n)] = 1 / std**2
        bending, torsion = self._stiffnesses
        if torsion is not None:
            # (log GJ/EI - its nominal value)^2 / std^2.
            row = np.zeros(self.size)
            row[torsion] = 1 / STIFFNESS_RATIO_STD
            if bending is not None:
                row[bending] = -row[torsion]
            else:
                mean[torsion] += np.log(self.fixed[0] / self.model.nominal[0])
            precision += np.outer(row, row)
        if self.n_rest:
            rough = self.model.roughness
            precision[n:, n:] = rough.T @ rough / roughness_std**2
            precision[n:, n:] += np.eye(self.n_rest) / REST_TURNS_STD**2
        return mean, precision


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
