"""CableModel: a chain and its effects, composed slot by slot into one Lagrangian.

Every stage differentiates the same expressions: the Lagrangian

    L(x, lam) = sum_e L_e(x_e, x_(e+1), lam) + L_ends(x_0, x_N, lam)

with the energy of bending, weight and loads and the end conditions times their multipliers. An
equilibrium is a stationary point. All that a slot or an end adds is one CasADi function each,
mapped over the cable, see `assembly`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.assembly import Assembly, deviation_names
from dlo_casadi.effects import (
    BoundaryEffect,
    Cable,
    Effect,
    Kinematics,
    Load,
    MeasurementEffect,
    PointForceAt,
    SectionLaw,
    Sight,
    SpringAt,
    StateEffect,
)
from dlo_casadi.ends import EndConditions, reaction_rows
from dlo_casadi.errors import DloError
from dlo_casadi.parameters import STIFFNESS_BOUNDS, Parameter
from dlo_casadi.rest import RestCurvature
from dlo_casadi.rod.chain import DEFAULT_ELEMENT, Chain
from dlo_casadi.rod.element import Cell, Slot, Stiffness
from dlo_casadi.rod.in_frame import Forces, SlotDerivatives, SlotInFrame
from dlo_casadi.rod.node import Node

StartKind = Literal["pinned", "clamped"]
EndKind = Literal["pinned", "clamped", "free"]
FloatArray = NDArray[np.floating]

BENDING_STIFFNESS = "bending_stiffness"
# ln(1000): a prior of the stiffness may be off by three decades.
STIFFNESS_PRIOR_STD = float(np.log(1e3))
# ln(3): GJ over EI is 1 / (1 + nu) in a solid round rod; strands and jackets make it less or more.
STIFFNESS_RATIO_STD = float(np.log(3.0))
# Nobody knows how a cable's own twist was gripped: tolerances.roll by default [rad].
ROLL_STD = 1.0
TORSIONAL_STIFFNESS = "torsional_stiffness"
STIFFNESSES = (BENDING_STIFFNESS, TORSIONAL_STIFFNESS)
# Elements of `CableModel.coarse`.
COARSE_MESH = 10
# Roll of the end clamp about the cable against what is declared [rad]: rest twist, see design.
END_ROLL = "end_roll"
# Numbers that tell where the camera of a pose stood, see `Pose.vector`.
SIGHT_SIZE = 3


def _stiffness(name: str, nominal: float) -> Parameter:
    lower, upper = STIFFNESS_BOUNDS
    std = STIFFNESS_PRIOR_STD
    return Parameter(name, "N m^2", nominal, lower=lower, upper=upper, prior_std=std, log=True)


@dataclass(frozen=True)
class _Law:
    """A section law with its parameters, as elements ask for it."""

    effect: SectionLaw
    cable: Cable
    params: dict[str, ca.SX]

    @property
    def even(self) -> bool:
        return self.effect.even

    def factor(self, bend: ca.SX, cell: Cell) -> ca.SX:
        return self.effect.factor(bend, cell, self.cable, self.params)

    def tangent(self, bend: ca.SX, cell: Cell) -> ca.SX:
        return self.effect.tangent(bend, cell, self.cable, self.params)


@dataclass(frozen=True)
class _SlotTerms:
    """Expressions of one slot: its Lagrangian and its share of the stretched, bowed curve."""

    lagrangian: ca.SX
    advance: ca.SX
    ratio: ca.SX


@dataclass(frozen=True)
class SlotNumbers:
    """What a slot depends on beside its nodes and multipliers."""

    p: ca.SX
    rest: ca.SX
    place: ca.SX
    deviation: ca.SX
    shares: ca.SX


@dataclass(frozen=True)
class CableModel:
    """An elastic cable between two fixtures, in a plane or in space.

    Parameters
    ----------
    cable : Cable
    n : int
        Number of elements.
    element : str
        A name of `rod.chain.ELEMENTS`.
    start : "pinned" or "clamped"
    end : "pinned", "clamped" or "free"
    gravity : (dimension,) [m/s^2]
        In the board frame; three numbers for a cable in space.
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
    element: str = DEFAULT_ELEMENT
    start: StartKind = "pinned"
    end: EndKind = "pinned"
    gravity: tuple[float, ...] = (0.0, -9.81)
    effects: tuple[Effect, ...] = ()
    n_rest: int = 9
    priors: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.gravity) != len(self.cable.axes):
            raise DloError(
                f"gravity has {len(self.gravity)} numbers, but the cable "
                f"{'has no' if len(self.gravity) == 3 else 'has a'} torsional stiffness: in space "
                "give both, in a plane neither"
            )
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
        held = (self.start == "clamped", self.end == "clamped")
        return Chain(self.cable.length, self.n, self.element, *held, in_space=self.in_space)

    @property
    def in_space(self) -> bool:
        """Whether the cable may leave the plane."""
        return len(self.gravity) == 3

    @property
    def node(self) -> type[Node]:
        """What the nodes carry."""
        return self.chain.kind.node

    @property
    def n_pose(self) -> int:
        """Numbers that declare one pose, see `pose.Pose.vector`."""
        return EndConditions.size(self.node) + SIGHT_SIZE

    @property
    def deviation_names(self) -> tuple[str, ...]:
        """What may be different in every pose."""
        return deviation_names(self.node)

    @cached_property
    def rest(self) -> RestCurvature:
        """Basis of the rest curvature."""
        return RestCurvature(self.cable.length, 0 if self.cable.straight else self.n_rest)

    @cached_property
    def rest_basis(self) -> FloatArray:
        """Rest curvature per coefficient (n_rests, n_coefficients): kappa_0 = rest_basis @ c.

        In space the coefficients about the axis z follow those about y; the rest twist is none.
        """
        means, strains = self.rest.cell_means(self.chain.cells), len(self.node.strains)
        return np.kron(np.eye(strains)[:, -len(self.node.curvatures) :], means)

    @property
    def roughness(self) -> FloatArray:
        """Second differences of the rest coefficients, about each axis."""
        return np.kron(np.eye(len(self.node.curvatures)), self.rest.roughness)

    @property
    def n_coefficients(self) -> int:
        """Number of rest coefficients."""
        return self.rest.n_coefficients * len(self.node.curvatures)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffnesses, in space the roll of the end, then the effects' with qualified names."""
        listed = [_stiffness(BENDING_STIFFNESS, self.cable.bending_stiffness)]
        if self.cable.torsional_stiffness is not None:
            torsion = _stiffness(TORSIONAL_STIFFNESS, self.cable.torsional_stiffness)
            # Known by its ratio to the bending stiffness, see `Unknowns.prior_precision`.
            listed.append(torsion.with_prior(np.inf))
            if self.start == self.end == "clamped":
                std = self.priors.get(END_ROLL, ROLL_STD)
                listed.append(
                    Parameter(END_ROLL, "rad", scale=0.1, lower=-9.0, upper=9.0, prior_std=std)
                )
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

    @property
    def stiffness_indices(self) -> list[int]:
        """Where the stiffnesses stand in the vector `p`, bending first."""
        return [k for k, name in enumerate(self.names) if name in STIFFNESSES]

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

    def with_mesh(self, n: int, element: str | None = None) -> CableModel:
        """Return the same model on another mesh."""
        return replace(self, n=n, element=element or self.element)

    @cached_property
    def coarse(self) -> CableModel:
        """The same model on a coarse mesh, kept with its functions."""
        return self.with_mesh(COARSE_MESH)

    def _filling(self, base: type[Any]) -> list[tuple[Any, dict[str, ca.SX]]]:
        """Effects of one slot of the model with their own parameters."""
        picked = []
        for effect in self.effects:
            if isinstance(effect, base):
                local = {
                    parameter.name: self._p[self.names.index(f"{effect.label}.{parameter.name}")]
                    for parameter in effect.parameters(self.cable)
                }
                for name in effect.per_pose(self.cable):
                    local[name] = self._deviation[self.deviation_names.index(name)]
                picked.append((effect, local))
        return picked

    # ---- symbols -----------------------------------------------------------------------------

    @cached_property
    def _p(self) -> ca.SX:
        return ca.SX.sym("p", len(self.parameters))

    @cached_property
    def _pose(self) -> ca.SX:
        """What is declared of one pose, see `pose.Pose.vector`."""
        return ca.SX.sym("pose", self.n_pose)

    @property
    def _ends(self) -> ca.SX:
        """The ends as declared, see `EndConditions.vector`."""
        return self._pose[:-SIGHT_SIZE]

    @property
    def _sight(self) -> Sight:
        start = EndConditions.of(self._ends, self.node).start
        return Sight(start, self._pose[-3:-1], self._pose[-1])

    @cached_property
    def _deviation(self) -> ca.SX:
        """Deviation of one pose from its declared ends: `deviation_names`."""
        return ca.SX.sym("deviation", len(self.deviation_names))

    @cached_property
    def _lam(self) -> ca.SX:
        """Border: multipliers of the end conditions, then place and pull of each spring."""
        return ca.SX.sym("lam", self.n_border)

    @cached_property
    def _nodes(self) -> tuple[ca.SX, ca.SX]:
        """Coordinates of the two nodes of a slot, and their increments."""
        node = self.chain.kind.node
        return ca.SX.sym("x", 2 * node.coordinates), ca.SX.sym("delta", 2 * node.increment)

    @cached_property
    def _local(self) -> tuple[ca.SX, ca.SX]:
        """Local coordinates of a slot, and their increments: see `Element.local`."""
        return ca.SX.sym("local", self._local_of_nodes.numel()), ca.SX.sym(
            "step", 2 * self.node.increment
        )

    @property
    def _local_of_nodes(self) -> ca.SX:
        return self.chain.kind.local(*ca.vertsplit(self._nodes[0], self.node.coordinates))

    @cached_property
    def _local_slope(self) -> ca.SX:
        """Derivative (2b, 2b) of the local increments by the nodes'."""
        kind, (x, delta) = self.chain.kind, self._nodes
        pairs = zip(
            ca.vertsplit(x, self.node.coordinates),
            ca.vertsplit(delta, self.node.increment),
            strict=True,
        )
        moved = kind.local(*(self.node.retract(own, step) for own, step in pairs))
        slope = ca.jacobian(kind.local_gap(self._local_of_nodes, moved), delta)
        return ca.substitute(slope, delta, ca.SX.zeros(delta.shape))

    @cached_property
    def _rest(self) -> ca.SX:
        """Rest strains inside a slot, see `Chain.rest_stencils`."""
        return ca.SX.sym("rest", 3 * len(self.node.strains))

    @cached_property
    def _place(self) -> ca.SX:
        """A row of `Layout.slots`."""
        return ca.SX.sym("place", self.chain.layout.slots.shape[1])

    @cached_property
    def n_conditions(self) -> int:
        """Number of end conditions."""
        return len(self.condition_names)

    @property
    def n_springs(self) -> int:
        """Number of springs from places of the cable."""
        return sum(effect.n_springs for effect in self.effects if isinstance(effect, Load))

    @property
    def n_border(self) -> int:
        """Number of unknowns of the whole pose: `border_names`."""
        return len(self.border_names)

    @cached_property
    def border_names(self) -> tuple[str, ...]:
        """Names of the unknowns beside the nodes: end conditions' multipliers, then springs'.

        A spring's place y [m] is an unknown of its own, held on the cable by its pull [N]: so that
        no node knows more than its neighbours, see `SpringAt`.
        """
        own = [f"{what}_{axis}" for what in ("place", "pull") for axis in self.node.axes]
        springs = [f"spring_{k}.{name}" for k in range(self.n_springs) for name in own]
        return (*self.condition_names, *springs)

    @property
    def n_multipliers(self) -> int:
        """How many of them are multipliers: negative eigenvalues of the tangent at a minimum."""
        return self.n_conditions + self.node.dimension * self.n_springs

    @cached_property
    def are_multipliers(self) -> NDArray[np.bool_]:
        """Which of the border's unknowns are multipliers (n_border,); the others are places."""
        return np.array([".place_" not in name for name in self.border_names], dtype=bool)

    def _spring_unknowns(self, k: int) -> tuple[ca.SX, ca.SX]:
        """Place and pull of a spring."""
        d = self.node.dimension
        own = self._lam[self.n_conditions + 2 * d * k : self.n_conditions + 2 * d * (k + 1)]
        return own[:d], own[d:]

    @cached_property
    def condition_names(self) -> tuple[str, ...]:
        """Names of the end conditions: end position, then frames of clamps."""
        axes, turns = self.node.axes, self.node.turns
        names = [] if self.end == "free" else [f"end_position_{axis}" for axis in axes]
        names += [f"start_{turn}" for turn in turns] if self.start == "clamped" else []
        names += [f"end_{turn}" for turn in turns] if self.end == "clamped" else []
        return tuple(names)

    @cached_property
    def deviations(self) -> tuple[str, ...]:
        """Which deviations of a pose can matter for these boundaries."""
        axes, turns = self.node.axes, self.node.turns
        used = [] if self.end == "free" else [f"end_{axis}" for axis in axes]
        used += [f"start_{turn}" for turn in turns] if self.start == "clamped" else []
        used += [f"end_{turn}" for turn in turns] if self.end == "clamped" else []
        used += [name for effect in self.effects for name in effect.per_pose(self.cable)]
        return tuple(used)

    # ---- mechanics ---------------------------------------------------------------------------

    @cached_property
    def _held(self) -> EndConditions:
        """Where the ends really are: declared, deviation of the pose, boundary effects."""
        d, b = self.node.dimension, self.node.increment
        place, first, last, _ = ca.vertsplit(self._deviation, [0, d, d + b, d + 2 * b, 2 * (d + b)])
        declared = EndConditions.of(self._ends, self.node)
        ends = declared.changed(end=declared.end + place).turned(first, last)
        for effect, local in self._filling(BoundaryEffect):
            ends = effect.conditions(ends, local)
        if END_ROLL in self.names:
            # The material axes of an untwisted cable at the end, against the clamp's.
            ends = ends.rolled(self._p[self.names.index(END_ROLL)])
        return ends

    @cached_property
    def held(self) -> ca.Function:
        """(p, ends, deviation) -> where the ends really are, length without load [m].

        The ends as `EndConditions.vector`, declared and true.
        """
        length = self.cable.length * self._stretch
        arguments = [self._p, self._ends, self._deviation]
        return ca.Function("held", arguments, [self._held.vector, length])

    @cached_property
    def _stretch(self) -> ca.SX:
        factor = ca.SX(1)
        for effect, local in self._filling(Kinematics):
            factor = factor * effect.stretch(self.cable, local)
        return factor

    @cached_property
    def _compliance(self) -> ca.SX:
        return sum(
            (effect.compliance(local) for effect, local in self._filling(Kinematics)),
            start=ca.SX(0),
        )

    @property
    def extensible(self) -> bool:
        """Whether some effect lets the cable stretch under tension."""
        return any(effect.extensible for effect, _ in self._filling(Kinematics))

    @property
    def yields(self) -> bool:
        """Whether the end moves with the force on it while the nodes stay."""
        return self.extensible or self.chain.kind.n_inner > 0

    @cached_property
    def _gravity(self) -> ca.SX:
        """Gravity [m/s^2] as every weight feels it."""
        gravity = ca.SX(ca.DM(self.gravity))
        for effect, local in self._filling(Load):
            gravity = effect.gravity(gravity, local)
        return gravity

    def _resultant(self, s: ca.SX | float) -> ca.SX:
        """Force [N] of all that is spread along the cable on its part beyond s."""
        weight = self.cable.mass / self.cable.length * self._gravity
        total = weight * (self.cable.length - s)
        for effect, local in self._filling(Load):
            total += effect.resultant(ca.SX(s), self._gravity, self.cable, local)
        return total

    @cached_property
    def _forces(self) -> list[PointForceAt]:
        """Dead forces on single places of the cable."""
        return [
            force
            for effect, local in self._filling(Load)
            for force in effect.forces(self._gravity, local)
        ]

    @cached_property
    def _springs(self) -> list[SpringAt]:
        """Springs from places of the cable."""
        return [spring for effect, local in self._filling(Load) for spring in effect.springs(local)]

    @cached_property
    def _total_load(self) -> ca.SX:
        """Sum of all dead loads [N]."""
        return sum((force.force for force in self._forces), start=self._resultant(0.0))

    def _slot(self, ratio: ca.SX, inner: ca.SX, square: ca.SX) -> Slot:
        """The slot's symbols; numbers that all slots share are written in."""
        kind, table = self.chain.kind, self.chain.layout.slots
        place = ca.vertcat(
            *(
                ca.SX(column[0]) if np.all(column == column[0]) else self._place[i]
                for i, column in enumerate(table.T)
            )
        )
        return Slot(
            local=kind.local_moved(*self._local),
            rest=self._rest,
            place=place,
            mesh=self.chain.h,
            stretch=self._stretch,
            ratio=ratio,
            inner=inner,
            square=square,
        )

    def _bending_energy(self, slot: Slot) -> ca.SX:
        laws = [_Law(effect, self.cable, local) for effect, local in self._filling(SectionLaw)]
        return self.chain.kind.bending(slot, self._stiffness, laws)

    @property
    def _bending_stiffness(self) -> ca.SX:
        return self._p[self.names.index(BENDING_STIFFNESS)]

    @property
    def _stiffness(self) -> Stiffness:
        if not self.in_space:
            return Stiffness(self._bending_stiffness, ca.SX(0))
        bending = self._bending_stiffness * ca.SX.eye(2)
        for effect, local in self._filling(SectionLaw):
            bending = effect.bending(bending, local)
        return Stiffness(bending, self._p[self.names.index(TORSIONAL_STIFFNESS)])

    @cached_property
    def section_moment(self) -> ca.Function:
        """(bend [1/m], p) -> moment [N m] of the section in the middle of the cable.

        M = dW/dk of the energy W = EI/2 k^2 factor(k) per length.
        """
        bend, length = ca.SX.sym("bend"), self.cable.length
        cell = Cell(ca.SX(0.499 * length), ca.SX(0.002 * length), 0.002 * length)
        energy = self._bending_stiffness / 2 * bend**2
        for effect, local in self._filling(SectionLaw):
            energy *= effect.factor(bend, cell, self.cable, local)
        return ca.Function("section_moment", [bend, self._p], [ca.gradient(energy, bend)])

    def _slot_energy(self, slot: Slot) -> ca.SX:
        """Energy of bending and loads of one slot [J]: of the loads, minus their work along it."""
        return self._bending_energy(slot) - self._work(slot, self._slot_forces(slot))

    def _work(self, slot: Slot, forces: list[ca.SX]) -> ca.SX:
        """Work of `_slot_forces` along a slot [J]."""
        kind = self.chain.kind
        nodes, weights = kind.rule
        shares = ca.vertsplit(self._shares)
        work = ca.SX(0)
        for force, u, weight in zip(forces, nodes, weights, strict=False):
            work += weight * slot.length * ca.dot(force, kind.tangent(slot, u))
        for force, share in zip(forces[len(nodes) :], shares, strict=False):
            work += ca.dot(force, kind.advance(slot, share))
        return work

    def _slot_forces(self, slot: Slot) -> list[ca.SX]:
        """Dead forces [N] that a slot carries: at the points of its rule, then those on places."""
        nodes, _ = self.chain.kind.rule
        spread = [self._resultant(slot.start + u * slot.length) for u in nodes]
        return [*spread, *(force.force for force in self._forces)]

    @cached_property
    def _shares(self) -> ca.SX:
        """Shares of a slot up to the places of the forces, then of the springs, 0 to 1."""
        return ca.SX.sym("share", len(self._forces) + self.n_springs)

    @cached_property
    def shares(self) -> ca.Function:
        """(p, place) -> the shares of a slot (n_forces + n_springs,)."""
        start = self._place[0]
        positions = [local.position for local in self._forces]
        positions += [local.position for local in self._springs]
        found = [ca.fmin(ca.fmax((s - start) / self.chain.h, 0), 1) for s in positions]
        return ca.Function("shares", [self._p, self._place], [ca.vertcat(ca.SX.zeros(0), *found)])

    def _with_shares(self, expressions: list[ca.SX]) -> list[ca.SX]:
        return ca.substitute(expressions, [self._shares], [self.shares(self._p, self._place)])

    def _pull(self, slot: Slot) -> ca.SX:
        """Work of the multipliers of places, the end's and the springs', along a slot [J]."""
        kind = self.chain.kind
        work = ca.SX(0)
        if self.end != "free":
            work = ca.dot(self._lam[: self.node.dimension], kind.advance(slot))
        shares = ca.vertsplit(self._shares)[len(self._forces) :] if self.n_springs else []
        for k, share in enumerate(shares):
            work += ca.dot(self._spring_unknowns(k)[1], kind.advance(slot, share))
        return work

    @cached_property
    def _terms(self) -> _SlotTerms:
        """A slot's Lagrangian and curve."""
        terms = self._terms_by_share
        return _SlotTerms(*self._with_shares([terms.lagrangian, terms.advance, terms.ratio]))

    @cached_property
    def slot_by_share(self) -> ca.Function:
        """(x, lam, p, rest, place, deviation, shares) -> L_e and advance: see `shares`."""
        terms = self._terms_by_share
        arguments = [*self._slot_arguments, self._shares]
        return self._here("slot_by_share", arguments, [terms.lagrangian, terms.advance])

    @cached_property
    def _terms_by_share(self) -> _SlotTerms:
        """A slot's Lagrangian, and its curve, stretched by the tension and bowed.

            L_e = V_e + lam^T advance_e - h C N_e^2 / 2,   N_e = -(1/h) dL_e/d(ratio)

        which is exact for dead loads; the inner unknowns are eliminated.
        """
        kind, h = self.chain.kind, self.chain.h
        ratio, inner = ca.SX.sym("ratio"), ca.SX.sym("inner", kind.n_inner)
        slot = self._slot(ratio, inner, inner**2)
        plain = self._slot_energy(slot) + self._pull(slot)

        def rigid(expression: ca.SX) -> ca.SX:
            return ca.substitute(expression, ratio, self._stretch)

        condensed = kind.condensed(slot, rigid(plain), self._bending_energy)
        lagrangian, stretched = condensed.lagrangian, self._stretch
        if self.extensible:
            (tension,) = ca.substitute(
                [-ca.gradient(plain, ratio) / h],
                [ratio, inner],
                [self._stretch, ca.SX.zeros(inner.shape)],
            )
            lagrangian -= self._compliance * h * tension**2 / 2
            stretched = self._stretch + self._compliance * tension
        true = self._slot(stretched, condensed.inner, condensed.square)
        # The curve whose end the Lagrangian's derivative by the multipliers holds.
        return _SlotTerms(lagrangian, kind.advance(true), stretched)

    def in_frame(self, x: ca.SX, pulls: ca.SX, numbers: SlotNumbers) -> SlotInFrame:
        """A slot in space, written in the frame in its middle.

        Parameters
        ----------
        x : (8,)
            Frames of both nodes.
        pulls : (3, 1 + n_springs) [N]
            Force on the end's holder, then the springs' pulls.
        numbers : SlotNumbers
        """
        spread, dead = len(self.chain.kind.rule[0]), len(self._forces)
        weights = np.zeros((spread + dead + self.n_springs, pulls.shape[1]))
        weights[:spread, 0] = -1.0
        weights[spread + dead :, 1:] = -np.eye(self.n_springs)
        loads = self.slot_forces(numbers.p, numbers.place, numbers.deviation)
        own = numbers.p, numbers.rest, numbers.place, numbers.deviation, numbers.shares

        def energy(phi: ca.SX, inner: ca.SX, forces: ca.SX) -> ca.SX:
            local = ca.vertcat(ca.DM(self.node.identity), phi)
            return ca.SX(self.slot_in_frame(local, inner, forces, *own))

        total = ca.SX(loads) + pulls @ ca.DM(weights.T)
        return SlotInFrame(self.chain.kind, energy, x, Forces(total, weights))

    @cached_property
    def slot_forces(self) -> ca.Function:
        """(p, place, deviation) -> dead forces (dimension, m) [N] on it, see `slot_in_frame`."""
        forces = self._slot_forces(self._slot(self._stretch, self._inner, ca.SX(0)))
        forces += [ca.SX.zeros(self.node.dimension)] * self.n_springs
        arguments = [self._p, self._place, self._deviation]
        return ca.Function("slot_forces", arguments, [ca.horzcat(*forces)])

    @cached_property
    def slot_in_frame(self) -> ca.Function:
        """(local, inner, forces, p, rest, place, deviation, shares) -> energy [J] of a slot.

        Its minimum over the inner unknowns is that of `slot_by_share`. Forces are arguments, so
        that a slot and the forces on it may be turned together: the energy stays. The multipliers
        of the end's place and of the springs' are such forces, too, see `in_frame`.
        """
        kind, h = self.chain.kind, self.chain.h
        ratio, inner = ca.SX.sym("ratio"), self._inner
        slot = self._slot(ratio, inner, inner**2)
        count = len(self._slot_forces(slot)) + self.n_springs
        forces = ca.SX.sym("force", self.node.dimension, count)
        energy = self._bending_energy(slot) - self._work(slot, ca.horzsplit(forces))
        tension = ca.substitute(-ca.gradient(energy, ratio) / h, inner, ca.SX.zeros(inner.shape))
        lagrangian = kind.expanded(slot, energy, self._bending_energy)
        lagrangian -= self._compliance * h * tension**2 / 2
        local, step = self._local
        own = [self._p, self._rest, self._place, self._deviation, self._shares]
        found = ca.substitute([lagrangian], [ratio, step], [self._stretch, ca.SX.zeros(step.shape)])
        return ca.Function("slot_in_frame", [local, inner, forces, *own], found)

    @cached_property
    def _inner(self) -> ca.SX:
        """Unknowns inside an element that are eliminated from it."""
        return ca.SX.sym("inner", self.chain.kind.n_inner)

    @cached_property
    def _compliances(self) -> dict[int, ca.SX]:
        """What the conditions of clamps that give way give per multiplier, by their places."""
        sides = {"start": ca.SX(0), "end": ca.SX(0)}
        for effect, local in self._filling(BoundaryEffect):
            if effect.gives:
                for side, compliance in zip(sides, effect.compliance(local), strict=True):
                    sides[side] += compliance
        turns = {f"{side}_{turn}": c for side, c in sides.items() for turn in self.node.turns}
        return {
            k: turns[name]
            for k, name in enumerate(self.condition_names)
            if name in turns and not turns[name].is_zero()
        }

    @cached_property
    def compliances(self) -> ca.Function:
        """(p) -> compliances of the conditions `compliant`."""
        found = ca.vertcat(ca.SX.zeros(0), *self._compliances.values())
        return ca.Function("compliances", [self._p], [found])

    @property
    def compliant(self) -> list[int]:
        """End conditions that give way."""
        return list(self._compliances)

    @cached_property
    def _at_ends(self) -> ca.SX:
        """Lagrangian of the ends: holders, end conditions, and the loads' work at the start."""
        node = self.chain.kind.node
        x, delta = self._nodes
        first = node.retract(x[: node.coordinates], delta[: node.increment])
        last = node.retract(x[node.coordinates :], delta[node.increment :])
        held = self._held
        gaps = [] if self.end == "free" else [held.start - held.end]
        gaps += [node.gap(held.start_frame, first)] if self.start == "clamped" else []
        gaps += [node.gap(held.end_frame, last)] if self.end == "clamped" else []
        total = ca.dot(self._lam[: self.n_conditions], ca.vertcat(*gaps)) if gaps else ca.SX(0)
        for effect, local in self._filling(BoundaryEffect):
            total += effect.energy(first, last, local)
        for k, compliance in self._compliances.items():
            total -= compliance * self._lam[k] ** 2 / 2
        for k, spring in enumerate(self._springs):
            place, pull = self._spring_unknowns(k)
            total += spring.energy(place) + ca.dot(pull, held.start - place)
        return total - ca.dot(self._total_load, held.start)

    @property
    def n_inner(self) -> int:
        """Number of unknowns of a slot in `slot_potential` beside its nodes."""
        return int(self.extensible) + self.chain.kind.n_inner

    @cached_property
    def slot_potential(self) -> ca.Function:
        """(x, lam, p, rest, place, deviation, inner) -> energy [J] to minimise, and conditions.

        The slot's share (n_border,) of the conditions on places is the slope by the multipliers.
        The unknowns inside are, for an extensible cable, a_e with the axial strain sqrt(C) a_e and
        the energy h a_e^2 / 2, and the element's own.
        """
        kind, unknowns = self.chain.kind, ca.SX.sym("unknowns", self.n_inner)
        ratio, axial = self._stretch, ca.SX(0)
        if self.extensible:
            axial = unknowns[0]
            ratio = ratio + ca.sqrt(self._compliance) * axial
        inner = ca.SX.sym("inner", kind.n_inner)
        slot = self._slot(ratio, inner, inner**2)
        energy = kind.expanded(slot, self._slot_energy(slot), self._bending_energy)
        energy += self.chain.h * axial**2 / 2
        own = ca.reshape(unknowns[self.n_inner - kind.n_inner :], inner.shape)
        reached = ca.gradient(self._pull(slot), self._lam)
        outputs = ca.substitute([energy, reached], [inner], [own])
        arguments = [*self._slot_arguments, unknowns]
        return self._here("slot_potential", arguments, self._with_shares(outputs))

    # ---- functions of a slot, an end, a node ---------------------------------------------------

    @property
    def _slot_arguments(self) -> list[ca.SX]:
        x, _ = self._nodes
        return [x, self._lam, self._p, self._rest, self._place, self._deviation]

    @property
    def _end_arguments(self) -> list[ca.SX]:
        x, _ = self._nodes
        return [x, self._lam, self._p, self._pose, self._deviation]

    def _here(self, name: str, arguments: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
        """A function at increments of zero, its outputs dense."""
        local, step = self._local
        _, delta = self._nodes
        symbols = [step, delta, local]
        values = [ca.SX.zeros(step.shape), ca.SX.zeros(delta.shape), self._local_of_nodes]
        found = ca.substitute(outputs, symbols, values)
        return ca.Function(name, arguments, [ca.densify(one) for one in ca.cse(found)])

    @property
    def _by_slot(self) -> ca.SX:
        """What the Lagrangian of a slot is differentiated by: local increments, multipliers."""
        return ca.vertcat(self._local[1], self._lam)

    @property
    def _by_ends(self) -> ca.SX:
        """What that of the ends is differentiated by: increments of the nodes, multipliers."""
        return ca.vertcat(self._nodes[1], self._lam)

    @property
    def _to_local(self) -> ca.SX:
        """Derivative of local increments and multipliers by the nodes' and multipliers."""
        return ca.diagcat(self._local_slope, ca.SX.eye(self.n_border))

    @cached_property
    def slot(self) -> ca.Function:
        """(x, lam, p, rest, place, deviation) -> L_e, its gradient (2b + k,) and Hessian."""
        if self.in_space:
            found, spread = self._about_nodes, self._of_pulls
            outputs = [found.value, spread @ found.gradient, spread @ found.hessian @ spread.T]
            return self._here("slot", self._slot_arguments, outputs)
        value = self._terms.lagrangian
        hessian, gradient = ca.hessian(value, self._by_slot)
        return self._here("slot", self._slot_arguments, [value, gradient, hessian])

    @cached_property
    def slot_slope(self) -> ca.Function:
        """As `slot` -> its gradient alone, for a small part of the operations."""
        if self.in_space:
            gradient = self._of_pulls @ self._about_nodes.gradient
        else:
            gradient = ca.gradient(self._terms.lagrangian, self._by_slot)
        return self._here("slot_slope", self._slot_arguments, [gradient])

    @cached_property
    def _framed(self) -> SlotInFrame:
        """The slot in space, at this model's own symbols."""
        starts = [] if self.end == "free" else [0]
        starts += [self.n_conditions + 6 * k + 3 for k in range(self.n_springs)]
        pulls = [self._lam[k : k + 3] for k in starts]
        if self.end == "free":
            pulls = [ca.SX.zeros(3), *pulls]
        shares = ca.SX(self.shares(self._p, self._place))
        numbers = SlotNumbers(self._p, self._rest, self._place, self._deviation, shares)
        return self.in_frame(self._nodes[0], ca.horzcat(*pulls), numbers)

    @cached_property
    def _about_nodes(self) -> SlotDerivatives:
        """Derivatives by rotations about the nodes' own axes."""
        framed = self._framed
        return framed.derivatives().about(*framed.node_turns)

    @property
    def _of_pulls(self) -> ca.DM:
        """Matrix from both nodes and the pulls to both nodes and all multipliers."""
        rows = np.zeros((2 * self.node.increment + self.n_border, 6 + 3 * (1 + self.n_springs)))
        rows[:6, :6] = np.eye(6)
        if self.end != "free":
            rows[6:9, 6:9] = np.eye(3)
        for k in range(self.n_springs):
            at = 6 + self.n_conditions + 6 * k + 3
            rows[at : at + 3, 9 + 3 * k : 12 + 3 * k] = np.eye(3)
        return ca.sparsify(ca.DM(rows))

    @cached_property
    def at_ends(self) -> ca.Function:
        """(x, lam, p, pose, deviation) of the first and last node -> as `slot`."""
        hessian, gradient = ca.hessian(self._at_ends, self._by_ends)
        return self._here("at_ends", self._end_arguments, [self._at_ends, gradient, hessian])

    @cached_property
    def slot_sensitivity(self) -> ca.Function:
        """As `slot` -> derivative of the gradient by p, rest and deviation (2b + k, ...)."""
        by = ca.vertcat(self._p, self._rest, self._deviation)
        if self.in_space:
            first, last, pulled = self._framed.by_numbers(by)
            turns = self._framed.node_turns
            mixed = self._of_pulls @ ca.vertcat(turns[0] @ first, turns[1] @ last, pulled)
        else:
            mixed = ca.jacobian(ca.gradient(self._terms.lagrangian, self._by_slot), by)
        return self._here("slot_sensitivity", self._slot_arguments, [mixed])

    @cached_property
    def end_sensitivity(self) -> ca.Function:
        """As `at_ends` -> derivative of the gradient by p and deviation (2b + k, ...)."""
        by = ca.vertcat(self._p, self._deviation)
        mixed = ca.jacobian(ca.gradient(self._at_ends, self._by_ends), by)
        return self._here("end_sensitivity", self._end_arguments, [mixed])

    @cached_property
    def _advanced(self) -> ca.SX:
        """True advance of a slot and its length ratio (dimension + 1,)."""
        return ca.vertcat(self._terms.advance, self._terms.ratio)

    @cached_property
    def slot_curve(self) -> ca.Function:
        """As `slot` -> advance [m] and length ratio (dimension + 1,)."""
        return self._here("slot_curve", self._slot_arguments, [self._advanced])

    @cached_property
    def slot_curve_slopes(self) -> ca.Function:
        """As `slot` -> the same, derivatives by increments and lam, and by p, rest, deviation."""
        others = ca.vertcat(self._p, self._rest, self._deviation)
        if self.in_space:
            # The advance is the Lagrangian's derivative by the force on the end's holder.
            found, spread = self._about_nodes, self._of_pulls
            by_nodes = (spread @ found.hessian)[:, 6:9].T
            advance = [by_nodes, self._framed.by_numbers(others)[2][:3, :]]
            stretched = self._terms.ratio
            by_nodes = ca.jacobian(stretched, self._by_slot) @ self._to_local
            ratio = [by_nodes, ca.jacobian(stretched, others)]
            blocks = [ca.vertcat(*pair) for pair in zip(advance, ratio, strict=True)]
        else:
            blocks = [ca.jacobian(self._advanced, by) for by in (self._by_slot, others)]
        return self._here("slot_curve_slopes", self._slot_arguments, [self._advanced, *blocks])

    @cached_property
    def _seen(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        """Arguments, place (and slope) in the measurement of one station, and what moves it."""
        kind = self.chain.kind
        x, delta = self._nodes
        point, ratio = ca.SX.sym("point", self.node.dimension), ca.SX.sym("ratio")
        before, after = (
            self.node.retract(own, step)
            for own, step in zip(
                ca.vertsplit(x, x.numel() // 2),
                ca.vertsplit(delta, delta.numel() // 2),
                strict=True,
            )
        )
        frame = self.node.middle(before, after)
        slope = ratio * self.node.tangent(frame)
        image = point
        maps = self._filling(MeasurementEffect)
        for effect, local in maps:
            image = effect.observe(image, frame, self._sight, local)
        rows = image
        if kind.smooth:
            rows = ca.vertcat(image, ca.jtimes(image, point, slope) if maps else slope)
        arguments = [point, ratio, x, self._p, self._pose]
        return arguments, rows, ca.vertcat(point, ratio, delta)

    @cached_property
    def station(self) -> ca.Function:
        """(point, ratio, x, p, ends) of an element boundary -> its image: place, slope dr/ds."""
        arguments, rows, _ = self._seen
        return self._here("station", arguments, [rows])

    @cached_property
    def station_slopes(self) -> ca.Function:
        """As `station` -> the same, derivatives by (point, ratio, increments) and by p."""
        arguments, rows, moving = self._seen
        blocks = [ca.jacobian(rows, symbols) for symbols in (moving, self._p)]
        return self._here("station_slopes", arguments, [rows, *blocks])

    @cached_property
    def slot_strain(self) -> ca.Function:
        """As `slot` -> mean strains of the cell [1/m]."""
        return self._here("strain", self._slot_arguments, [self.chain.kind.strain(self._plain)])

    @property
    def _plain(self) -> Slot:
        """The slot without its inner unknowns."""
        return self._slot(self._stretch, ca.SX.zeros(self.chain.kind.n_inner), ca.SX(0))

    @property
    def has_state(self) -> bool:
        """Whether a pose changes the rest curvature of the next one."""
        return any(isinstance(effect, StateEffect) for effect in self.effects)

    @cached_property
    def slot_state(self) -> ca.Function:
        """As `slot` -> rest strains of the cell after it; by increments, rest and p."""
        own = self._rest[::3]
        strain, mean = self.chain.kind.strain(self._plain), own
        for effect, local in self._filling(StateEffect):
            mean = effect.next_rest(mean, strain, self.cable, local)
        rest = ca.SX.sym("mean", own.numel())
        mean = ca.substitute(mean, own, rest)
        slopes = [ca.jacobian(mean, symbols) for symbols in (self._local[1], rest, self._p)]
        slopes[0] = slopes[0] @ self._local_slope
        mean, *slopes = ca.substitute([mean, *slopes], [rest], [own])
        return self._here("slot_state", self._slot_arguments, [mean, *slopes])

    @cached_property
    def _reactions(self) -> ca.SX:
        """Forces [N] and moments [N m] of the cable on its fixtures, see `ends.REACTIONS`.

        Forces are minus the slope of the Lagrangian by the ends' places, nodes and multipliers
        kept. Moments, about the world's axes, are the slope by turns of the first and last node of
        what the holders add to it: multipliers of clamps, springs of pins.
        """
        node, (x, delta) = self.node, self._nodes
        places = -ca.gradient(self._at_ends, self._pose)[: 2 * node.dimension]
        turns = ca.gradient(self._at_ends, delta)
        places, turns = ca.substitute([places, turns], [delta], [ca.SX.zeros(delta.shape)])
        pairs = zip(
            ca.vertsplit(places, node.dimension),
            ca.vertsplit(x, node.coordinates),
            ca.vertsplit(turns, node.increment),
            strict=True,
        )
        here = [row for force, own, turn in pairs for row in (force, node.in_world(own, turn))]
        moved = [
            node.retract(own, step)
            for own, step in zip(
                ca.vertsplit(x, node.coordinates),
                ca.vertsplit(delta, node.increment),
                strict=True,
            )
        ]
        return ca.substitute([ca.vertcat(*here)], [x], [ca.vertcat(*moved)])[0]

    @cached_property
    def reactions(self) -> ca.Function:
        """As `at_ends` -> `ends.REACTIONS` in one column [N, N m]."""
        return self._here("reactions", self._end_arguments, [self._reactions])

    @cached_property
    def _readings(self) -> ca.SX:
        """The same as sensors show them."""
        rows, of = self._reactions, reaction_rows(self.node)
        for effect, local in self._filling(MeasurementEffect):
            parts = effect.feel({name: rows[at] for name, at in of.items()}, local)
            rows = ca.vertcat(*(parts[name] for name in of))
        return rows

    @cached_property
    def readings(self) -> ca.Function:
        """As `reactions`, as sensors show them."""
        return self._here("readings", self._end_arguments, [self._readings])

    @cached_property
    def reading_slopes(self) -> ca.Function:
        """As `readings` -> derivatives by increments and multipliers, by p, and by deviation."""
        by = (self._by_ends, self._p, self._deviation)
        slopes = [ca.jacobian(self._readings, one) for one in by]
        return self._here("reading_slopes", self._end_arguments, slopes)

    @property
    def shape_dependent_loads(self) -> tuple[str, ...]:
        """Names of effects whose forces depend on the shape."""
        return tuple(effect.name for effect, _ in self._filling(Load) if not effect.dead)

    @cached_property
    def dead_load(self) -> ca.Function:
        """P -> sum of the dead loads (dimension,) [N], without those of single poses."""
        still = ca.SX.zeros(len(self.deviation_names))
        load = ca.substitute(self._total_load, self._deviation, still)
        return ca.Function("dead_load", [self._p], [ca.densify(load)])

    @cached_property
    def assembly(self) -> Assembly:
        """These functions evaluated for many poses."""
        return Assembly(self)
