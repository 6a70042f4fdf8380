"""The cable as it is declared: sizes, mass, and first guesses of its stiffnesses."""

import math
from typing import Annotated, Literal, Self

from pydantic import model_validator

from dlo_casadi.config.frozen import ConfigSection
from dlo_casadi.config.problems import ConfigProblem, Contradiction
from dlo_casadi.config.values import STIFFNESS, Name, Positive, implausible_sizes, within

# Density of copper in plastic [kg/m^3]: two test sessions have 2200. `mass_error` can find a fifth
# of it (foam) up to five times it, more than any metal in cables.
DENSITY = 2200.0


class Cable(ConfigSection):
    """The cable between its two fixtures."""

    name: Name = "cable"
    """What to call the cable."""
    length: Positive
    """Length along the cable between its two fixtures [m]."""
    mass: Positive | None
    """Mass of that length [kg]; null (None in Python) where it is
    not known: readings of a force tell it."""
    diameter: Positive
    """Outer diameter [m]."""
    youngs_modulus: Positive | None = None
    """Young's modulus E of a solid round rod [Pa], a crude prior; or give bending_stiffness."""
    bending_stiffness: Positive | None = None
    """Bending stiffness EI [N m^2], a crude prior; or give youngs_modulus."""
    torsional_stiffness: Annotated[Positive, within(STIFFNESS)] | None = None
    """Torsional stiffness GJ [N m^2] of a cable in space, a crude prior; EI / 1.3 when absent."""
    damping_time: Positive | None = None
    """Damping time tau [s], M = EI (kappa - kappa_0 + tau dkappa/dt): a first guess for motions."""
    rest_shape: Literal["straight", "curved"] = "curved"
    """Shape without load: straight (no rest curvature is fitted) or curved."""

    @property
    def prior_bending_stiffness(self) -> float:
        """First guess of EI [N m^2]: the declared value, or E pi d^4 / 64."""
        if self.bending_stiffness is not None:
            return self.bending_stiffness
        assert self.youngs_modulus is not None  # checked when the object was made
        square = self.diameter * self.diameter  # infinite of an absurd one, where ** raises
        return self.youngs_modulus * math.pi * square * square / 64.0

    @property
    def prior_mass(self) -> float:
        """Mass [kg]: the declared value, or that of a solid round rod of DENSITY."""
        if self.mass is not None:
            return self.mass
        return DENSITY * math.pi / 4.0 * self.diameter * self.diameter * self.length

    @property
    def prior_torsional_stiffness(self) -> float:
        """First guess of GJ [N m^2]: the declared value, or EI / 1.3 (round rod, nu = 0.3)."""
        return self.torsional_stiffness or self.prior_bending_stiffness / 1.3

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        declared, young = self.bending_stiffness, self.youngs_modulus
        problems = implausible_sizes(self.length, self.prior_mass, self.diameter)
        if self.mass is None and ("mass",) in [place for place, _ in problems]:
            text = f"{self.diameter:g} m: a solid cable has {self.prior_mass:.2g} kg: in metres?"
            sizes = [problem for problem in problems if problem.place != ("mass",)]
            problems = sizes or [ConfigProblem(("diameter",), text)]
        if declared is not None and (wrong := STIFFNESS.complaint(declared)):
            problems.append(ConfigProblem(("bending_stiffness",), wrong))
        if (young is None) == (declared is None):
            found, key = ("neither", ()) if young is None else ("both", ("bending_stiffness",))
            text = f"give youngs_modulus [Pa] or bending_stiffness [N m^2], found {found}"
            problems.append(ConfigProblem(key, text))
        elif young and (wrong := STIFFNESS.complaint(self.prior_bending_stiffness)):
            problems.append(ConfigProblem(("youngs_modulus",), f"{wrong} for EI = E pi d^4 / 64"))
        if problems:
            raise Contradiction(*problems)
        return self
