"""A compact mass carried by the cable."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.effect import Cable, Load, Params, PointForceAt
from dlo_casadi.parameters import Parameter


class LumpedMass(Load):
    """A compact mass on the cable: a connector, a clip, a sensor.

        V = -m g . r(s)                                               [J]

    Parameters
    ----------
    mass : scalar [kg], >= 0
        Vanishes at 0; at most three times the cable's mass.
    position : scalar [m], in [0, L]
        Arc length s from the start fixture. r(s) is once differentiable in s.

    Its own size and moment of inertia are neglected: good while it is shorter than L / 10.

    References
    ----------
    Point load on an elastica, e.g. Frisch-Fay, Flexible Bars, 1962.
    """

    name = "lumped_mass"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare mass and position."""
        return (
            Parameter("mass", "kg", lower=0.0, scale=0.1 * cable.mass, upper=3 * cable.mass),
            Parameter(
                "position",
                "m",
                nominal=cable.length / 2,
                scale=0.1 * cable.length,
                lower=0.0,
                upper=cable.length,
                scan=True,
            ),
        )

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """Weight of the mass."""
        return (PointForceAt(params["mass"] * gravity, params["position"]),)
