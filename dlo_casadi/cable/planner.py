"""Plans of motions on a coarse mesh, and fine simulations of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.motion import CableInMotion
from dlo_casadi.cable.move import RATE, Move, rows_of
from dlo_casadi.cable.move_checks import held_by
from dlo_casadi.cable.move_limits import used_along
from dlo_casadi.cable.shape_in_motion import Modes, directions, moving_cable
from dlo_casadi.cable.simulated import Motion
from dlo_casadi.codegen.fit_steps import fastest_steps
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import DloError, MotionError
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.planning.course import Course
from dlo_casadi.planning.others import least_jerk, shaped
from dlo_casadi.planning.predicted import Case, predicted
from dlo_casadi.planning.problem import CLEAR, FIXTURES, Planned, Task, planned
from dlo_casadi.runtime.progress import Step

# Elements of the cable that is planned with. Between two clamps 10 leave swings 30 times as large.
_ELEMENTS = 20
# Steps in time in a period of the slowest mode, and in the motion at least.
_A_PERIOD, _A_MOTION = 100, 60
# Error of a step of the fine simulation [lengths]: some hundred steps leave a swing of 3e-5.
_FINE = 3e-7
# Share of a limit that a fine simulation may exceed, and rounds of planning with stricter ones.
_OVER, _ROUNDS = 1e-3, 3
# Swing [lengths] up to which the fastest motion is sought, and the accuracy of its duration.
_STILL, _ACCURATE = 1e-3, 0.01
# Longest duration that is tried, in periods of the slowest mode.
_LONGEST = 16.0
# Longest duration that is planned, in periods.
_SLOWEST = 40.0
# Shortest one that is sought, in periods: the cable does not move within it.
_BRIEFEST = 0.05
# Ratio of durations that are tried one after the other.
_LONGER = 1.4
# Directions of the parameters' covariance in which a robust motion is planned, draws of the band.
_DIRECTIONS, _DRAWS = 2, 2000


class Verified(NamedTuple):
    """A course that was planned, the cable along it by a fine simulation, used shares of limits."""

    course: Course
    planned: Planned
    motion: Motion
    used: dict[str, float]


class _LimitError(DloError):
    """No motion of a duration keeps the limits; another duration might."""


class Shape(Protocol):
    """What is used of a `FittedCable`'s shape."""

    pose: HeldPose
    equilibrium: Equilibrium

    @property
    def points(self) -> FloatArray:
        """Points (101, d) [m]."""

    def modes(self, count: int = 6) -> Modes:
        """Small motions about it."""


@dataclass(frozen=True, eq=False)
class Planner:
    """Plans on a coarse mesh, and verifies on the cable's own one."""

    cable: CableInMotion
    before: Shape
    after: Shape
    limits: dict[str, float]
    obstacles: tuple[Any, ...]
    robust: bool
    step: Step

    # ---- the cable that is planned with ----------------------------------------------------------

    @cached_property
    def mode(self) -> tuple[float, float]:
        """Natural frequency [Hz] and damping ratio of the slowest mode that comes back."""
        modes = self.after.modes(3)
        back = np.flatnonzero(modes.frequencies > 0)  # a roll between pins does not come back
        if not back.size:
            raise DloError("move: nothing brings this cable back to rest, so that nothing swings")
        k = int(back[0])
        return float(modes.frequencies[k]), float(modes.damping_ratios[k])

    @property
    def period(self) -> float:
        """Of the slowest mode [s]."""
        return 1.0 / self.mode[0]

    @cached_property
    def coarse(self) -> CableInMotion:
        """On the mesh that is planned with."""
        n = self.cable.model.n
        return self.cable.with_mesh(_ELEMENTS) if n > _ELEMENTS else self.cable

    def _case(self, cable: MovingCable, weight: float) -> Case:
        """A cable with the places where it rests before and after."""
        found = []
        for shape in (self.before, self.after):
            known = np.linspace(0.0, self.cable.length, len(shape.equilibrium.x))
            x = cable.model.node.interpolated(cable.model.chain.places, known, shape.equilibrium.x)
            found.append(solve_equilibrium(cable.model, cable.p, cable.rest, shape.pose, x_init=x))
        cable = cable.about(found[0].x)
        first, last = (
            cable.at_rest(eq, cable.fixtures(shape.pose.vector))
            for eq, shape in zip(found, (self.before, self.after), strict=True)
        )
        return Case(cable, first, last.r, fastest_steps(cable), weight)

    @cached_property
    def directions(self) -> list[tuple[FloatArray, FloatArray]]:
        """Changes of p and of the rest curvature by one standard deviation in each direction."""
        return directions(self.coarse)

    def _changed(self, p: FloatArray, rest: FloatArray) -> MovingCable:
        return moving_cable(replace(self.coarse, p=self.coarse.p + p, rest=self.coarse.rest + rest))

    @cached_property
    def nominal(self) -> Case:
        """The cable as it is likeliest."""
        return self._case(moving_cable(self.coarse), 1.0)

    def task(self, course: Course, cases: Sequence[Case], limits: dict[str, float]) -> Task:
        """What is asked of a course: the swing is looked at for half a period."""
        dt = min(self.period / _A_PERIOD, course.duration / _A_MOTION)
        own = {name: x for name, x in limits.items() if name not in ("bend_radius", "swing")}
        if "bend_radius" in limits:
            own["curvature"] = 1 / limits["bend_radius"]
        return Task(cases, dt, self.period / 2, own, self.obstacles)

    # ---- what parameters do to the swing ---------------------------------------------------------

    def _slopes(self, course: Course, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Swing (R,), and its change (R, D) by one standard deviation in each direction."""
        task = self.task(course, [self.nominal], {})

        def rows(case: Case) -> FloatArray:
            found = predicted(case, course, theta, task.dt, task.after, derivatives=False)
            return found.swing.value

        first, columns = rows(self.nominal), []
        for p, rest in self.directions:
            both = [rows(self._case(self._changed(k * p, k * rest), 1.0)) for k in (0.5, -0.5)]
            columns.append(both[0] - both[1])
        return first, np.array(columns).reshape((-1, len(first))).T

    def band(self, course: Course, theta: FloatArray) -> tuple[float, float]:
        """5 % and 95 % quantiles of the swing [m] under the covariance, to first order."""
        first, slopes = self._slopes(course, theta)
        draws = np.random.default_rng(0).standard_normal((slopes.shape[1], _DRAWS))
        sizes = np.linalg.norm(first[:, None] + slopes @ draws, axis=0)
        low, high = np.quantile(sizes, (0.05, 0.95))
        return float(low), float(high)

    def _robust_cases(self, course: Course, theta: FloatArray) -> list[Case]:
        """Cables to both sides in the directions that change the swing most."""
        _, slopes = self._slopes(course, theta)
        _, sizes, vectors = np.linalg.svd(slopes, full_matrices=False)
        count = min(_DIRECTIONS, int((sizes > 0).sum()))
        cases = []
        for vector in vectors[:count]:
            p, rest = (
                np.sqrt(count) * sum(v * x[k] for v, x in zip(vector, self.directions, strict=True))
                for k in (0, 1)
            )
            for sign in (1, -1):
                changed = self._changed(sign * p, sign * rest)
                cases.append(self._case(changed, 0.5 / count))
        return cases or [self.nominal]

    # ---- planning --------------------------------------------------------------------------------

    def plan(
        self, duration: float, limits: dict[str, float], start: FloatArray | None
    ) -> tuple[Course, Planned]:
        """The best course of a duration."""
        course = Course.between(self.before.pose, self.after.pose, duration)
        try:
            found = planned(self.task(course, [self.nominal], limits), course, start)
            if self.robust and self.directions:
                cases = [*self._robust_cases(course, found.theta)]
                # Limits are those of the first case, the likeliest cable, which has no weight.
                cases = [replace(self.nominal, weight=0.0), *cases]
                found = planned(self.task(course, cases, limits), course, found.theta)
        except MotionError as error:
            raise MotionError(
                f"move: the motion of least jerk in {duration:.4g} s has no solution: {error}\n"
                f"  Try: a longer duration; the slowest mode has a period of {self.period:.3g} s.",
                t=error.t,
            ) from error
        return course, found

    def within(self, duration: float) -> Move:
        """The best motion of a duration, whose limits are kept in a fine simulation.

        Raises
        ------
        DloError
            If none keeps them, with the shortest duration that was found to do.
        """
        try:
            return self._result(self._verified(duration, None))
        except _LimitError as error:
            happened = error.message.partition("\n")[0]
        try:
            _, longer = self._first(max(1.1 * duration, 1.1 * self.shortest[0]))
        except DloError as error:
            raise DloError(f"{happened}\n  Nor does a longer one: {error.message}") from None
        raise DloError(
            f"{happened}\n  Try: duration={longer.course.duration:g}, which keeps them; "
            "duration=None finds the shortest"
        )

    def _verified(self, duration: float, start: FloatArray | None) -> Verified:
        """The best course of a duration; raises _LimitError if none keeps the limits."""
        self._require_time(duration)
        limits = dict(self.limits)
        for round_ in range(_ROUNDS):
            self.step(f"a motion of {duration:.4g} s", round_, _ROUNDS)
            course, found = self.plan(duration, limits, start)
            self._require(found, duration)
            try:
                motion = self.simulated(course, course.values(found.theta, self.times(course)))
            except MotionError as error:
                raise MotionError(
                    f"move: the motion that was planned for {duration:.4g} s has no solution on "
                    f"the cable's own mesh at {error.t:.4g} s.\n  Try: a longer duration; the "
                    f"slowest mode has a period of {self.period:.3g} s",
                    t=error.t,
                ) from error
            used = used_along(course, found.theta, motion, self.limits, self.obstacles)
            over = {name: x for name, x in used.items() if not x <= 1 + _OVER}
            if not over:
                self.step(f"a motion of {duration:.4g} s", _ROUNDS, _ROUNDS)
                used |= self._used_swing(course, found.theta, motion)
                return Verified(course, found, motion, used)
            for name, share in over.items():
                limits[name] = self._stricter(name, limits[name], share)
            start = found.theta
        worst = max(over, key=lambda name: over[name])
        raise _LimitError(
            f"move: in {duration:.4g} s {worst} needs {over[worst]:.3f} times its limit of "
            f"{self.limits[worst]:g} in a fine simulation"
        )

    def _used_swing(self, course: Course, theta: FloatArray, motion: Motion) -> dict[str, float]:
        """Used share of the limit of the swing, which 95 % of the cables shall keep.

        Raises _LimitError if they do not.
        """
        if "swing" not in self.limits:
            return {}
        left, limit = self.swing(motion, course.duration), self.limits["swing"]
        if self.directions:
            left = max(left, self.band(course, theta)[1])
        if left > limit:
            raise _LimitError(
                f"move: after {course.duration:.4g} s the swing may be {1e3 * left:.3g} mm, more "
                f"than its limit of {1e3 * limit:.3g} mm"
            )
        return {"swing": left / limit}

    def _require_time(self, duration: float) -> None:
        """Raise an error if no cable could be moved so fast, or if nothing swings so slowly."""
        if duration > (longest := max(_SLOWEST * self.period, 4 * self.shortest[0])):
            raise DloError(
                f"move: {duration:g} s is {duration / self.period:.3g} periods of the slowest "
                f"mode: nothing swings.\n  Try: at most {longest:.3g} s, or points along a line"
            )
        shortest = self.shortest
        if duration < shortest[0]:
            least, name = shortest
            raise _LimitError(
                f"move: {duration:.4g} s is too short for {name} = {self.limits[name]:g}: the "
                f"fixtures alone need {least:.4g} s"
            )

    @cached_property
    def shortest(self) -> tuple[float, str]:
        """Least time [s] that the fixtures' limits leave, and the name of the limit.

        A way D takes D / v with the speed v, 2 sqrt(D / a), and (32 D / j)^(1/3).
        """
        found = [(0.0, "")]
        for part in Course.between(self.before.pose, self.after.pose, 1.0).parts:
            way = float(np.linalg.norm(part.last - part.first))
            for name, (turns, order) in FIXTURES.items():
                if turns == part.turns and name in self.limits:
                    size = (1.0, 4.0, 32.0)[order - 1] * way / self.limits[name]
                    found.append((size ** (1 / order), name))
        return max(found)

    def _stricter(self, name: str, limit: float, share: float) -> float:
        """A limit that makes up for what the plan's coarse cable does not see."""
        if name == "clearance":
            return limit + (share - 1) * CLEAR * self.cable.length
        return limit * share if name == "bend_radius" else limit / share

    def _require(self, found: Planned, duration: float) -> None:
        """Raise an error if limits cannot be kept."""
        names = {"curvature": "bend_radius"}
        over = {names.get(k, k): x for k, x in found.used.items() if not x <= 1 + _OVER}
        if found.converged and not over:
            return
        if not over:
            raise _LimitError(
                f"move: IPOPT found no motion of {duration:.4g} s within {found.steps} steps"
            )
        near = CLEAR * self.cable.length
        text = ", ".join(
            f"{1e3 * (x - 1) * near:.3g} mm more clearance"
            if k == "clearance"
            else f"{k} {x:.3g} times its limit of {self.limits[k]:g}"
            for k, x in over.items()
        )
        if "clearance" in over:
            raise DloError(
                f"move: no motion of {duration:.4g} s was found that keeps the limits: it needs "
                f"{text}.\n  Try: a pose on the way, and two motions past the obstacles"
            )
        raise _LimitError(f"move: no motion of {duration:.4g} s keeps the limits: it needs {text}")

    def fastest(self) -> Move:
        """The motion of shortest duration that keeps the limits and leaves little swing."""
        low, best = self._first(max(0.5 * self.period, 1.2 * self.shortest[0]))
        low = max(low, _BRIEFEST * self.period)
        while (high := best.course.duration) - low > _ACCURATE * high:
            middle = (low + high) / 2
            found, _ = self._possible(middle, best.planned.theta)
            low, best = (middle, best) if found is None else (low, found)
        return self._result(best)

    def _first(self, duration: float) -> tuple[float, Verified]:
        """The first possible of longer and longer durations, and one that is too short.

        Raises DloError if none is.
        """
        low, longest = self.shortest[0], max(_LONGEST * self.period, 4 * self.shortest[0])
        while True:
            duration = float(f"{duration:.3g}")  # a number that can be told
            found, why = self._possible(duration, None)
            if found is not None:
                return low, found
            low, duration = duration, _LONGER * duration
            if duration > longest:
                raise DloError(f"no motion up to {low:g} s is possible; the last one: {why}")

    def _possible(self, duration: float, start: FloatArray | None) -> tuple[Verified | None, str]:
        """A course of a duration; None and why, if there is none."""
        try:
            found = self._verified(duration, start)
        except DloError as error:
            return None, str(error)
        left, allowed = self.swing(found.motion, duration), _STILL * self.cable.length
        if "swing" in self.limits or left <= allowed:
            return found, ""
        return None, (
            f"{1e3 * left:.3g} mm of swing are left, {1e3 * allowed:.2g} mm allowed.\n"
            "  Try: wider limits"
        )

    # ---- fine simulation -------------------------------------------------------------------------

    def times(self, course: Course) -> FloatArray:
        """Times [s] of the fixtures' table: at a robot's rate, and a period beyond arrival."""
        rate = max(RATE, RATE / course.duration)  # 250 rows of a short motion
        count = int(np.ceil((course.duration + self.period) * rate))
        return np.arange(count + 1) / rate

    def simulated(self, course: Course, values: FloatArray) -> Motion:
        """The cable along coordinates (N, C) at `_times`."""
        held = held_by(self.before.pose)
        held |= rows_of(course, values)
        told: dict[str, Any] = {"begins": self.before, "tolerance": _FINE}
        return self.cable.simulate(self.times(course), **held, **told)

    def swing(self, motion: Motion, duration: float) -> float:
        """Of a motion after arrival [m]."""
        apart = motion.points[motion.t >= duration] - self.after.points
        return float(np.sqrt((apart**2).sum(axis=2).mean()))

    def _result(self, found: Verified) -> Move:
        """The motion beside those of least jerk and of zero vibration."""
        course, theta = found.course, found.planned.theta
        t, duration = self.times(course), course.duration
        swings = {"planned": self.swing(found.motion, duration)}
        others = {
            "minimum jerk": least_jerk(course, t),
            "zero vibration": shaped(course, t, *self.mode),
        }
        for k, (name, values) in enumerate(others.items()):
            self.step("beside others", k, len(others))
            if values is not None:
                with suppress(MotionError):  # it may tear the cable out of reach
                    swings[name] = self.swing(self.simulated(course, values), duration)
        self.step("beside others", len(others), len(others))
        band = self.band(course, theta) if self.directions else (swings["planned"],) * 2
        own = found.planned.steps, course, theta
        rest = self.after.points
        return Move(duration, found.motion, rest, swings, band, self.limits, found.used, *own)
