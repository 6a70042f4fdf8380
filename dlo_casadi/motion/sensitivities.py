"""Derivatives of a motion by parameters and by its first state, exact through the steps of time.

A step fulfils the balance at its end, which is differentiated: with K, C and M there, and with what
is known of the increments from the step before,

    (K + c_1 C + c_2 M) dX = -(K dq + C dv + M da + dR/dp dp)

so that a factorisation of the step's own matrix serves all columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import MODELS, lagrangian_of
from dlo_casadi.motion.state import Fixtures, State
from dlo_casadi.motion.steps import FIRST, SCHEME, Moving, Scheme, Stepper, turned_back, turns_of
from dlo_casadi.motion.system import Balance, MovingCable
from dlo_casadi.rod.ends import EndConditions


@dataclass(frozen=True, eq=False)
class Numbers:
    """Changes of what is given, by q numbers: all but the state.

    Parameters
    ----------
    p : (n_parameters, q)
    rest : (n_segments, 3 strains, q) [1/m]
        See `Chain.rest_inside`.
    turns : (2 increment, q) [rad]
        Of what holds the start's and the end's direction, about its own axes.
    places, velocities, accelerations : (2, dimension, q)
        Of what holds the start's and the end's place.
    """

    p: FloatArray
    rest: FloatArray
    turns: FloatArray
    places: FloatArray
    velocities: FloatArray
    accelerations: FloatArray


@dataclass(frozen=True, eq=False)
class Columns:
    """Derivatives of a `Moving` by q numbers.

    Parameters
    ----------
    turn, place : (n_nodes, increment, q), (n_nodes, dimension, q)
        Turns about the nodes' own axes; changes of places.
    rates, accelerations, own : (n_nodes, increment + dimension, q)
    force, moment : (n_segments, ..., q), (n_moments, q)
    """

    turn: FloatArray
    place: FloatArray
    rates: FloatArray
    accelerations: FloatArray
    own: FloatArray
    force: FloatArray
    moment: FloatArray

    @property
    def moved(self) -> FloatArray:
        """Turns and places (n_nodes, increment + dimension, q)."""
        return np.concatenate([self.turn, self.place], axis=1)


class Tangent:
    """The equations of motion, linearised at a state.

    Attributes
    ----------
    stiffness, damping, mass : (segments (n_segments, L, L), ends)
        K, C and M.
    """

    def __init__(self, cable: MovingCable, state: State, fixtures: Fixtures) -> None:
        self.cable = cable
        stiff, damp, mass, self._by_p, self._by_rest = cable.segments("linear", state)
        _, hessian, rubbing = cable.ends(state, fixtures)
        none = np.zeros_like(hessian)
        self.stiffness, self.damping, self.mass = (stiff, hessian), (damp, rubbing), (mass, none)
        self._ends_by = _ends_by(cable, state, fixtures)

    def solve(
        self,
        c: tuple[float, float],
        turns: FloatArray,
        known: tuple[FloatArray, FloatArray, FloatArray],
        numbers: Numbers,
    ) -> FloatArray:
        """Columns (N, q) of the unknowns.

        `known`: what is known of positions, velocities and accelerations (n_nodes, increment +
        dimension, q).
        """
        right = self.right(known, numbers)
        segments, ends = (
            c[0] * one + c[1] * other for one, other in zip(self.damping, self.mass, strict=True)
        )
        balance = Balance(self.cable, right[:, 0], right[:, :0], self.stiffness, (segments, ends))
        return balance.stepped(turns).solve(-right)

    def right(
        self, known: tuple[FloatArray, FloatArray, FloatArray], numbers: Numbers
    ) -> FloatArray:
        """Change (N, q) of the residual by what is known, see `solve`."""
        cable = self.cable
        total: FloatArray = self._by_p @ numbers.p + self._by_rest @ numbers.rest
        for matrix, columns in zip((self.stiffness, self.damping, self.mass), known, strict=True):
            total = total + matrix[0][:, :, : 2 * (cable.b + cable.d)] @ both_nodes(cable, columns)
        return cable.gathered_columns(total, self._ends(known, numbers))

    def _ends(
        self, known: tuple[FloatArray, FloatArray, FloatArray], numbers: Numbers
    ) -> FloatArray:
        b, (by_p, by_turns) = self.cable.b, self._ends_by
        total = by_p @ numbers.p + by_turns @ numbers.turns
        for matrix, columns in zip((self.stiffness, self.damping), known, strict=False):
            ends = np.concatenate([columns[0, :b], columns[-1, :b]])
            total = total + matrix[1][:, : 2 * b] @ ends
        return total


def both_nodes(cable: MovingCable, columns: FloatArray) -> FloatArray:
    """Turns of both nodes of each segment, then places (n_segments, 2 (b + d), q)."""
    b = cable.b
    parts = [columns[:-1, :b], columns[1:, :b], columns[:-1, b:], columns[1:, b:]]
    return np.concatenate(parts, axis=1)


def stepped(
    before: Moving,
    after: Moving,
    columns: Columns,
    tangent: Tangent,
    numbers: Numbers,
    dt: float,
    scheme: Scheme,
) -> Columns:
    """Derivatives after a step of time from `before` to `after`."""
    cable = tangent.cable
    b, c = cable.b, scheme.factors(dt)
    turned = np.asarray(cable.model.node.difference(before.state.x, after.state.x))
    blocks = turns_of(turned)
    # dX = T (turn after - turned back turn before); rates and accelerations are affine in dX.
    carried = turned_back(turned, columns.turn)
    first = np.concatenate([blocks @ carried, columns.place], axis=1)
    own_0 = -(columns.rates / dt + (0.5 - scheme.beta) * columns.own) / scheme.beta
    rates_0 = columns.rates + dt * ((1 - scheme.gamma) * columns.own + scheme.gamma * own_0)
    share = (1 - scheme.alpha_m) * own_0 + scheme.alpha_m * columns.own
    changed_0 = (share - scheme.alpha_f * columns.accelerations) / (1 - scheme.alpha_f)
    position = np.zeros_like(first)
    rates, changed = rates_0 - c[0] * first, changed_0 - c[1] * first
    held = cable.held
    for k, node in held:
        position[node, b:] = numbers.places[k]
        rates[node, b:] = numbers.velocities[k]
        changed[node, b:] = numbers.accelerations[k]
    found = tangent.solve(c, blocks, (position, rates, changed), numbers)
    turn, place, force, moment = cable.steps(found)
    for k, node in held:
        place[node] = numbers.places[k]
    by_x = np.concatenate([blocks @ turn, place], axis=1)
    moved = by_x - first
    own = own_0 + moved / (scheme.beta * dt**2)
    rates_1, changed_1 = rates + c[0] * by_x, changed + c[1] * by_x
    for k, node in held:
        rates_1[node, b:] = numbers.velocities[k]
        changed_1[node, b:] = own[node, b:] = numbers.accelerations[k]
    return Columns(turn, place, rates_1, changed_1, own, force, moment)


class Stepping(Protocol):
    """Steps in time and derivatives through them: those of Python, or compiled ones."""

    def step(self, before: Moving, fixtures: Fixtures, dt: float) -> Moving | None:
        """The state dt later; None if there is no step."""

    def derived(
        self,
        before: Moving,
        after: Moving,
        columns: Columns,
        fixtures: Fixtures,
        numbers: Numbers,
        dt: float,
    ) -> Columns:
        """Derivatives after a step."""


class Steps:
    """Steps in time of a cable, and derivatives through them."""

    def __init__(self, cable: MovingCable) -> None:
        self._stepper = Stepper(cable, SCHEME)

    def step(self, before: Moving, fixtures: Fixtures, dt: float) -> Moving | None:
        """The state dt later; None if there is no step."""
        return self._stepper.step(before, fixtures, dt)

    def derived(
        self,
        before: Moving,
        after: Moving,
        columns: Columns,
        fixtures: Fixtures,
        numbers: Numbers,
        dt: float,
    ) -> Columns:
        """Derivatives after a step, see `stepped`."""
        tangent = Tangent(self._stepper.cable, after.state, fixtures)
        return stepped(before, after, columns, tangent, numbers, dt, SCHEME)


def started(
    state: State, tried: Moving, columns: Columns, tangent: Tangent, numbers: Numbers, dt: float
) -> Columns:
    """Derivatives of a state whose first accelerations come from a step `tried` of the same dt."""
    none = np.zeros_like(columns.rates)
    still = Moving(state, np.hstack([state.w, state.v]) * 0)
    first = Columns(columns.turn, columns.place, columns.rates, none, none, *_forces(columns))
    after = stepped(still, tried, first, tangent, numbers, dt, FIRST)
    accelerations = after.accelerations
    return Columns(
        columns.turn,
        columns.place,
        columns.rates,
        accelerations,
        accelerations,
        after.force,
        after.moment,
    )


def _forces(columns: Columns) -> tuple[FloatArray, FloatArray]:
    return columns.force, columns.moment


def at_rest(tangent: Tangent, numbers: Numbers) -> Columns:
    """Derivatives of a state of equilibrium."""
    cable = tangent.cable
    b, d, q = cable.b, cable.d, numbers.p.shape[1]
    none = np.zeros((cable.n_nodes, b + d, q))
    position = none.copy()
    for k, node in cable.held:
        position[node, b:] = numbers.places[k]
    unit = np.broadcast_to(np.eye(b), (cable.n_nodes, b, b))
    found = tangent.solve((0.0, 0.0), unit, (position, none, none), numbers)
    turn, place, force, moment = cable.steps(found)
    for k, node in cable.held:
        place[node] = numbers.places[k]
    return Columns(turn, place, none, none, none, force, moment)


def _ends_by(cable: MovingCable, state: State, fixtures: Fixtures) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the ends' rows by p, and by turns of what holds their directions."""
    (found,) = cable.at_ends("end_sensitivity", state, fixtures)
    found, count, first = found[cable.end_rows], len(cable.p), len(cable.p) + cable.d
    if cable.rubs is not None:
        rates = np.concatenate([state.w[0], state.w[-1]])
        found[: 2 * cable.b, :count] += np.array(cable.rubs(rates, cable.p)[2])
    # Deviations are the end's place, then turns of the start and of the end.
    return found[:, :count], found[:, first : first + 2 * cable.b]


def places_by_p(cable: MovingCable, pose: FloatArray) -> FloatArray:
    """Derivative (2, dimension, n_parameters) of the fixtures' true places by p."""
    size, d = EndConditions.size(cable.model.node), cable.d
    deviation = np.zeros(len(cable.model.deviation_names))
    found = _true_places_by_p(cable.model.unmeshed)(cable.p, pose[:size], deviation)
    return np.asarray(found).reshape((2, d, -1))


@lru_cache(maxsize=MODELS)
def _true_places_by_p(model: CableModel) -> ca.Function:
    terms = lagrangian_of(model)
    places = terms.true_ends.vector[: 2 * model.node.dimension]
    arguments = [terms.p, terms.declared_ends, terms.deviation]
    return ca.Function("places_by_p", arguments, [ca.densify(ca.jacobian(places, terms.p))])
