"""A gripper that holds the cable in another direction than declared."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca

from dlo_casadi.effects.clamp_angle import ClampTurn
from dlo_casadi.effects.effect import EndConditions, Params
from dlo_casadi.rod.node import quaternion_product, rotation


class ClampRotation(ClampTurn):
    """True minus declared orientation of the clamps in space, the same in all poses.

        R' = R exp(0, y, z)

    The rotation vector is about the clamp's own axes. Its part about x, along the cable, is
    `end_roll`: rolls of the two clamps act by their difference alone.

    Parameters
    ----------
    start_y, start_z, end_y, end_z : scalar [rad]
        Vanish at 0. Only those of clamped ends are declared.
    """

    name = "clamp_rotation"
    in_plane = False
    errors = ("y", "z")
    tolerances: ClassVar = dict.fromkeys(("start_y", "start_z", "end_y", "end_z"), "rotation")

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Turn the clamps."""
        if self.start:
            ends = ends.changed(start_frame=_turned(ends.start_frame, "start", params))
        if self.end:
            ends = ends.changed(end_frame=_turned(ends.end_frame, "end", params))
        return ends


def _turned(frame: ca.SX, side: str, params: Params) -> ca.SX:
    turn = rotation(ca.vertcat(0, params[f"{side}_y"], params[f"{side}_z"]))
    return ca.vertcat(*quaternion_product(ca.vertsplit(frame), ca.vertsplit(turn)))
