"""A lens that is not quite as calibrated."""

from dataclasses import dataclass
from typing import Self

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import MeasurementEffect, Params, Viewpoint


@dataclass(frozen=True)
class ImageDistortion(MeasurementEffect):
    """Radial distortion about the image centre, in the cable's plane.

        measured = c + (1 + k |true - c|^2) (true - c)

    Parameters
    ----------
    coefficient : scalar k [1/m^2]
        Vanishes at 0.
    center : (float, float) [m]
        The image centre c in the board frame: an option of the effect, never fitted.

    References
    ----------
    First radial term of Brown, Photogrammetric Engineering 37 (1971).
    """

    name = "image_distortion"
    lasts = True
    dimensions = (2,)

    center: tuple[float, float] = (0.0, 0.0)

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the coefficient."""
        return (Parameter("coefficient", "1/m^2", scale=0.005 / cable.length**2),)

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """It needs photographs."""
        if setup.center is not None:
            return super().impossible(setup)
        return (
            "it is of the lens of a camera, and there are no photographs. "
            "Try: measurement.kind images, or image_scale"
        )

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """The effect with the middle of the photographs as centre."""
        return cls(center=setup.center or (0.0, 0.0))

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Move the point along its radius."""
        arm = point - ca.DM(self.center)
        return ca.DM(self.center) + (1 + params["coefficient"] * ca.sumsqr(arm)) * arm
