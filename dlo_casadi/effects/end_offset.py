"""An end fixture whose true position differs from the declared one."""

from dataclasses import replace
from typing import ClassVar

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import BoundaryEffect, EndConditions, Params, vector


class EndOffset(BoundaryEffect):
    """True minus declared position of the end fixture, the same in all poses.

        end' = end + (dx, dy (, dz))

    Parameters
    ----------
    dx, dy, dz : scalar [m]
        Vanish at 0; dz in space alone.
    """

    name = "end_offset"
    at_random = "an end displaced by a vector of its own"
    tolerances: ClassVar = {"dx": "end", "dy": "end", "dz": "end"}
    as_deviation: ClassVar = {"dx": "end_x", "dy": "end_y", "dz": "end_z"}

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the offset."""
        names = (f"d{axis}" for axis in cable.axes)
        return Parameter.symmetric(names, "m", 0.002 * cable.length, 0.3 * cable.length)

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """It needs a fixture at the end."""
        if setup.end.place:
            return super().impossible(setup)
        return (
            "it moves the end fixture, and the end is free. "
            "Try: experiment.boundary, with an end that is held: pinned, swivel, clamped or slide"
        )

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Move the end fixture."""
        return replace(ends, end=ends.end + vector(params, "d"))
