"""A stiffness that changes along the cable: evenly, or within a stretch of it."""

from collections.abc import Mapping

import casadi as ca

from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.effect import PLACES, Params, Scan, SectionLaw
from dlo_casadi.rod.element import Cell

# Trial lengths of sections, as shares of the cable's length.
SECTIONS = (0.08, 0.2)


class StiffnessGradient(SectionLaw):
    """A taper: the stiffness grows linearly from start to end.

        EI(s) = EI (1 + slope (2 s / L - 1)),   in space GJ(s) alike

    Parameters
    ----------
    slope : scalar, in (-1, 1)
        Vanishes at 0; the stiffness stays positive everywhere.
    """

    name = "stiffness_gradient"
    lasts = True
    declared = Parameter.symmetric(("slope",), "", 0.2, 0.95)

    def along(self, cell: Cell, cable: CableData, params: Params) -> ca.SX:
        """Mean of the linear stiffness over the cell."""
        return 1 + params["slope"] * (cell.middle * 2 / cable.length - 1)


class StiffSection(SectionLaw):
    """A splice, a heat-shrink sleeve, a tape: `factor` times as stiff between two places.

        EI(s) = EI factor     for start <= s <= end,   EI elsewhere; in space GJ(s) alike

    A cell of which the section covers the share c has the compliance (1 - c + c / factor) / EI: the
    moment is continuous, so compliances are averaged, not stiffnesses. The edges of c are rounded
    over a quarter of a cell, so that it is smooth in start and end.

    Parameters
    ----------
    start, end : scalar [m], in [0, L]
        The start comes before the end.
    factor : scalar, > 0
        Vanishes at 1; below 1 the section is softer, e.g. a worn place.
    """

    name = "stiff_section"
    lasts = True
    repeatable = True

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Declare the section's ends and its factor."""
        length = cable.length
        return (
            Parameter("start", "m", 0.45 * length, 0.05 * length, 0.0, length),
            Parameter("end", "m", 0.55 * length, 0.05 * length, 0.0, length),
            Parameter("factor", nominal=1.0, scale=0.5, lower=0.02, upper=100.0),
        )

    def refusal(self, setup: Setup, values: Mapping[str, float]) -> str:
        """A section has a length."""
        start, end = values["start"], values["end"]
        if start < end:
            return super().refusal(setup, values)
        return (
            f"it starts at {start:g} m and ends at {end:g} m from the start of the cable, "
            "which leaves no section between. Try: start smaller than end"
        )

    def scans(self, setup: Setup) -> tuple[Scan, ...]:
        """Try short and long sections all along the cable."""
        length = setup.cable.length
        return tuple(
            {
                "start": float(max(share - width / 2, 0.0) * length),
                "end": float(min(share + width / 2, 1.0) * length),
            }
            for width in SECTIONS
            for share in PLACES
        )

    def place(self, values: Mapping[str, float]) -> float:
        """Arc length of its middle [m]."""
        return (values["start"] + values["end"]) / 2

    def along(self, cell: Cell, cable: CableData, params: Params) -> ca.SX:
        """Harmonic mean of the stiffness over the cell."""
        low, high, rounding = cell.low, cell.high, 0.25 * cell.mesh

        def ramp(x: ca.SX) -> ca.SX:
            return (x + ca.sqrt(x * x + rounding**2)) / 2

        start, end = params["start"], params["end"]
        covered = ramp(high - start) - ramp(low - start) - ramp(high - end) + ramp(low - end)
        share = covered / cell.width
        return 1 / (1 + share * (1 / params["factor"] - 1))


class DynamicStiffness(SectionLaw):
    """A cable that is stiffer in motion than at rest: polymers relax, strands stick.

        M = M_rest + factor EI (kappa - kappa_rest)

    for changes from the shape at rest, with the moment M_rest and the curvature there; GJ alike.
    Still shapes do not know it.

    Parameters
    ----------
    factor : scalar, > 0
        Vanishes at 1.
    """

    name = "dynamic_stiffness"
    declared = (Parameter("factor", nominal=1.0, scale=0.2, lower=0.2, upper=10.0),)

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if there are recordings of the moving cable."""
        return super().applies(setup) and setup.moves

    def dynamic(self, params: Params) -> ca.SX:
        """The factor."""
        return params["factor"]
