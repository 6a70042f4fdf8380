"""The contract of an effect and its kinds.

An effect declares parameters and belongs to one kind. It sees the curve, never the solver's
coordinates; it creates no symbol, keeps no state and calls no solver. It also states where it
applies, which values a diagnosis tries, and which other effects may be mistaken for it. All of that
has defaults: most effects declare only `name`, `parameters` and their law.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects.acting import MassAt, PointForceAt, SpringAt
from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.errors import counted
from dlo_casadi.rod.element import Cell
from dlo_casadi.rod.ends import EndConditions
from dlo_casadi.rod.obstacles import Obstacle
from dlo_casadi.thresholds import NEAR_END

Params = Mapping[str, ca.SX]
Scan = dict[str, float]

# Trial places of point loads, as shares of the length.
PLACES = np.linspace(0.06, 0.94, 23)


def vector(params: Params, prefix: str) -> ca.SX:
    """Vector (dimension,) of the parameters `prefix`x, `prefix`y and, in space, `prefix`z."""
    return ca.vertcat(*(params[prefix + axis] for axis in "xyz" if prefix + axis in params))


@dataclass(frozen=True)
class Viewpoint:
    """Position of the camera of a pose: symbols of one pose.

    Parameters
    ----------
    start : (dimension,) [m]
        The start fixture.
    camera : (2,) [1]
        The camera's centre (x, y) over its distance z from the cable's declared plane.
    nearness : scalar [1/m]
        1/z. Both are zero where no camera is known: the projection is then orthogonal.
    """

    start: ca.SX
    camera: ca.SX
    nearness: ca.SX


@dataclass(frozen=True)
class Effect:
    """Something that acts on a cable or its measurement. Subclasses derive from one of the kinds.

    Parameters
    ----------
    label : str, optional
        Prefix of the parameters' names: the effect's name, with _2 for the second one of that name;
        of a clip or obstacle with the number of that.
    """

    name: ClassVar[str]
    kind: ClassVar[str]
    # Parameters with a declared tolerance -> name of the tolerance. Such an effect is a nuisance in
    # every model to which it applies, unless larger values are needed.
    tolerances: ClassVar[Mapping[str, str]] = {}
    # Parameter -> name and unit of its inverse, for parameters whose inverse is better known.
    inverses: ClassVar[Mapping[str, tuple[str, str]]] = {}
    # Words for what differs between poses if the parameters are random from pose to pose; empty if
    # this is never tried.
    at_random: ClassVar[str] = ""
    # Parameter -> the deviation of a pose, see `deviation_names`, that has the same effect.
    as_deviation: ClassVar[Mapping[str, str]] = {}
    # Whether its parameters are moments per bending stiffness [1/m]; `energy` gets moments [N m].
    per_stiffness: ClassVar[bool] = False
    # Number of the cable that its only parameter corrects, see `correction`; empty for none.
    corrects: ClassVar[str] = ""
    # Whether tables of parameters list it while it is a nuisance.
    shown: ClassVar[bool] = True
    # Whether the effect applies in the plane (2), in space (3).
    dimensions: ClassVar[tuple[int, ...]] = (2, 3)
    # Whether derivatives taken where the effect vanishes reveal it.
    gradual: ClassVar[bool] = True

    # Whether it lasts as long as the cable, its holders or its camera, and does not come from one
    # pose to the next.
    lasts: ClassVar[bool] = False

    # Whether a cable may have any number of them, at different places.
    repeatable: ClassVar[bool] = False

    # Name of its field, if it has one, with the index of the clip or obstacle that it is of.
    index: ClassVar[str] = ""

    # Parameters that do not depend on the cable, see `parameters`.
    declared: ClassVar[tuple[Parameter, ...]] = ()

    label: str = ""

    def __post_init__(self) -> None:
        if not self.label:
            index = getattr(self, self.index) if self.index else 0
            object.__setattr__(self, "label", self.name + (f"_{index + 1}" if index else ""))

    def parameters(self, cable: CableData) -> tuple[Parameter, ...]:
        """Parameters with units, bounds and the nominal value at which the effect vanishes."""
        if not self.declared:
            raise TypeError(f"{type(self).__name__} declares no parameters")
        return self.declared

    def per_pose(self, cable: CableData) -> tuple[str, ...]:
        """Names of its unknowns in each pose, taken from `deviation_names`."""
        return ()

    @classmethod
    def impossible(cls, setup: Setup) -> str:
        """Why a setup has no such effect, and what to try; empty if it may have one."""
        count, where = len(setup.gravity), {2: "a plane", 3: "space"}
        if count in cls.dimensions:
            return ""
        return (
            f"it is of cables in {where[cls.dimensions[0]]}, and gravity has "
            f"{counted(count, 'number')}: the cable is in {where[count]}. "
            "Try: without it, or experiment.gravity"
        )

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """Whether the effect is possible in a setup and visible in its measurements."""
        return not cls.impossible(setup)

    @classmethod
    def made_for(cls, setup: Setup) -> Self:
        """Return the effect with options that suit a setup."""
        return cls()

    @classmethod
    def each_for(cls, setup: Setup) -> tuple[Self, ...]:
        """All such effects that a setup may have at once, with different labels."""
        return (cls.made_for(setup),)

    @classmethod
    def several(cls, setup: Setup, count: int) -> tuple[Self, ...]:
        """The first `count` that a cable may have, with different labels; fewer if it has fewer."""
        first = cls.made_for(setup)
        if cls.repeatable:
            labels = (f"{cls.name}_{k}" for k in range(2, count + 1))
            return (first, *(replace(first, label=label) for label in labels))
        return (first, *cls.each_for(setup)[1:count])

    def refusal(self, setup: Setup, values: Mapping[str, float]) -> str:
        """Why it cannot be declared with these values, and what to try; empty if it can be."""
        return self.impossible(setup)

    def prior(self, setup: Setup) -> dict[str, float]:
        """Standard deviations of the prior on its parameters; empty without a prior."""
        return {
            q.name: setup.tolerances[self.tolerances[q.name]]
            for q in self.parameters(setup.cable)
            if self.tolerances.get(q.name) in setup.tolerances
        }

    def scans(self, setup: Setup) -> tuple[Scan, ...]:
        """Trial values of the parameters in which it is nonlinear."""
        return ({},)

    def place(self, values: Mapping[str, float]) -> float | None:
        """Arc length [m] at which it acts; None if it acts at more than one place."""
        return None

    def may_be(self, found: "Fitted") -> bool:
        """Whether this effect may be the cause of another one that was found, judged by shapes."""
        return False

    def linear(self) -> "Effect":
        """Return the same effect, of the same label, in the parameters of its score test.

        They differ if the derivative by a parameter is zero where the effect vanishes, although the
        effect is linear in a combination of several parameters.
        """
        return self

    def of_linear(self, cable: CableData, values: Mapping[str, float]) -> dict[str, float]:
        """Convert parameters of `linear` to those of this effect."""
        return dict(values)

    def in_linear(self, values: Mapping[str, float]) -> dict[str, float] | None:
        """Convert parameters of this effect to those of `linear`; None if it is fitted in its own.

        Only where its own parameters have a curved valley, along which a fit takes long.
        """
        return None


class SectionLaw(Effect):
    """Kind `section`: how much the section resists. Section laws multiply.

        W = along (of_bend k^T B k + GJ tau^2) / 2                      [N]

    for the curvature k and the twist tau beyond those at rest. `along` changes both stiffnesses
    with the arc length; `of_bend` changes the bending stiffness with the bend.
    """

    kind: ClassVar[str] = "section"
    # Whether the bending stiffness is the same about all axes.
    isotropic: ClassVar[bool] = True

    def along(self, cell: Cell, cable: CableData, params: Params) -> ca.SX:
        """Factor on the stiffnesses against bending and torsion of a cell."""
        return ca.SX(1)

    def of_bend(self, square: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Factor on the bending energy.

        Parameters
        ----------
        square : scalar [1/m^2]
            |curvature - rest curvature|^2.
        """
        return ca.SX(1)

    def tangent(self, square: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Factor on the stiffness against a small change of the bend k.

        d^2/dk^2 (of_bend k^2 / 2) = m + 2 k^2 m',   m = d(of_bend k^2)/d(k^2)
        """
        q = ca.SX.sym("q")
        moment = ca.gradient(self.of_bend(q, cable, params) * q, q)
        return ca.substitute(moment + 2 * q * ca.gradient(moment, q), q, square)

    def bending(self, stiffness: ca.SX, params: Params) -> ca.SX:
        """Bending stiffness B (2, 2) [N m^2] of a cable in space about its axes y and z."""
        return stiffness

    def dynamic(self, params: Params) -> ca.SX | float:
        """Factor on the stiffness against changes from the shape at rest, in motion alone."""
        return 1.0


class Kinematics(Effect):
    """Kind `kinematics`: true length and axial strain."""

    kind: ClassVar[str] = "kinematics"

    @property
    def extensible(self) -> bool:
        """Whether it lets the cable stretch under tension: it has a `compliance` of its own."""
        return type(self).compliance is not Kinematics.compliance

    def stretch(self, cable: CableData, params: Params) -> ca.SX | float:
        """Uniform factor on the declared length. Factors multiply."""
        return 1.0

    def compliance(self, params: Params) -> ca.SX | float:
        """Axial strain per tension, 1/EA [1/N]. Compliances add."""
        return 0.0


class Load(Effect):
    """Kind `load`: forces with a potential. Loads add; all share one gravity."""

    kind: ClassVar[str] = "load"
    # Whether it is an added weight, in addition to the cable's own.
    carried: ClassVar[bool] = False
    # Number of `springs`.
    n_springs: ClassVar[int] = 0

    @property
    def dead(self) -> bool:
        """Whether the forces do not depend on the shape."""
        return self.n_springs == 0

    def gravity(self, gravity: ca.SX, params: Params) -> ca.SX:
        """Return gravity (dimension,) [m/s^2], in direction and size, as every weight feels it."""
        return gravity

    def resultant(
        self, s: ca.SX, gravity: ca.SX, cable: CableData, params: Params
    ) -> ca.SX | float:
        """Force (dimension,) [N] of a distributed load on the part of the cable beyond s [m].

        A dead load has the energy V = - int resultant . dr/ds ds, a sum over elements, plus a term
        that depends on the start's place.
        """
        return 0.0

    def forces(self, gravity: ca.SX, params: Params) -> tuple[PointForceAt, ...]:
        """Point forces of the load."""
        return ()

    def springs(self, params: Params) -> tuple[SpringAt, ...]:
        """Springs at single places of the cable."""
        return ()

    def masses(self, params: Params) -> tuple[MassAt, ...]:
        """Compact masses on the cable: their inertia; their weights are among `forces`."""
        return ()

    def mass_per_length(self, s: ca.SX, cable: CableData, params: Params) -> ca.SX | float:
        """Mass per length [kg/m] at s in addition to the declared one; its weight: `resultant`."""
        return 0.0


class PointLoad(Load):
    """A load at one place of the cable, its parameter `position` [m]."""

    repeatable = True

    def position(self, cable: CableData) -> Parameter:
        """Parameter `position`: arc length of the place from the start fixture."""
        length = cable.length
        return Parameter("position", "m", length / 2, 0.1 * length, 0.0, length)

    def scans(self, setup: Setup) -> tuple[Scan, ...]:
        """Try places all along the cable."""
        return tuple({"position": float(share * setup.cable.length)} for share in PLACES)

    def place(self, values: Mapping[str, float]) -> float:
        """Arc length of its place [m]."""
        return values["position"]

    def force(self, place: ca.SX, gravity: ca.SX, params: Params) -> ca.SX:
        """Force (dimension,) [N] on the cable if its place is at `place` (dimension,) [m]."""
        dead = (item.force for item in self.forces(gravity, params))
        elastic = (spring.on_cable(place) for spring in self.springs(params))
        return sum((*dead, *elastic), start=ca.SX.zeros(place.numel()))


class BoundaryEffect(Effect):
    """Kind `boundary`: how the ends are held."""

    kind: ClassVar[str] = "boundary"

    def conditions(self, ends: EndConditions, params: Params) -> EndConditions:
        """Change the end conditions. Changes are applied in the order of the model's effects."""
        return ends

    def energy(self, first: ca.SX, last: ca.SX, params: Params) -> ca.SX | float:
        """Energy stored in the holders [J], given the cable's first and last node. Energies add."""
        return 0.0

    def compliance(self, params: Params) -> tuple[ca.SX | float, ca.SX | float]:
        """Turn of the start and end clamp per moment on it [rad/(N m)]. Compliances add."""
        return 0.0, 0.0


@dataclass(frozen=True)
class ContactEffect(Effect):
    """Kind `contact`: where an obstacle is. Its one parameter is its shift outwards [m].

    Parameters
    ----------
    obstacle : int
        Its index, 0 for the first, among declared obstacles or, with a `surface`, among effects'.
    """

    kind: ClassVar[str] = "contact"
    obstacle: int = 0

    def surface(self, gravity: tuple[float, ...]) -> Obstacle | None:
        """The effect's own obstacle with the parameter at zero; None if it is a declared one."""
        return None


class MeasurementEffect(Effect):
    """Kind `measurement`: from true points of the cable and true forces to measured ones."""

    kind: ClassVar[str] = "measurement"
    # Whether every measurement in photographs has it, and no other.
    photographed: ClassVar[bool] = False

    def observe(self, point: ca.SX, frame: ca.SX, viewpoint: Viewpoint, params: Params) -> ca.SX:
        """Measured point of the true point (dimension,) [m]. Effects are applied in order.

        Parameters
        ----------
        frame : (coordinates,)
            State of a node at that point: in a plane its heading [rad]. Maps that depend on it are
            differentiated along the cable in a plane only.
        """
        return point

    def feel(self, reactions: Mapping[str, ca.SX], params: Params) -> dict[str, ca.SX]:
        """Measured forces and moments on the fixtures, given true ones, by `ends.reaction_rows`."""
        return dict(reactions)


class StateEffect(Effect):
    """Kind `state`: the change of the rest curvature by each pose."""

    kind: ClassVar[str] = "state"

    def next_rest(self, rest: ca.SX, strain: ca.SX, cable: CableData, params: Params) -> ca.SX:
        """Rest strain [1/m] of a cell after a pose with this strain has been held.

        The curvature in a plane; in space the twist, then curvatures about the axes y and z.
        """
        raise TypeError(f"{self.name} has no law of the state")

    @classmethod
    def applies(cls, setup: Setup) -> bool:
        """True if there is a rest curvature and more than one pose."""
        return super().applies(setup) and setup.n_poses > 1 and setup.curved


@dataclass(frozen=True)
class Fitted:
    """An effect with its fitted parameters.

    `values` and `stds` hold each parameter's value and standard deviation.
    """

    effect: Effect
    setup: Setup
    values: Mapping[str, float]
    stds: Mapping[str, float]

    def near(self, side: str) -> bool:
        """Whether it acts so near to the start, or end, that the fixture may be the cause."""
        place, length = self.effect.place(self.values), self.setup.cable.length
        if place is None:
            return False
        return place < NEAR_END * length if side == "start" else place > (1 - NEAR_END) * length

    def propagated(self, of: Callable[[Params], ca.SX]) -> tuple[FloatArray, FloatArray]:
        """Value (k,) of an expression of the parameters, and its change by each std (k, n)."""
        names = list(self.values)
        own = ca.SX.sym("own", len(names))
        result = of(dict(zip(names, ca.vertsplit(own), strict=True)))
        both = ca.Function("of", [own], [result, ca.jacobian(result, own)])
        value, slopes = both([self.values[name] for name in names])
        return np.array(value)[:, 0], np.array(slopes) * [self.stds[name] for name in names]
