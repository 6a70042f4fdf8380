"""Loads across gravity: a uniform one, and gravity rotated against the measurement's frame."""

from dataclasses import dataclass
from math import inf
from typing import Self

import casadi as ca
import numpy as np

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import Load, Params
from dlo_casadi.rod.quaternions import rotated, rotation


@dataclass(frozen=True)
class LoadAcrossGravity(Load):
    """A load with one component per direction across gravity: one in a plane, two in space.

    Parameters
    ----------
    vertical : "x", "y" or "z", optional
        In space, the world's axis nearest to gravity; z by default. Components are named after
        the other two.
    """

    vertical: str = ""

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """Set the axis nearest to gravity."""
        if len(setup.gravity) == 2:
            return cls()
        return cls(vertical="xyz"[int(np.argmax(np.abs(setup.gravity)))])

    def components(self, name: str, cable: CableData) -> tuple[str, ...]:
        """Names of a parameter's components: in a plane it is a single number."""
        if len(cable.axes) == 2:
            return (name,)
        return tuple(f"{name}_{axis}" for axis in "xyz" if axis != (self.vertical or "z"))


class SideLoad(LoadAcrossGravity):
    """A force per length across gravity: a draught, a fan, a tilted camera.

        V = - int (q . r(s)) ds,   q = sum_i force_per_length_i e_i     [J]

    In a plane e is the direction of gravity turned counter-clockwise by pi/2: +x for gravity along
    -y, and without gravity. In space e_x, e_y are the unit vectors across gravity nearest to the
    world's axes x and y, if gravity is mostly along z; otherwise they are named in the same way.

    Parameters
    ----------
    force_per_length : scalar [N/m]
        In space two, force_per_length_x and force_per_length_y; per declared length, also with
        `length_error` or stretch. Vanish at 0; estimated up to half the cable's weight on Earth.
    """

    name = "side_load"
    lasts = True

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the force per length."""
        weight = 9.81 * cable.mass / cable.length
        names = self.components("force_per_length", cable)
        return Parameter.symmetric(names, "N/m", 0.1 * weight, 0.5 * weight, inf)

    def resultant(self, s: ca.SX, gravity: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Force on the part beyond s."""
        names = self.components("force_per_length", cable)
        if len(names) == 1:
            across = ca.vertcat(-gravity[1], gravity[0]) / ca.norm_2(gravity)
            across = ca.SX([1, 0]) if gravity.is_zero() else across
            return params[names[0]] * (cable.length - s) * across
        # Without gravity these are the world's axes themselves.
        down = gravity / ca.sqrt(ca.sumsqr(gravity) + 1e-12)
        total = ca.SX.zeros(3)
        for name in names:
            axis = ca.DM([float(name.endswith(x)) for x in cable.axes])
            across = axis - ca.dot(axis, down) * down
            total += params[name] * across / ca.norm_2(across)
        return total * (cable.length - s)


class GravityTilt(LoadAcrossGravity):
    """The board or the robot does not stand plumb: gravity is turned for every weight.

        g' = R(angle) g

    In space R is the rotation of a vector with two components, about the two world axes that are
    not the one nearest to gravity.

    Parameters
    ----------
    angle : scalar [rad]
        In space two, angle_x and angle_y (or x, z; y, z). Counter-clockwise;
        vanish at 0; at most half a radian.
    """

    name = "gravity_tilt"

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the angles."""
        return Parameter.symmetric(self.components("angle", cable), "rad", 0.05, 0.5)

    def gravity(self, gravity: ca.SX, params: Params) -> ca.SX:
        """Turn gravity counter-clockwise."""
        if "angle" in params:
            c, s = ca.cos(params["angle"]), ca.sin(params["angle"])
            return ca.vertcat(c * gravity[0] - s * gravity[1], s * gravity[0] + c * gravity[1])
        turn = ca.vertcat(*(params.get(f"angle_{axis}", ca.SX(0)) for axis in "xyz"))
        return rotated(rotation(turn), gravity)
