"""A section that yields as it is bent: strands that slip."""

from typing import ClassVar

import casadi as ca
from scipy.special import roots_jacobi

from dlo_casadi.effects.cable import CableData, Parameter
from dlo_casadi.effects.effect import Params, SectionLaw

# Gauss-Jacobi on [0, 1] with the weight 2 t: ten points integrate the law to 1e-12 for |k|/c up to
# 2, and to 1e-8 for 5.
_NODES, _WEIGHTS = roots_jacobi(10, 0.0, 1.0)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2
# |k| is rounded to sqrt(k^2 + d^2) - d over this share of one turn per length.
_ROUNDING = 1e-3


class BendingSoftening(SectionLaw):
    """The moment grows less than the bend: strands slip, insulation yields.

        M = EI k / (1 + |k| / c),   W = int_0^k M dk = EI k^2 f(|k|) / 2     [N m], [N]
        f(|k|) = 2 int_0^1 t / (1 + t |k| / c) dt

    with k = curvature - rest curvature. In space k is a vector, and with the stiffness matrix B

        W = f(|k|) k^T B k / 2,   M = dW/dk

    so that the size of the bend softens the section, whatever its direction. Torsion keeps its
    stiffness. The estimated parameter is `softness` = 1/c, which vanishes at 0.

    Parameters
    ----------
    softness : scalar [m], >= 0
        Inverse of the curvature scale c.

    References
    ----------
    Slip of strands lowers the bending stiffness with curvature, e.g. Papailiou, IEEE Trans.
    Power Delivery 12 (1997); the hyperbolic law is the simplest that keeps M monotone.
    """

    name = "bending_softening"
    lasts = True
    inverses: ClassVar = {"softness": ("curvature_scale", "1/m")}

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the softness."""
        return (Parameter("softness", "m", scale=0.1 * cable.length, lower=0.0, upper=1e3),)

    def of_bend(self, square: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Energy over EI k^2 / 2: 2 int_0^1 t / (1 + t |k|/c) dt, by quadrature in t."""
        ratio = self._ratio(square, cable, params)
        terms = [w / (1 + t * ratio) for t, w in zip(_NODES, _WEIGHTS, strict=True)]
        return sum(terms, start=ca.SX(0))

    def tangent(self, square: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """dM/dk over EI: (1 + |k|/c)^-2."""
        return 1 / (1 + self._ratio(square, cable, params)) ** 2

    @staticmethod
    def _ratio(square: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """|k|/c, rounded."""
        delta = _ROUNDING * cable.curvature_scale
        return params["softness"] * (ca.sqrt(square + delta**2) - delta)
