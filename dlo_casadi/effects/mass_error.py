"""A cable that is heavier or lighter than declared."""

from typing import Any

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import Load, Params

# Qualified name of its parameter.
MASS_FACTOR = "mass_error.factor"
# Largest factor by which a mass may be wrong.
HEAVIEST = 5.0


class MassError(Load):
    """The mass of the cable itself is not the declared one.

        true mass = factor mass

    Without other loads, shapes depend only on the ratio of mass to bending stiffness: a measured
    force is needed to separate the two.

    Parameters
    ----------
    factor : scalar, > 0
        Vanishes at 1; from a fifth to five.
    """

    name = "mass_error"
    lasts = True
    corrects = "mass"
    declared = (Parameter("factor", nominal=1.0, scale=0.1, lower=1 / HEAVIEST, upper=HEAVIEST),)

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if forces are measured and the cable has weight."""
        return super().applies(setup) and bool(setup.readings) and any(setup.gravity)

    @staticmethod
    def correction(mass: Any, cable: CableData) -> Any:
        """Value of the parameter at a true mass [kg]."""
        return mass / cable.mass

    def resultant(self, s: ca.SX, gravity: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Weight of the part beyond s, in addition to the declared one."""
        return (params["factor"] - 1) * cable.mass * gravity * (1 - s / cable.length)

    def mass_per_length(self, s: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Its inertia, likewise."""
        return (params["factor"] - 1) * cable.mass / cable.length
