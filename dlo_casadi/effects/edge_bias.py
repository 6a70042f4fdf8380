"""Where a camera sees an edge depends a little on the edge's direction."""

from typing import ClassVar

import casadi as ca

from dlo_casadi.effects.cable import Parameter, Setup
from dlo_casadi.effects.effect import MeasurementEffect, Params, Viewpoint

# Harmonics of the cable's direction: light from one side shifts all of its picture, which is the
# first; the grid of pixels has the fourth. Of the three rendered sessions of photographs, without
# any all have a wrong EI (1 to 2 %, outside of its interval) and one an effect that is not there;
# with one, or up to the third, two of them are `unexplained`; with four all are as they should be,
# and six are no closer.
HARMONICS = range(1, 5)
# Standard deviation of each harmonic, in pixels.
PIXELS = 0.05


class EdgeBias(MeasurementEffect):
    """The middle between two edges is off by a share of a pixel that depends on their direction.

        measured = true + N(phi) sum_k (a_k cos k phi + b_k sin k phi)

    with the normal N to the left of the cable's direction phi. Light from one side, the grid of
    pixels and the sharpening of a camera do that. It is a nuisance of every photograph, the same
    in all of them, and never blamed for a residual.

    Parameters
    ----------
    a1, b1, ..., a4, b4 : scalar [m]
        Vanish at 0.
    """

    name = "edge_bias"
    dimensions = (2,)
    shown: ClassVar = False
    declared = tuple(Parameter(f"{x}{k}", "m", scale=1e-4) for k in HARMONICS for x in ("a", "b"))

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Where there are photographs."""
        return super().applies(setup) and setup.pixel is not None

    def prior(self, setup: Setup) -> dict[str, float]:
        """A share of a pixel for each coefficient; none without pixels."""
        std = PIXELS * (setup.pixel or 0.0)
        return {q.name: std for q in self.parameters(setup.cable)} if std else {}

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Move the point along the cable's normal."""
        offset = sum(
            (
                params[f"a{k}"] * ca.cos(k * frame) + params[f"b{k}"] * ca.sin(k * frame)
                for k in HARMONICS
            ),
            start=ca.SX(0),
        )
        return point + offset * ca.vertcat(-ca.sin(frame), ca.cos(frame))
