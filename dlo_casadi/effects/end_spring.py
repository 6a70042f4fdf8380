"""Pins that hold the cable's direction, by a spring or by friction."""

from dataclasses import dataclass
from typing import ClassVar, Self

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import BoundaryEffect, Fitted, Params, Scan

# Trial headings of the relaxed spring, relative to the cable's mean heading there [rad].
HEADINGS = (-1.2, -0.6, 0.0, 0.6, 1.2)


class PinSpring(BoundaryEffect):
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
    def impossible(cls, setup: Setup) -> str:
        """It needs a pin at that end."""
        held = getattr(setup, cls.side)
        if held.turns:
            return super().impossible(setup)
        return (
            f"it is a spring at a pin, and the {cls.side} is {held}. "
            f"Try: experiment.boundary, with the {cls.side} pinned"
            + (", or clamp_compliance" if held.direction else "")
        )

    def scans(self, setup: Setup) -> tuple[Scan, ...]:
        """Try headings around the cable's mean heading at that end."""
        mean = setup.directions[self.side == "end"]
        return tuple({"heading": mean + turn} for turn in HEADINGS)

    def may_be(self, found: Fitted) -> bool:
        """A local effect next to the pin may be caused by the pin."""
        return found.near(self.side)

    def energy(self, first: ca.SX, last: ca.SX, params: Params) -> ca.SX:
        """Energy of the spring [J]."""
        heading = first if self.side == "start" else last
        return params["stiffness"] * (heading - params["heading"]) ** 2 / 2


class StartSpring(PinSpring):
    """A torsional spring at the start pin: V = k (phi(0) - heading)^2 / 2."""

    name = "start_spring"
    lasts = True
    side = "start"


class EndSpring(PinSpring):
    """A torsional spring at the end pin: V = k (phi(L) - heading)^2 / 2."""

    name = "end_spring"
    lasts = True
    side = "end"


@dataclass(frozen=True)
class PinMoment(BoundaryEffect):
    """Moments of the pins on the cable, as friction leaves them.

        V = -EI (start phi(0) + end phi(L))                           [J]

    They differ from pose to pose, so they cannot be declared. Shapes tell the ratio of a moment to
    EI: with a prior on moments as unknowns of each pose, a smaller EI would need smaller moments.

    Parameters
    ----------
    start, end : scalar [1/m]
        Moment of the pin over EI, counter-clockwise, which is the size of the cable's curvature
        there; vanish at 0. Only those of pinned ends.
    """

    sides: tuple[str, ...] = ("start", "end")
    name = "pin_moment"
    at_random = "moments of its own at the pins, as friction leaves them,"
    per_stiffness = True
    dimensions = (2,)

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if an end is a pin."""
        return super().applies(setup) and (setup.start.turns or setup.end.turns)

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """The effect with moments at the pinned ends."""
        ends = {"start": setup.start, "end": setup.end}
        return cls(sides=tuple(side for side, held in ends.items() if held.turns))

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the curvatures."""
        return Parameter.symmetric(self.sides, "1/m", 0.1 / cable.length)

    def energy(self, first: ca.SX, last: ca.SX, params: Params) -> ca.SX:
        """Energy of the moments [J]."""
        headings = {"start": first, "end": last}
        return -sum((params[side] * headings[side] for side in self.sides), ca.SX(0))
