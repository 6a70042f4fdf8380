"""A cable that is longer or shorter than declared."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca

from dlo_casadi.effects.cable import Cable, Parameter
from dlo_casadi.effects.effect import Kinematics, Params


class LengthError(Kinematics):
    """The length between the fixtures is not the declared one; the mass stays.

        true length = L + length_difference

    Parameters
    ----------
    length_difference : scalar [m]
        True minus declared; vanishes at 0.
    """

    name = "length_error"
    tolerances: ClassVar = {"length_difference": "length"}

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the difference."""
        length = cable.length
        return Parameter.symmetric(("length_difference",), "m", 0.002 * length, 0.3 * length)

    def stretch(self, cable: Cable, params: Params) -> ca.SX:
        """Return true over declared length."""
        return 1 + params["length_difference"] / cable.length
