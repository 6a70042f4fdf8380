"""Clamps that hold the cable in another direction than declared, or that give way."""

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import BoundaryEffect, EndConditions, Fitted, Params
from dlo_casadi.rod.quaternions import quaternion_product, rotation


@dataclass(frozen=True)
class ClampEffect(BoundaryEffect):
    """An effect of the clamps that is the same in all poses.

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
    def impossible(cls, setup: Setup) -> str:
        """It needs a clamp."""
        if setup.start.direction or setup.end.direction:
            return super().impossible(setup)
        return (
            "it turns a clamp, and no end is clamped. "
            "Try: experiment.boundary, with start or end clamped"
        )

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """The effect with errors of the clamped ends."""
        return cls(start=setup.start.direction, end=setup.end.direction)

    def may_be(self, found: Fitted) -> bool:
        """A local effect next to a clamp may be caused by the clamp."""
        return any(found.near(side) for side in self.sides)


class ClampTurn(ClampEffect):
    """True minus declared direction of the clamps."""

    at_random = "clamps turned by an angle of its own"

    # Parameters of one clamp, appended to the name of its end.
    errors: ClassVar[tuple[str, ...]]

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the errors of the clamped ends."""
        names = (f"{side}_{error}" for side in self.sides for error in self.errors)
        return Parameter.symmetric(names, "rad", 0.05, 0.9)


class ClampAngle(ClampTurn):
    """True minus declared heading of the clamps, the same in all poses.

        heading' = heading + heading_error

    Parameters
    ----------
    start_heading_error, end_heading_error : scalar [rad]
        Counter-clockwise; vanish at 0. Only those of clamped ends are declared.
    """

    name = "clamp_angle"
    dimensions = (2,)
    errors = ("heading_error",)
    tolerances: ClassVar = {"start_heading_error": "heading", "end_heading_error": "heading"}
    as_deviation: ClassVar = {
        "start_heading_error": "start_heading",
        "end_heading_error": "end_heading",
    }

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Turn the clamps."""
        return ends.turned(params.get("start_heading_error"), params.get("end_heading_error"))


class ClampRotation(ClampTurn):
    """True minus declared orientation of the clamps in space, the same in all poses.

        R' = R exp(0, y, z)

    The rotation vector is about the clamp's own axes. Its part about x, along the cable, is
    `end_roll`, because only the difference between the rolls of both clamps matters.

    Parameters
    ----------
    start_y, start_z, end_y, end_z : scalar [rad]
        Vanish at 0. Only those of clamped ends are declared.
    """

    name = "clamp_rotation"
    dimensions = (3,)
    errors = ("y", "z")
    tolerances: ClassVar = dict.fromkeys(("start_y", "start_z", "end_y", "end_z"), "rotation")
    as_deviation: ClassVar = {
        "start_y": "start_rotation_y",
        "start_z": "start_rotation_z",
        "end_y": "end_rotation_y",
        "end_z": "end_rotation_z",
    }

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Turn the clamps."""
        turned = {}
        for name in (f"{side}_frame" for side in self.sides):
            side, frame = name.split("_")[0], ca.vertsplit(getattr(ends, name))
            turn = rotation(ca.vertcat(0, params[f"{side}_y"], params[f"{side}_z"]))
            turned[name] = ca.vertcat(*quaternion_product(frame, ca.vertsplit(turn)))
        return replace(ends, **turned)


class ClampCompliance(ClampEffect):
    """A clamp turns with the moment of the cable on it.

        heading of the cable in the clamp = heading of the clamp + compliance * moment

    In space the rotation vector is compliance * moment about the clamp's axes, including twist (to
    second order: the increment is 2 tan(angle / 2) about the axis).

    Parameters
    ----------
    start, end : scalar [rad/(N m)], >= 0
        Vanish at 0. Only those of clamped ends are declared.
    """

    name = "clamp_compliance"
    lasts = True

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the compliances of the clamped ends."""
        # A tenth of the angle by which a uniform moment turns the whole cable.
        scale = 0.1 * cable.length / cable.bending_stiffness
        return tuple(Parameter(side, "rad/(N m)", scale=scale, lower=0.0) for side in self.sides)

    def compliance(self, params: Params) -> tuple[ca.SX | float, ca.SX | float]:
        """Compliances of the clamps."""
        return params.get("start", 0.0), params.get("end", 0.0)
