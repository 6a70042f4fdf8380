"""The Lagrangian of a slot, of the ends, and what they are written in.

    L(x, lam) = sum_e L_e(x_e, x_(e+1), lam) + L_ends(x_0, x_N, lam)

with the energy of bending, weight and loads and the end conditions times their multipliers. An
equilibrium is a stationary point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.effects import (
    BoundaryEffect,
    Cable,
    Kinematics,
    Load,
    PointForceAt,
    SectionLaw,
    Sight,
    SpringAt,
)
from dlo_casadi.model.composition import (
    BENDING_STIFFNESS,
    END_ROLL,
    SIGHT_SIZE,
    TORSIONAL_STIFFNESS,
    Composition,
)
from dlo_casadi.rod.element import Cell, Slot, Stiffness
from dlo_casadi.rod.ends import EndConditions
from dlo_casadi.rod.in_frame import Forces, SlotInFrame


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


class Lagrangian(Composition):
    """The expressions of a model, in symbols of its own."""

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

    def _spring_unknowns(self, k: int) -> tuple[ca.SX, ca.SX]:
        """Place and pull of a spring."""
        d = self.node.dimension
        own = self._lam[self.n_conditions + 2 * d * k : self.n_conditions + 2 * d * (k + 1)]
        return own[:d], own[d:]

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
