"""A gripper that gives way."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.cable import Cable
from dlo_casadi.effects.clamp_angle import ClampEffect
from dlo_casadi.effects.effect import Params
from dlo_casadi.effects.parameter import Parameter


class ClampCompliance(ClampEffect):
    """A clamp turns with the moment of the cable on it.

        heading of the cable in the clamp = heading of the clamp + compliance * moment

    In space by the rotation vector compliance * moment about the clamp's axes, its twist, too
    (of second order: the increment is 2 tan(angle / 2) about the axis).

    Parameters
    ----------
    start, end : scalar [rad/(N m)], >= 0
        Vanish at 0. Only those of clamped ends are declared.
    """

    name = "clamp_compliance"
    gives = True

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the compliances of the clamped ends."""
        # A tenth of what the whole cable turns by under an even moment.
        scale = 0.1 * cable.length / cable.bending_stiffness
        return tuple(Parameter(side, "rad/(N m)", scale=scale, lower=0.0) for side in self.sides)

    def compliance(self, params: Params) -> tuple[ca.SX | float, ca.SX | float]:
        """Compliances of the clamps."""
        return params.get("start", 0.0), params.get("end", 0.0)
