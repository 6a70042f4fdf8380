"""A cable that takes a set."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.cable import Cable, Parameter
from dlo_casadi.effects.effect import Params, StateEffect


class RestCurvatureDrift(StateEffect):
    """After each pose the rest curvature has moved towards the curvature held.

        kappa_0 <- kappa_0 + rate (kappa - kappa_0)

    In space so has the rest twist.

    Parameters
    ----------
    rate : scalar, in [0, 1)
        Share of the bend that a pose leaves behind; vanishes at 0.
    """

    name = "rest_curvature_drift"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the rate."""
        return (Parameter("rate", scale=0.05, lower=0.0, upper=0.95),)

    def next_rest(self, rest: ca.SX, strain: ca.SX, cable: Cable, params: Params) -> ca.SX:
        """Rest strain after the pose [1/m]."""
        return rest + params["rate"] * (strain - rest)
