"""A recorded motion beside the model: residuals of its points, and their exact derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, pairwise
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.codegen.fit_steps import fastest_steps
from dlo_casadi.effects import SectionLaw
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EquilibriumError, EstimationError
from dlo_casadi.estimation.moving_fixtures import GivenNumbers, HeldFixtures
from dlo_casadi.estimation.stepping import started, stepped, within
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.motion import sensitivities
from dlo_casadi.motion.beginning import Basis, begun, columns_of
from dlo_casadi.motion.handles import between
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.sensitivities import Columns, Stepping, Tangent
from dlo_casadi.motion.state import Fixtures, State
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.sensing.measured_motion import MeasuredMotion

# Modes of a first state: with 8, shapes pulled aside at one place are met within 0.1 % of the pull
# (amplitudes of a free cable's modes fall with the square of their number).
MODES = 8
# Standard deviation of the amplitude of the first mode, in lengths; of higher ones in proportion to
# the inverse of their frequencies.
AMPLITUDE = 0.3
# States whose points are evaluated at once.
_AT_ONCE = 200


@dataclass(frozen=True, eq=False)
class Seen:
    """A motion as the model predicts it.

    Parameters
    ----------
    residual : (R,) [m]
        Predicted minus measured, of all points that were seen.
    by_theta, by_own : (R, size), (R, n_own)
        Their derivatives; empty if not asked for.
    first : State
        The state at the first instant.
    points : (T, K, d) [m]
        Predicted points.
    """

    residual: FloatArray
    by_theta: FloatArray
    by_own: FloatArray
    first: State
    points: FloatArray


@dataclass(frozen=True, eq=False)
class Recording:
    """A measured motion, and the unknowns that it has of its own.

    Parameters
    ----------
    dt : float [s]
        Longest step of time. Derivatives are those of these steps; points are extrapolated from
        them and from half of them, to fourth order.
    basis : Basis, optional
        What the first state is made of, its coordinates are among the recording's own unknowns;
        None if the cable hangs still at first, and nothing of its first state is unknown.
    until : float [s]
        Only points up to this time are compared.
    period : float [s]
        Of the first mode.
    rest : State, optional
        The cable hanging still between the first fixtures, near which it is sought.
    """

    measured: MeasuredMotion
    tolerances: Tolerances
    dt: float
    basis: Basis | None = None
    until: float = np.inf
    period: float = 1.0
    rest: State | None = None

    @cached_property
    def path(self) -> FixturePath:
        """How the fixtures move."""
        own = self.measured
        rows = {
            f"{name.partition('_')[0]}_frame" if "_" in name else name: _columns(x)
            for name, x in own.moving.items()
        }
        return FixturePath.of(held_by(own.held_at(0)), own.fixtures_t, rows)

    @cached_property
    def times(self) -> FloatArray:
        """Times (T,) [s] of the compared points."""
        return self.measured.t[self.measured.t <= self.until]

    # ---- own unknowns --------------------------------------------------------------------------

    def own_std(self, model: CableModel) -> FloatArray:
        """Standard deviations (n_own,) of its own unknowns.

        These are deviations of the end's place [m], of the directions of the start and of the end
        [rad], then the coordinates eta and zeta of the first state, see `beginning`.
        """
        parts = [np.full(len(self._turned(model)), getattr(self.tolerances, model.node.tolerance))]
        if model.end.place:
            parts.insert(0, np.full(model.node.dimension, self.tolerances.end))
        if self.basis is not None:
            w = self.basis.frequencies
            parts += [AMPLITUDE * w[0] / w, np.full(len(w), AMPLITUDE * w[0])]
        return np.concatenate(parts)

    @staticmethod
    def _turned(model: CableModel) -> list[int]:
        """Rows of turns (2 increment,) of fixtures that hold the direction."""
        b = model.node.increment
        sides = enumerate((model.start, model.end))
        return [
            b * k + int(row)
            for k, kind in sides
            for row in np.flatnonzero(kind.rotations(model.node))
        ]

    def ways(self, model: CableModel) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the end's place (d, n_own) and of fixtures' turns (2 b, n_own)."""
        n, d, b = len(self.own_std(model)), model.node.dimension, model.node.increment
        place, turns = np.zeros((d, n)), np.zeros((2 * b, n))
        first = d * model.end.place
        place[:, :first] = np.eye(d)[:, :first]
        rows = self._turned(model)
        turns[rows, first + np.arange(len(rows))] = 1.0
        return place, turns

    def fixtures(self, cable: MovingCable, t: float, own: FloatArray) -> Fixtures:
        """The fixtures at a time of the points' clock, with their deviations."""
        return HeldFixtures(self.path, self.ways(cable.model), cable, own).at(t)

    # ---- evaluation ----------------------------------------------------------------------------

    def evaluate(
        self,
        unknowns: Unknowns,
        theta: FloatArray,
        own: FloatArray,
        near: State | None = None,
        *,
        derivatives: bool = False,
        known: Seen | None = None,
    ) -> Seen:
        """Predicted minus measured points.

        `near`: a first state near which that of these unknowns is sought. `known`: what is
        predicted there, if only derivatives are asked for.

        Raises
        ------
        EstimationError
            If the first state or a step of time is not found.
        """
        model, p, rest = unknowns.model, unknowns.p(theta), unknowns.rest(theta)
        cable = MovingCable(model, p, rest)
        rest_near = near if self.basis is None else self.rest
        if self.basis is None or _depends_on_rest(model):
            fixtures = self.fixtures(cable, 0.0, own)
            at_rest = rest_state(cable, fixtures, rest_near)
            cable = cable.about(at_rest.x) if _depends_on_rest(model) else cable
        numbers = (
            GivenNumbers(
                self.path,
                self.ways(model),
                cable,
                unknowns.slopes(theta),
                unknowns.rest_slopes,
            )
            if derivatives
            else None
        )
        if self.basis is None:
            first = cable.with_places(at_rest, fixtures)
        else:
            first = self._first(cable, own, near)
        held, steps = (
            HeldFixtures(self.path, self.ways(cable.model), cable, own),
            fastest_steps(cable),
        )
        seen, by = self._seen(self._states(steps, held, first, numbers), held, numbers)
        size = unknowns.size
        points: FloatArray
        if known is None:
            # The error of a step falls with the square of its length: extrapolated to zero.
            finer = replace(self, dt=self.dt / 2)
            fine, _ = finer._seen(finer._states(steps, held, first, None), held, None)
            points = fine + (fine - seen) / 3
        else:
            points = known.points
        mask = np.isfinite(self.measured.points[: len(points), :, 0])
        residual = self.measured.deviations(points)[mask].ravel()
        if by is None:
            none = np.zeros((0, 0))
            return Seen(residual, none, none, first, points)
        rows = self.measured.deviations(by)[mask].reshape(len(residual), -1)
        return Seen(residual, rows[:, :size], rows[:, size:], first, points)

    def _first(self, cable: MovingCable, own: FloatArray, near: State | None) -> State:
        fixtures = self.fixtures(cable, 0.0, own)
        if near is None:
            near = rest_state(cable, fixtures, self.rest)
        assert self.basis is not None
        count = self.basis.forces.shape[1]
        return begun(cable, near, fixtures, self.basis, own[-2 * count :])

    def _states(
        self,
        steps: Stepping,
        held: HeldFixtures,
        first: State,
        numbers: GivenNumbers | None,
    ) -> Iterator[tuple[State, Columns | None]]:
        """The state at each time, and its derivatives."""
        times = self.times
        columns = None if numbers is None else self.first_columns(held, first, numbers)
        yield first, columns
        if len(times) == 1:
            return
        dt = min(self.dt, float(times[1] - times[0]))
        stretches = [within(begin, end, self.dt) for begin, end in pairwise(times)]
        held.prepare(np.concatenate([[dt], *(at for at, _ in stretches)]), numbers)
        now = started(held, first, columns, (0.0, dt), numbers)
        for ends, dt in stretches:
            for at in ends:
                now = stepped(steps, held, now, at, dt, numbers)
            yield now.moving.state, now.columns

    def first_columns(
        self, held: HeldFixtures, first: State, numbers: GivenNumbers, at: float = 0.0
    ) -> Columns:
        """Derivatives of the first state, which is that of a time of the fixtures [s]."""
        cable, at_first, given = held.cable, numbers.at(at), held.at(at)
        if self.basis is None:
            return sensitivities.at_rest(Tangent(cable, first, given), at_first)
        own = held.own[-2 * self.basis.forces.shape[1] :]
        return columns_of(cable, first, given, self.basis, at_first, own)

    def _seen(
        self,
        states: Iterator[tuple[State, Columns | None]],
        held: HeldFixtures,
        numbers: GivenNumbers | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Points (T, K, d) of the markers, and their derivatives (T, K, d, q)."""
        # All derivatives of all states of a minute in space would take a gigabyte.
        parts = []
        while some := list(islice(states, _AT_ONCE)):
            parts.append(self._seen_in(some, held, numbers))
        points = np.concatenate([x for x, _ in parts])
        by = [x for _, x in parts if x is not None]
        return points, np.concatenate(by) if by else None

    def _seen_in(
        self,
        states: Sequence[tuple[State, Columns | None]],
        held: HeldFixtures,
        numbers: GivenNumbers | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """The same of some states."""
        cable, (segment, u) = held.cable, self._markers(held.cable)
        known, columns = zip(*states, strict=True)
        p, _, place = (np.broadcast_to(x, (len(known), *x.shape)) for x in cable.numbers[:3])
        x, r = (_both(np.stack([getattr(one, key) for one in known])) for key in ("x", "r"))
        z, by_place, by_p = cable.segment.mapped("curve")(x, r, p, place)
        d, u_of = cable.d, len(segment)
        points = between(z.reshape((*z.shape[:2], 4, d))[:, segment], u)
        if numbers is None:
            return points, None
        moved = [
            between(
                (by[segment] @ both[segment] + by_own[segment] @ numbers.p).reshape(u_of, 4, -1), u
            )
            for by, by_own, both in zip(by_place, by_p, map(_of_both, columns), strict=True)
        ]
        return points, np.array(moved).reshape(len(known), u_of, d, -1)

    def _markers(self, cable: MovingCable) -> tuple[IntArray, FloatArray]:
        """Segment of each marker, and its share of it."""
        low, width = cable.layout[:, :2].T
        s = self.measured.s
        segment = np.clip(np.searchsorted(low, s, side="right") - 1, 0, len(low) - 1)
        return segment, (s - low[segment]) / width[segment]


def _depends_on_rest(model: CableModel) -> bool:
    """Whether an effect acts on changes from the shape at rest."""
    none = SectionLaw.dynamic
    return any(isinstance(x, SectionLaw) and type(x).dynamic is not none for x in model.effects)


def rest_state(cable: MovingCable, fixtures: Fixtures, near: State | None) -> State:
    """The state of equilibrium between fixtures, near another one if given."""
    model = cable.model
    held = held_pose(model, fixtures.pose)
    guess = None if near is None else near.x
    try:
        found = solve_equilibrium(model, cable.p, cable.rest, held, x_init=guess)
    except EquilibriumError as error:
        raise EstimationError(f"no shape at rest at the first instant: {error}") from error
    return cable.at_rest(found, fixtures)


def _columns(rows: FloatArray) -> FloatArray:
    return rows[:, None] if rows.ndim == 1 else rows


def held_by(fields: Mapping[str, FloatArray]) -> HeldPose:
    """A pose of numbers by the names of its fields."""
    known: dict[str, Any] = {
        name: float(x) if name.endswith("heading") else tuple(np.ravel(x).tolist())
        for name, x in fields.items()
    }
    return HeldPose(**known)


def held_pose(model: CableModel, pose: FloatArray) -> HeldPose:
    """The declared pose of numbers (n_pose,)."""
    node = model.node
    d, c = node.dimension, node.coordinates
    start, end, first, last = np.split(pose[: 2 * (d + c)], np.cumsum([d, d, c]))
    held = {}
    for side, frame in (("start", first), ("end", last)):
        if getattr(model, side).direction:
            held[f"{side}_{node.direction}"] = node.declared(frame)
    end_place = tuple(end.tolist()) if model.end.place else None
    return HeldPose(start=tuple(start.tolist()), end=end_place, **held)


def _both(rows: FloatArray) -> FloatArray:
    """Rows (T, n_nodes, ...) of both nodes of each segment, side by side."""
    return np.concatenate([rows[:, :-1], rows[:, 1:]], axis=2)


def _of_both(columns: Columns | None) -> FloatArray:
    """Turns of both nodes of each segment, then places (n_segments, 2 (b + d), q)."""
    assert columns is not None
    parts = (columns.turn[:-1], columns.turn[1:], columns.place[:-1], columns.place[1:])
    return np.concatenate(parts, axis=1)
