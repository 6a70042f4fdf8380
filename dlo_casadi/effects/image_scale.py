"""A ruler that is off."""

from typing import ClassVar

import casadi as ca

from dlo_casadi.effects.cable import Parameter
from dlo_casadi.effects.effect import MeasurementEffect, Params, Viewpoint


class ImageScale(MeasurementEffect):
    """Measured lengths are true lengths times a factor, about the start fixture.

        measured = start + factor (true - start)

    Parameters
    ----------
    factor : scalar, > 0
        Vanishes at 1.
    """

    name = "image_scale"
    lasts = True
    dimensions = (2,)
    tolerances: ClassVar = {"factor": "scale"}
    declared = (Parameter("factor", nominal=1.0, scale=0.002, lower=0.7, upper=1.4),)

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Scale about the start fixture."""
        return viewpoint.start + params["factor"] * (point - viewpoint.start)
