"""A step in time as one CasADi function, with derivatives by the implicit function theorem.

The unknowns of a step are those of `MovingCable`: increments X of the nodes that no fixture holds,
forces and moments. Newton's method solves their balance R = 0 with

    dR/dX = K T^-1 + c_1 C + c_2 M,    T^-1 = (I - [X]_x / 2) / (1 + |X|^2 / 4)

where T^-1 stands in the columns of turns, because K is by turns about the nodes' own axes.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.sparse import csc_matrix

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.steps import NEWTON_STEPS, SCHEME, Moving
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.ends import EndConditions
from dlo_casadi.rod.node import Node

# Newton's last step in units of the unknowns: what is left is about its square.
_LAST = 1e-7
# Residual in its units from which a step is no solution: a converged one leaves 1e-8 at most.
_BALANCED = 1e-5


def state_sizes(node: type[Node]) -> list[int]:
    """Rows of a node's state: frame, place, rates, their changes, the method's own changes."""
    moving = node.increment + node.dimension
    return [node.coordinates, node.dimension, moving, moving, moving]


def state_vector(moving: Moving) -> FloatArray:
    """A state as `step_function` takes it, node by node."""
    now = moving.state
    return np.hstack([now.x, now.r, moving.rates, moving.accelerations, moving.own]).ravel()


def fixtures_vector(cable: MovingCable, fixtures: Fixtures) -> FloatArray:
    """Fixtures as `step_function` takes them."""
    pose = fixtures.pose[: EndConditions.size(cable.model.node)]
    return np.concatenate(
        [pose, fixtures.velocities[:2].ravel(), fixtures.accelerations[:2].ravel()]
    )


def step_function(cable: MovingCable, dt: float) -> ca.Function:
    """(state, fixtures) -> next, end_force, start_force, places, see `CableInMotion.step`."""
    step, d = _Step(cable, dt), cable.d
    # The rest is below all errors in time; the residual itself has no common unit.
    ended = {"abstol": 0.0, "abstolStep": _LAST, "max_iter": NEWTON_STEPS}
    options: dict[str, Any] = {
        "jacobian_function": step.by_unknowns,
        "error_on_fail": False,
        **ended,
    }
    solver = ca.rootfinder("solver", "fast_newton", step.balance, options)
    state, fixtures = (ca.MX.sym(name, size) for name, size in step.given.items())
    given = ca.vertcat(state, fixtures)
    found = solver(ca.DM.zeros(cable.size), given)
    left = ca.norm_inf(step.balance(found, given) / step.units)
    after, forces = (
        ca.if_else(left < _BALANCED, x, ca.DM.nan(x.shape)) for x in step.after(found, given)
    )
    rows = state_sizes(step.node)
    places = ca.reshape(after, -1, cable.n_nodes)[rows[0] : rows[0] + d, :]
    names = ["next", "end_force", "start_force", "places"]
    outputs = [after, forces[d:], forces[:d], places]
    return ca.Function("step", [state, fixtures], outputs, ["state", "fixtures"], names)


class _Moved(NamedTuple):
    """The end of a step: rows of the nodes (rows, n_nodes), increments X, forces, moments, pose."""

    x: ca.MX
    r: ca.MX
    rates: ca.MX
    changed: ca.MX
    own: ca.MX
    turns: ca.MX
    force: ca.MX
    moment: ca.MX
    pose: ca.MX


class _Step:
    """Expressions of one step dt [s] of a cable."""

    def __init__(self, cable: MovingCable, dt: float) -> None:
        self.cable, self.dt, self.scheme = cable, dt, SCHEME
        self.node, self.size = cable.model.node, cable.size

    @property
    def given(self) -> dict[str, int]:
        """Sizes of state and fixtures."""
        state = sum(state_sizes(self.node)) * self.cable.n_nodes
        return {"state": state, "fixtures": EndConditions.size(self.node) + 4 * self.cable.d}

    @property
    def energy(self) -> float:
        """The larger of weight times length and EI over length [J]."""
        model, length = self.cable.model, self.cable.model.cable.length
        weight = model.cable.mass * float(np.linalg.norm(model.gravity))
        return max(weight * length, float(self.cable.p[model.stiffness_indices[0]]) / length)

    @cached_property
    def scale(self) -> FloatArray:
        """Units of the unknowns (size,): rad, lengths, energy over these."""
        cable, (nodes, forces, moments, size) = self.cable, self.cable.places
        model, length, d = cable.model, cable.model.cable.length, cable.d
        force = self.energy / length
        scale = np.ones(size + 1)
        scale[nodes[:, cable.b :]], scale[forces], scale[moments] = length, force, force * length
        for k in range(model.n_springs):  # each has its place before its force
            scale[forces[:, d * (1 + 2 * k) : d * (2 + 2 * k)]] = length
        return scale[:size]

    @property
    def units(self) -> FloatArray:
        """Units of the residual (size,): an energy over those of the unknowns."""
        return self.energy / self.scale

    # ---- the balance -----------------------------------------------------------------------------

    @cached_property
    def balance(self) -> ca.Function:
        """(u, given) -> residual."""
        u, given = self._symbols
        moved = self.moved(u, given)
        residual = self._summed(self._of_segments(moved), self._of_ends(moved))
        names = ["u", "given"], ["residual"]
        # Many directions at once go through the sparse derivative, not through every segment.
        return ca.Function("balance", [u, given], [residual], *names, {"jac_penalty": 0.05})

    @cached_property
    def by_unknowns(self) -> ca.Function:
        """(u, given) -> derivative of the residual by u, residual."""
        u, given = self._symbols
        moved, (sparsity, summed) = self.moved(u, given), self._pattern
        rows, blocks = self._segment.map(self.cable.n_segments).call(
            [*self._arguments(moved), _both(moved.turns)]
        )
        residual = self._summed(rows, self._of_ends(moved))
        values = _matrix(summed) @ ca.vertcat(ca.vec(blocks), ca.vec(self._ends_by(moved)))
        outputs = [ca.MX(sparsity, values) @ ca.diag(ca.DM(self.scale)), residual]
        names = ["derivative", "residual"]
        return ca.Function("by_unknowns", [u, given], outputs, ["u", "given"], names)

    @property
    def _symbols(self) -> tuple[ca.MX, ca.MX]:
        return ca.MX.sym("u", self.size), ca.MX.sym("given", sum(self.given.values()))

    def _summed(self, segments: ca.MX, ends: ca.MX) -> ca.MX:
        return _matrix(self.cable.gathering) @ ca.vertcat(ca.vec(segments), ends)

    @cached_property
    def _pattern(self) -> tuple[ca.Sparsity, csc_matrix]:
        """Where the derivative is not zero, and the matrix that sums blocks there."""
        rows, columns = [], []
        for index in map(np.atleast_2d, self.cable.index):
            shape = (*index.shape, index.shape[1])
            rows.append(np.broadcast_to(index[:, None, :], shape).ravel())
            columns.append(np.broadcast_to(index[:, :, None], shape).ravel())
        row, column, size = np.concatenate(rows), np.concatenate(columns), self.size
        inside = np.flatnonzero((row >= 0) & (column >= 0))
        places, own = np.unique(column[inside] * size + row[inside], return_inverse=True)
        summed = csc_matrix((np.ones(len(inside)), (own, inside)), (len(places), len(row)))
        row_of, column_of = (places % size).tolist(), (places // size).tolist()
        return ca.Sparsity.triplet(size, size, row_of, column_of), summed

    def _arguments(self, moved: _Moved) -> list[Any]:
        """Of the functions of the segments."""
        b, rates, changed = self.cable.b, moved.rates, moved.changed
        rows = [moved.x, moved.r, rates[:b, :], rates[b:, :], changed[:b, :], changed[b:, :]]
        numbers = [ca.DM(np.ascontiguousarray(x.T)) for x in self.cable.numbers]
        return [*map(_both, rows), moved.force, *numbers]

    def _of_segments(self, moved: _Moved) -> ca.MX:
        """Residual (L, n_segments)."""
        (rows,) = self.cable.segment.residual.map(self.cable.n_segments).call(
            self._arguments(moved)
        )
        return rows

    @cached_property
    def _segment(self) -> ca.Function:
        """(arguments of `MovingSegment.motion`, both X) -> residual, derivative by unknowns."""
        segment, b = self.cable.segment, self.cable.b
        turns = ca.SX.sym("turns", 2 * b)
        factors = ca.DM(self.scheme.factors(self.dt))
        residual, stiffness, rest = segment.motion(*segment.arguments, factors)
        total = ca.horzcat(stiffness[:, : 2 * b] @ self._by_turns(turns), stiffness[:, 2 * b :])
        return ca.Function("implicit", [*segment.arguments, turns], [residual, total + rest])

    def _by_turns(self, turns: Any) -> Any:
        """T^-1 (2 b, 2 b) of both X (2 b,)."""
        b = self.cable.b
        if b == 1:
            return ca.DM.eye(2)
        parts = ca.vertsplit(turns, b)
        inverse = [(ca.DM.eye(b) - ca.skew(x) / 2) / (1 + ca.sumsqr(x) / 4) for x in parts]
        return ca.diagcat(*inverse)

    def _at_ends(self, name: str, moved: _Moved) -> list[ca.MX]:
        """Values of a function of the ends, such as `Functions.at_ends`."""
        cable, model = self.cable, self.cable.model
        lam = ca.MX.zeros(model.n_lam)
        for k, row in enumerate(cable.held_turns):
            lam[row] = moved.moment[k]
        pose = ca.vertcat(moved.pose, ca.MX.zeros(model.n_pose - moved.pose.numel()))
        both = ca.vertcat(moved.x[:, 0], moved.x[:, -1])
        deviation = ca.DM.zeros(len(model.deviation_names))
        return list(getattr(functions_of(model), name).call([both, lam, cable.p, pose, deviation]))

    def _rubbing(self, moved: _Moved) -> tuple[ca.MX, ca.MX]:
        """Moments against both ends' turning, and their derivative."""
        b, rubs = self.cable.b, self.cable.rubs
        if rubs is None:
            return ca.MX(2 * b, 1), ca.MX(2 * b, 2 * b)
        moments, by_rates, _ = rubs(
            ca.vertcat(moved.rates[:b, 0], moved.rates[:b, -1]), self.cable.p
        )
        return moments, by_rates

    def _of_ends(self, moved: _Moved) -> ca.MX:
        """Residual of the ends."""
        rows = self._at_ends("end_slope", moved)[0][self.cable.end_rows]
        rows[: 2 * self.cable.b] += self._rubbing(moved)[0]
        return rows

    def _ends_by(self, moved: _Moved) -> ca.MX:
        """Its derivative by the unknowns."""
        b, kept = self.cable.b, self.cable.end_rows
        hessian = self._at_ends("at_ends", moved)[2][kept, kept]
        rubbing, by_rates = self._rubbing(moved)
        for k in (0, b) if self.node.twists else ():  # as in `MovingSegment.matrices`
            hessian[k : k + b, k : k + b] -= ca.skew(rubbing[k : k + b]) / 2
        turns = ca.vertcat(moved.turns[:, 0], moved.turns[:, -1])
        total = ca.horzcat(hessian[:, : 2 * b] @ self._by_turns(turns), hessian[:, 2 * b :])
        total[: 2 * b, : 2 * b] += self.scheme.factors(self.dt)[0] * by_rates
        return total

    # ---- the end of a step -------------------------------------------------------------------

    def after(self, u: ca.MX, given: ca.MX) -> tuple[ca.MX, ca.MX]:
        """State after the step; forces on what holds the start, then the end."""
        cable, b, d = self.cable, self.cable.b, self.cable.d
        moved = self.moved(u, given)
        outer = [x[:, [0, -1]] for x in self._arguments(moved)]
        (rows,) = cable.segment.residual.map(2).call(outer)
        first, last = rows[2 * b : 2 * b + d, 0], rows[2 * b + d : 2 * (b + d), 1]
        start = functions_of(cable.model).dead_load(cable.p) - first
        end = -last if cable.model.end.place else ca.MX.zeros(d)
        parts = ca.vertcat(moved.x, moved.r, moved.rates, moved.changed, moved.own)
        return ca.vec(parts), ca.vertcat(start, end)

    def moved(self, u: ca.MX, given: ca.MX) -> _Moved:
        """Where the unknowns u, in their units, lead from what is given."""
        cable, dt, scheme, b = self.cable, self.dt, self.scheme, self.cable.b
        nodes, forces, moments, _ = cable.places
        known = ca.vertcat(ca.DM(self.scale) * u, 0)  # zero for what is no unknown
        step, force = (_taken(known, index) for index in (nodes, forces))
        state, pose, *moving = self._parts(given)
        rows = ca.reshape(state, -1, cable.n_nodes)
        edges = np.cumsum([0, *state_sizes(self.node)]).tolist()
        frame, place, rates_0, changed_0, own_0 = ca.vertsplit(rows, edges)
        own = ((step / dt - rates_0) / dt - (0.5 - scheme.beta) * own_0) / scheme.beta
        share = (1 - scheme.alpha_m) * own + scheme.alpha_m * own_0
        changed = (share - scheme.alpha_f * changed_0) / (1 - scheme.alpha_f)
        rates = rates_0 + dt * ((1 - scheme.gamma) * own_0 + scheme.gamma * own)
        clips = ca.DM.zeros(cable.d, len(self._clips))
        velocities, accelerations = (
            ca.horzcat(ca.reshape(one, cable.d, 2), clips) for one in moving
        )
        x, by = ca.SX.sym("x", self.node.coordinates), ca.SX.sym("by", b)
        turned = ca.Function("turned", [x, by], [self.node.moved(x, by)]).map(cable.n_nodes)
        return _Moved(
            turned(frame, step[:b, :]),
            self._with(place + step[b:, :], self._true_places(pose)),
            ca.vertcat(rates[:b, :], self._with(rates[b:, :], velocities)),
            ca.vertcat(changed[:b, :], self._with(changed[b:, :], accelerations)),
            ca.vertcat(own[:b, :], self._with(own[b:, :], accelerations)),
            step[:b, :],
            force,
            known[moments.tolist()],
            pose,
        )

    def _parts(self, given: ca.MX) -> list[ca.MX]:
        """State, pose, velocities and accelerations of both fixtures' places."""
        size, d = EndConditions.size(self.node), self.cable.d
        edges = np.cumsum([0, self.given["state"], size, 2 * d, 2 * d]).tolist()
        return list(ca.vertsplit(given, edges))

    def _true_places(self, pose: ca.MX) -> ca.MX:
        """Places (d, 2 + clips) of both fixtures, with their errors, and of clips."""
        cable, d = self.cable, self.cable.d
        deviation = ca.DM.zeros(len(cable.model.deviation_names))
        true, _ = cable.segment.terms.true_ends_and_length(cable.p, pose, deviation)
        return ca.horzcat(ca.reshape(true[: 2 * d], d, 2), ca.DM(self._clips.T))

    @property
    def _clips(self) -> FloatArray:
        """Places (clips, d) [m] of clips."""
        anchors = self.cable.anchors
        return np.zeros((0, self.cable.d)) if anchors is None else anchors.places

    def _with(self, rows: ca.MX, held: ca.MX) -> ca.MX:
        """Rows (d, n_nodes), at held nodes those of the fixtures: of both ends, then of clips."""
        columns = ca.horzsplit(rows)
        for k, node in self.cable.held:
            columns[node] = held[:, k]
        return ca.horzcat(*columns)


def _both(rows: ca.MX) -> ca.MX:
    """Rows of both nodes of each segment."""
    return ca.vertcat(rows[:, :-1], rows[:, 1:])


def _taken(known: ca.MX, index: np.ndarray) -> ca.MX:
    """Values (k, n) by their places (n, k); the last one where there is none."""
    places = (index % known.numel()).ravel().tolist()
    return ca.reshape(known[places], index.shape[1], index.shape[0])


def _matrix(matrix: Any) -> ca.DM:
    return ca.DM(csc_matrix(matrix))
