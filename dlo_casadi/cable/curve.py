"""The curve of a cable, at the arc lengths that a caller asks for."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import MeasurementEffect
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.assembly import Inputs, assembly_of
from dlo_casadi.model.cable_model import CableModel

# Rounding error allowed in arc lengths beyond the ends, as a share of the length.
_ROUNDING = 1e-9


class CableCurve(NodeCurve):
    """A cable from its start at s = 0 to its end at s = L = `length` [m]."""

    def at(self, s: ArrayLike, derivative: int = 0) -> FloatArray:
        """Positions (K, d) [m] at arc lengths s (K,) [m] in [0, L], or derivatives by s.

        Raises
        ------
        DloError
            If an arc length lies outside the cable.
        """
        try:
            places = np.atleast_1d(np.asarray(s, dtype=float)).ravel()
        except (TypeError, ValueError):
            raise DloError(f"s: arc lengths [m] belong here, found {s!r}") from None
        slack = _ROUNDING * self.length
        outside = places[~((places >= -slack) & (places <= self.length + slack))]
        if len(outside):
            raise DloError(
                f"s = {outside[0]:g} m is not on the cable: {len(outside)} of "
                f"{counted(len(places), 'arc length')} lie outside 0 to {self.length:g} m.\n"
                "  Try: arc lengths in metres from the start."
            )
        return super().at(np.clip(places, 0.0, self.length), derivative)


def curves_of(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: HeldPose, eq: Equilibrium
) -> tuple[CableCurve, CableCurve]:
    """The cable itself in a pose, and as the session's camera measures it."""
    plain = model
    effects = tuple(x for x in model.effects if not isinstance(x, MeasurementEffect))
    if effects != model.effects:  # the true curve is that without the effects of the camera
        plain = replace(model, effects=effects, priors={})
    kept = [name in plain.names for name in model.names]
    true, seen = (
        CableCurve.of(
            model.cable.length,
            assembly_of(one).curve(eq.shapes, Inputs.of(q, rest, pose.vector[None]))[0],
        )
        for one, q in ((plain, p[kept]), (model, p))
    )
    return true, seen
