"""A section that bends more easily about one axis than about another."""

from collections.abc import Mapping
from math import atan2, copysign, hypot, pi

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import Effect, Params, SectionLaw

# Largest ratio of the two stiffnesses: a ribbon of width w and thickness t has (w / t)^2.
LARGEST = 100.0


class BendingAnisotropy(SectionLaw):
    """Two bending stiffnesses: flat cables, zip cord, cables that were rolled flat.

        B = EI (d_1 d_1^T + ratio d_2 d_2^T),   d_1 = (cos angle, sin angle),   d_2 across it

    about the material axes (y, z): EI is the stiffness about d_1.

    Parameters
    ----------
    ratio : scalar, > 0
        Stiffness about d_2 over that about d_1; vanishes at 1.
    angle : scalar [rad]
        From the axis y of the start clamp to d_1, about the cable's axis x. A diagnosis takes d_1
        within an eighth of a turn from y, since a quarter turn more is the same as 1 / ratio.

    References
    ----------
    Principal axes of a section, e.g. Timoshenko and Gere, Mechanics of Materials, 1972.
    """

    name = "bending_anisotropy"
    lasts = True
    dimensions = (3,)
    isotropic = False
    declared = (
        Parameter("ratio", nominal=1.0, scale=0.2, lower=1 / LARGEST, upper=LARGEST),
        Parameter("angle", "rad", scale=0.3, lower=-pi / 2, upper=pi / 2),
    )

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if a clamp or a rest curvature determines the roll of the section."""
        told = setup.start.roll or setup.end.roll or setup.curved
        return super().applies(setup) and told

    def bending(self, stiffness: ca.SX, params: Params) -> ca.SX:
        """Stiffness about y and z."""
        mean, half = (1 + params["ratio"]) / 2, (1 - params["ratio"]) / 2
        double = 2 * params["angle"]
        c, s = half * ca.cos(double), half * ca.sin(double)
        return ca.mtimes(stiffness, _symmetric(mean + c, s, mean - c))

    def linear(self) -> Effect:
        """Return the same section, in terms of its deviation from the mean stiffness."""
        return _LinearAnisotropy(label=self.label)

    def of_linear(self, cable: CableData, values: Mapping[str, float]) -> dict[str, float]:
        """Ratio and angle of the axis nearer to y; the ratio is at most LARGEST."""
        a, b = values["difference"], values["coupling"]
        size = min(hypot(a, b), (LARGEST - 1) / (LARGEST + 1))
        angle, ratio = atan2(b, a) / 2, (1 - size) / (1 + size)
        if abs(angle) > pi / 4:
            angle, ratio = angle - copysign(pi / 2, angle), 1 / ratio
        return {"ratio": ratio, "angle": angle}


class _LinearAnisotropy(SectionLaw):
    """The same law in parameters a, b in which it is linear: EI (1 + a, b; b, 1 - a).

    EI is the mean stiffness here; the fit of EI absorbs the change of the mean with the ratio.
    """

    name = "linear_anisotropy"
    isotropic = False
    declared = Parameter.symmetric(("difference", "coupling"), "", 0.1, 1.0)

    def bending(self, stiffness: ca.SX, params: Params) -> ca.SX:
        """Stiffness about y and z."""
        a, b = params["difference"], params["coupling"]
        return ca.mtimes(stiffness, _symmetric(1 + a, b, 1 - a))


def _symmetric(yy: ca.SX, yz: ca.SX, zz: ca.SX) -> ca.SX:
    return ca.vertcat(ca.horzcat(yy, yz), ca.horzcat(yz, zz))
