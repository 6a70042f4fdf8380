"""A constant force at one place of the cable."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.effect import Cable, Params, PointForceAt, PointLoad
from dlo_casadi.parameters import Parameter


class PointForce(PointLoad):
    """A dead force on the cable, the same in every pose: a string over a pulley, a jet.

        V = - f . r(s)                                                [J]

    Parameters
    ----------
    fx, fy : scalar [N]
        In the board frame; vanishes at 0; at most three times the cable's weight on Earth.
    position : scalar [m], in [0, L]
        Arc length from the start fixture.
    """

    name = "point_force"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the force and its place."""
        scale = 0.1 * 9.81 * cable.mass
        return (
            Parameter("fx", "N", scale=scale, lower=-30 * scale, upper=30 * scale),
            Parameter("fy", "N", scale=scale, lower=-30 * scale, upper=30 * scale),
            self.position(cable),
        )

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """The force."""
        return (PointForceAt(ca.vertcat(params["fx"], params["fy"]), params["position"]),)
