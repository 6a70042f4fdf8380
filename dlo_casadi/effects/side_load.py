"""A uniform load across gravity."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.cable import Cable, Parameter
from dlo_casadi.effects.effect import LoadAcrossGravity, Params


class SideLoad(LoadAcrossGravity):
    """A force per length across gravity: a draught, a fan, a tilted camera.

        V = - int (q . r(s)) ds,   q = sum_i force_per_length_i e_i     [J]

    In a plane e is +x. In space e_x, e_y are the unit vectors across gravity that are nearest to
    the world's axes x and y, if gravity is most along z; they are named alike where it is not.

    Parameters
    ----------
    force_per_length; in space force_per_length_x, force_per_length_y : scalar [N/m]
        Vanish at 0; at most half the cable's weight on Earth.
    """

    name = "side_load"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the force per length."""
        weight = 9.81 * cable.mass / cable.length
        names = self.components("force_per_length", cable)
        return Parameter.symmetric(names, "N/m", 0.1 * weight, 0.5 * weight)

    def resultant(self, s: ca.SX, gravity: ca.SX, cable: Cable, params: Params) -> ca.SX:
        """Force on the part beyond s."""
        names = self.components("force_per_length", cable)
        if len(names) == 1:
            return params[names[0]] * (cable.length - s) * ca.vertcat(1, 0)
        # Of a cable without weight the world's axes themselves.
        down = gravity / ca.sqrt(ca.sumsqr(gravity) + 1e-12)
        total = ca.SX.zeros(3)
        for name in names:
            axis = ca.DM([float(name.endswith(x)) for x in cable.axes])
            across = axis - ca.dot(axis, down) * down
            total += params[name] * across / ca.norm_2(across)
        return total * (cable.length - s)
