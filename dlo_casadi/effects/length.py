"""A cable that is longer or shorter than declared, or that stretches."""

from typing import Any, ClassVar

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter
from dlo_casadi.effects.effect import Kinematics, Params


class LengthError(Kinematics):
    """The length between the fixtures is not the declared one; the mass stays.

        true length = L + length_difference

    The whole cable is longer, and with it the arc lengths of its markers, in proportion. A cable
    that is pulled further into a clamp, or whose length was measured wrongly beyond its markers,
    leaves them where they are: that is not this effect.

    Parameters
    ----------
    length_difference : scalar [m]
        True minus declared; vanishes at 0.
    """

    name = "length_error"
    corrects = "length"
    at_random = "a length of its own, by a standard deviation"
    tolerances: ClassVar = {"length_difference": "length"}

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the difference."""
        length = cable.length
        return Parameter.symmetric(("length_difference",), "m", 0.002 * length, 0.3 * length)

    @staticmethod
    def correction(length: Any, cable: CableData) -> Any:
        """Value of the parameter at a true length [m]."""
        return length - cable.length

    def stretch(self, cable: CableData, params: Params) -> ca.SX:
        """Return true over declared length."""
        return 1 + params["length_difference"] / cable.length


class AxialStretch(Kinematics):
    """Axial strain N / EA under the tension N(s).

        V = int N^2 / (2 EA) ds                                         [J]

    The parameter is `compliance` = 1/EA; it vanishes at 0, where the cable is inextensible.

    Parameters
    ----------
    compliance : scalar [1/N], >= 0
    """

    name = "axial_stretch"
    lasts = True
    inverses: ClassVar = {"compliance": ("axial_stiffness", "N")}
    declared = (Parameter("compliance", "1/N", scale=1e-3, lower=0.0, upper=1.0),)

    def compliance(self, params: Params) -> ca.SX:
        """Return 1/EA [1/N]."""
        return params["compliance"]
