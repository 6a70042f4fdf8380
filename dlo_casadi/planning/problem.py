"""The course of fixtures after which a cable is at rest, as a nonlinear program for IPOPT.

    min  swing(theta)^2 / sigma^2 + effort(theta)    subject to  used(theta) <= 1

over the coefficients of a `Course` (direct single shooting). The swing is that of `predicted`, the
effort that of least jerk is 1. Derivatives of first order are exact, through the steps of time; the
Hessian is that of Gauss and Newton, damped by that of the effort as long as something swings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MotionError
from dlo_casadi.planning.course import INTERVALS, Course
from dlo_casadi.planning.predicted import Case, Predicted, predicted
from dlo_casadi.rod.obstacles import Obstacle

# Swing that is worth as much as the effort of least jerk: in lengths, a camera does not see less;
# as a share of the swing of least jerk, where that is small; motions are not exact below the third,
# a motion along a cable that hangs swings less.
SIGMA, SHARE, EXACT = 1e-4, 2e-3, 1e-7
# Levenberg's damping: the weight of the effort in the Hessian over the objective. Courses of 0.6
# periods converge in 22 steps with 0.01, in 25 with 0.001, in more than 60 without.
_DAMPED = 0.01
# Steps of IPOPT, and the relative change of the objective at which they end.
_STEPS, _CHANGE = 60, 1e-3
# Instants of each interval of the splines at which the fixtures' limits are kept.
_INSTANTS = 4
# Distance [lengths] that changes a clearance's use by one.
CLEAR = 0.05
# Names of the fixtures' limits by the order of their derivatives, of places and of turns.
FIXTURES = {
    "speed": (False, 1),
    "acceleration": (False, 2),
    "jerk": (False, 3),
    "turn_speed": (True, 1),
    "turn_acceleration": (True, 2),
}


@dataclass(frozen=True, eq=False)
class Task:
    """What is asked of a course.

    Parameters
    ----------
    cases : sequence of Case
        The cable, or several that it may be; the mean square of their swings counts. Limits are
        those of the first.
    dt, after : float [s]
        Step in time; how long the swing is looked at.
    limits : dict
        Largest values by name: those of `FIXTURES`, force [N], moment [N m], curvature [1/m];
        clearance [m] is a smallest one.
    obstacles : sequence of obstacles
    """

    cases: Sequence[Case]
    dt: float
    after: float
    limits: dict[str, float]
    obstacles: Sequence[Obstacle] = ()

    @property
    def length(self) -> float:
        """Of the cable [m]."""
        return self.cases[0].cable.model.cable.length


@dataclass(frozen=True, eq=False)
class Planned:
    """Coefficients of a course, its swing [m], IPOPT's steps, and whether it has converged.

    `used`: the largest share of each limit that the course needs, 1 at the limit.
    """

    theta: FloatArray
    swing: float
    effort: float
    steps: int
    converged: bool
    used: dict[str, float]


def planned(task: Task, course: Course, start: FloatArray | None = None) -> Planned:
    """The best course, from that of least jerk or from a start of its coefficients.

    Raises MotionError if the cable cannot follow that of least jerk.
    """
    problem = _Problem(task, course)
    theta = course.least_jerk if start is None else start
    x, f, g = ca.MX.sym("x", course.size), problem.objective, problem.limits
    count = len(problem.names)
    functions: dict[str, Any] = {"f": f(x), "g": g(x) if count else ca.MX(0, 1)}
    p, lam_f, lam_g = ca.MX.sym("p", 0), ca.MX.sym("lam_f"), ca.MX.sym("lam_g", count)
    slope = problem.jacobian(x) if count else ca.MX(0, course.size)
    hessian = ca.triu(problem.hessian(x, lam_f, lam_g))
    options: dict[str, Any] = {
        "print_time": False,
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "show_eval_warnings": False,
        "grad_f": ca.Function("grad_f", [x, p], [functions["f"], problem.gradient(x)]),
        "jac_g": ca.Function("jac_g", [x, p], [functions["g"], slope]),
        "hess_lag": ca.Function("hess_lag", [x, p, lam_f, lam_g], [hessian]),
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "max_iter": _STEPS,
            # Motions are exact to 1e-7: it ends where the objective no longer changes.
            "acceptable_tol": 1e6,
            "acceptable_constr_viol_tol": 1e-6,
            "acceptable_obj_change_tol": _CHANGE,
            "acceptable_iter": 2,
            "mu_strategy": "adaptive",
            "nlp_scaling_method": "none",
        },
    }
    solver = ca.nlpsol("course", "ipopt", functions | {"x": x, "p": p}, options)
    done = solver(x0=theta, lbg=-np.inf, ubg=1.0)
    stats = solver.stats()
    x_found, steps = np.array(done["x"]).ravel(), int(stats["iter_count"])
    return problem.result(x_found, steps, bool(stats["success"]))


class _Problem:
    """Functions of the program; the last motions are kept."""

    def __init__(self, task: Task, course: Course) -> None:
        self.task, self.course, size = task, course, course.size
        least = course.least_jerk
        first = self._simulated(least, derivatives=False)
        self._known: dict[tuple[bytes, bool], list[Predicted] | None]
        self._known = {(least.tobytes(), False): first}
        self.sigma = min(SIGMA * task.length, max(SHARE * self.swing(first), EXACT * task.length))
        self.names = self._names()
        count = max(len(self.names), 1)
        self._callbacks = [
            _Called("objective", [size], (1, 1), self._objective),
            _Called("gradient", [size], (size, 1), self._gradient),
            _Called("limits", [size], (count, 1), self._used),
            _Called("jacobian", [size], (count, size), self._used_by),
            _Called("hessian", [size, 1, len(self.names)], (size, size), self._hessian),
        ]
        self.objective, self.gradient, self.limits, self.jacobian, self.hessian = self._callbacks

    # ---- motions ---------------------------------------------------------------------------------

    def _simulated(self, theta: FloatArray, *, derivatives: bool) -> list[Predicted]:
        """Of all cases; raises MotionError if one has no solution."""
        course, task = self.course, self.task
        return [
            predicted(x, course, theta, task.dt, task.after, derivatives=derivatives)
            for x in task.cases
        ]

    def motions(self, theta: FloatArray, derivatives: bool) -> list[Predicted] | None:
        """Of all cases; None if one has no solution."""
        key = theta.tobytes(), derivatives
        if key not in self._known:
            try:
                found = self._simulated(theta, derivatives=derivatives)
            except MotionError:
                found = None
            # Values come first, then derivatives of accepted steps: four motions are enough.
            while len(self._known) > 3:
                del self._known[next(iter(self._known))]
            self._known[key] = found
        return self._known[key]

    def _values(self, theta: FloatArray) -> list[Predicted] | None:
        known = self._known.get((theta.tobytes(), True))
        return known if known is not None else self.motions(theta, False)

    # ---- objective -------------------------------------------------------------------------------

    def swing(self, motions: Sequence[Predicted]) -> float:
        """Root of the mean square [m] over the cases."""
        squares = [float(x.swing.value @ x.swing.value) for x in motions]
        return float(np.sqrt(np.dot([x.weight for x in self.task.cases], squares)))

    def effort(self, theta: FloatArray) -> float:
        """Of the fixtures, 1 for least jerk."""
        hessian, linear, constant = self.course.effort
        return float(theta @ hessian @ theta / 2 + linear @ theta + constant)

    def _objective(self, theta: FloatArray) -> Any:
        motions = self._values(theta)
        if motions is None:
            return np.nan
        return (self.swing(motions) / self.sigma) ** 2 + self.effort(theta)

    def _gradient(self, theta: FloatArray) -> Any:
        motions = self.motions(theta, True)
        if motions is None:
            return np.full(self.course.size, np.nan)
        hessian, linear, _ = self.course.effort
        total = hessian @ theta + linear
        for case, motion in zip(self.task.cases, motions, strict=True):
            total = total + 2 * case.weight / self.sigma**2 * motion.swing.by.T @ motion.swing.value
        return total

    # ---- limits ----------------------------------------------------------------------------------

    def _names(self) -> list[str]:
        """The limit of each row."""
        rows = self._rows(self.course.least_jerk, derivatives=False)
        return [name for name, values, _ in rows for _ in range(len(values))]

    def _used(self, theta: FloatArray) -> Any:
        if self._motion(theta, False) is None:
            return np.full(len(self.names), np.nan)
        return np.concatenate([values for _, values, _ in self._rows(theta, derivatives=False)])

    def _used_by(self, theta: FloatArray) -> Any:
        if self._motion(theta, True) is None:
            return np.full((len(self.names), self.course.size), np.nan)
        return np.concatenate([by for _, _, by in self._rows(theta, derivatives=True)])

    def _motion(self, theta: FloatArray, derivatives: bool) -> list[Predicted] | None:
        return self.motions(theta, True) if derivatives else self._values(theta)

    def _rows(
        self, theta: FloatArray, *, derivatives: bool
    ) -> list[tuple[str, FloatArray, FloatArray]]:
        """Name, values and derivatives of each kind of limit."""
        limits, found = self.task.limits, []
        for name, vectors, by in self._squares(theta, derivatives):
            rows = (
                2 / limits[name] ** 2 * np.einsum("rk,rkq->rq", vectors, by) if derivatives else by
            )
            found.append((name, (vectors**2).sum(axis=1) / limits[name] ** 2, rows))
        if "clearance" in limits:
            found += self._clearances(theta, derivatives)
        return found

    def _squares(
        self, theta: FloatArray, derivatives: bool
    ) -> list[tuple[str, FloatArray, FloatArray]]:
        """Name, vectors (R, k) whose lengths are limited, derivatives (R, k, q)."""
        limits, course = self.task.limits, self.course
        found: list[tuple[str, FloatArray, FloatArray]] = []
        t = np.linspace(0, course.duration, INTERVALS * _INSTANTS + 1)
        columns = course.columns
        for name, (turns, order) in FIXTURES.items():
            for part, own in zip(course.parts, columns, strict=True):
                if name in limits and part.turns == turns:
                    values = course.values(theta, t, order)[:, own]
                    rows = course.weights(t, order)[1]
                    by = np.zeros((len(t), len(own), course.count, rows.shape[1]))
                    for k, column in enumerate(own):
                        by[:, k, column] = rows
                    found.append((name, values, by.reshape((*by.shape[:2], -1))))
        if not {"force", "moment", "curvature"} & limits.keys():
            return found
        motions = self._motion(theta, derivatives)
        for name in ("force", "moment", "curvature"):
            if name in limits and motions is not None:
                value, by = getattr(motions[0], name)
                rows = value.reshape((-1, value.shape[-1]))
                by = by.reshape((*rows.shape, -1)) if derivatives else by
                found.append((name, rows, by))
        return found

    def _clearances(
        self, theta: FloatArray, derivatives: bool
    ) -> list[tuple[str, FloatArray, FloatArray]]:
        motions = self._motion(theta, derivatives)
        found: list[tuple[str, FloatArray, FloatArray]] = []
        if motions is None:
            return found
        need = self.task.limits["clearance"] + self.task.cases[0].cable.model.cable.diameter / 2
        unit, places = CLEAR * self.task.length, motions[0].places
        for obstacle in self.task.obstacles:
            surface = obstacle.near(places.value)
            used = 1 + (need - surface.distance) / unit
            by = places.by
            if derivatives:
                by = -np.einsum("snd,sndq->snq", surface.normal, by).reshape((used.size, -1)) / unit
            found.append(("clearance", used.ravel(), by))
        return found

    # ---- second order ----------------------------------------------------------------------------

    def _hessian(self, theta: FloatArray, lam_f: FloatArray, lam_g: FloatArray) -> Any:
        motions = self.motions(theta, True)
        if motions is None:
            return np.full((self.course.size,) * 2, np.nan)
        # Far from rest the motion is far from linear: a step may then change the effort little.
        share = 1 + _DAMPED * (self.swing(motions) / self.sigma) ** 2
        total = share * self.course.effort[0]
        for case, motion in zip(self.task.cases, motions, strict=True):
            total += 2 * case.weight / self.sigma**2 * motion.swing.by.T @ motion.swing.by
        total, at = float(lam_f[0]) * total, 0
        for name, vectors, by in self._squares(theta, True):
            weights = (
                2 * np.maximum(lam_g[at : at + len(vectors)], 0.0) / self.task.limits[name] ** 2
            )
            flat = (np.sqrt(weights)[:, None, None] * by).reshape((-1, by.shape[-1]))
            total += flat.T @ flat
            at += len(vectors)
        return total

    def result(self, theta: FloatArray, steps: int, converged: bool) -> Planned:
        """What the coefficients lead to."""
        motions = self._values(theta)
        swing = np.nan if motions is None else self.swing(motions)
        used: dict[str, float] = {}
        for name, values, _ in self._rows(theta, derivatives=False) if motions else []:
            largest = float(values.max(initial=0.0))
            share = largest if name == "clearance" else float(np.sqrt(largest))
            used[name] = max(used.get(name, 0.0), share)
        return Planned(theta, swing, self.effort(theta), steps, converged, used)


class _Called(ca.Callback):
    """A function of columns that NumPy evaluates."""

    def __init__(
        self,
        name: str,
        given: list[int],
        shape: tuple[int, int],
        function: Callable[..., Any],
    ) -> None:
        super().__init__()
        self._given, self._shape, self._function = given, shape, function
        self.construct(name)

    def get_n_in(self) -> int:
        return len(self._given)

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._given[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._shape)

    def eval(self, given: Sequence[ca.DM]) -> list[ca.DM]:
        found = self._function(*(np.array(x).ravel() for x in given))
        return [ca.reshape(ca.DM(found), *self._shape)]
