"""The Lagrangian of a segment, of the ends, and what they are written in.

    L(x, lam) = sum_e L_e(x_e, x_(e+1), lam) + L_ends(x_0, x_N, lam)

with the energy of bending, weight and loads and the end conditions times their multipliers. An
equilibrium is a stationary point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from dlo_casadi.effects import (
    BoundaryEffect,
    Cable,
    Kinematics,
    Load,
    PointForceAt,
    SectionLaw,
    SpringAt,
)
from dlo_casadi.model.cable_model import (
    BENDING_STIFFNESS,
    END_ROLL,
    TORSIONAL_STIFFNESS,
    CableModel,
)
from dlo_casadi.model.symbols import Symbols
from dlo_casadi.rod.element import Cell, Section, Segment
from dlo_casadi.rod.ends import EndConditions
from dlo_casadi.rod.in_frame import Forces, SegmentInFrame

# Models whose expressions and functions are kept: a diagnosis compares some thirty at a time.
MODELS = 64


@dataclass(frozen=True)
class _Law:
    """A section law with its parameters, as elements ask for it."""

    effect: SectionLaw
    cable: Cable
    params: dict[str, ca.SX]

    def along(self, cell: Cell) -> ca.SX:
        return self.effect.along(cell, self.cable, self.params)

    def of_bend(self, square: ca.SX) -> ca.SX:
        return self.effect.of_bend(square, self.cable, self.params)

    def tangent(self, square: ca.SX) -> ca.SX:
        return self.effect.tangent(square, self.cable, self.params)


@dataclass(frozen=True)
class _SegmentTerms:
    """Expressions of one segment: its Lagrangian and its share of the stretched, bowed curve."""

    lagrangian: ca.SX
    advance: ca.SX
    ratio: ca.SX


@dataclass(frozen=True)
class SegmentNumbers:
    """What a segment depends on beside its nodes and multipliers."""

    p: ca.SX
    rest: ca.SX
    place: ca.SX
    deviation: ca.SX
    shares: ca.SX


class Lagrangian(Symbols):
    """The expressions of a model.

    Parameters
    ----------
    model : CableModel
    """

    @cached_property
    def true_ends(self) -> EndConditions:
        """Where the ends really are: declared, deviation of the pose, boundary effects."""
        d, b = self.model.node.dimension, self.model.node.increment
        place, first, last, _ = ca.vertsplit(self.deviation, [0, d, d + b, d + 2 * b, 2 * (d + b)])
        declared = EndConditions.of(self.declared_ends, self.model.node)
        ends = declared.changed(end=declared.end + place).turned(first, last)
        for effect, local in self.effects_of(BoundaryEffect):
            ends = effect.conditions(ends, local)
        if END_ROLL in self.model.names:
            # The material axes of an untwisted cable at the end, against the clamp's.
            ends = ends.rolled(self.p[self.model.names.index(END_ROLL)])
        return ends

    @cached_property
    def held(self) -> ca.Function:
        """(p, ends, deviation) -> where the ends really are, length without load [m].

        The ends as `EndConditions.vector`, declared and true.
        """
        length = self.model.cable.length * self.stretch
        arguments = [self.p, self.declared_ends, self.deviation]
        return ca.Function("held", arguments, [self.true_ends.vector, length])

    @cached_property
    def stretch(self) -> ca.SX:
        """True length without load over the declared one."""
        factor = ca.SX(1)
        for effect, local in self.effects_of(Kinematics):
            factor = factor * effect.stretch(self.model.cable, local)
        return factor

    @cached_property
    def axial_compliance(self) -> ca.SX:
        """Axial strain per tension [1/N]."""
        return sum(
            (effect.compliance(local) for effect, local in self.effects_of(Kinematics)),
            start=ca.SX(0),
        )

    @cached_property
    def felt_gravity(self) -> ca.SX:
        """Gravity [m/s^2] as every weight feels it."""
        gravity = ca.SX(ca.DM(self.model.gravity))
        for effect, local in self.effects_of(Load):
            gravity = effect.gravity(gravity, local)
        return gravity

    def resultant(self, s: ca.SX | float) -> ca.SX:
        """Force [N] of all that is spread along the cable on its part beyond s."""
        weight = self.model.cable.mass / self.model.cable.length * self.felt_gravity
        total = weight * (self.model.cable.length - s)
        for effect, local in self.effects_of(Load):
            total += effect.resultant(ca.SX(s), self.felt_gravity, self.model.cable, local)
        return total

    @cached_property
    def dead_forces(self) -> list[PointForceAt]:
        """Dead forces on single places of the cable."""
        return [
            force
            for effect, local in self.effects_of(Load)
            for force in effect.forces(self.felt_gravity, local)
        ]

    @cached_property
    def springs(self) -> list[SpringAt]:
        """Springs from places of the cable."""
        return [
            spring for effect, local in self.effects_of(Load) for spring in effect.springs(local)
        ]

    @cached_property
    def total_load(self) -> ca.SX:
        """Sum of all dead loads [N]."""
        return sum((force.force for force in self.dead_forces), start=self.resultant(0.0))

    def segment(self, ratio: ca.SX, inner: ca.SX, square: ca.SX) -> Segment:
        """The segment's symbols; numbers that all segments share are written in."""
        kind, table = self.model.chain.kind, self.model.chain.layout.segments
        place = ca.vertcat(
            *(
                ca.SX(column[0]) if np.all(column == column[0]) else self.place[i]
                for i, column in enumerate(table.T)
            )
        )
        return Segment(
            local=kind.local_moved(*self.local),
            rest=self.rest_strains,
            place=place,
            mesh=self.model.chain.h,
            stretch=self.stretch,
            ratio=ratio,
            inner=inner,
            square=square,
        )

    def elastic_energy(self, segment: Segment) -> ca.SX:
        """Energy of bending and twist of a segment [J]."""
        return self.model.chain.kind.elastic(segment, self.section)

    @property
    def section(self) -> Section:
        """The section, its stiffnesses and laws."""
        known = dict(zip(self.model.names, ca.vertsplit(self.p), strict=True))
        bending = known[BENDING_STIFFNESS] * ca.SX.eye(len(self.model.node.curvatures))
        filling = self.effects_of(SectionLaw)
        for effect, local in filling:
            bending = effect.bending(bending, local)
        laws = [_Law(effect, self.model.cable, local) for effect, local in filling]
        return Section(bending, known.get(TORSIONAL_STIFFNESS, ca.SX(0)), laws)

    @cached_property
    def section_moment(self) -> ca.Function:
        """(bend [1/m], p) -> moment [N m] of the section in the middle of the cable.

        M = dW/dk of the energy W per length; in space about the material axis z.
        """
        bend, length = ca.SX.sym("bend"), self.model.cable.length
        cell = Cell(ca.SX(0.499 * length), ca.SX(0.002 * length), 0.002 * length)
        strain = ca.vertcat(ca.SX.zeros(len(self.model.node.strains) - 1), bend)
        energy = self.section.density(strain, cell)
        return ca.Function("section_moment", [bend, self.p], [ca.gradient(energy, bend)])

    def segment_energy(self, segment: Segment) -> ca.SX:
        """Energy of bending and loads of one segment [J]: of loads, minus their work along it."""
        return self.elastic_energy(segment) - self.work_along(segment, self.forces_on(segment))

    def work_along(self, segment: Segment, forces: list[ca.SX]) -> ca.SX:
        """Work of `forces_on` a segment along it [J]."""
        kind = self.model.chain.kind
        nodes, weights = kind.rule
        shares = ca.vertsplit(self.share_symbols)
        work = ca.SX(0)
        for force, u, weight in zip(forces, nodes, weights, strict=False):
            work += weight * segment.length * ca.dot(force, kind.tangent(segment, u))
        for force, share in zip(forces[len(nodes) :], shares, strict=False):
            work += ca.dot(force, kind.advance(segment, share))
        return work

    def forces_on(self, segment: Segment) -> list[ca.SX]:
        """Dead forces [N] on a segment: at the points of its rule, then those on single places."""
        nodes, _ = self.model.chain.kind.rule
        spread = [self.resultant(segment.start + u * segment.length) for u in nodes]
        return [*spread, *(force.force for force in self.dead_forces)]

    @cached_property
    def share_symbols(self) -> ca.SX:
        """Shares of a segment up to the places of the forces, then of the springs, 0 to 1."""
        return ca.SX.sym("share", len(self.dead_forces) + self.model.n_springs)

    @cached_property
    def shares(self) -> ca.Function:
        """(p, place) -> the shares of a segment (n_forces + n_springs,)."""
        start = self.place[0]
        positions = [local.position for local in self.dead_forces]
        positions += [local.position for local in self.springs]
        found = [ca.fmin(ca.fmax((s - start) / self.model.chain.h, 0), 1) for s in positions]
        return ca.Function("shares", [self.p, self.place], [ca.vertcat(ca.SX.zeros(0), *found)])

    def with_shares(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Expressions with the shares in place of their symbols."""
        return ca.substitute(expressions, [self.share_symbols], [self.shares(self.p, self.place)])

    def work_of_multipliers(self, segment: Segment) -> ca.SX:
        """Work of the multipliers of places, the end's and the springs', along a segment [J]."""
        kind = self.model.chain.kind
        work = ca.SX(0)
        if self.model.end != "free":
            work = ca.dot(self.lam[: self.model.node.dimension], kind.advance(segment))
        shares = (
            ca.vertsplit(self.share_symbols)[len(self.dead_forces) :]
            if self.model.n_springs
            else []
        )
        for k, share in enumerate(shares):
            work += ca.dot(self.spring_unknowns(k)[1], kind.advance(segment, share))
        return work

    @cached_property
    def segment_terms(self) -> _SegmentTerms:
        """A segment's Lagrangian and curve."""
        terms = self.segment_terms_by_share
        return _SegmentTerms(*self.with_shares([terms.lagrangian, terms.advance, terms.ratio]))

    @cached_property
    def segment_terms_by_share(self) -> _SegmentTerms:
        """A segment's Lagrangian, and its curve, stretched by the tension and bowed.

            L_e = V_e + lam^T advance_e - h C N_e^2 / 2,   N_e = -(1/h) dL_e/d(ratio)

        which is exact for dead loads; the inner unknowns are eliminated.
        """
        kind, h = self.model.chain.kind, self.model.chain.h
        ratio, inner = ca.SX.sym("ratio"), ca.SX.sym("inner", kind.n_inner)
        segment = self.segment(ratio, inner, inner**2)
        plain = self.segment_energy(segment) + self.work_of_multipliers(segment)

        def rigid(expression: ca.SX) -> ca.SX:
            return ca.substitute(expression, ratio, self.stretch)

        condensed = kind.condensed(segment, rigid(plain), self.elastic_energy)
        lagrangian, stretched = condensed.lagrangian, self.stretch
        if self.model.extensible:
            (tension,) = ca.substitute(
                [-ca.gradient(plain, ratio) / h],
                [ratio, inner],
                [self.stretch, ca.SX.zeros(inner.shape)],
            )
            lagrangian -= self.axial_compliance * h * tension**2 / 2
            stretched = self.stretch + self.axial_compliance * tension
        true = self.segment(stretched, condensed.inner, condensed.square)
        # The curve whose end the Lagrangian's derivative by the multipliers holds.
        return _SegmentTerms(lagrangian, kind.advance(true), stretched)

    def in_frame(self, x: ca.SX, pulls: ca.SX, numbers: SegmentNumbers) -> SegmentInFrame:
        """A segment in space, written in the frame in its middle.

        Parameters
        ----------
        x : (8,)
            Frames of both nodes.
        pulls : (3, 1 + n_springs) [N]
            Force on the end's holder, then the springs' pulls.
        numbers : SegmentNumbers
        """
        spread, dead = len(self.model.chain.kind.rule[0]), len(self.dead_forces)
        weights = np.zeros((spread + dead + self.model.n_springs, pulls.shape[1]))
        weights[:spread, 0] = -1.0
        weights[spread + dead :, 1:] = -np.eye(self.model.n_springs)
        loads = self.segment_forces(numbers.p, numbers.place, numbers.deviation)
        own = numbers.p, numbers.rest, numbers.place, numbers.deviation, numbers.shares

        def energy(phi: ca.SX, inner: ca.SX, forces: ca.SX) -> ca.SX:
            local = ca.vertcat(ca.DM(self.model.node.identity), phi)
            return ca.SX(self.segment_in_frame(local, inner, forces, *own))

        total = ca.SX(loads) + pulls @ ca.DM(weights.T)
        return SegmentInFrame(self.model.chain.kind, energy, x, Forces(total, weights))

    @cached_property
    def segment_forces(self) -> ca.Function:
        """(p, place, deviation) -> dead forces (dimension, m) [N] on it, see `segment_in_frame`."""
        forces = self.forces_on(self.segment(self.stretch, self.inner, ca.SX(0)))
        forces += [ca.SX.zeros(self.model.node.dimension)] * self.model.n_springs
        arguments = [self.p, self.place, self.deviation]
        return ca.Function("segment_forces", arguments, [ca.horzcat(*forces)])

    @cached_property
    def segment_in_frame(self) -> ca.Function:
        """(local, inner, forces, p, rest, place, deviation, shares) -> energy [J] of a segment.

        Its minimum over the inner unknowns is that of `segment_by_share`. Forces are arguments, so
        that a segment and the forces on it may be turned together: the energy stays. Multipliers of
        the end's place and of the springs' are such forces, too, see `in_frame`.
        """
        kind, h = self.model.chain.kind, self.model.chain.h
        ratio, inner = ca.SX.sym("ratio"), self.inner
        segment = self.segment(ratio, inner, inner**2)
        count = len(self.forces_on(segment)) + self.model.n_springs
        forces = ca.SX.sym("force", self.model.node.dimension, count)
        energy = self.elastic_energy(segment) - self.work_along(segment, ca.horzsplit(forces))
        tension = ca.substitute(-ca.gradient(energy, ratio) / h, inner, ca.SX.zeros(inner.shape))
        lagrangian = kind.expanded(segment, energy, self.elastic_energy)
        lagrangian -= self.axial_compliance * h * tension**2 / 2
        local, step = self.local
        own = [self.p, self.rest_strains, self.place, self.deviation, self.share_symbols]
        found = ca.substitute([lagrangian], [ratio, step], [self.stretch, ca.SX.zeros(step.shape)])
        return ca.Function("segment_in_frame", [local, inner, forces, *own], found)

    @cached_property
    def compliance_of(self) -> dict[int, ca.SX]:
        """What the conditions of clamps that give way give per multiplier, by their places."""
        sides = {"start": ca.SX(0), "end": ca.SX(0)}
        for effect, local in self.effects_of(BoundaryEffect):
            if effect.gives:
                for side, compliance in zip(sides, effect.compliance(local), strict=True):
                    sides[side] += compliance
        turns = {f"{side}_{turn}": c for side, c in sides.items() for turn in self.model.node.turns}
        return {
            k: turns[name]
            for k, name in enumerate(self.model.condition_names)
            if name in turns and not turns[name].is_zero()
        }

    @cached_property
    def compliances(self) -> ca.Function:
        """(p) -> compliances of the conditions `compliant`."""
        found = ca.vertcat(ca.SX.zeros(0), *self.compliance_of.values())
        return ca.Function("compliances", [self.p], [found])

    @property
    def compliant(self) -> list[int]:
        """End conditions that give way."""
        return list(self.compliance_of)

    @cached_property
    def ends_lagrangian(self) -> ca.SX:
        """Lagrangian of the ends: holders, end conditions, and the loads' work at the start."""
        node = self.model.chain.kind.node
        x, delta = self.nodes
        first = node.retract(x[: node.coordinates], delta[: node.increment])
        last = node.retract(x[node.coordinates :], delta[node.increment :])
        held = self.true_ends
        gaps = [] if self.model.end == "free" else [held.start - held.end]
        gaps += [node.gap(held.start_frame, first)] if self.model.start == "clamped" else []
        gaps += [node.gap(held.end_frame, last)] if self.model.end == "clamped" else []
        total = ca.dot(self.lam[: self.model.n_conditions], ca.vertcat(*gaps)) if gaps else ca.SX(0)
        for effect, local in self.effects_of(BoundaryEffect):
            total += effect.energy(first, last, local)
        for k, compliance in self.compliance_of.items():
            total -= compliance * self.lam[k] ** 2 / 2
        for k, spring in enumerate(self.springs):
            place, pull = self.spring_unknowns(k)
            total += spring.energy(place) + ca.dot(pull, held.start - place)
        return total - ca.dot(self.total_load, held.start)


@lru_cache(maxsize=MODELS)
def lagrangian_of(model: CableModel) -> Lagrangian:
    """The expressions of a model, made once."""
    return Lagrangian(model)
