"""CableModel: a chain and its effects, composed slot by slot into one Lagrangian.

Every stage differentiates the same expressions, see `lagrangian`: all that a slot, an end or a
node adds is one CasADi function each, mapped over the cable, see `assembly`.
"""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from dlo_casadi.effects import Load, MeasurementEffect, StateEffect
from dlo_casadi.model.assembly import Assembly
from dlo_casadi.model.lagrangian import Lagrangian, SlotNumbers
from dlo_casadi.rod.element import Slot
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.in_frame import SlotDerivatives, SlotInFrame


class CableModel(Lagrangian):
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

    @property
    def _slot_arguments(self) -> list[ca.SX]:
        x, _ = self._nodes
        return [x, self._lam, self._p, self._rest, self._place, self._deviation]

    @property
    def _end_arguments(self) -> list[ca.SX]:
        x, _ = self._nodes
        return [x, self._lam, self._p, self._pose, self._deviation]

    def _here(
        self, name: str, arguments: list[ca.SX], outputs: list[ca.SX], *, often: bool = True
    ) -> ca.Function:
        """A function at increments of zero, its outputs dense.

        What is evaluated often is worth the search for common subexpressions: it takes away a
        fifth of the operations, and of many effects' derivatives longer than the evaluation.
        """
        local, step = self._local
        _, delta = self._nodes
        symbols = [step, delta, local]
        values = [ca.SX.zeros(step.shape), ca.SX.zeros(delta.shape), self._local_of_nodes]
        found = ca.substitute(outputs, symbols, values)
        found = ca.cse(found) if often else found
        return ca.Function(name, arguments, [ca.densify(one) for one in found])

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
    def slot_by_share(self) -> ca.Function:
        """(x, lam, p, rest, place, deviation, shares) -> L_e and advance: see `shares`."""
        terms = self._terms_by_share
        arguments = [*self._slot_arguments, self._shares]
        return self._here("slot_by_share", arguments, [terms.lagrangian, terms.advance])

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
        return self._here("slot_sensitivity", self._slot_arguments, [mixed], often=False)

    @cached_property
    def end_sensitivity(self) -> ca.Function:
        """As `at_ends` -> derivative of the gradient by p and deviation (2b + k, ...)."""
        by = ca.vertcat(self._p, self._deviation)
        mixed = ca.jacobian(ca.gradient(self._at_ends, self._by_ends), by)
        return self._here("end_sensitivity", self._end_arguments, [mixed])

    @cached_property
    def _advanced(self) -> ca.SX:
        """True advance of a slot and its `_rates`."""
        return ca.vertcat(self._terms.advance, self._rates)

    @cached_property
    def _rates(self) -> ca.SX:
        """Length ratio of a slot and, in a plane, its turning d phi / ds [1/m]."""
        if self.in_space:  # no map of the measurement depends on the frame there
            return self._terms.ratio
        turning = self._stretch * self.chain.kind.strain(self._plain)
        return ca.vertcat(self._terms.ratio, turning)

    @cached_property
    def slot_curve(self) -> ca.Function:
        """As `slot` -> advance [m], length ratio and, in a plane, turning [1/m]."""
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
        outputs = [self._advanced, *blocks]
        return self._here("slot_curve_slopes", self._slot_arguments, outputs, often=False)

    @cached_property
    def _seen(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        """Arguments, place (and slope) in the measurement of one station, and what moves it."""
        kind = self.chain.kind
        x, delta = self._nodes
        point, rates = (
            ca.SX.sym("point", self.node.dimension),
            ca.SX.sym("rates", self._rates.numel()),
        )
        before, after = (
            self.node.retract(own, step)
            for own, step in zip(
                ca.vertsplit(x, x.numel() // 2),
                ca.vertsplit(delta, delta.numel() // 2),
                strict=True,
            )
        )
        frame = ca.SX.sym("frame", self.node.coordinates)
        slope = rates[0] * self.node.tangent(frame)
        image = point
        maps = self._filling(MeasurementEffect)
        for effect, local in maps:
            image = effect.observe(image, frame, self._sight, local)
        rows = image
        if kind.smooth:
            slope = ca.jtimes(image, point, slope) if maps else slope
            for turning in ca.vertsplit(rates)[1:]:
                slope += ca.jtimes(image, frame, turning)
            rows = ca.vertcat(image, slope)
        rows = ca.substitute(rows, frame, self.node.middle(before, after))
        arguments = [point, rates, x, self._p, self._pose]
        return arguments, rows, ca.vertcat(point, rates, delta)

    @cached_property
    def station(self) -> ca.Function:
        """(point, rates, x, p, ends) of an element boundary -> its image: place, slope dr/ds."""
        arguments, rows, _ = self._seen
        return self._here("station", arguments, [rows])

    @cached_property
    def station_slopes(self) -> ca.Function:
        """As `station` -> the same, derivatives by (point, rates, increments) and by p."""
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
