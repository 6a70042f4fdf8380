"""Gravity turned against the board frame."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.effect import Cable, Load, Params
from dlo_casadi.parameters import Parameter


class GravityTilt(Load):
    """The board does not hang plumb: gravity is turned by `angle` for every weight.

        g' = R(angle) g

    Parameters
    ----------
    angle : scalar [rad]
        Counter-clockwise; vanishes at 0; at most half a radian.
    """

    name = "gravity_tilt"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the angle."""
        return (Parameter("angle", "rad", scale=0.05, lower=-0.5, upper=0.5),)

    def gravity(self, gravity: ca.SX, params: Params) -> ca.SX:
        """Turn gravity counter-clockwise by the angle."""
        c, s = ca.cos(params["angle"]), ca.sin(params["angle"])
        return ca.vertcat(c * gravity[0] - s * gravity[1], s * gravity[0] + c * gravity[1])
