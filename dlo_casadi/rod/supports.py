"""Kinds of supports: what each holds of a cable, in one table."""

from enum import Flag, StrEnum, auto

import numpy as np

from dlo_casadi.arrays import BoolArray
from dlo_casadi.rod.node import Node

# Distance [m] below which two places on a cable are one.
SAME_PLACE = 1e-9


class Holds(Flag):
    """Parts of a cable's place and frame that a support holds at its node.

    Without `ALONG` the cable slides through the support, and the arc length there is unknown.
    """

    PLACE = auto()
    ALONG = auto()
    DIRECTION = auto()
    ROLL = auto()


class SupportKind(StrEnum):
    """The kinds of supports by their words in files; `HOLDS` is what each holds."""

    FREE = "free"
    PINNED = "pinned"
    EYELET = "eyelet"
    SLIDE = "slide"
    SWIVEL = "swivel"
    CLAMPED = "clamped"

    @property
    def holds(self) -> Holds:
        """All that it holds."""
        return HOLDS[self]

    @property
    def place(self) -> bool:
        """Whether it holds the place of the cable."""
        return Holds.PLACE in self.holds

    @property
    def direction(self) -> bool:
        """Whether it holds the direction of the cable."""
        return Holds.DIRECTION in self.holds

    @property
    def roll(self) -> bool:
        """Whether it holds the roll of the cable about its axis."""
        return Holds.ROLL in self.holds

    @property
    def slides(self) -> bool:
        """Whether the cable slides through it."""
        return self.place and Holds.ALONG not in self.holds

    @property
    def turns(self) -> bool:
        """Whether the cable is held at a place and may turn there."""
        return self.place and not self.direction

    def rotations(self, node: type[Node]) -> BoolArray:
        """Which increments (increment,) of a node it holds, in the order of `Node.about`."""
        return np.array([self.roll if axis == "x" else self.direction for axis in node.about])

    def without_roll(self) -> "SupportKind":
        """The kind that holds the same except the roll of the cable."""
        return next(kind for kind, held in HOLDS.items() if held == self.holds & ~Holds.ROLL)


def place_problem(s: float, length: float, fed: tuple[bool, bool] = (False, False)) -> str:
    """Why no point at the arc length s [m] of a cable is between its ends; empty if one may be.

    `fed`: whether the cable is fed through its start, through its end: there may be more of it.
    """
    if (s >= 0 or fed[0]) and (s <= length + SAME_PLACE or fed[1]):
        return ""
    return f"{s:g} m is not between 0 and cable.length {length:g} m"


_POINT = Holds.PLACE | Holds.ALONG
HOLDS = {
    SupportKind.FREE: Holds(0),
    SupportKind.PINNED: _POINT,
    SupportKind.EYELET: Holds.PLACE,
    SupportKind.SLIDE: Holds.PLACE | Holds.DIRECTION,
    SupportKind.SWIVEL: _POINT | Holds.DIRECTION,
    SupportKind.CLAMPED: _POINT | Holds.DIRECTION | Holds.ROLL,
}
# Kinds that a start, an end, and a clip between the ends may have.
STARTS = (SupportKind.PINNED, SupportKind.CLAMPED, SupportKind.SWIVEL, SupportKind.SLIDE)
ENDS = (*STARTS, SupportKind.FREE)
CLIPS = (SupportKind.PINNED, SupportKind.CLAMPED, SupportKind.SWIVEL, SupportKind.EYELET)
