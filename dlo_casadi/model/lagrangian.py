"""The Lagrangian of a segment and of the ends, and the expressions it consists of.

    L(x, lam) = sum_e L_e(x_e, x_(e+1), lam) + L_ends(x_0, x_N, lam)

It contains the energy of bending, weight and loads, and the end conditions times their
multipliers. An equilibrium is a stationary point.
"""

from dataclasses import replace
from functools import cached_property, lru_cache, partial
from math import prod
from typing import Any, NamedTuple

import casadi as ca

from dlo_casadi.effects import (
    BoundaryEffect,
    Kinematics,
    Load,
    PointForceAt,
    SectionLaw,
    SpringAt,
    Viewpoint,
)
from dlo_casadi.model.cable_model import (
    BENDING_STIFFNESS,
    END_ROLL,
    FREE_LENGTH,
    TORSIONAL_STIFFNESS,
    VIEWPOINT_SIZE,
    CableModel,
)
from dlo_casadi.model.clips import clip_size
from dlo_casadi.rod.chain import moved_rest
from dlo_casadi.rod.element import LAYOUT_SIZE, Section, Segment
from dlo_casadi.rod.ends import ClipConditions, EndConditions, held_turns

# Distance before the edge of a segment, as a share of its length, from which on a place counts as
# beyond it. Rounding is smaller, so that just one segment has the derivatives by the place.
BESIDE = 1e-9
# Number of models whose expressions and functions are cached: a diagnosis compares about thirty.
MODELS = 64


class _SegmentTerms(NamedTuple):
    """Expressions of one segment: its Lagrangian, its advance and its length ratio."""

    lagrangian: ca.SX
    advance: ca.SX
    ratio: ca.SX


class Lagrangian:
    """Symbols and expressions of an `unmeshed` model: of one segment, the ends and one pose.

    Attributes
    ----------
    p : (n_parameters,)
        In the order of `model.names`.
    pose : (n_pose,)
        A declared pose, see `HeldPose.vector`.
    deviation : (n_deviations,)
        Unknowns that this pose has of its own, see `deviation_names`.
    lam : (n_lam,)
        Border: multipliers of the end conditions, then unknowns of springs and of clips.
    x, delta : (2 coordinates,), (2 increment,)
        Coordinates of a segment's two nodes, or of the first and last node; their increments.
    rest_strains : (3 strains,) [1/m]
        Rest strains inside a segment, see `Chain.rest_stencils`.
    place : (6,) or (4,)
        A row of `Layout.segments`. Where nodes are moved, to clips or with an end that slides: the
        arc lengths of its ends, the length of an element, and where the even element starts that
        has its rest strains.
    inner : (n_inner,)
        Internal unknowns of an element, which are eliminated.
    """

    def __init__(self, model: CableModel) -> None:
        self.model, self.node, self.kind = model, model.node, model.chain.kind
        n, pulls = model.n_springs, model.pulls
        # With clips the first one's rows are those of the force beyond a segment, see `Beyond`.
        self.end_pull, self.pulls = pulls[n] if model.clips else model.end_pull, pulls[:n]
        self.p = ca.SX.sym("p", len(model.parameters))
        self.pose = ca.SX.sym("pose", model.n_pose)
        self.deviation = ca.SX.sym("deviation", len(model.deviation_names))
        self.lam = ca.SX.sym("lam", model.n_lam)
        self.x = ca.SX.sym("x", 2 * self.node.coordinates)
        self.delta = ca.SX.sym("delta", 2 * self.node.increment)
        self.rest_strains = ca.SX.sym("rest", 3 * len(self.node.strains))
        self.place = ca.SX.sym("place", 4 if model.moves_nodes else LAYOUT_SIZE)
        self.inner = ca.SX.sym("inner", self.kind.n_inner)

    def effects_of(self, base: type[Any]) -> list[tuple[Any, dict[str, ca.SX]]]:
        """Effects of one kind in the model, random ones included, with their own parameters."""
        cable, picked = self.model.cable, []
        known = dict(zip(self.model.deviation_names, ca.vertsplit(self.deviation), strict=True))
        known |= zip(self.model.names, ca.vertsplit(self.p), strict=True)
        for effect in (*self.model.effects, *self.model.random):
            if isinstance(effect, base):
                unit = known[BENDING_STIFFNESS] if effect.per_stiffness else 1
                names = [q.name for q in effect.parameters(cable)]
                own = {name: unit * known[f"{effect.label}.{name}"] for name in names}
                own |= {name: known[name] for name in effect.per_pose(cable)}
                picked.append((effect, own))
        return picked

    @property
    def declared_ends(self) -> ca.SX:
        """The ends as declared, see `EndConditions.vector`."""
        return self.pose[: EndConditions.size(self.node)]

    @property
    def viewpoint(self) -> Viewpoint:
        """Position of the camera for a pose."""
        size = EndConditions.size(self.node)
        x, y, inverse = ca.vertsplit(self.pose[size : size + VIEWPOINT_SIZE])
        start = EndConditions.of(self.declared_ends, self.node).start
        return Viewpoint(start, ca.vertcat(x, y), inverse)

    @property
    def moved(self) -> list[ca.SX]:
        """The two nodes, moved by their increments."""
        rows, steps = (ca.vertsplit(both, both.numel() // 2) for both in (self.x, self.delta))
        return [self.node.moved(own, step) for own, step in zip(rows, steps, strict=True)]

    @cached_property
    def local(self) -> ca.SX:
        """Local coordinates of a segment between the moved nodes, see `Element.local`."""
        return self.kind.local(*self.moved)

    @cached_property
    def true_ends(self) -> EndConditions:
        """True ends: as declared, plus the pose's deviation and the boundary effects."""
        d, b = self.node.dimension, self.node.increment
        fixed = 2 * (d + b) + 1
        clips = fixed + d * len(self.model.clips)
        edges = [0, d, d + b, d + 2 * b, fixed, clips, self.deviation.numel()]
        place, first, last, _, moved, _ = ca.vertsplit(self.deviation, edges)
        declared, held = EndConditions.of(self.declared_ends, self.node), []
        if self.model.clips:
            rows = ca.vertsplit(self.pose[-self.model.clip_numbers :], clip_size(self.node))
            pairs = zip(rows, ca.vertsplit(moved, d), strict=True)
            held = [ClipConditions(row[:d] + step, row[-1], ca.SX.zeros(b)) for row, step in pairs]
        ends = replace(declared, end=declared.end + place, clips=tuple(held)).turned(first, last)
        for effect, local in self.effects_of(BoundaryEffect):
            ends = effect.conditions(ends, local)
        if END_ROLL in self.model.names:
            # The material axes of an untwisted cable at the end, against the clamp's.
            ends = ends.rolled(self.p[self.model.names.index(END_ROLL)])
        return ends

    @cached_property
    def true_ends_and_length(self) -> ca.Function:
        """(p, ends, deviation) -> true ends, length without load [m].

        The ends as `EndConditions.vector`, declared and true.
        """
        length = self.model.cable.length * self.stretch
        arguments = [self.p, self.declared_ends, self.deviation]
        return ca.Function("true_ends_and_length", arguments, [self.true_ends.vector, length])

    @cached_property
    def stretch(self) -> ca.SX:
        """True length without load over the declared one."""
        cable, effects = self.model.cable, self.effects_of(Kinematics)
        return prod((effect.stretch(cable, local) for effect, local in effects), start=ca.SX(1))

    @cached_property
    def axial_compliance(self) -> ca.SX:
        """Axial strain per tension [1/N]."""
        own = (effect.compliance(local) for effect, local in self.effects_of(Kinematics))
        return sum(own, start=ca.SX(0))

    @cached_property
    def felt_gravity(self) -> ca.SX:
        """Gravity [m/s^2] after the effects that change it."""
        gravity = ca.SX(ca.DM(self.model.gravity))
        for effect, local in self.effects_of(Load):
            gravity = effect.gravity(gravity, local)
        return gravity

    def resultant(self, s: ca.SX | float) -> ca.SX:
        """Force [N] of all distributed loads on the cable from s to its declared length."""
        weight = self.model.cable.mass / self.model.cable.length * self.felt_gravity
        total = weight * (self.model.cable.length - s)
        for effect, local in self.effects_of(Load):
            total += effect.resultant(ca.SX(s), self.felt_gravity, self.model.cable, local)
        return total

    @cached_property
    def dead_forces(self) -> list[PointForceAt]:
        """Dead point forces on the cable."""
        loads = self.effects_of(Load)
        return [f for effect, local in loads for f in effect.forces(self.felt_gravity, local)]

    @cached_property
    def springs(self) -> list[SpringAt]:
        """Springs at places of the cable."""
        return [k for effect, local in self.effects_of(Load) for k in effect.springs(local)]

    @cached_property
    def total_load(self) -> ca.SX:
        """Sum of all dead loads [N] on the cable from its start to its declared length."""
        start = self.resultant(self.along_ends[0])
        return sum((force.force for force in self.dead_forces), start=start)

    @cached_property
    def along_ends(self) -> tuple[ca.SX | float, ca.SX | float]:
        """Arc lengths [m] at both ends."""
        own, (starts, ends) = dict(self.model.sliding), self.model.loose
        length = self.model.cable.length
        if self.model.fed_by_length:
            deviation = self.deviation[self.model.deviation_names.index(FREE_LENGTH)]
            more = self.pose[EndConditions.size(self.node) + VIEWPOINT_SIZE] + deviation
            return (length - more if starts else 0.0), (more if ends else length)
        low, high = own.get(0), own.get(len(self.model.clips) + 1)
        return 0.0 if low is None else self.lam[low], length if high is None else self.lam[high]

    def segment(
        self, ratio: ca.SX, inner: ca.SX, square: ca.SX, local: ca.SX | None = None
    ) -> Segment:
        """The segment's symbols."""
        return Segment(
            local=self.local if local is None else local,
            rest=self._rest_inside,
            place=self.row,
            stretch=self.stretch,
            ratio=ratio,
            inner=inner,
            square=square,
        )

    @property
    def row(self) -> ca.SX:
        """A row of `Layout.segments` (6,)."""
        if not self.model.moves_nodes:
            return self.place
        low, high, mesh, _ = ca.vertsplit(self.place)
        return ca.vertcat(low, high - low, low, high - low, 1, mesh)

    @property
    def _rest_inside(self) -> ca.SX:
        """Rest strains (3 strains,) [1/m] inside the segment, whose ends may be moved to clips."""
        if not self.model.moves_nodes:
            return self.rest_strains
        low, high, mesh, even = ca.vertsplit(self.place)
        x, w = ((low + high) / 2 - even) / mesh - 0.5, (high - low) / mesh
        parts = (moved_rest(own, x, w) for own in ca.vertsplit(self.rest_strains, 3))
        return ca.vertcat(*(row for part in parts for row in part))

    def elastic_energy(self, segment: Segment) -> ca.SX:
        """Energy of bending and twist of a segment [J]."""
        return self.kind.elastic(segment, self.section)

    @property
    def section(self) -> Section:
        """The section, its stiffnesses and laws."""
        known = dict(zip(self.model.names, ca.vertsplit(self.p), strict=True))
        bending = known[BENDING_STIFFNESS] * ca.SX.eye(len(self.node.curvatures))
        laws = self.effects_of(SectionLaw)
        for effect, local in laws:
            bending = effect.bending(bending, local)

        def product(factor: str, of: Any) -> ca.SX:
            found = (getattr(law, factor)(of, self.model.cable, local) for law, local in laws)
            return prod(found, start=ca.SX(1))

        along, of_bend, tangent = (partial(product, k) for k in ("along", "of_bend", "tangent"))
        torsion = known.get(TORSIONAL_STIFFNESS, ca.SX(0))
        return Section(bending, torsion, along, of_bend, tangent)

    @cached_property
    def has_law_of_bend(self) -> bool:
        """Whether the bending stiffness changes with the bend."""
        square = ca.SX.sym("square")
        return bool(ca.depends_on(self.section.of_bend(square), square))

    def segment_energy(self, segment: Segment) -> ca.SX:
        """Elastic energy of one segment minus the work of the loads along it [J]."""
        return self.elastic_energy(segment) - self.work_along(segment, self.forces_on(segment))

    def work_along(self, segment: Segment, forces: list[ca.SX]) -> ca.SX:
        """Work [J] along a segment of `forces_on` it."""
        (nodes, weights), work = self.kind.rule, ca.SX(0)
        shares = ca.vertsplit(self.share_symbols)
        for force, u, weight in zip(forces, nodes, weights, strict=False):
            work += weight * segment.length * ca.dot(force, self.kind.tangent(segment, u))
        for force, share in zip(forces[len(nodes) :], shares, strict=False):
            work += ca.dot(force, self.kind.advance(segment, share))
        return work

    def forces_on(self, segment: Segment) -> list[ca.SX]:
        """Dead forces [N] on a segment: at its quadrature points, then the point forces."""
        spread = [self.resultant(segment.start + u * segment.length) for u in self.kind.rule[0]]
        return [*spread, *(force.force for force in self.dead_forces)]

    @cached_property
    def share_symbols(self) -> ca.SX:
        """Shares (0 to 1) of a segment that lie before each point force and spring."""
        return ca.SX.sym("share", len(self.dead_forces) + len(self.pulls))

    @cached_property
    def shares(self) -> ca.Function:
        """(p, place) -> the shares of a segment (n_forces + n_springs,)."""
        start = self.place[0]
        positions = [x.position for x in self.dead_forces] + [x.position for x in self.springs]
        last = start + self.length > self.model.cable.length - BESIDE * self.length
        shares = [(s - start) / self.length for s in positions]
        inside = [ca.logic_and(u >= -BESIDE, ca.logic_or(u < 1 - BESIDE, last)) for u in shares]
        found = [ca.if_else(here, u, u > 0.5) for here, u in zip(inside, shares, strict=True)]
        return ca.Function("shares", [self.p, self.place], [ca.vertcat(ca.SX.zeros(0), *found)])

    @property
    def length(self) -> ca.SX:
        """Length of a segment [m], if it has one: of links that of all elements."""
        return self.row[1 if self.kind.smooth else 5]

    def with_shares(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Expressions with the shares in place of their symbols."""
        return ca.substitute(expressions, [self.share_symbols], [self.shares(self.p, self.place)])

    def work_of_multipliers(self, segment: Segment) -> ca.SX:
        """Work [J] along a segment of the force at its end and of those on springs."""
        work = ca.SX(0)
        if self.end_pull:
            work = ca.dot(self.lam[self.end_pull], self.kind.advance(segment))
        for k, rows in enumerate(self.pulls):
            share = self.share_symbols[len(self.dead_forces) + k]
            work += ca.dot(self.lam[rows], self.kind.advance(segment, share))
        return work

    @cached_property
    def segment_terms(self) -> _SegmentTerms:
        """A segment's Lagrangian and curve."""
        return _SegmentTerms(*self.with_shares(list(self.segment_terms_by_share)))

    @cached_property
    def segment_terms_by_share(self) -> _SegmentTerms:
        """A segment's Lagrangian, and its curve with axial strain and bubble.

            L_e = V_e + lam^T advance_e - h C N_e^2 / 2,   N_e = -(1/h) dL_e/d(ratio)

        which is exact for dead loads; the internal unknowns are eliminated.
        """
        kind, h = self.kind, self.length
        ratio, inner = ca.SX.sym("ratio"), self.inner
        segment = self.segment(ratio, inner, inner**2)
        plain = self.segment_energy(segment) + self.work_of_multipliers(segment)

        def rigid(expression: ca.SX) -> ca.SX:
            return ca.substitute(expression, ratio, self.stretch)

        condensed = kind.condensed(segment, rigid(plain), self.elastic_energy)
        lagrangian, stretched = condensed.lagrangian, self.stretch
        if self.model.extensible:
            tension = rigid(-ca.gradient(plain, ratio) / h)
            tension = ca.substitute(tension, inner, ca.SX.zeros(inner.shape))
            lagrangian -= self.axial_compliance * h * tension**2 / 2
            stretched = self.stretch + self.axial_compliance * tension
        true = self.segment(stretched, condensed.inner, condensed.square)
        # The end of this curve is in the Lagrangian's derivative by the multipliers.
        return _SegmentTerms(lagrangian, kind.advance(true), stretched)

    @cached_property
    def compliance_of(self) -> dict[int, ca.SX]:
        """Index of the condition of a compliant clamp -> its turn per moment [rad/(N m)]."""
        total = [ca.SX(0), ca.SX(0)]
        for effect, local in self.effects_of(BoundaryEffect):
            total = [c + own for c, own in zip(total, effect.compliance(local), strict=True)]
        sides = zip(("start", "end"), total, strict=True)
        turns = {f"{side}_{turn}": c for side, c in sides for turn in self.node.turns}
        names = enumerate(self.model.condition_names)
        return {k: turns[name] for k, name in names if name in turns and not turns[name].is_zero()}

    @cached_property
    def compliances(self) -> ca.Function:
        """(p) -> compliances of the conditions `compliant`."""
        found = ca.vertcat(ca.SX.zeros(0), *self.compliance_of.values())
        return ca.Function("compliances", [self.p], [found])

    @property
    def compliant(self) -> list[int]:
        """Indices of the end conditions of compliant clamps."""
        return list(self.compliance_of)

    @cached_property
    def ends_lagrangian(self) -> ca.SX:
        """Lagrangian of the ends: holders, end conditions, and the work of loads at the start."""
        first, last = self.moved
        true = self.true_ends
        gaps = [true.start - true.end] if self.model.end.place else []
        gaps += [held_turns(self.model.start, self.node, true.start_frame, first)]
        gaps += [held_turns(self.model.end, self.node, true.end_frame, last)]
        held = self.lam[: len(self.model.condition_names)]
        total = ca.dot(held, ca.vertcat(*gaps))
        for effect, local in self.effects_of(BoundaryEffect):
            total += effect.energy(first, last, local)
        for k, compliance in self.compliance_of.items():
            total -= compliance * self.lam[k] ** 2 / 2
        d, springs = self.node.dimension, self.model.pulls[: self.model.n_springs]
        places = [self.lam[[row - d for row in rows]] for rows in springs]  # before their pulls
        total += sum(k.energy(y) for k, y in zip(self.springs, places, strict=True))
        places += [clip.place for clip in true.clips]
        for place, rows in zip(places, self.model.pulls, strict=True):
            total += ca.dot(self.lam[rows], true.start - place)
        total -= ca.dot(self.total_load, true.start)
        if self.model.end.slides:
            total += ca.dot(self.resultant(self.along_ends[1]), true.end)
        return total

    @cached_property
    def feeding(self) -> ca.SX:
        """Energy [J] of what ends that slide take from beyond them: against tensions, its weight.

        With it the condition of the arc length there is T = N + M k / 2 for the tension N in the
        cable before the end; the weight that enters comes from the same place.
        """
        true, total, k = self.true_ends, ca.SX(0), EndConditions.size(self.node) + VIEWPOINT_SIZE
        low, high = self.along_ends
        fed = ((true.start, -ca.SX(low)), (true.end, high - self.model.cable.length))
        weights = (self.resultant(low) - self.resultant(0.0), -self.resultant(high))
        for slides, (place, more), weight in zip(self.model.loose, fed, weights, strict=True):
            if slides and not self.model.fed_by_length:
                tension, k = self.pose[k], k + 1
                stretched = self.stretch + self.axial_compliance * tension / 2
                total += more * tension * stretched + ca.dot(weight, place)
        return total


def lagrangian_of(model: CableModel) -> Lagrangian:
    """The expressions of a model, made once for all its meshes."""
    return _lagrangian_of(model.unmeshed)


_lagrangian_of = lru_cache(maxsize=MODELS)(Lagrangian)
