"""What is declared of a cable."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi


@dataclass(frozen=True)
class Cable:
    """What is declared of a cable.

    Parameters
    ----------
    length : float [m]
        Along the cable between its fixtures.
    mass : float [kg]
        Of that length.
    diameter : float [m]
    bending_stiffness : float [N m^2]
        Crude prior of EI.
    name : str
    straight : bool
        True if no rest curvature is fitted.
    torsional_stiffness : float [N m^2], optional
        Crude prior of GJ; a cable that has one is in space, others stay in a plane.
    """

    length: float
    mass: float
    diameter: float
    bending_stiffness: float
    name: str = "cable"
    straight: bool = False
    torsional_stiffness: float | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the components of a position or a force."""
        return ("x", "y") if self.torsional_stiffness is None else ("x", "y", "z")

    @property
    def curvature_scale(self) -> float:
        """One full turn over the length [1/m]."""
        return 2 * pi / self.length
