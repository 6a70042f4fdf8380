"""A cable that takes a set: with every bend, or where it is bent sharply."""

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import Params, Scan, StateEffect

# A kink max(x, 0) is rounded to (x + sqrt(x^2 + d^2)) / 2, where d is this share of one turn per
# length. The error is d / 2 at the kink and d^2 / (4 |x|) away from it.
_ROUNDING = 0.01
# Trial yield curvatures, as shares of the largest bend.
YIELDS = (0.15, 0.3, 0.45, 0.6, 0.75)


class RestCurvatureDrift(StateEffect):
    """After each pose the rest curvature has moved towards the curvature held.

        kappa_0 <- kappa_0 + rate (kappa - kappa_0)

    In space the rest twist moves in the same way.

    Parameters
    ----------
    rate : scalar, in [0, 1)
        Share of the bend that a pose leaves behind; vanishes at 0.
    """

    name = "rest_curvature_drift"
    declared = (Parameter("rate", scale=0.05, lower=0.0, upper=0.95),)

    def next_rest(self, rest: ca.SX, strain: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Rest strain after the pose [1/m]."""
        return rest + params["rate"] * (strain - rest)


class PlasticSet(StateEffect):
    """After each pose a share of what the bend exceeds a yield curvature by has become rest shape.

        b = kappa - kappa_0
        kappa_0 <- kappa_0 + share max(|b| - y, 0) b / |b|

    with the size |b| of the bend. In space b is a vector, and twist leaves nothing behind. With
    y = 0 it is a drift of the rest curvature. The kink is rounded over a hundredth of a turn per
    length, smoothly and oddly in b.

    Parameters
    ----------
    yield_curvature : scalar y [1/m], >= 0
        Bends below it leave nothing behind; at most a hundred turns per length.
    share : scalar, in [0, 1)
        Vanishes at 0; 1 would be ideally plastic.

    References
    ----------
    Moment and curvature of an elastic-plastic beam with linear hardening, e.g. Lubliner,
    Plasticity Theory, 1990, in the poses' order and without the Bauschinger effect.
    """

    name = "plastic_set"

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare yield curvature and share."""
        turn = cable.curvature_scale
        return (
            Parameter("yield_curvature", "1/m", 0.5 * turn, 0.1 * turn, 0.0, 100 * turn),
            Parameter("share", scale=0.1, lower=0.0, upper=0.99),
        )

    def scans(self, setup: Setup) -> tuple[Scan, ...]:
        """Try yield curvatures below the largest bend; without one, below a turn per length."""
        bend = setup.largest_bend or setup.cable.curvature_scale
        return tuple({"yield_curvature": share * bend} for share in YIELDS)

    def next_rest(self, rest: ca.SX, strain: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Rest strain after the pose [1/m].

        With rounded kinks, (ramp(|b| - y) - ramp(-|b| - y)) / |b| is 1 - 2 y / (S_- + S_+) with
        S = sqrt((|b| -+ y)^2 + d^2). This is written in |b|^2, which is smooth at 0.
        """
        bend, limit = strain - rest, params["yield_curvature"]
        if bend.numel() > 1:
            bend = ca.vertcat(0, bend[1:])
        square, level = ca.sumsqr(bend), limit**2
        rounding = (_ROUNDING * cable.curvature_scale) ** 2
        product = ca.sqrt((square - level) ** 2 + 2 * rounding * (square + level) + rounding**2)
        both = ca.sqrt(2 * (square + level + rounding + product))
        return rest + params["share"] * (1 - 2 * limit / both) * bend
