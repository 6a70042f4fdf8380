"""A clamp that holds the cable in another direction than declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

from dlo_casadi.effects.cable import Cable
from dlo_casadi.effects.effect import BoundaryEffect, EndConditions, Fitted, Params
from dlo_casadi.effects.parameter import Parameter
from dlo_casadi.effects.setup import Setup


@dataclass(frozen=True)
class ClampEffect(BoundaryEffect):
    """Something about the clamps that is the same in all poses.

    Parameters
    ----------
    start, end : bool
        Which of the ends are clamped.
    """

    start: bool = True
    end: bool = True

    @property
    def sides(self) -> list[str]:
        """Names of the clamped ends."""
        return [side for side in ("start", "end") if getattr(self, side)]

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Where an end is clamped."""
        return super().applies(setup) and "clamped" in (setup.start, setup.end)

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """With the errors of those ends that are clamped."""
        return cls(start=setup.start == "clamped", end=setup.end == "clamped")

    def refusal(self, setup: Setup, values: Mapping[str, float]) -> str:
        """Without a clamp it has no parameters."""
        if self.start or self.end:
            return super().refusal(setup, values)
        return (
            "it turns a clamp, and no end is clamped. "
            "Try: experiment.boundary, with start or end clamped"
        )

    def may_be(self, found: Fitted) -> bool:
        """A local effect beside a clamp may be the clamp's."""
        return (self.start and found.near_start) or (self.end and found.near_end)


class ClampTurn(ClampEffect):
    """True minus declared direction of the clamps."""

    # Parameters of one clamp, behind the name of its end.
    errors: ClassVar[tuple[str, ...]]

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the errors of the clamped ends."""
        return tuple(
            Parameter(f"{side}_{error}", "rad", scale=0.05, lower=-0.9, upper=0.9)
            for side in self.sides
            for error in self.errors
        )


class ClampAngle(ClampTurn):
    """True minus declared heading of the clamps, the same in all poses.

        heading' = heading + heading_error

    Parameters
    ----------
    start_heading_error, end_heading_error : scalar [rad]
        Counter-clockwise; vanish at 0. Only those of clamped ends are declared.
    """

    name = "clamp_angle"
    in_space = False
    errors = ("heading_error",)
    tolerances: ClassVar = {"start_heading_error": "heading", "end_heading_error": "heading"}

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Turn the clamps."""
        return ends.turned(params.get("start_heading_error"), params.get("end_heading_error"))
