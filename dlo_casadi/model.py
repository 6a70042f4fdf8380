"""CableModel: a chain and its effects, composed slot by slot into one Lagrangian.

Every stage differentiates the same expression

    Lagrangian(phi, lam) = V(phi) + lam^T c(phi) - sum_e h C N_e^2 / 2

with the energy V of bending, weight and loads, the end conditions c = 0, and, for a cable of axial
compliance C, the tension N_e = -(1/h) dL/d(length ratio of element e), which is exact for dead
loads. An equilibrium is a stationary point; the chain's coordinates stay the headings alone.

A load W(r) whose force depends on the place r(s) where it acts would couple all headings before s.
Stretching and bowing, small as they are, feel it as the dead force f = -W'(r_0) at the place r_0 of
the cable that does neither, u away from where it really is:

    L = A(phi, lam, f) + f . r_0 + W(r_0),    dL/dphi = dA/dphi + dr_0/dphi^T W'' u

with A the Lagrangian under dead loads. With f and q = W'' u as symbols all terms are those of
neighbours; derivatives go through these two vectors by the chain rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.chain import Chain, Curve, Element
from dlo_casadi.effects import (
    BoundaryEffect,
    Cable,
    Effect,
    EndConditions,
    Kinematics,
    Load,
    MeasurementEffect,
    SectionLaw,
    Sight,
    StateEffect,
)
from dlo_casadi.errors import DloError
from dlo_casadi.parameters import STIFFNESS_BOUNDS, Parameter
from dlo_casadi.rest import RestCurvature

StartKind = Literal["pinned", "clamped"]
EndKind = Literal["pinned", "clamped", "free"]
FloatArray = NDArray[np.floating]

# ln(1000): a prior of the stiffness may be off by three decades.
STIFFNESS_PRIOR_STD = float(np.log(1e3))
# What may be different in every pose, in the order of `deviation`: where the ends deviate from
# what is declared [m, rad], and a force of unknown cause [N].
DEVIATIONS = ("end_x", "end_y", "start_heading", "end_heading", "pull_x", "pull_y")
# Numbers that declare one pose: its ends (6) and its camera (3), see `equilibrium.Pose.vector`.
POSE_SIZE = 9


def _stiffening(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Stiffness 1 + x of a bow under tension and its slope; compressed, x < 0, it stays above 1/4.

    Elements of a limp cable would buckle one by one on the way to an equilibrium. Twice
    differentiable, and 1 + x + O(x^3) everywhere.
    """
    a = 4 / 3 * ca.fmin(x, 0)
    pressed = 1 - a + a**2
    return ca.fmax(x, 0) + 0.25 + 0.75 / pressed, (1 - 2 * a) / pressed**2


@dataclass(frozen=True)
class CableModel:
    """An elastic cable between two fixtures in a plane.

    Parameters
    ----------
    cable : Cable
    n : int
        Number of elements.
    element : "quadratic", "arc" or "link"
    start : "pinned" or "clamped"
    end : "pinned", "clamped" or "free"
    gravity : (float, float) [m/s^2]
        In the board frame.
    effects : tuple of Effect
        In the order in which those of one slot are applied.
    n_rest : int
        Number of spline coefficients of the rest curvature; 0 = straight at rest.
    priors : dict
        Standard deviations of Gaussian priors on effect parameters by qualified name: what is
        within a declared tolerance is a nuisance, not an effect.

    Notes
    -----
    Immutable: `model.with_effect(effect)` returns another model.
    """

    cable: Cable
    n: int = 40
    element: Element = "quadratic"
    start: StartKind = "pinned"
    end: EndKind = "pinned"
    gravity: tuple[float, float] = (0.0, -9.81)
    effects: tuple[Effect, ...] = ()
    n_rest: int = 9
    priors: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        labels = [effect.label for effect in self.effects]
        for effect in self.effects:
            if labels.count(effect.label) > 1:
                raise DloError(
                    f"two effects are both labelled {effect.label!r}; give one another label, "
                    f"e.g. {type(effect).__name__}(label='{effect.label}_2')"
                )

    def __getstate__(self) -> dict[str, Any]:
        """What the model was made of: CasADi's expressions are built anew in another process."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    # ---- composition -------------------------------------------------------------------------

    @cached_property
    def chain(self) -> Chain:
        """The chain of n elements."""
        return Chain(
            self.cable.length, self.n, self.element, self.start == "clamped", self.end == "clamped"
        )

    @cached_property
    def rest(self) -> RestCurvature:
        """Basis of the rest curvature."""
        return RestCurvature(self.cable.length, 0 if self.cable.straight else self.n_rest)

    @cached_property
    def rest_basis(self) -> FloatArray:
        """Rest curvature per coefficient (n_cells, n_rest): kappa_0 = rest_basis @ c."""
        return self.rest.cell_means(self.chain.cells)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Bending stiffness, then the parameters of the effects with qualified names."""
        stiffness = Parameter(
            "bending_stiffness",
            "N m^2",
            nominal=self.cable.bending_stiffness,
            lower=STIFFNESS_BOUNDS[0],
            upper=STIFFNESS_BOUNDS[1],
            prior_std=STIFFNESS_PRIOR_STD,
            log=True,
        )
        listed = [stiffness]
        for effect in self.effects:
            for parameter in effect.parameters(self.cable):
                name = f"{effect.label}.{parameter.name}"
                std = self.priors.get(name, parameter.prior_std)
                listed.append(replace(parameter, name=name, prior_std=std))
        return tuple(listed)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Qualified names of the parameters, in the order of the vector `p`."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def nominal(self) -> FloatArray:
        """Parameter vector `p` at the nominal values."""
        return np.array([parameter.nominal for parameter in self.parameters])

    def with_effect(self, effect: Effect, priors: dict[str, float] | None = None) -> CableModel:
        """Return this model with one more effect."""
        return replace(
            self, effects=(*self.effects, effect), priors={**self.priors, **(priors or {})}
        )

    def without_effect(self, label: str) -> CableModel:
        """Return this model without the effect of that label."""
        kept = tuple(effect for effect in self.effects if effect.label != label)
        priors = {k: v for k, v in self.priors.items() if not k.startswith(f"{label}.")}
        return replace(self, effects=kept, priors=priors)

    def with_mesh(self, n: int, element: Element | None = None) -> CableModel:
        """Return the same model on another mesh."""
        return replace(self, n=n, element=element or self.element)

    def _slot(self, base: type[Any]) -> list[tuple[Any, dict[str, ca.SX]]]:
        """Effects of one slot with their own parameters."""
        picked = []
        for effect in self.effects:
            if isinstance(effect, base):
                local = {
                    parameter.name: self._p[self.names.index(f"{effect.label}.{parameter.name}")]
                    for parameter in effect.parameters(self.cable)
                }
                for name in effect.per_pose:
                    local[name] = self._deviation[DEVIATIONS.index(name)]
                picked.append((effect, local))
        return picked

    # ---- symbols -----------------------------------------------------------------------------

    @cached_property
    def _phi(self) -> ca.SX:
        return ca.SX.sym("phi", self.chain.n_headings)

    @cached_property
    def _p(self) -> ca.SX:
        return ca.SX.sym("p", len(self.parameters))

    @cached_property
    def _rest(self) -> ca.SX:
        return ca.SX.sym("kappa_0", self.chain.n_cells)

    @cached_property
    def _pose(self) -> ca.SX:
        """What is declared of one pose, see `equilibrium.Pose.vector`."""
        return ca.SX.sym("pose", POSE_SIZE)

    @property
    def _ends(self) -> ca.SX:
        """Start (2), end (2), start heading, end heading as declared."""
        return self._pose[:6]

    @property
    def _sight(self) -> Sight:
        return Sight(self._pose[:2], self._pose[6:8], self._pose[8])

    @cached_property
    def _deviation(self) -> ca.SX:
        """Deviation of one pose from its declared ends: see DEVIATIONS."""
        return ca.SX.sym("deviation", len(DEVIATIONS))

    @cached_property
    def _lam(self) -> ca.SX:
        return ca.SX.sym("lam", self.n_conditions)

    @cached_property
    def n_conditions(self) -> int:
        """Number of end conditions: end position, then headings of clamped arcs."""
        position = 0 if self.end == "free" else 2
        headings = 0
        if self.chain.nodal:
            headings = (self.start == "clamped") + (self.end == "clamped")
        return position + headings

    @cached_property
    def condition_names(self) -> tuple[str, ...]:
        """Names of the end conditions, for messages."""
        names = [] if self.end == "free" else ["end_position_x", "end_position_y"]
        if self.chain.nodal:
            names += ["start_heading"] if self.start == "clamped" else []
            names += ["end_heading"] if self.end == "clamped" else []
        return tuple(names)

    @cached_property
    def deviations(self) -> tuple[str, ...]:
        """Which deviations of a pose can matter for these boundaries."""
        used = [] if self.end == "free" else ["end_x", "end_y"]
        used += ["start_heading"] if self.start == "clamped" else []
        used += ["end_heading"] if self.end == "clamped" else []
        used += [name for effect in self.effects for name in effect.per_pose]
        return tuple(used)

    # ---- mechanics ---------------------------------------------------------------------------

    @cached_property
    def _held(self) -> EndConditions:
        """Where the ends really are: declared, deviation of the pose, boundary effects."""
        ends = EndConditions(
            start=self._ends[:2],
            end=self._ends[2:4] + self._deviation[:2],
            start_heading=self._ends[4] + self._deviation[2],
            end_heading=self._ends[5] + self._deviation[3],
        )
        for effect, local in self._slot(BoundaryEffect):
            ends = effect.conditions(ends, local)
        return ends

    @cached_property
    def held(self) -> ca.Function:
        """(p, ends, deviation) -> where the ends really are (6,), length without load [m]."""
        ends = self._held
        where = ca.vertcat(ends.start, ends.end, ends.start_heading, ends.end_heading)
        length = self.cable.length * self._stretch
        return ca.Function("held", [self._p, self._ends, self._deviation], [where, length])

    @cached_property
    def _stretch(self) -> ca.SX:
        factor = ca.SX(1)
        for effect, local in self._slot(Kinematics):
            factor = factor * effect.stretch(self.cable, local)
        return factor

    @cached_property
    def _compliance(self) -> ca.SX:
        return sum(
            (effect.compliance(local) for effect, local in self._slot(Kinematics)), start=ca.SX(0)
        )

    @property
    def extensible(self) -> bool:
        """Whether some effect lets the cable stretch under tension."""
        return any(effect.extensible for effect, _ in self._slot(Kinematics))

    def _curve(
        self,
        ratio: ca.SX | None = None,
        bow: ca.SX | None = None,
        square: ca.SX | None = None,
    ) -> Curve:
        held = self._held
        return self.chain.curve(
            self._phi,
            held.start,
            held.start_heading,
            held.end_heading,
            self._stretch,
            ratio,
            self._rest,
            bow,
            square,
        )

    @property
    def bowed(self) -> bool:
        """Whether the elements bow."""
        return self.element == "quadratic"

    @property
    def yields(self) -> bool:
        """Whether the end moves with the force on it while the headings stay."""
        return self.extensible or self.bowed

    def _bending_energy(self, curve: Curve) -> ca.SX:
        """Bending energy [J]: of each cell's mean bend, and of its bow to second order."""
        cells = self.chain.cells
        width, bend = ca.DM(np.diff(cells, axis=1).ravel()), curve.strain - self._rest
        density, tangent, uneven = self._p[0] / 2 * bend**2, ca.SX(1), ca.SX(0)
        middle = cells.mean(axis=1)
        halves = [np.stack(p, axis=1) for p in ((cells[:, 0], middle), (middle, cells[:, 1]))]
        for effect, local in self._slot(SectionLaw):
            if not self.bowed or effect.even:
                density = density * effect.factor(bend, cells, self.cable, local)
                tangent = tangent * effect.tangent(bend, cells, self.cable, local)
                continue
            first, second = (effect.factor(bend, c, self.cable, local) for c in halves)
            density = density * (first + second) / 2
            tangent = tangent * (first + second) / 2
            uneven += (first - second) / (first + second)
        if self.bowed:
            # The bow's own curvature is 4 bow (1 - 2u) / h: at Gauss points, +- 4/sqrt(3) bow / h.
            bowed = 4 / np.sqrt(3) * curve.bow / (width * self._stretch)
            # Where the halves resist differently, a mean bend bows the cell.
            density += self._p[0] / 2 * tangent * (bowed**2 + 2 * uneven * bend * bowed)
        return ca.dot(width, density) * self._stretch

    @cached_property
    def _gravity(self) -> ca.SX:
        """Gravity (2,) [m/s^2] that every weight feels."""
        gravity = ca.SX(ca.DM(self.gravity))
        for effect, local in self._slot(Load):
            gravity = effect.gravity(gravity, local)
        return gravity

    def _energy(self, curve: Curve, dead: bool = False) -> ca.SX:
        """Energy of bending, weight, loads and holders [J], without stretching.

        `dead`: forces that depend on the shape are the symbols `_force`.
        """
        energy = self._bending_energy(curve)
        weight = self.cable.mass / self.cable.length * self._gravity
        energy -= ca.dot(weight, curve.first_moment)
        for effect, local in self._slot(Load):
            if effect.dead or not dead:
                energy += effect.energy(curve, self._gravity, local)
        if dead:
            energy -= ca.dot(self._force, self._places(curve))
        for effect, local in self._slot(BoundaryEffect):
            energy += effect.energy(curve, local)
        return energy

    def _conditions(self, curve: Curve) -> ca.SX:
        """End conditions c(phi) = 0: [m], [rad]."""
        held = self._held
        rows = []
        if self.end != "free":
            rows.append(curve.nodes[self.n, :].T - held.end)
        if self.chain.nodal:
            if self.start == "clamped":
                rows.append(curve.start_direction - held.start_heading)
            if self.end == "clamped":
                rows.append(curve.end_direction - held.end_heading)
        return ca.vertcat(*rows) if rows else ca.SX.zeros(0)

    # ---- loads that depend on the shape ------------------------------------------------------

    @cached_property
    def _local_loads(self) -> list[tuple[Any, dict[str, ca.SX]]]:
        return [(effect, local) for effect, local in self._slot(Load) if not effect.dead]

    @cached_property
    def _force(self) -> ca.SX:
        return ca.SX.sym("force", 2 * len(self._local_loads))

    @cached_property
    def _swing(self) -> ca.SX:
        """How much each force changes as the place moves to where it really is [N]."""
        return ca.SX.sym("swing", 2 * len(self._local_loads))

    def _places(self, curve: Curve) -> ca.SX:
        """Where the loads that depend on the shape act, stacked [m]."""
        return ca.vertcat(*(curve.position(local["position"]) for _, local in self._local_loads))

    @cached_property
    def _local(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Places r_0, energy W(r_0), and what `_force` and (given it) `_swing` stand for."""
        at = ca.SX.sym("at", 2 * len(self._local_loads))
        energy = ca.SX(0)
        for k, (effect, local) in enumerate(self._local_loads):
            energy += effect.energy_at(at[2 * k : 2 * k + 2], self._gravity, local)
        stiffness, slope = ca.hessian(energy, at)
        places = self._places(self._curve())
        moved = -(ca.gradient(self._under_dead_loads[0], self._force) + places)
        energy, force, swing = ca.substitute([energy, -slope, stiffness @ moved], [at], [places])
        return places, energy, force, swing

    def _resolved(self, *expressions: ca.SX) -> list[ca.SX]:
        """Expressions of headings, multipliers and inputs alone."""
        if not self._local_loads:
            return list(expressions)
        _, _, force, swing = self._local
        found = ca.substitute([*expressions], [self._swing], [swing])
        return list(ca.substitute(found, [self._force], [force]))

    def _jacobian(self, expression: ca.SX, symbols: ca.SX) -> ca.SX:
        """Derivative by the symbols, through the forces that depend on the shape."""
        slopes = ca.jacobian(expression, symbols)
        if self._local_loads:
            _, _, force, swing = self._local
            by_force = ca.jacobian(force, symbols)
            by_swing = ca.jacobian(swing, symbols) + ca.jacobian(swing, self._force) @ by_force
            slopes += ca.jacobian(expression, self._force) @ by_force
            slopes += ca.jacobian(expression, self._swing) @ by_swing
        return ca.densify(slopes)

    @cached_property
    def _lagrangian(self) -> tuple[ca.SX, Curve]:
        """Lagrangian and the stretched, bowed curve, functions of headings and multipliers."""
        lagrangian, curve = self._under_dead_loads
        if self._local_loads:
            places, energy, _, _ = self._local
            lagrangian += ca.dot(self._force, places) + energy
        lagrangian, ratio, bow, square = self._resolved(
            lagrangian, curve.ratio, curve.bow, curve.square
        )
        return lagrangian, replace(curve, ratio=ratio, bow=bow, square=square)

    @cached_property
    def _under_dead_loads(self) -> tuple[ca.SX, Curve]:
        """The same with `_force` for what depends on the shape, its energy W left out."""
        ratio, bow = ca.SX.sym("ratio", self.n), ca.SX.sym("bow", self.n)
        uniform, none = ca.SX.ones(self.n) * self._stretch, ca.SX.zeros(self.n)
        curve = self._curve(ratio if self.extensible else uniform, bow if self.bowed else none)
        plain = self._energy(curve, dead=True) + ca.dot(self._lam, self._conditions(curve))

        def rigid(*expressions: ca.SX) -> list[ca.SX]:
            """Without stretching and bowing."""
            found: list[ca.SX] = ca.substitute([*expressions], [ratio, bow], [uniform, none])
            return found

        (lagrangian,) = rigid(plain)
        stretched = uniform
        if self.extensible:
            (tension,) = rigid(-ca.gradient(plain, ratio) / self.chain.h)
            lagrangian -= self._compliance * self.chain.h * ca.sumsqr(tension) / 2
            stretched = uniform + self._compliance * tension
        if self.bowed:
            torque, ones = ca.gradient(plain, bow), ca.SX.ones(self.n)
            elastic = ca.jtimes(ca.gradient(self._bending_energy(curve), bow), bow, ones)
            torque, stiffness, elastic = rigid(torque, ca.jtimes(torque, bow, ones), elastic)
            factor, slope = _stiffening(stiffness / elastic - 1)
            bowed = -torque / (elastic * factor)
            lagrangian += ca.dot(torque, bowed) / 2
            # The curve whose end the Lagrangian's derivative by the multipliers holds.
            return lagrangian, self._curve(stretched, bowed, bowed**2 * slope)
        return lagrangian, self._curve(stretched)

    @property
    def n_inner(self) -> int:
        """Number of coordinates of `potential` beside the headings."""
        return self.n * (self.extensible + self.bowed)

    @cached_property
    def potential(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Symbols (coordinates, parameters), energy [J] and end conditions of the minimisation.

        min V(coordinates) s.t. conditions = 0. The coordinates are the headings, for an
        extensible cable one a_e per element with the axial strain sqrt(C) a_e and the energy
        h a_e^2 / 2, and for quadratic elements their bows. The parameters stack p, rest, pose,
        deviation.
        """
        parameters = ca.vertcat(self._p, self._rest, self._pose, self._deviation)
        axial = ca.SX.sym("axial", self.n if self.extensible else 0)
        bow = ca.SX.sym("bow", self.n if self.bowed else 0)
        ratio = self._stretch + ca.sqrt(self._compliance) * axial if self.extensible else None
        curve = self._curve(ratio, bow if self.bowed else None)
        energy, conditions = self._energy(curve), self._conditions(curve)
        if self.bowed:
            # To second order in the bows, as in the Lagrangian.
            torque = ca.gradient(energy, bow)
            stiffness = ca.jtimes(torque, bow, ca.SX.ones(self.n))
            straight = ca.substitute([energy, torque, stiffness], [bow], [ca.SX.zeros(self.n)])
            energy = straight[0] + ca.dot(straight[1], bow) + ca.dot(straight[2], bow**2) / 2
        energy += self.chain.h * ca.sumsqr(axial) / 2
        return ca.vertcat(self._phi, axial, bow), parameters, energy, conditions

    # ---- numerical functions -----------------------------------------------------------------

    @property
    def _arguments(self) -> list[ca.SX]:
        return [self._phi, self._lam, self._p, self._rest, self._pose, self._deviation]

    @cached_property
    def _stationarity(self) -> ca.SX:
        """Gradient of the Lagrangian by (phi, lam): force balance, then end conditions."""
        lagrangian, _ = self._under_dead_loads
        if self._local_loads:
            lagrangian += ca.dot(self._swing, self._local[0])
        return ca.gradient(lagrangian, ca.vertcat(self._phi, self._lam))

    @cached_property
    def kkt(self) -> ca.Function:
        """(phi, lam, p, rest, pose, deviation) -> stationarity (N,), its Jacobian (N, N)."""
        unknowns = ca.vertcat(self._phi, self._lam)
        blocks = [ca.densify(self._stationarity), self._jacobian(self._stationarity, unknowns)]
        return ca.Function("kkt", self._arguments, self._resolved(*blocks))

    @cached_property
    def balance(self) -> ca.Function:
        """Same arguments -> stationarity (N,) only."""
        return ca.Function("balance", self._arguments, self._resolved(self._stationarity))

    @cached_property
    def sensitivity(self) -> ca.Function:
        """Same arguments -> derivatives of the stationarity by p, rest and deviation."""
        blocks = [
            self._jacobian(self._stationarity, symbol)
            for symbol in (self._p, self._rest, self._deviation)
        ]
        return ca.Function("sensitivity", self._arguments, self._resolved(*blocks))

    @cached_property
    def _observed(self) -> ca.SX:
        """Measured image of the curve: see `observation`."""
        _, curve = self._under_dead_loads
        nodes = curve.nodes
        maps = self._slot(MeasurementEffect)
        rows = []
        point, slope, heading = ca.SX.sym("point", 2), ca.SX.sym("slope", 2), ca.SX.sym("heading")
        image = point
        for effect, local in maps:
            image = effect.observe(image, heading, self._sight, local)
        pushed = ca.jtimes(image, point, slope) if maps else slope
        move = ca.Function("move", [point, slope, heading, self._p, self._pose], [image, pushed])
        headings = curve.node_headings
        slopes = curve.node_slopes if self.chain.nodal else ca.SX.zeros(self.n + 1, 2)
        for i in range(self.n + 1):
            position, direction = move(
                nodes[i, :].T, slopes[i, :].T, headings[i], self._p, self._pose
            )
            rows.append(ca.horzcat(position.T, direction.T))
        table = ca.vertcat(*rows)
        return ca.densify(ca.vec(table if self.chain.nodal else table[:, :2]))

    @cached_property
    def observation(self) -> ca.Function:
        """Same arguments -> measured curve z, its derivatives by phi+lam, p, rest, deviation.

        z stacks the columns x, y of the nodes and, for arcs, dx/ds, dy/ds: with cubic Hermite
        interpolation every measured point is a fixed linear function of z.
        """
        z = self._observed
        unknowns = ca.vertcat(self._phi, self._lam)
        blocks = [
            self._jacobian(z, symbol) for symbol in (unknowns, self._p, self._rest, self._deviation)
        ]
        return ca.Function("observation", self._arguments, self._resolved(z, *blocks))

    def slopes_by(self, names: Sequence[str]) -> ca.Function:
        """Same arguments -> derivatives of the stationarity and of z by the named parameters."""
        chosen = ca.vertcat(*(self._p[self.names.index(name)] for name in names))
        blocks = [self._jacobian(e, chosen) for e in (self._stationarity, self._observed)]
        return ca.Function("slopes_by", self._arguments, self._resolved(*blocks))

    @cached_property
    def shape(self) -> ca.Function:
        """Same arguments -> measured curve z only."""
        return ca.Function("shape", self._arguments, self._resolved(self._observed))

    @cached_property
    def strain(self) -> ca.Function:
        """(phi, pose, deviation, p) -> curvature per cell (n_cells,) [1/m]."""
        curve = self._curve()
        return ca.Function(
            "strain", [self._phi, self._pose, self._deviation, self._p], [curve.strain]
        )

    @property
    def has_state(self) -> bool:
        """Whether a pose changes the rest curvature of the next one."""
        return any(isinstance(effect, StateEffect) for effect in self.effects)

    @cached_property
    def next_rest(self) -> ca.Function:
        """Same arguments -> rest curvature after the pose, its derivatives by phi, rest, p."""
        curvature = self._curve().strain
        rest = self._rest
        for effect, local in self._slot(StateEffect):
            rest = effect.next_rest(rest, curvature, self.cable, local)
        blocks = [
            ca.densify(ca.jacobian(rest, symbol)) for symbol in (self._phi, self._rest, self._p)
        ]
        return ca.Function("next_rest", self._arguments, [ca.densify(rest), *blocks])

    @cached_property
    def energy(self) -> ca.Function:
        """Same arguments -> potential energy [J], stretching included, and true nodes (n+1, 2)."""
        lagrangian, curve = self._lagrangian
        work = ca.dot(self._lam, self._conditions(curve))
        return ca.Function("energy", self._arguments, [lagrangian - work, curve.nodes])

    @cached_property
    def start_force(self) -> ca.Function:
        """Same arguments -> force (2,) [N] of the cable on its start, whatever the loads.

        Minus the slope of the energy by the start's place, the end held: of the Lagrangian, with
        headings and multipliers kept.
        """
        lagrangian, _ = self._lagrangian
        slope = ca.gradient(lagrangian, self._ends)[:2]
        return ca.Function("start_force", self._arguments, [ca.densify(-slope)])

    @property
    def shape_dependent_loads(self) -> tuple[str, ...]:
        """Names of effects whose forces depend on the shape."""
        return tuple(effect.name for effect, _ in self._local_loads)

    @cached_property
    def dead_load(self) -> ca.Function:
        """P -> sum of the dead loads on the cable (2,) [N]: minus the energy's slope by a shift."""
        shift = ca.SX.sym("shift", 2)
        curve = replace(self._curve(), start=shift)
        slope = ca.gradient(self._energy(curve), shift)
        unused = [symbol for symbol in ca.symvar(slope) if not ca.depends_on(self._p, symbol)]
        zeros = [ca.SX(0)] * len(unused)
        return ca.Function("dead_load", [self._p], ca.substitute([-slope], unused, zeros))
