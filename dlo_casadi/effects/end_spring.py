"""A pin that holds the cable's direction."""

from typing import ClassVar

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter
from dlo_casadi.effects.effect import BoundaryEffect, Fitted, Params, Scan
from dlo_casadi.effects.setup import Setup

# Trial headings of the relaxed spring, relative to the mean heading of the cable there [rad].
HEADINGS = (-1.2, -0.6, 0.0, 0.6, 1.2)


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

    dimensions = (2,)
    # The end that the pin holds.
    side: ClassVar[str]

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare stiffness and relaxed heading."""
        scale = cable.bending_stiffness / cable.length
        return (
            Parameter("stiffness", "N m/rad", scale=scale, lower=0.0),
            Parameter("heading", "rad", scale=0.5, lower=-10.0, upper=10.0),
        )

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Where that end is a pin."""
        return super().applies(setup) and getattr(setup, cls.side) == "pinned"

    def scans(self, setup: Setup) -> tuple[Scan, ...]:
        """Try headings about the cable's mean one at that end."""
        mean = setup.directions[self.side == "end"]
        return tuple({"heading": mean + turn} for turn in HEADINGS)

    def may_be(self, found: Fitted) -> bool:
        """A local effect beside the pin may be caused by the pin."""
        return found.near(self.side)

    def energy(self, first: ca.SX, last: ca.SX, params: Params) -> ca.SX:
        """Energy of the spring [J]."""
        heading = first if self.side == "start" else last
        return params["stiffness"] * (heading - params["heading"]) ** 2 / 2


class StartSpring(_PinSpring):
    """A torsional spring at the start pin: V = k (phi(0) - heading)^2 / 2."""

    name = "start_spring"
    side = "start"


class EndSpring(_PinSpring):
    """A torsional spring at the end pin: V = k (phi(L) - heading)^2 / 2."""

    name = "end_spring"
    side = "end"
