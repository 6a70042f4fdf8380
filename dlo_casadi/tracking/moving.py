"""A cable in motion learns from what is seen of it, one instant after the other.

The numbers x = (unknowns of the cable, deviations of its fixtures, coordinates of its first state)
are Gaussian, x = x_0 + A z with z ~ N(0, I), and the state is a function of them, whose derivatives
C are carried through the steps of time (`sensitivities`). An instant tells the residual r of what
is seen, in units of its noise, with derivatives H = (dy/dstate) C A:

    z = (I + H^T H)^-1 H^T r,   A <- A (I + H^T H)^-1/2,   x <- x + A z,   state <- state + C A z

That is the extended Kalman filter on the few directions of the state that the numbers move, which
go with the cable; it needs no history. In motion a cable has its stiffness and damping to within
`REPEATED` only, so that both are among x twice: in motion, and at rest.

References
----------
Pham, Verron and Roubaud, J. Marine Syst. 16 (1998): the singular evolutive extended Kalman filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, qr, solve_triangular
from scipy.special import chdtrc

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.fit_steps import compiled_steps
from dlo_casadi.effects.clock_delay import CLOCK_DELAY
from dlo_casadi.equilibrium.curve import NodeCurve, Observed, ObservedChange
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError, EstimationError, MotionError
from dlo_casadi.estimation.motion_fit import MESH_ERROR
from dlo_casadi.estimation.motion_start import (
    FIRST_STRETCHES,
    IN_A_PERIOD,
    LONGEST_STEP,
    MESH,
    begin,
)
from dlo_casadi.estimation.motion_told import REPEATED
from dlo_casadi.estimation.moving_fixtures import GivenNumbers, HeldFixtures
from dlo_casadi.estimation.problem import Priors, Problem
from dlo_casadi.estimation.recording import Recording, rest_state
from dlo_casadi.estimation.stepping import Instant, started, stepped, within
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.motion.beginning import Basis
from dlo_casadi.motion.path import FixturePath
from dlo_casadi.motion.sensitivities import Steps, both_nodes
from dlo_casadi.motion.state import State
from dlo_casadi.motion.steps import still
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.tracking.known import Known
from dlo_casadi.tracking.measured import Measured
from dlo_casadi.tracking.seen import OUTLIER

# Time [s] over which the first state of a cable that moves already is sought.
FIRST_SEEN = FIRST_STRETCHES[-1]
# Rows of the fixtures that are kept.
_ROWS = 8
# Steps of time in the longest one of a fit, and in the one that its period allows: a fit's points
# are extrapolated to steps of no length.
_FINER, _OF_PERIOD = 4, 2
# Smallest standard deviation of a fixture [m, rad]: none is exact.
_EXACT = 1e-9


# Times [s] and what holds the cable then.
Rows = tuple[tuple[float, HeldPose], ...]


@dataclass(frozen=True, eq=False)
class Sample:
    """Fixtures at a time [s], and what was measured of the cable then."""

    t: float
    pose: HeldPose
    measured: Measured


@dataclass(frozen=True, eq=False)
class Seen:
    """An instant as it was seen before it was used; see `seen.Seen`."""

    innovation: FloatArray
    rms: float

    @property
    def probability(self) -> float:
        """Of an innovation as large by chance."""
        return float(chdtrc(len(self.innovation), self.innovation @ self.innovation))

    @property
    def refused(self) -> bool:
        """Whether it was seen wrong."""
        return self.probability < OUTLIER


@dataclass(frozen=True, eq=False)
class InMotion:
    """A cable in motion, and what is known of it.

    Parameters
    ----------
    known : Known
        The cable at rest.
    moving : Known
        The cable in motion, on the mesh of motion.
    recording : Recording
        Its own unknowns and their prior.
    own : (n_own,)
        Their values.
    root : (n + n_own + n, q)
        A; rows of the unknowns in motion, of its own, and of the unknowns at rest.
    still : (n_segments, 2 strains) [1/m]
        Strains at rest, see `MovingSegment.still`.
    t : float [s]
    rows : tuple of (time [s], HeldPose)
        The last rows of the fixtures.
    now : Instant
        The state; `dt` is 0 before the first step.
    longest : float [s]
        Longest step of time.
    """

    known: Known
    moving: Known
    recording: Recording
    own: FloatArray
    root: FloatArray
    still: FloatArray
    t: float
    rows: Rows
    now: Instant
    longest: float
    compiled: bool

    # ---- the first state -------------------------------------------------------------------------

    @classmethod
    def begun(
        cls, known: Known, seen: Sequence[Sample], *, at_rest: bool, compiled: bool
    ) -> InMotion:
        """A motion after its first instants: one if the cable hangs still at first.

        Otherwise its first state is the one that fits best to all of them, see `beginning`.

        Raises
        ------
        DloError
            If motion does not know a part of the cable.
        EstimationError
            If the cable has no such state.
        """
        moving = _on_mesh(known)
        model, first = moving.model, seen[0]
        if CLOCK_DELAY in model.names:
            raise DloError(
                f"{model.cable.name!r} was fitted with a delay between two clocks, which is not "
                "tracked.\n  Try: times of one clock, and a fit without tolerances.delay"
            )
        recording = Recording(_recorded(seen, at_rest=at_rest), _tolerances(known), LONGEST_STEP)
        cable = MovingCable(model, moving.p, moving.rest)
        own: FloatArray = np.zeros(len(recording.own_std(model)))
        fixtures = recording.fixtures(cable, 0.0, own)
        rest = rest_state(cable, fixtures, None)
        if cable.segment.stiffens:
            cable = cable.about(rest.x)
        if at_rest:
            state = cable.with_places(rest, fixtures)
            slowest = float(Basis.of(cable, rest, fixtures, 1).frequencies[0])
            recording = replace(recording, period=2 * np.pi / slowest)
        else:
            std = _noise_of(first.measured, model)
            found = begin(recording, *_problem(moving, recording, std), std)
            recording, own, state = found.recording, found.own, found.seen.first
        shared, loose = known.root, np.diag(_loose(known))
        root = block_diag(np.hstack([shared, loose]), np.diag(recording.own_std(model)))
        root = np.vstack([root, np.pad(shared, ((0, 0), (0, root.shape[1] - shared.shape[1])))])
        root = root[:, np.abs(root).max(axis=0) > 0]
        longest = min(LONGEST_STEP / _FINER, recording.period / IN_A_PERIOD / _OF_PERIOD)
        begun = cls(
            known,
            moving,
            recording,
            own,
            root,
            cable.still,
            first.t,
            ((first.t, first.pose),),
            Instant(still(state), None, 0.0),
            longest,
            compiled,
        )
        return begun._with_first_columns(state)._learned_at_once(seen)

    def _with_first_columns(self, state: State) -> InMotion:
        held, numbers = self._given(_path(self.rows, whole=True), self.cable)
        columns = self.recording.first_columns(held, state, numbers, self.t)
        return replace(self, now=replace(self.now, columns=columns))

    def _learned_at_once(self, seen: Sequence[Sample]) -> InMotion:
        """The cable after its first instants, about whose best state all of them are linear."""
        count = len(self.own)
        n = (len(self.root) - count) // 2
        first = np.zeros(len(self.root))
        first[n : n + count] = self.own
        z, *_ = np.linalg.lstsq(self.root, first, rcond=None)  # the prior's mean is zero
        now, information, slope = self, np.eye(len(z)), np.zeros(len(z))
        path = _path(tuple((one.t, one.pose) for one in seen), whole=True)
        for one in seen:
            now = now if one is seen[0] else now.ahead(one.t, one.pose, path)
            if one.measured.size:
                residual, columns, _ = now._told(one.measured)
                information += columns.T @ columns
                slope += columns.T @ (residual + columns @ z)
        step = np.linalg.solve(information, slope) - z
        return now._moved(step, information)

    # ---- time ------------------------------------------------------------------------------------

    @property
    def cable(self) -> MovingCable:
        """The cable in motion, with its present values."""
        return MovingCable(self.moving.model, self.moving.p, self.moving.rest, self.still)

    def _given(self, path: FixturePath, cable: MovingCable) -> tuple[HeldFixtures, GivenNumbers]:
        """Fixtures along a path, and the derivatives of what is given by the numbers."""
        ways = self.recording.ways(cable.model)
        by_p, by_rest = self.moving.uncertainty.unknowns_in(cable.model)
        scale = self.moving.scale
        numbers = GivenNumbers(path, ways, cable, by_p * scale, by_rest * scale)
        return HeldFixtures(path, ways, cable, self.own), numbers

    def ahead(self, t: float, pose: HeldPose, path: FixturePath | None = None) -> InMotion:
        """The cable at a later time [s], where its fixtures are as in a pose.

        `path`: of the fixtures, if it is known until later.

        Raises
        ------
        MotionError
            If the ends are held out of reach, or if a step of time has no solution.
        """
        model = self.moving.model
        if model.end.place and pose.span > _REACH * model.cable.length:
            raise MotionError(
                f"advance: at {t:g} s the ends are held {pose.span:.4g} m apart; "
                f"{model.cable.name!r} is {model.cable.length:g} m long.\n"
                "  Try: metres? The fixtures at this time?",
                t=t,
            )
        cable, rows = self.cable, (*self._rows_before(t), (t, pose))
        held, numbers = self._given(path or _path(rows), cable)
        times, dt = within(self.t, t, self.longest)
        held.prepare(np.array(times), numbers)
        steps = compiled_steps(cable) if self.compiled else Steps(cable)
        now = self.now
        try:
            if not now.dt:
                state = now.moving.state
                now = started(held, state, now.columns, (self.t, times[0]), numbers)
            for at in times:
                now = stepped(steps, held, now, at, dt, numbers)
        except EstimationError as error:
            raise MotionError(
                f"advance: from {self.t:g} to {t:g} s: {error.message}.\n  Try: fixtures that stay "
                f"within reach and do not jump (the ends are {pose.span:.4g} m apart, the cable is "
                f"{model.cable.length:g} m long), or instants that are closer in time",
                t=t,
            ) from None
        return replace(self, t=t, rows=rows[-_ROWS:], now=now)

    def _rows_before(self, t: float) -> Rows:
        """The last rows of the fixtures; those of a cable at rest have rested."""
        if len(self.rows) > 1 or not self.recording.measured.at_rest:
            return self.rows
        ((before, held),) = self.rows
        return tuple((before - k * (t - before), held) for k in (2, 1, 0))

    def faded(self, forget: float, walked: FloatArray) -> InMotion:
        """What is known has faded, and unknowns have walked by standard deviations (n,)."""
        if forget == 1 and not walked.any():
            return self
        n, own = len(walked), np.zeros(len(self.own))
        walk = np.concatenate([np.eye(n), np.zeros((len(own), n)), np.eye(n)])
        root = np.hstack([self.root / np.sqrt(forget), walk * (walked / self.moving.scale)])
        root = qr(root.T, mode="economic")[1].T
        return replace(self, root=root, known=self.known.with_root(root[-n:]))

    # ---- what is seen ----------------------------------------------------------------------------

    def observed(self) -> tuple[Observed, ObservedChange]:
        """The curve, and its changes by independent numbers of one standard deviation."""
        cable, c = self.cable, self.now.columns
        assert c is not None
        z, by_place, by_p = cable.handles(self.now.moving.state)
        moved = by_place @ both_nodes(cable, c.moved)
        by_unknowns = self.moving.uncertainty.unknowns_in(cable.model)[0] * self.moving.scale
        moved[..., : by_unknowns.shape[1]] += by_p @ by_unknowns
        moved = moved.reshape(*z.shape, -1) @ self.root[: moved.shape[-1]]
        h = cable.model.cable.length / cable.n_segments

        def nodes(rows: FloatArray) -> FloatArray:
            first = np.concatenate([rows[:, 0], rows[:, 1] / h], axis=1)
            last = np.concatenate([rows[-1:, 2], rows[-1:, 3] / h], axis=1)
            return np.concatenate([first, last])

        none = np.zeros((0, moved.shape[-1]))
        curve = NodeCurve.of(cable.model.cable.length, nodes(z))
        return Observed(curve, none[:, 0]), ObservedChange(nodes(moved), none)

    def _told(self, measured: Measured) -> tuple[FloatArray, FloatArray, float]:
        """Residual (R,) and derivatives (R, q) in units of the noise; root mean square [m]."""
        told, change = self.observed()
        noise = replace(measured.noise, point=_noise_of(measured, self.moving.model))
        measured = replace(measured, noise=noise).on(told)
        return measured.off(told), measured.along(told, change), measured.rms(told)

    def learned(self, measured: Measured) -> tuple[InMotion, Seen]:
        """The cable after an instant, and how it was seen."""
        residual, columns, rms = self._told(measured)
        factor = np.linalg.cholesky(columns @ columns.T + np.eye(len(residual)))
        seen = Seen(solve_triangular(factor, residual, lower=True), rms)
        if seen.refused:
            return self, seen
        information = np.eye(columns.shape[1]) + columns.T @ columns
        step = np.linalg.solve(information, columns.T @ residual)
        return self._moved(step, information), seen

    def _moved(self, z: FloatArray, information: FloatArray) -> InMotion:
        """The numbers and the state after a step of z, with its covariance."""
        step, count = self.root @ z, len(self.own)
        n = (len(step) - count) // 2
        root = self.root @ np.linalg.inv(np.linalg.cholesky(information)).T
        moving, known = (
            one.at(one.uncertainty.unknowns_in(one.model), step[part])
            for one, part in ((self.moving, slice(0, n)), (self.known, slice(n + count, None)))
        )
        return replace(
            self,
            known=known.with_root(root[n + count :]),
            moving=moving,
            own=self.own + step[n : n + count],
            root=root,
            now=self.now.moved(self.moving.model.node, step[: n + count]),
        )


# Distance of the ends over the length beyond which a cable is torn, whatever its length may be.
_REACH = 1.05


def _noise_of(measured: Measured, model: CableModel) -> float:
    """Noise [m] of a coordinate of a point in motion, as in a fit."""
    return float(np.hypot(measured.noise.point, MESH_ERROR * model.cable.length))


def _on_mesh(known: Known) -> Known:
    """The cable on the mesh of motion."""
    coefficients = np.linalg.lstsq(known.model.rest_basis, known.rest, rcond=None)[0]
    model = replace(known.model, clips=()).with_mesh(MESH)
    return replace(known, model=model, rest=model.rest_basis @ coefficients)


def _loose(known: Known) -> FloatArray:
    """Standard deviations (n,) of the unknowns from rest to motion."""
    names = known.uncertainty.names
    values = dict(zip(known.model.names, np.abs(known.p), strict=True))
    sizes = [REPEATED.get(name, 0.0) * values.get(name, 0.0) for name in names]
    return np.array(sizes) / known.scale


def _tolerances(known: Known) -> Tolerances:
    """How far fixtures are from where they are declared, as the fit has found."""
    model, node = known.model, known.model.node
    scatter = [known.uncertainty.scatter.get(name, 0.0) for name in model.deviation_names]
    sizes = np.where(np.isfinite(scatter), scatter, 0.0)
    place, turns, _ = np.split(sizes, [node.dimension, node.dimension + 2 * node.increment])
    return replace(
        Tolerances(),
        **{"end": max(_EXACT, place.max()), node.tolerance: max(_EXACT, turns.max())},
    )


def _recorded(seen: Sequence[Sample], *, at_rest: bool) -> MeasuredMotion:
    """The first instants as a recording."""
    t = np.array([one.t for one in seen])
    first = seen[0].pose
    names = ("start", "end", *first._direction_names)
    rows = {x: [getattr(one.pose, x) for one in seen] for x in names}
    known = {x: np.array(row, dtype=float) for x, row in rows.items() if row[0] is not None}
    moving = {x: row for x, row in known.items() if len(seen) > 1 and np.ptp(row, axis=0).any()}
    resting = {x: row[0] for x, row in known.items() if x not in moving}
    marks = [] if at_rest else [one.measured for one in seen]
    s = np.unique(np.concatenate([np.zeros(0), *(one.s for one in marks)]))
    points = np.full((len(seen), len(s), len(first.start)), np.nan)
    for rows_of, one in zip(points, marks, strict=False):
        rows_of[np.searchsorted(s, one.s)] = one.points
    return MeasuredMotion(
        "motion", t - t[0], points, s, t - t[0], moving, resting, at_rest, held_out=False
    )


def _problem(moving: Known, recording: Recording, std: float) -> tuple[Problem, FloatArray]:
    """A fit's statement of the cable without still poses, and theta; `std`: of its points [m]."""
    model, names = moving.model, moving.uncertainty.names
    free = np.array([name in names for name in model.names])
    unknowns = Unknowns(model, free, moving.p)
    coefficients = np.linalg.lstsq(model.rest_basis, moving.rest, rcond=None)[0]
    problem = Problem(unknowns, (), NoiseModel(std), Priors.of(recording.tolerances, model))
    return problem, unknowns.pack(moving.p, coefficients)


def _path(rows: Rows, *, whole: bool = False) -> FixturePath:
    """The way of the fixtures from the last row but one to the last, or through all (`whole`)."""
    t, last = np.array([t for t, _ in rows]), rows[-1][1]
    places = {x: [getattr(pose, x) for _, pose in rows] for x in ("start", "end")}
    known = {x: np.array(row, dtype=float) for x, row in places.items() if row[0] is not None}
    frames = np.array([pose.frames for _, pose in rows])
    frames = np.unwrap(frames, axis=0) if frames.shape[2] == 1 else frames
    known |= {f"{x}_frame": frames[:, k] for k, x in enumerate(("start", "end"))}
    moving = {x: row for x, row in known.items() if np.ptp(row, axis=0).any()}
    return (FixturePath.of if whole else FixturePath.of_last)(last, t, moving)
