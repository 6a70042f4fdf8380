"""CasADi functions of one segment, of the ends, and of one element boundary.

Every stage differentiates the same expressions, see `lagrangian`. The functions are mapped over the
cable, see `assembly`.
"""

from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from dlo_casadi.effects import MeasurementEffect, StateEffect
from dlo_casadi.model.cable_functions import CableFunctions
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.framed import SegmentNumbers, in_frame
from dlo_casadi.model.lagrangian import MODELS, lagrangian_of
from dlo_casadi.model.stacked import Mapped, simplified
from dlo_casadi.rod.element import Segment
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.in_frame import SegmentDerivatives, SegmentInFrame


class Functions(CableFunctions):
    """CasADi functions of one segment, of the ends and of one station of an `unmeshed` model."""

    def __init__(self, model: CableModel) -> None:
        super().__init__(lagrangian_of(model))
        own, lam, place = self.terms, self.terms.lam, self.terms.place
        self._segment_arguments = [own.x, lam, own.p, own.rest_strains, place, own.deviation]
        self._end_arguments = [own.x, lam, own.p, own.pose, own.deviation]
        # Variables of the first and second derivatives; values by which gradients of segments are
        # also differentiated.
        self._by = ca.vertcat(own.delta, lam)
        self._numbers = ca.vertcat(own.p, own.rest_strains, own.deviation)
        self._edges = place[:2]  # where nodes are moved: arc lengths of the segment's ends
        self._mapped: dict[str, Mapped] = {}
        self._compact: dict[str, ca.Function] = {}

    def mapped(self, name: str) -> Mapped:
        """The function of that name over many segments (or nodes) of many poses."""
        if name not in self._mapped:
            self._mapped[name] = Mapped(getattr(self, name), repetitive=self._is_repetitive(name))
        return self._mapped[name]

    def compact(self, name: str) -> ca.Function:
        """The function of that name as a part of larger expressions.

        Repeated operations are removed if there are many.
        """
        if not self._is_repetitive(name):
            return getattr(self, name)
        if name not in self._compact:
            self._compact[name] = simplified(getattr(self, name))
        return self._compact[name]

    def _is_repetitive(self, name: str) -> bool:
        """Whether half of its operations are repeated: with a law of the bend; else a fifth is."""
        return self.terms.has_law_of_bend and name.startswith(("segment", "edge"))

    def _here(self, name: str, arguments: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
        """A function at zero increments, with dense outputs."""
        delta = self.terms.delta
        still = ca.SX.zeros(delta.shape)
        # Checking costs a tenth of substituting.
        here = [ca.substitute(x, delta, still) if ca.depends_on(x, delta) else x for x in outputs]
        dense = [ca.densify(one) for one in here]
        return ca.Function(name, arguments, dense)

    def _of_segment(self, name: str, *outputs: ca.SX) -> ca.Function:
        return self._here(name, self._segment_arguments, list(outputs))

    def _of_ends(self, name: str, *outputs: ca.SX) -> ca.Function:
        return self._here(name, self._end_arguments, list(outputs))

    @cached_property
    def _gradient(self) -> ca.SX:
        """Gradient (2b + k,) of the Lagrangian of a segment."""
        if self.kind.framed:
            return self._of_forces @ self._about_nodes.gradient
        return ca.gradient(self.terms.segment_terms.lagrangian, self._by)

    @cached_property
    def segment(self) -> ca.Function:
        """(x, lam, p, rest, place, deviation) -> L_e, its gradient (2b + k,) and Hessian."""
        if self.kind.framed:
            found, spread = self._about_nodes, self._of_forces
            value, hessian = found.value, spread @ found.hessian @ spread.T
        else:
            value = self.terms.segment_terms.lagrangian
            hessian, _ = ca.hessian(value, self._by)
        return self._of_segment("segment", value, self._gradient, hessian)

    @cached_property
    def segment_slope(self) -> ca.Function:
        """As `segment` -> its gradient alone, in far fewer operations."""
        return self._of_segment("segment_slope", self._gradient)

    @cached_property
    def segment_by_share(self) -> ca.Function:
        """(x, lam, p, rest, place, deviation, shares) -> L_e and advance: see `shares`."""
        terms = self.terms.segment_terms_by_share
        arguments = [*self._segment_arguments, self.terms.share_symbols]
        return self._here("segment_by_share", arguments, [terms.lagrangian, terms.advance])

    @cached_property
    def segment_potential(self) -> ca.Function:
        """(x, lam, p, rest, place, deviation, inner) -> energy [J] to minimise, and conditions.

        The segment's part (n_border,) of the conditions on places is the gradient by the
        multipliers. The internal unknowns are those of the element and, for an extensible cable,
        a_e with the axial strain sqrt(C) a_e and the energy h a_e^2 / 2.
        """
        kind, inner = self.kind, self.terms.inner
        unknowns = ca.SX.sym("unknowns", self.model.n_inner)
        ratio, axial = self.terms.stretch, ca.SX(0)
        if self.model.extensible:
            axial = unknowns[0]
            ratio = ratio + ca.sqrt(self.terms.axial_compliance) * axial
        segment = self.terms.segment(ratio, inner, inner**2)
        energy = self.terms.segment_energy(segment)
        energy = kind.expanded(segment, energy, self.terms.elastic_energy)
        energy += self.terms.length * axial**2 / 2
        own = ca.reshape(unknowns[self.model.n_inner - kind.n_inner :], inner.shape)
        reached = ca.gradient(self.terms.work_of_multipliers(segment), self.terms.lam)
        outputs = ca.substitute([energy, reached], [inner], [own])
        arguments = [*self._segment_arguments, unknowns]
        return self._here("segment_potential", arguments, self.terms.with_shares(outputs))

    @cached_property
    def _framed(self) -> SegmentInFrame:
        """The segment in space, in terms of this model's own symbols."""
        free, lam = not self.terms.end_pull, self.terms.lam
        multipliers = [ca.SX.zeros(3)] * free + [lam[rows] for rows in self._force_rows]
        _, _, p, rest, place, deviation = self._segment_arguments
        numbers = SegmentNumbers(p, rest, place, deviation, ca.SX(self.terms.shares(p, place)))
        return in_frame(self.terms, self.terms.x, ca.horzcat(*multipliers), numbers)

    @property
    def _force_rows(self) -> list[list[int]]:
        """Border rows of the forces on the end's holder, on springs and on clips."""
        return [rows for rows in (self.terms.end_pull, *self.terms.pulls) if rows]

    @cached_property
    def _about_nodes(self) -> SegmentDerivatives:
        """Derivatives by rotations about the nodes' own axes."""
        framed = self._framed
        return framed.derivatives().about(*framed.node_turns)

    @property
    def _of_forces(self) -> ca.DM:
        """Matrix from both nodes and these forces to both nodes and the border."""
        every = np.eye(6 + self.model.n_lam)
        none = [np.zeros((len(every), 3))] * (not self.terms.end_pull)
        forces = [every[:, 6 + np.array(rows)] for rows in self._force_rows]
        return ca.sparsify(ca.DM(np.hstack([every[:, :6], *none, *forces])))

    @cached_property
    def at_ends(self) -> ca.Function:
        """(x, lam, p, pose, deviation) of the first and last node -> as `segment`."""
        hessian, gradient = ca.hessian(self._of_both, self._by)
        return self._of_ends("at_ends", self._of_both, gradient, hessian)

    @property
    def _of_both(self) -> ca.SX:
        """Lagrangian of the ends."""
        return self.terms.ends_lagrangian + self.terms.feeding

    @cached_property
    def end_slope(self) -> ca.Function:
        """As `at_ends` -> its gradient alone."""
        return self._of_ends("end_slope", ca.gradient(self._of_both, self._by))

    @cached_property
    def end_shape(self) -> ca.Function:
        """As `at_ends` -> Lagrangian of the ends, forces and moments on both holders.

        The forces (dimension, 2) [N] and moments (increment, 2) [N m] are those of `Equilibrium`.
        """
        rows, sides = reaction_rows(self.node), ("start", "end")
        forces = [self._reactions[rows[f"{side}_force"]] for side in sides]
        moments = [self._reactions[rows[f"{side}_moment"]] for side in sides]
        value = self._of_both
        return self._of_ends("end_shape", value, ca.horzcat(*forces), ca.horzcat(*moments))

    @cached_property
    def segment_sensitivity(self) -> ca.Function:
        """As `segment` -> derivative of the gradient by p, rest and deviation (2b + k, ...)."""
        return self._of_segment("segment_sensitivity", self._gradient_by(self._numbers))

    @cached_property
    def _by_edges(self) -> ca.SX:
        """Derivatives (2,) [N] of a segment's Lagrangian by the arc lengths of its ends."""
        terms = self.terms.segment_terms
        value = self._about_nodes.value if self.kind.framed else terms.lagrangian
        return ca.gradient(value, self._edges)

    @cached_property
    def edge_slope(self) -> ca.Function:
        """As `segment` -> `_by_edges`."""
        return self._of_segment("edge_slope", self._by_edges)

    @cached_property
    def segment_by_edges(self) -> ca.Function:
        """As `segment` -> derivatives by the ends' arc lengths: of the gradient, once and twice.

        That of the gradient is (2b + k, 2); the others are `_by_edges`, the configurational forces
        at both ends, and (2, 2).
        """
        twice = ca.jacobian(self._by_edges, self._edges)
        outputs = self._gradient_by(self._edges), self._by_edges, twice
        return self._of_segment("segment_by_edges", *outputs)

    @cached_property
    def edge_sensitivity(self) -> ca.Function:
        """As `segment` -> derivatives (2, ...) of `_by_edges` by p, rest and deviation."""
        return self._of_segment("edge_sensitivity", ca.jacobian(self._by_edges, self._numbers))

    def _gradient_by(self, numbers: ca.SX) -> ca.SX:
        """Derivative (2b + k, a) of the gradient of a segment by other numbers (a,)."""
        if not self.kind.framed:
            return ca.jacobian(self._gradient, numbers)
        first, last, by_lam = self._framed.by_numbers(numbers)
        turns = self._framed.node_turns
        return self._of_forces @ ca.vertcat(turns[0] @ first, turns[1] @ last, by_lam)

    @cached_property
    def end_sensitivity(self) -> ca.Function:
        """As `at_ends` -> derivative of the gradient by p and deviation (2b + k, ...)."""
        gradient = ca.gradient(self._of_both, self._by)
        numbers = ca.vertcat(self.terms.p, self.terms.deviation)
        return self._of_ends("end_sensitivity", ca.jacobian(gradient, numbers))

    @cached_property
    def _advanced(self) -> ca.SX:
        """True advance of a segment and its `_rates`."""
        return ca.vertcat(self.terms.segment_terms.advance, self._rates)

    @cached_property
    def _rates(self) -> ca.SX:
        """Length ratio of a segment and, in a plane, its curvature d phi / ds [1/m]."""
        if self.node.increment > 1:  # no map of the measurement depends on a frame
            return self.terms.segment_terms.ratio
        turning = self.terms.stretch * self.kind.strain(self._plain)
        return ca.vertcat(self.terms.segment_terms.ratio, turning)

    @cached_property
    def segment_curve(self) -> ca.Function:
        """As `segment` -> advance [m], length ratio and, in a plane, curvature [1/m]."""
        return self._of_segment("segment_curve", self._advanced)

    @cached_property
    def segment_curve_slopes(self) -> ca.Function:
        """As `segment` -> the same, derivatives by increments, lam, and by p, rest, deviation."""
        if self.kind.framed:
            # The advance is the derivative of the Lagrangian by the force on the end's holder.
            by_nodes = (self._of_forces @ self._about_nodes.hessian)[:, 6:9].T
            moving = ca.vertcat(by_nodes, ca.jacobian(self._rates, self._by))
        else:
            moving = ca.jacobian(self._advanced, self._by)
        blocks = moving, self._advanced_by(self._numbers)
        return self._of_segment("segment_curve_slopes", self._advanced, *blocks)

    @cached_property
    def curve_by_edges(self) -> ca.Function:
        """As `segment_curve` -> its derivatives by the arc lengths of the segment's ends."""
        return self._of_segment("curve_by_edges", self._advanced_by(self._edges))

    def _advanced_by(self, numbers: ca.SX) -> ca.SX:
        """Derivative of `_advanced` by other numbers (a,)."""
        if not self.kind.framed:
            return ca.jacobian(self._advanced, numbers)
        advance = self._framed.by_numbers(numbers)[2][:3, :]
        return ca.vertcat(advance, ca.jacobian(self._rates, numbers))

    @cached_property
    def _seen(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        """Arguments of one station, its measured place (and dr/ds), and the variables of both."""
        kind, node = self.kind, self.node
        point, rates = ca.SX.sym("point", node.dimension), ca.SX.sym("rates", self._rates.numel())
        frame = ca.SX.sym("frame", node.coordinates)
        tangent = rates[0] * node.tangent(frame)
        image = point
        maps = self.terms.effects_of(MeasurementEffect)
        for effect, local in maps:
            image = effect.observe(image, frame, self.terms.viewpoint, local)
        rows = image
        if kind.smooth:
            tangent = ca.jtimes(image, point, tangent) if maps else tangent
            for turning in ca.vertsplit(rates)[1:]:
                tangent += ca.jtimes(image, frame, turning)
            rows = ca.vertcat(image, tangent)
        rows = ca.substitute(rows, frame, node.middle(*self.terms.moved))
        arguments = [point, rates, self.terms.x, self.terms.p, self.terms.pose]
        return arguments, rows, ca.vertcat(point, rates, self.terms.delta)

    @cached_property
    def station(self) -> ca.Function:
        """(point, rates, x, p, ends) of an element boundary -> measured place, and dr/ds there."""
        arguments, rows, _ = self._seen
        return self._here("station", arguments, [rows])

    @cached_property
    def station_slopes(self) -> ca.Function:
        """As `station` -> the same, derivatives by (point, rates, increments) and by p."""
        arguments, rows, moving = self._seen
        blocks = [ca.jacobian(rows, symbols) for symbols in (moving, self.terms.p)]
        return self._here("station_slopes", arguments, [rows, *blocks])

    @cached_property
    def segment_shape(self) -> ca.Function:
        """As `segment` -> L_e, advance [m], mean strains of the cell [1/m]."""
        terms, strain = self.terms.segment_terms, self.kind.strain(self._plain)
        return self._of_segment("segment_shape", terms.lagrangian, terms.advance, strain)

    @cached_property
    def segment_strain(self) -> ca.Function:
        """As `segment` -> mean strains of the cell [1/m]."""
        return self._of_segment("strain", self.kind.strain(self._plain))

    @property
    def _plain(self) -> Segment:
        """The segment without its inner unknowns."""
        inner = ca.SX.zeros(self.terms.inner.shape)
        return self.terms.segment(self.terms.stretch, inner, ca.SX(0))

    @cached_property
    def segment_state(self) -> ca.Function:
        """As `segment` -> rest strains of the cell after the pose, and their derivatives.

        The derivatives are by increments, rest, p and deviation.
        """
        own, mean = self.terms.rest_strains[::3], self._mean_after
        rest = ca.SX.sym("mean", own.numel())
        mean = ca.substitute(mean, own, rest)
        by = (self.terms.delta, rest, self.terms.p, self.terms.deviation)
        slopes = [ca.jacobian(mean, symbols) for symbols in by]
        mean, *slopes = ca.substitute([mean, *slopes], [rest], [own])
        return self._of_segment("segment_state", mean, *slopes)

    @cached_property
    def state_by_edges(self) -> ca.Function:
        """As `segment_state` -> derivatives of the rest strains after by the ends' arc lengths."""
        return self._of_segment("state_by_edges", ca.jacobian(self._mean_after, self._edges))

    @property
    def _mean_after(self) -> ca.SX:
        """Rest strains of the cell after the pose."""
        mean, strain = self.terms.rest_strains[::3], self.kind.strain(self._plain)
        for effect, local in self.terms.effects_of(StateEffect):
            mean = effect.next_rest(mean, strain, self.model.cable, local)
        return mean

    @cached_property
    def _reactions(self) -> ca.SX:
        """Forces [N] and moments [N m] of the cable on its fixtures, see `ends.reaction_rows`.

        Forces on ends are minus the gradient of the Lagrangian by the ends' places, at fixed nodes
        and multipliers; those on clips are multipliers. Moments are about the world's axes: the
        gradient of the holders' part of the Lagrangian (multipliers of clamps, springs of pins) by
        rotations of the first and last node.
        """
        node, x, delta = self.node, self.terms.x, self.terms.delta
        places = -ca.gradient(self.terms.ends_lagrangian, self.terms.pose)[: 2 * node.dimension]
        turns = ca.gradient(self.terms.ends_lagrangian, delta)
        places, turns = ca.substitute([places, turns], [delta], [ca.SX.zeros(delta.shape)])
        pairs = zip(
            ca.vertsplit(places, node.dimension),
            ca.vertsplit(x, node.coordinates),
            ca.vertsplit(turns, node.increment),
            strict=True,
        )
        here = [row for force, own, turn in pairs for row in (force, node.to_world(own, turn))]
        clips = (self.terms.lam[rows] for rows in self.model.pulls[self.model.n_springs :])
        return ca.substitute(ca.vertcat(*here, *clips), x, ca.vertcat(*self.terms.moved))

    @cached_property
    def moment_ends(self) -> tuple[str, ...]:
        """The ends whose fixtures take a moment: clamps, and pins with springs."""
        rows = reaction_rows(self.node)
        moments = {side: self._reactions[rows[f"{side}_moment"]] for side in ("start", "end")}
        return tuple(side for side, moment in moments.items() if not moment.is_zero())

    @cached_property
    def reactions(self) -> ca.Function:
        """As `at_ends` -> `ends.reaction_rows` in one column [N, N m]."""
        return self._of_ends("reactions", self._reactions)

    @cached_property
    def _readings(self) -> ca.SX:
        """`_reactions` as the sensors measure them."""
        rows, of = self._reactions, reaction_rows(self.node, len(self.model.clips))
        for effect, local in self.terms.effects_of(MeasurementEffect):
            parts = effect.feel({name: rows[at] for name, at in of.items()}, local)
            rows = ca.vertcat(*(parts[name] for name in of))
        return rows

    @cached_property
    def readings(self) -> ca.Function:
        """As `reactions` -> the same as measured by sensors."""
        return self._of_ends("readings", self._readings)

    @cached_property
    def reading_slopes(self) -> ca.Function:
        """As `readings` -> derivatives by increments and multipliers, by p, and by deviation."""
        by = (self._by, self.terms.p, self.terms.deviation)
        return self._of_ends("reading_slopes", *(ca.jacobian(self._readings, one) for one in by))


def functions_of(model: CableModel) -> Functions:
    """The functions of a model, made once for all its meshes."""
    return _functions_of(model.unmeshed)


_functions_of = lru_cache(maxsize=MODELS)(Functions)
