"""A pin that holds the cable's direction."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.effect import BoundaryEffect, Cable, Params
from dlo_casadi.parameters import Parameter


class _PinSpring(BoundaryEffect):
    """A torsional spring between a pin and the cable.

        V = k (phi - heading)^2 / 2                                   [J]

    Parameters
    ----------
    stiffness : scalar [N m/rad], >= 0
        Vanishes at 0.
    heading : scalar [rad]
        Direction in which the spring is relaxed.
    """

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare stiffness and relaxed heading."""
        scale = cable.bending_stiffness / cable.length
        return (
            Parameter("stiffness", "N m/rad", scale=scale, lower=0.0),
            Parameter("heading", "rad", scale=0.5, lower=-10.0, upper=10.0, scan=True),
        )

    def _spring(self, heading: ca.SX, params: Params) -> ca.SX:
        return params["stiffness"] * (heading - params["heading"]) ** 2 / 2


class StartSpring(_PinSpring):
    """A torsional spring at the start pin: V = k (phi(0) - heading)^2 / 2."""

    name = "start_spring"

    def energy(self, first: ca.SX, last: ca.SX, params: Params) -> ca.SX:
        """Energy of the spring [J]."""
        return self._spring(first, params)


class EndSpring(_PinSpring):
    """A torsional spring at the end pin: V = k (phi(L) - heading)^2 / 2."""

    name = "end_spring"

    def energy(self, first: ca.SX, last: ca.SX, params: Params) -> ca.SX:
        """Energy of the spring [J]."""
        return self._spring(last, params)
