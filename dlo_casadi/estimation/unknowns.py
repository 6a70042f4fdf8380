"""Unknowns of a fit: scaled parameters and rest curvature, with their Gaussian prior."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.model.cable_model import STIFFNESS_RATIO_STD, STIFFNESSES, CableModel

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]

# A weak prior of the rest curvature: a turn per length, one standard deviation.
REST_TURNS_STD = 1.0
# Logarithms change by so much in a step, a factor of 20. Where shapes hardly tell a stiffness, a
# step led to its bounds, where equilibria are lost to rounding: 40 steps that crept, instead of 7.
FARTHEST = 3.0


@dataclass(frozen=True)
class Unknowns:
    """The vector theta of a fit: free parameters (scaled or logarithmic), then rest coefficients.

    Parameters
    ----------
    model : CableModel
    free : (n_parameters,) bool
        Which parameters are estimated; the others stay at `fixed`.
    fixed : (n_parameters,)
        Parameter values of what is not estimated (SI).
    rest_free : bool
        Whether the rest curvature is estimated.
    told : tuple of (row (size,), value)
        What else is known of theta: row @ theta is `value`, with a standard deviation of one.
    """

    model: CableModel
    free: BoolArray
    fixed: FloatArray
    rest_free: bool = True
    told: tuple[tuple[FloatArray, float], ...] = ()

    @property
    def _used(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.free)

    @property
    def n_parameters(self) -> int:
        """Number of free parameters."""
        return int(self.free.sum())

    @property
    def n_rest(self) -> int:
        """Number of free rest-curvature coefficients."""
        return self.model.n_coefficients if self.rest_free else 0

    @property
    def size(self) -> int:
        """Length of theta."""
        return self.n_parameters + self.n_rest

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta."""
        names = [self.model.names[i] for i in self._used]
        return (*names, *(f"rest_curvature[{k}]" for k in range(self.n_rest)))

    @property
    def scales(self) -> FloatArray:
        """SI value per unit of theta; 1 for logarithmic parameters."""
        parameters = [self.model.parameters[i] for i in self._used]
        scales = [1.0 if q.log else q.scale for q in parameters]
        return np.array(scales + [self.model.cable.curvature_scale] * self.n_rest)

    def pack(self, p: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Theta of parameter values and rest coefficients."""
        parts = []
        for i in self._used:
            q = self.model.parameters[i]
            parts.append(np.log(p[i]) if q.log else p[i] / q.scale)
        if self.rest_free:
            parts += list(coefficients / self.model.cable.curvature_scale)
        return np.array(parts)

    def p(self, theta: FloatArray) -> FloatArray:
        """Parameter vector of the model (SI)."""
        p = self.fixed.copy()
        for value, i in zip(theta, self._used, strict=False):
            q = self.model.parameters[i]
            p[i] = np.exp(value) if q.log else value * q.scale
        return p

    def slopes(self, theta: FloatArray) -> FloatArray:
        """dp/dtheta (n_parameters of the model, size)."""
        out = np.zeros((len(self.model.parameters), self.size))
        for k, i in enumerate(self._used):
            q = self.model.parameters[i]
            out[i, k] = np.exp(theta[k]) if q.log else q.scale
        return out

    def coefficients(self, theta: FloatArray) -> FloatArray:
        """Rest-curvature coefficients [1/m]."""
        if not self.rest_free:
            return np.zeros(self.model.n_coefficients)
        return theta[self.n_parameters :] * self.model.cable.curvature_scale

    def rest(self, theta: FloatArray) -> FloatArray:
        """Rest curvature of the bending cells before the first pose [1/m]."""
        return self.model.rest_basis @ self.coefficients(theta)

    def symbolic_p(self, theta: ca.SX) -> ca.SX:
        """Parameter vector of the model as an expression of theta."""
        p = ca.SX(ca.DM(self.fixed))
        for k, i in enumerate(self._used):
            q = self.model.parameters[i]
            p[i] = ca.exp(theta[k]) if q.log else theta[k] * q.scale
        return p

    def symbolic_rest(self, theta: ca.SX) -> ca.SX:
        """Rest curvature before the first pose as an expression of theta."""
        return ca.DM(self.rest_slopes) @ theta

    @property
    def rest_slopes(self) -> FloatArray:
        """Derivative of the rest curvature by theta (n_rests, size)."""
        out = np.zeros((self.model.chain.n_rests, self.size))
        if self.rest_free:
            out[:, self.n_parameters :] = self.model.rest_basis * self.model.cable.curvature_scale
        return out

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of theta."""
        lower, upper = [], []
        for i in self._used:
            q = self.model.parameters[i]
            low, high = (np.log(q.lower), np.log(q.upper)) if q.log else (q.lower, q.upper)
            scale = 1.0 if q.log else q.scale
            lower.append(low / scale)
            upper.append(high / scale)
        rest = np.full(self.n_rest, 20.0)
        return np.concatenate([lower, -rest]), np.concatenate([upper, rest])

    @property
    def widest(self) -> FloatArray:
        """Standard deviations of theta of which nothing is known but its bounds: even between them.

        Those of rest coefficients, which have a prior, are infinite.
        """
        width = []
        for i in self._used:
            q = self.model.parameters[i]
            low, high = q.range
            width.append(np.log(high / low) if q.log else (high - low) / q.scale)
        return np.concatenate([np.array(width) / np.sqrt(12), np.full(self.n_rest, np.inf)])

    def reach(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of theta after one step: logarithms change by FARTHEST at most."""
        far = np.full(self.size, np.inf)
        far[: self.n_parameters][[self.model.parameters[i].log for i in self._used]] = FARTHEST
        lower, upper = self.bounds
        return np.maximum(lower, theta - far), np.minimum(upper, theta + far)

    def prior_mean(self, precision: FloatArray) -> FloatArray:
        """Mean of the Gaussian prior of theta, whose precision matrix is given."""
        nominal = self.model.nominal
        mean = self.pack(nominal, np.zeros(self.model.n_coefficients))
        bending, torsion = self._stiffnesses
        if torsion is not None and bending is None:
            mean[torsion] += np.log(self.fixed[0] / nominal[0])
        pulled = sum((row * (value - row @ mean) for row, value in self.told), np.zeros_like(mean))
        return mean + np.linalg.pinv(precision, hermitian=True) @ pulled if self.told else mean

    @property
    def _stiffnesses(self) -> tuple[int | None, int | None]:
        """Entries of the logarithms of EI and GJ; None where they are not estimated."""
        found = [self.names.index(name) if name in self.names else None for name in STIFFNESSES]
        return found[0], found[1]

    def odd_ratio(self, theta: FloatArray) -> bool:
        """Whether GJ over EI is more than two standard deviations from what is declared.

        Where an effect is missing, a cable without torsion often fits shapes better than any.
        """
        bending, torsion = self._stiffnesses
        if bending is None or torsion is None:
            return False
        return self.own_prior(theta, torsion) > 4.0

    def own_prior(self, theta: FloatArray, k: int) -> float:
        """What the prior of entry k itself adds to twice the objective."""
        q = self.model.parameters[self._used[k]]
        gap = theta - self.pack(self.model.nominal, np.zeros(self.model.n_coefficients))
        bending, torsion = self._stiffnesses
        if k == torsion:
            of_bending = gap[bending] if bending is not None else 0.0
            return float(((gap[k] - of_bending) / STIFFNESS_RATIO_STD) ** 2)
        return 0.0 if np.isinf(q.prior_std) else float((gap[k] / q.prior_std) ** 2)

    def prior_precision(self, roughness_std: float) -> FloatArray:
        """Precision matrix (size, size) of the prior of theta.

        Parameters
        ----------
        roughness_std : float
            Standard deviation of second differences of the scaled rest coefficients.
        """
        precision = np.zeros((self.size, self.size))
        for k, i in enumerate(self._used):
            q = self.model.parameters[i]
            std = q.prior_std if q.log else q.prior_std / q.scale
            precision[k, k] = 0.0 if np.isinf(std) else 1 / std**2
        bending, torsion = self._stiffnesses
        if torsion is not None:
            # (log GJ/EI - its nominal value)^2 / std^2.
            row = np.zeros(self.size)
            row[torsion] = 1 / STIFFNESS_RATIO_STD
            if bending is not None:
                row[bending] = -row[torsion]
            precision += np.outer(row, row)
        if self.n_rest:
            rest = slice(self.n_parameters, self.size)
            rough = self.model.roughness
            precision[rest, rest] = rough.T @ rough / roughness_std**2
            precision[rest, rest] += np.eye(self.n_rest) / REST_TURNS_STD**2
        rows = np.reshape([row for row, _ in self.told], (-1, self.size))
        return np.asarray(precision + rows.T @ rows)
