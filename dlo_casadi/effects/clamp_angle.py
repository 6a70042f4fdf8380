"""A clamp that holds the cable in another direction than declared."""

from __future__ import annotations

from dataclasses import dataclass

from dlo_casadi.effects.effect import BoundaryEffect, Cable, EndConditions, Params
from dlo_casadi.parameters import Parameter


@dataclass(frozen=True)
class ClampAngle(BoundaryEffect):
    """True minus declared heading of the clamps, the same in all poses.

        heading' = heading + heading_error

    Parameters
    ----------
    start_heading_error, end_heading_error : scalar [rad]
        Counter-clockwise; vanish at 0. Only those of clamped ends are declared.
    """

    name = "clamp_angle"

    start: bool = True
    end: bool = True

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the errors of the clamped ends."""
        held = [side for side, used in (("start", self.start), ("end", self.end)) if used]
        return tuple(
            Parameter(f"{side}_heading_error", "rad", scale=0.05, lower=-0.9, upper=0.9)
            for side in held
        )

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Turn the clamps."""
        return ends.turned(params.get("start_heading_error"), params.get("end_heading_error"))
