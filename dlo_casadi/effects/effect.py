"""The contract of an effect and its six slots.

An effect declares parameters and fills one slot of the model. It sees the curve, never the
solver's coordinates; it creates no symbol, keeps no state and calls no solver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import pi
from typing import ClassVar, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.chain import Curve
from dlo_casadi.parameters import Parameter

Params = Mapping[str, ca.SX]


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
    """

    length: float
    mass: float
    diameter: float
    bending_stiffness: float
    name: str = "cable"
    straight: bool = False

    @property
    def curvature_scale(self) -> float:
        """One full turn over the length [1/m]."""
        return 2 * pi / self.length


@dataclass(frozen=True)
class EndConditions:
    """Where and how the ends are held: symbols of one pose.

    `start`, `end` (2,) [m]; `start_heading`, `end_heading` [rad].
    """

    start: ca.SX
    end: ca.SX
    start_heading: ca.SX
    end_heading: ca.SX

    def changed(self, **values: ca.SX) -> EndConditions:
        """Return a copy with some conditions replaced."""
        return replace(self, **values)


@dataclass(frozen=True)
class Sight:
    """From where the points of a pose are measured: symbols of one pose.

    Parameters
    ----------
    start : (2,) [m]
        The start fixture.
    camera : (2,) [1]
        The camera's centre (x, y) over its distance z from the cable's declared plane.
    nearness : scalar [1/m]
        1/z. Both are zero where no camera is known: it then sees from infinity, straight on.
    """

    start: ca.SX
    camera: ca.SX
    nearness: ca.SX


@dataclass(frozen=True)
class Effect:
    """Something that acts on a cable. Subclasses fill the slot that gives them their base.

    Parameters
    ----------
    label : str, optional
        Prefix of the parameters' names; the effect's name unless a model has two of a kind.
    """

    name: ClassVar[str]
    slot: ClassVar[str]
    # Unknowns of each pose that the effect uses beside its parameters; see model.DEVIATIONS.
    per_pose: ClassVar[tuple[str, ...]] = ()

    label: str = ""

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", self.name)

    def parameters(self, cable: Cable) -> tuple[Parameter, ...]:
        """Parameters with units, bounds and the nominal value at which the effect vanishes."""
        raise TypeError(f"{type(self).__name__} declares no parameters")

    def linear(self) -> Effect:
        """Return the same effect, of the same label, in parameters for its score test.

        Those are another choice where a parameter tells nothing at the value at which the effect
        vanishes although the effect is linear in several at once.
        """
        return self

    def of_linear(self, cable: Cable, values: Mapping[str, float]) -> dict[str, float]:
        """Own parameters from those of `linear`."""
        return dict(values)


class SectionLaw(Effect):
    """Slot `section`: how much the section resists bending. Section laws multiply."""

    slot: ClassVar[str] = "section"
    # Whether the law is the same all along the cable.
    even: ClassVar[bool] = False

    def factor(
        self, bend: ca.SX, cells: NDArray[np.floating], cable: Cable, params: Params
    ) -> ca.SX:
        """Factor on the bending energy EI/2 (curvature - rest curvature)^2 of each cell.

        Parameters
        ----------
        bend : (n_cells,) [1/m]
            Curvature minus rest curvature.
        cells : (n_cells, 2) [m]
            From where to where each cell reaches.

        Returns
        -------
        (n_cells,) [1]
        """
        raise TypeError(f"{self.name} has no section law")

    def tangent(
        self, bend: ca.SX, cells: NDArray[np.floating], cable: Cable, params: Params
    ) -> ca.SX:
        """Factor on the stiffness against a small change of the bend, shaped as `factor`.

        Only the bow of quadratic elements asks for it, of laws that are the same all along the
        cable, so that it may be approximate.
        """
        return self.factor(bend, cells, cable, params)


class Kinematics(Effect):
    """Slot `kinematics`: stretch and length."""

    slot: ClassVar[str] = "kinematics"
    extensible: ClassVar[bool] = False

    def stretch(self, cable: Cable, params: Params) -> ca.SX | float:
        """Uniform factor on the declared length. Factors multiply."""
        return 1.0

    def compliance(self, params: Params) -> ca.SX | float:
        """Axial strain per tension, 1/EA [1/N]. Compliances add."""
        return 0.0


class Load(Effect):
    """Slot `load`: forces with a potential. Loads add; all share one gravity."""

    slot: ClassVar[str] = "load"
    # Whether the forces stay the same whatever the shape. If not, the load acts at one place, the
    # arc length `position` among its parameters.
    dead: ClassVar[bool] = True

    def gravity(self, gravity: ca.SX, params: Params) -> ca.SX:
        """Return the direction and size of gravity (2,) [m/s^2] that every weight feels."""
        return gravity

    def energy(self, curve: Curve, gravity: ca.SX, params: Params) -> ca.SX | float:
        """Potential energy of the load [J]."""
        return 0.0

    def energy_at(self, point: ca.SX, gravity: ca.SX, params: Params) -> ca.SX | float:
        """Potential energy [J] of a load at one place, where that place (2,) [m] is known."""
        return self.energy(cast(Curve, _Place(point)), gravity, params)


@dataclass(frozen=True)
class _Place:
    """One point of a curve: all that a load at one place asks a curve for."""

    point: ca.SX

    def position(self, s: ca.SX | float) -> ca.SX:
        return self.point


class BoundaryEffect(Effect):
    """Slot `boundary`: how the ends are held."""

    slot: ClassVar[str] = "boundary"

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Change the end conditions. Changes are applied in the order of the model's effects."""
        return ends

    def energy(self, curve: Curve, params: Params) -> ca.SX | float:
        """Energy stored in the holders [J]. Energies add."""
        return 0.0


class MeasurementEffect(Effect):
    """Slot `measurement`: from true points of the cable to measured ones."""

    slot: ClassVar[str] = "measurement"

    def observe(self, point: ca.SX, heading: ca.SX, sight: Sight, params: Params) -> ca.SX:
        """Where the camera believes the true point (2,) [m] to be. Maps apply in order.

        Parameters
        ----------
        heading : scalar [rad]
            Direction of the cable at the point.
        """
        raise TypeError(f"{self.name} has no measurement map")


class StateEffect(Effect):
    """Slot `state`: what a pose leaves behind in the rest curvature."""

    slot: ClassVar[str] = "state"

    def next_rest(self, rest: ca.SX, curvature: ca.SX, cable: Cable, params: Params) -> ca.SX:
        """Rest curvature (n_cells,) [1/m] after a pose of this curvature has been held."""
        raise TypeError(f"{self.name} has no law of the state")
