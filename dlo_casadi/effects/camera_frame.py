"""A camera whose frame is not quite where the robot's is."""

from typing import ClassVar

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter
from dlo_casadi.effects.effect import MeasurementEffect, Params, Viewpoint, vector
from dlo_casadi.rod.quaternions import rotated, rotation

_ROTATIONS = ("rotation_x", "rotation_y", "rotation_z")
_TRANSLATIONS = ("translation_x", "translation_y", "translation_z")


class CameraFrame(MeasurementEffect):
    """Points are measured in a frame that is turned and shifted against that of the fixtures.

        measured = start + R (true - start) + t

    with R of the rotation vector (rotation_x, rotation_y, rotation_z) about the world's axes.

    Parameters
    ----------
    rotation_x, rotation_y, rotation_z : scalar [rad]
    translation_x, translation_y, translation_z : scalar [m]
        Vanish at 0.

    References
    ----------
    Hand-eye calibration, e.g. Tsai and Lenz, IEEE Trans. Robotics and Automation 5 (1989).
    """

    name = "camera_frame"
    dimensions = (3,)
    tolerances: ClassVar = {
        **dict.fromkeys(_ROTATIONS, "camera_rotation"),
        **dict.fromkeys(_TRANSLATIONS, "camera_translation"),
    }

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the rotation and the translation."""
        return (
            *Parameter.symmetric(_ROTATIONS, "rad", 0.01, 0.5),
            *Parameter.symmetric(_TRANSLATIONS, "m", 0.002 * cable.length, 0.3 * cable.length),
        )

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Turn about the start fixture, then shift."""
        turned = rotated(rotation(vector(params, "rotation_")), point - viewpoint.start)
        return viewpoint.start + turned + vector(params, "translation_")
