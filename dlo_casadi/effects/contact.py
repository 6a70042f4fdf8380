"""Obstacles that are not quite where they are declared."""

from dataclasses import dataclass
from typing import ClassVar, Self

from dlo_casadi.effects.cable import CableData, Parameter
from dlo_casadi.effects.effect import ContactEffect
from dlo_casadi.effects.setup import Setup


@dataclass(frozen=True)
class ObstacleOffset(ContactEffect):
    """True minus declared place of one obstacle's surface, the same in all poses.

        g' = g - offset

    of the cable's distance g [m] from the declared surface. `obstacle` is its number, 0 of the
    first.

    Parameters
    ----------
    offset : scalar [m]
        Outwards, towards the cable; vanishes at 0.
    """

    name = "obstacle_offset"
    tolerances: ClassVar = {"offset": "obstacle"}

    def __post_init__(self) -> None:
        if not self.label and self.obstacle:
            object.__setattr__(self, "label", f"{self.name}_{self.obstacle + 1}")
        super().__post_init__()

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the offset."""
        return Parameter.symmetric(["offset"], "m", 0.002 * cable.length, 0.1 * cable.length)

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Where there are obstacles."""
        return super().applies(setup) and setup.obstacles > 0

    @classmethod
    def each_for(cls, setup: Setup) -> tuple[Self, ...]:
        """One for each obstacle."""
        return tuple(cls(obstacle=k) for k in range(setup.obstacles))
