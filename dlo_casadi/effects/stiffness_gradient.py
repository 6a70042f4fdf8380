"""A stiffness that changes evenly along the cable."""

from __future__ import annotations

import casadi as ca

from dlo_casadi.effects.cable import Cable, Parameter
from dlo_casadi.effects.effect import Params, SectionLaw
from dlo_casadi.rod.element import Cell


class StiffnessGradient(SectionLaw):
    """A taper: the stiffness grows linearly from start to end.

        EI(s) = EI (1 + slope (2 s / L - 1)),   in space GJ(s) alike

    Parameters
    ----------
    slope : scalar, in (-1, 1)
        Vanishes at 0; the stiffness stays positive everywhere.
    """

    name = "stiffness_gradient"

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Declare the slope."""
        return (Parameter("slope", scale=0.2, lower=-0.95, upper=0.95),)

    def along(self, cell: Cell, cable: Cable, params: Params) -> ca.SX:
        """Mean of the linear stiffness over the cell."""
        return 1 + params["slope"] * (cell.middle * 2 / cable.length - 1)
