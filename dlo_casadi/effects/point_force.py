"""Forces at one place of the cable: a constant one, and one that is free in every pose."""

from math import inf

import casadi as ca

from dlo_casadi.effects.acting import PointForceAt
from dlo_casadi.effects.cable import CableData, Parameter
from dlo_casadi.effects.effect import Params, PointLoad, vector


class PointForce(PointLoad):
    """A dead force on the cable, the same in every pose: a string over a pulley, a jet.

        V = - f . r(s)                                                [J]

    Parameters
    ----------
    fx, fy, fz : scalar [N]
        In the board frame, fz in space alone; vanishes at 0; estimated up to
        three times the cable's weight on Earth.
    position : scalar [m], in [0, L]
        Arc length from the start fixture.
    """

    name = "point_force"

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the force and its place."""
        names, scale = (f"f{axis}" for axis in cable.axes), 0.1 * 9.81 * cable.mass
        return (*Parameter.symmetric(names, "N", scale, 30 * scale, inf), self.position(cable))

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """The force."""
        return (PointForceAt(vector(params, "f"), params["position"]),)


class UnknownPull(PointLoad):
    """A force at one place of the cable, different in every pose.

        V_j = - (f + f_j) . r(s)                                      [J]

    It assumes no cause: if no effect explains the residual, it gives the place and size of an
    unknown force. The forces are unknowns of the poses, not parameters of the cable, so they
    predict nothing.

    Parameters
    ----------
    fx, fy, fz : scalar [N]
        Mean over the poses, at most ten weights; f_j is the deviation of pose j from it.
    position : scalar [m], in [0, L]
    """

    name = "unknown_pull"

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the mean force and its place."""
        names, scale = (f"f{axis}" for axis in cable.axes), 9.81 * cable.mass
        return (*Parameter.symmetric(names, "N", scale, 10 * scale), self.position(cable))

    def per_pose(self, cable: CableData) -> tuple[str, ...]:
        """Deviation f_j of the pose's force from the mean."""
        return tuple(f"unknown_force_{axis}" for axis in cable.axes)

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """The force of this pose."""
        force = vector(params, "f") + vector(params, "unknown_force_")
        return (PointForceAt(force, params["position"]),)
