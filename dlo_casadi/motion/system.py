"""The whole cable in motion: segments and ends assembled into one banded system."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.sparse import csr_array

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import Damping
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion.anchors import Anchors
from dlo_casadi.motion.segment import MovingSegment, moving_segment, refuse_still
from dlo_casadi.motion.state import Banded, Fixtures, State
from dlo_casadi.motion.unknowns import Unknowns
from dlo_casadi.rod.ends import EndConditions

# Newton steps that bow segments to known places, and the share of the softest direction of a force
# below which a direction counts as stiff: along a segment it cannot give way.
_BOWED, _STIFF = 3, 1e-4


@dataclass(frozen=True, eq=False)
class Balance:
    """Residual (N,) of the equations of motion, and its derivatives.

    `rows`: of the segments (n_segments, L), before they are summed. `stiffness`, `damping`: K, and
    c_1 C + c_2 M, of the segments (n_segments, L, L) and of the ends.
    """

    cable: MovingCable
    residual: FloatArray
    rows: FloatArray
    stiffness: tuple[FloatArray, FloatArray]
    damping: tuple[FloatArray, FloatArray]

    def band(self, *parts: tuple[FloatArray, FloatArray]) -> FloatArray:
        """The sum of parts as a band, see `Banded`."""
        return self.cable.band(*(sum(both) for both in zip(*parts, strict=True)))

    def stepped(self, turns: FloatArray) -> Banded:
        """K + (c_1 C + c_2 M) T for blocks T (n_nodes, increment, increment) of turns."""
        b, (of_segment, at_ends) = self.cable.b, map(np.copy, self.damping)
        ends = (turns[:-1], turns[1:]), (turns[0], turns[-1])
        for matrix, both in zip((of_segment, at_ends), ends, strict=True):
            for k, block in enumerate(both):
                own = slice(k * b, (k + 1) * b)
                matrix[..., own] = matrix[..., own] @ block
        return Banded(self.band(self.stiffness, (of_segment, at_ends)), self.cable.width)


class MovingCable(Unknowns):
    """A model with its parameters, on its mesh, ready to be evaluated in motion.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
    still : (n_segments, 2 strains) [1/m], optional
        Strains at rest, see `MovingSegment.still`.
    anchors : Anchors, optional
        What clips hold; the model is that of the cable without them.

    Raises
    ------
    DloError
        If the model has a part that motion does not know: obstacles, a sliding end, links, clips.
    """

    def __init__(
        self,
        model: CableModel,
        p: FloatArray,
        rest: FloatArray,
        still: FloatArray | None = None,
        anchors: Anchors | None = None,
    ) -> None:
        refuse_still(model)
        super().__init__(model, p, anchors)
        self.rest = np.asarray(rest, float)
        self.segment: MovingSegment = moving_segment(model)
        if still is None:
            still = np.zeros((self.n_segments, 2 * len(model.node.strains)))
        self.still = still

    # ---- evaluation ----------------------------------------------------------------------------

    @cached_property
    def numbers(self) -> list[FloatArray]:
        """Arguments of the segments that do not change in motion."""
        chain, count = self.model.chain, self.n_segments
        rest = chain.rest_inside(self.rest[:, None])[..., 0]
        if self.anchors is not None:
            rest = self.anchors.rest_inside(self.model, rest)
        place, deviation = self.layout, np.zeros(len(self.model.deviation_names))
        rows = [np.tile(self.p, (count, 1)), rest, place, np.tile(deviation, (count, 1))]
        return [*rows, self.springs_on, self.still]

    def arguments(self, state: State) -> list[FloatArray]:
        """Arguments (n_segments, ...) of the functions of `MovingSegment`."""

        def both(rows: FloatArray) -> FloatArray:
            return np.concatenate([rows[:-1], rows[1:]], axis=1)

        moving = (state.x, state.r, state.w, state.v, state.alpha, state.a)
        return [*map(both, moving), state.force, *self.numbers]

    def segments(self, name: str, state: State, *more: FloatArray) -> list[FloatArray]:
        """Evaluate a function of `MovingSegment` for all segments (n_segments, rows, columns)."""
        rows = [*self.arguments(state), *more]
        return [out[0] for out in self.segment.mapped(name)(*(row[None] for row in rows))]

    def at_ends(self, name: str, state: State, fixtures: Fixtures) -> list[FloatArray]:
        """Evaluate a function of the ends, such as `Functions.at_ends`; no forces on places."""
        model, (start, end) = self.model, self._condition_rows
        lam = np.zeros(model.n_lam)
        lam[[*start, *end]] = state.moment
        both = np.concatenate([state.x[0], state.x[-1]])
        deviation = np.zeros(len(model.deviation_names))
        rows = (both, lam, self.p, fixtures.pose, deviation)
        found = functions_of(model).mapped(name)(*(row[None, None] for row in rows))
        return [out[0, 0] for out in found]

    def energy_of_ends(self, state: State, fixtures: Fixtures) -> float:
        """Potential energy [J] of the holders, and of dead loads at the start."""
        value = self.at_ends("at_ends", state, fixtures)[0]
        nowhere = np.zeros(self.d)
        # Springs have theirs with the segments, see `MovingSegment`.
        return float(value[0, 0]) - float(self._springs_at(self.p, nowhere))

    @cached_property
    def _springs_at(self) -> ca.Function:
        """(p, place) -> energy [J] of all springs there."""
        place, springs = ca.SX.sym("place", self.d), self.segment.terms.springs
        energy = sum((spring.energy(place) for spring in springs), start=ca.SX(0))
        return ca.Function("springs_at", [self.segment.p, place], [energy])

    def power_of_ends(self, state: State) -> float:
        """Power [W] that friction at the ends takes."""
        if self.rubs is None:
            return 0.0
        rates = np.concatenate([state.w[0], state.w[-1]])
        return float(rates @ np.array(self.rubs(rates, self.p)[0]).ravel())

    def ends(self, state: State, fixtures: Fixtures) -> list[FloatArray]:
        """Gradient, Hessian and damping of the ends, by the unknowns of `index`."""
        b, kept = self.b, self.end_rows
        _, gradient, hessian = self.at_ends("at_ends", state, fixtures)
        damping = np.zeros((len(kept), len(kept)))
        gradient, hessian = gradient[kept, 0], hessian[np.ix_(kept, kept)]
        if self.rubs is not None:
            rates = np.concatenate([state.w[0], state.w[-1]])
            pulled, by_rates, _ = (np.array(x) for x in self.rubs(rates, self.p))
            gradient[: 2 * b] += pulled[:, 0]
            damping[: 2 * b, : 2 * b] += by_rates
            for k in (0, b) if self.model.node.twists else ():  # as in `MovingSegment.matrices`
                own = slice(k, k + b)
                hessian[own, own] -= np.cross(np.eye(b), pulled[own, 0]) / 2
        return [gradient, hessian, damping]

    @cached_property
    def end_rows(self) -> list[int]:
        """Rows of the functions of the ends: turns of both nodes, then directions held."""
        start, end = self._condition_rows
        return [*range(2 * self.b), *(2 * self.b + row for row in (*start, *end))]

    @cached_property
    def rubs(self) -> ca.Function | None:
        """(body rates of both ends, p) -> moments against them, derivatives by both."""
        effects = self.segment.terms.effects_of(Damping)
        rates = ca.SX.sym("rates", 2 * self.b)
        sides = zip((self.model.start, self.model.end), ca.vertsplit(rates, self.b), strict=True)
        total = ca.SX(0)
        for kind, turning in sides:
            if kind.turns:
                total += sum((x.at_pin(turning, local) for x, local in effects), start=ca.SX(0))
        if total.is_zero():
            return None
        hessian, gradient = ca.hessian(total, rates)
        outputs = [gradient, hessian, ca.jacobian(gradient, self.segment.p)]
        return ca.Function("rubs", [rates, self.segment.p], [ca.densify(x) for x in outputs])

    def evaluated(
        self, state: State, fixtures: Fixtures, c: tuple[float, float] = (0.0, 0.0)
    ) -> Balance:
        """The balance of a state, with its derivatives K and c_1 C + c_2 M."""
        factors = np.broadcast_to(np.array(c), (self.n_segments, 2))
        rows, stiff, damp = self.segments("motion", state, factors)
        gradient, hessian, rubbing = self.ends(state, fixtures)
        residual = self.gathered(rows[..., 0], gradient)
        return Balance(self, residual, rows[..., 0], (stiff, hessian), (damp, c[0] * rubbing))

    def residual(self, state: State, fixtures: Fixtures) -> FloatArray:
        """Residual (N,) alone."""
        (rows,) = self.segments("residual", state)
        return self.gathered(rows[..., 0], self.ends(state, fixtures)[0])

    def gathered(self, segments: FloatArray, ends: FloatArray) -> FloatArray:
        """Rows (N,) summed over the segments (n_segments, L) and the ends."""
        index = np.concatenate([self.index[0].ravel(), self.index[1]])
        values = np.concatenate([segments.ravel(), ends])
        total = np.bincount(index % (self.size + 1), values, self.size + 1)
        return np.asarray(total[: self.size], dtype=float)

    def gathered_columns(self, segments: FloatArray, ends: FloatArray) -> FloatArray:
        """The same (N, q) of columns (n_segments, L, q) and (L, q)."""
        rows = np.concatenate([segments.reshape(-1, segments.shape[-1]), ends])
        return np.asarray(self.gathering @ rows)

    @cached_property
    def gathering(self) -> csr_array:
        """The sum as a matrix."""
        index = np.concatenate([self.index[0].ravel(), self.index[1]])
        known = np.flatnonzero(index >= 0)
        return csr_array((0 * known + 1.0, (index[known], known)), (self.size, len(index)))

    def band(self, segments: FloatArray, ends: FloatArray) -> FloatArray:
        """Band (3 width + 1, N) summed over the segments (n_segments, L, L) and the ends."""
        height = 3 * self.width + 1
        total = np.bincount(self._scatter[0], segments.ravel(), height * self.size + 1)
        total = total + np.bincount(self._scatter[1], ends.ravel(), height * self.size + 1)
        return np.asarray(total[:-1].reshape(height, self.size), dtype=float)

    def handles(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Handles (n_segments, 4, d) [m], derivatives (n_segments, 4 d, ...) by nodes and by p."""
        x, r, *_ = self.arguments(state)
        p, _, place = self.numbers[:3]
        z, *by = self.segment.mapped("curve")(*(row[None] for row in (x, r, p, place)))
        return z[0].reshape((-1, 4, self.d)), by[0][0], by[1][0]

    def moved_handles(self, by_place: FloatArray, solution: FloatArray) -> FloatArray:
        """Change (n_segments, 4, d) of the handles along a solution (N,)."""
        turned, shifted, _, _ = self.steps(solution)
        both = [turned[:-1], turned[1:], shifted[:-1], shifted[1:]]
        moved = by_place @ np.concatenate(both, axis=1)[..., None]
        return np.asarray(moved.reshape((-1, 4, self.d)))

    @property
    def slowest(self) -> float:
        """Order of magnitude of the slowest mode [rad/s]: that of a hanging or bent cable."""
        cable = self.model.cable
        stiffness = self.p[self.model.stiffness_indices[0]]
        bent = stiffness / (cable.mass * cable.length**3)
        return float(np.sqrt(bent + np.linalg.norm(self.model.gravity) / cable.length))

    # ---- states --------------------------------------------------------------------------------

    def fixtures(
        self,
        pose: FloatArray,
        velocities: FloatArray | None = None,
        accelerations: FloatArray | None = None,
    ) -> Fixtures:
        """The fixtures in a declared pose (n_pose,), at rest by default; clips rest."""
        clips = np.zeros((0, self.d)) if self.anchors is None else self.anchors.places
        still, none = np.zeros_like(clips), np.zeros((2, self.d))
        moving = (none if x is None else x for x in (velocities, accelerations))
        places = np.concatenate([self.true_places(pose[None])[0], clips])
        return Fixtures(
            pose[: self.model.n_pose], places, *(np.concatenate([x, still]) for x in moving)
        )

    def true_places(self, poses: FloatArray) -> FloatArray:
        """True places (T, 2, d) [m] of the fixtures in declared poses (T, n_pose)."""
        given = poses[None, :, : EndConditions.size(self.model.node)]
        p = np.broadcast_to(self.p, (1, len(poses), len(self.p)))
        found = self.segment.mapped("true_places")(p, given)[0]
        return np.asarray(found).reshape(len(poses), 2, self.d)

    def at_rest(self, eq: Equilibrium, fixtures: Fixtures) -> State:
        """The state in an equilibrium."""
        model, d = self.model, self.d
        force = np.zeros((self.n_segments, d * (1 + 2 * model.n_springs)))
        lam = eq.multipliers
        if model.end_pull:
            force[:, :d] = lam[model.end_pull]
        for k in range(model.n_springs):
            on = self.springs_on[:, k] > 0
            rows = model.pulls[k]
            force[on, d * (1 + 2 * k) : d * (2 + 2 * k)] = lam[[row - d for row in rows]]
            force[on, d * (2 + 2 * k) : d * (3 + 2 * k)] = lam[rows]
            before = np.cumsum(on[::-1])[::-1].astype(bool) & ~on
            force[before, :d] += lam[rows]
        start, end = self._condition_rows
        x = eq.x
        if self.anchors is not None:
            force[:, :d] += self.anchors.pull
            x = self.anchors.held(x)
        state = self.still_state(x, force, lam[[*start, *end]])
        return self.with_places(state, fixtures)

    def about(self, x: FloatArray) -> MovingCable:
        """The same cable; a dynamic stiffness acts on changes from nodes x (n_nodes, coordinates).

        Variations of the strains at rest are those of parabolas through the neighbours' means.
        """
        turns = np.asarray(self.model.node.difference(x[:-1], x[1:]))
        if turns.shape[1] > 1:  # from increments of the Cayley map to rotation vectors
            size = np.linalg.norm(turns, axis=1, keepdims=True)
            turns = turns * np.where(size > 1e-8, 2 * np.arctan(size / 2) / (size + 1e-300), 1.0)
        stretch = float(self.segment.stretch(self.p))
        mean = turns / (self.layout[:, 1:2] * stretch)
        middle, width = self.layout[:, 0] + self.layout[:, 1] / 2, self.layout[:, 1:2]
        between = width * np.gradient(mean, middle, axis=0, edge_order=2 if len(mean) > 2 else 1)
        still = np.hstack([mean, between])
        return MovingCable(self.model, self.p, self.rest, still, self.anchors)

    def still_state(self, x: FloatArray, force: FloatArray, moment: FloatArray) -> State:
        """Nodes at rest, all at the origin."""
        none, place = np.zeros((self.n_nodes, self.b)), np.zeros((self.n_nodes, self.d))
        return State(x, place, none, place, none, place, force, moment)

    def with_places(
        self, state: State, fixtures: Fixtures, near: FloatArray | None = None
    ) -> State:
        """The state with the places that follow from the frames and forces, start to end.

        `near` (n_nodes, dimension) [m]: known places; forces are then those that bow the segments
        so that they lead from one to the next.
        """
        first, still = 2 * self.b + 2 * self.d, replace(state, r=np.zeros_like(state.r))
        own = slice(first, first + self.d)
        if near is not None:
            still = self._bowed(still, fixtures, np.diff(near, axis=0), own)
        advance = self.evaluated(still, fixtures).rows[:, own]
        r = np.concatenate([[fixtures.places[0]], advance]).cumsum(axis=0)
        for k, node in self.held[1:]:
            r[node] = fixtures.places[k]
        return replace(still, r=r)

    def _bowed(self, state: State, fixtures: Fixtures, chords: FloatArray, own: slice) -> State:
        """The state with forces that bow segments to chords (n_segments, dimension) [m]."""
        for _ in range(_BOWED):
            balance = self.evaluated(state, fixtures)
            gap = (chords - balance.rows[:, own])[..., None]
            by_force = balance.stiffness[0][:, own, own]
            change = np.linalg.pinv(by_force, rcond=_STIFF, hermitian=True) @ gap
            force = state.force.copy()
            force[:, : self.d] += change[..., 0]
            state = replace(state, force=force)
        return state
