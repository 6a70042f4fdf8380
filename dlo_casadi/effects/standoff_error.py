"""A cable that is not as far in front of the board as declared."""

import casadi as ca

from dlo_casadi.effects.cable import Parameter, Setup
from dlo_casadi.effects.effect import MeasurementEffect, Params, Viewpoint


class StandoffError(MeasurementEffect):
    """The cable's axis lies nearer to the camera than declared, or farther.

    Let a point P of the cable be d in front of the declared plane, and the camera's centre C be z
    in front of it. The camera takes P for the place where the ray from C through P meets the plane:

        measured = C + (P - C) z / (z - d) = P + (P - C) d / (z - d)

    With one fixed camera this is `image_scale` about C instead of the start fixture, by the factor
    z / (z - d): the two differ only by a shift of (factor - 1) (start - C). A camera straight above
    the start fixture cannot distinguish them; one beside it can only as well as the fixtures are
    known; photographs from several places can.

    Parameters
    ----------
    distance : scalar d [m]
        True minus declared, positive towards the camera; less than z. Vanishes at 0.

    References
    ----------
    Central projection, e.g. Hartley and Zisserman, Multiple View Geometry, 2004, section 6.1.
    """

    name = "standoff_error"
    lasts = True
    dimensions = (2,)
    declared = (Parameter("distance", "m", scale=1e-3),)

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """Without a camera there are no rays."""
        if setup.camera:
            return super().impossible(setup)
        return (
            "it is a shift along the rays of a calibrated camera, and none is declared. "
            "Try: measurement.camera, or image_scale"
        )

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Follow the ray through the point to the declared plane."""
        d, nearness = params["distance"], viewpoint.nearness
        return point + d * (nearness * point - viewpoint.camera) / (1 - d * nearness)
