"""A uniform load along +x."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.effect import Cable, Load, Params
from dlo_casadi.parameters import Parameter


class SideLoad(Load):
    """A force per length along +x of the board: a draught, a fan, a tilted camera.

        V = - q int x(s) ds                                           [J]

    Parameters
    ----------
    force_per_length : scalar [N/m]
        Vanishes at 0; at most half the cable's weight on Earth.
    """

    name = "side_load"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the force per length."""
        weight = 9.81 * cable.mass / cable.length
        return (
            Parameter(
                "force_per_length",
                "N/m",
                scale=0.1 * weight,
                lower=-0.5 * weight,
                upper=0.5 * weight,
            ),
        )

    def resultant(self, s: ca.SX, gravity: ca.SX, cable: Cable, params: Params) -> ca.SX:
        """Force on the part beyond s."""
        return params["force_per_length"] * (cable.length - s) * ca.vertcat(1, 0)
