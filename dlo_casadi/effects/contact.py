"""Obstacles that are not quite where they are declared, or not declared at all."""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import ContactEffect, Scan
from dlo_casadi.rod.obstacles import Obstacle, Plane


@dataclass(frozen=True)
class ObstacleOffset(ContactEffect):
    """True minus declared place of one obstacle's surface, the same in all poses.

        g' = g - offset

    for the cable's distance g [m] from the declared surface. `obstacle` is the obstacle's index, 0
    for the first.

    Parameters
    ----------
    offset : scalar [m]
        Outwards, towards the cable; vanishes at 0.
    """

    name = "obstacle_offset"
    index = "obstacle"
    tolerances: ClassVar = {"offset": "obstacle"}

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the offset."""
        return Parameter.symmetric(["offset"], "m", 0.002 * cable.length, 0.1 * cable.length)

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """It needs a declared obstacle."""
        if setup.obstacles:
            return super().impossible(setup)
        return "it moves an obstacle, and none is declared. Try: experiment.obstacles"

    @classmethod
    def each_for(cls, setup: Setup) -> tuple[Self, ...]:
        """One for each obstacle."""
        return tuple(cls(obstacle=k) for k in range(setup.obstacles))


@dataclass(frozen=True)
class ContactPlane(ContactEffect):
    """A level plane below the cable that is not declared: a table on which it rests.

        g = (r - r_start) . up - height - diameter / 2 >= 0

    for all places r of the cable. The plane is the same in all poses and has no friction. There is
    no derivative where nothing touches, so a fit has to start where something does.

    Parameters
    ----------
    height : scalar [m]
        Along the vertical, from the start fixture of the first pose; negative. The effect vanishes
        where nothing touches.
    """

    name = "contact_plane"
    gradual = False
    level: float = 0.0

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the height."""
        lowest = -2 * cable.length
        return (Parameter("height", "m", lowest, 0.01 * cable.length, lowest, 0.0),)

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """It needs a vertical."""
        if any(setup.gravity):
            return super().impossible(setup)
        return (
            "it is a level plane, and without gravity no plane is level. "
            "Try: experiment.gravity, or experiment.obstacles"
        )

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """The effect with the height of the start fixture."""
        return cls(level=setup.level)

    @classmethod
    def each_for(cls, setup: Setup) -> tuple[Self, ...]:
        """One plane if several shapes have the same lowest height."""
        return () if setup.resting is None else (cls.made_for(setup),)

    def scans(self, setup: Setup) -> tuple[Scan, ...]:
        """Try the plane at the lowest height of several shapes."""
        height = (setup.resting or 0.0) - setup.cable.diameter / 2 - self.level
        return ({"height": min(height, 0.0)},)

    def surface(self, gravity: tuple[float, ...]) -> Obstacle:
        """The level plane through the start fixture of the first pose."""
        up = -np.array(gravity) / np.linalg.norm(gravity)
        return Plane(tuple((self.level * up).tolist()), tuple(up.tolist()), self.label)
