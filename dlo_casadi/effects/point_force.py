"""A constant force at one place of the cable."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.cable import Cable
from dlo_casadi.effects.effect import Params, PointForceAt, PointLoad, vector
from dlo_casadi.effects.parameter import Parameter


class PointForce(PointLoad):
    """A dead force on the cable, the same in every pose: a string over a pulley, a jet.

        V = - f . r(s)                                                [J]

    Parameters
    ----------
    fx, fy (, fz) : scalar [N]
        In the board frame; vanishes at 0; at most three times the cable's weight on Earth.
    position : scalar [m], in [0, L]
        Arc length from the start fixture.
    """

    name = "point_force"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the force and its place."""
        scale = 0.1 * 9.81 * cable.mass
        return (
            *(
                Parameter(f"f{axis}", "N", scale=scale, lower=-30 * scale, upper=30 * scale)
                for axis in cable.axes
            ),
            self.position(cable),
        )

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """The force."""
        return (PointForceAt(vector(params, "f"), params["position"]),)
