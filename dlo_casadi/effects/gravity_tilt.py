"""Gravity turned against the frame of the measurement."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.cable import Cable, Parameter
from dlo_casadi.effects.effect import LoadAcrossGravity, Params
from dlo_casadi.rod.node import rotated, rotation


class GravityTilt(LoadAcrossGravity):
    """The board or the robot does not stand plumb: gravity is turned for every weight.

        g' = R(angle) g

    In space R is that of a rotation vector with two components: about the world's axes that
    gravity is not most along.

    Parameters
    ----------
    angle; in space angle_x, angle_y (or x, z; y, z) : scalar [rad]
        Counter-clockwise; vanish at 0; at most half a radian.
    """

    name = "gravity_tilt"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the angles."""
        return Parameter.symmetric(self.components("angle", cable), "rad", 0.05, 0.5)

    def gravity(self, gravity: ca.SX, params: Params) -> ca.SX:
        """Turn gravity counter-clockwise."""
        if "angle" in params:
            c, s = ca.cos(params["angle"]), ca.sin(params["angle"])
            return ca.vertcat(c * gravity[0] - s * gravity[1], s * gravity[0] + c * gravity[1])
        turn = ca.vertcat(*(params.get(f"angle_{axis}", ca.SX(0)) for axis in "xyz"))
        return rotated(rotation(turn), gravity)
