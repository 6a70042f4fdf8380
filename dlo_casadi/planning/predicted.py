"""What a course does to a cable: its swing after arrival, forces, curvatures, places.

The cable is simulated in equal steps. The swing is the distance of the nodes from where they rest:

    swing^2 = mean over nodes and steps after arrival of |r(t) - r_rest|^2
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MotionError
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion import sensitivities
from dlo_casadi.motion.sensitivities import Columns, Tangent, both_nodes
from dlo_casadi.motion.state import State
from dlo_casadi.motion.steps import SCHEME, Moving, Stepper, still
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.planning.course import Course


@dataclass(frozen=True, eq=False)
class Case:
    """A cable that is moved.

    Parameters
    ----------
    cable : MovingCable
    first : State
        At rest before the motion.
    rest : (n_nodes, d) [m]
        Places where it rests after it.
    weight : float
        Of its swing among those of other cases; they sum up to one.
    """

    cable: MovingCable
    first: State
    rest: FloatArray
    weight: float = 1.0


class Rows(NamedTuple):
    """Values (..., k) and their derivatives (..., k, q) by the course's coefficients."""

    value: FloatArray
    by: FloatArray


@dataclass(frozen=True, eq=False)
class Predicted:
    """Of all steps S of a motion; derivatives are empty if not asked for.

    Parameters
    ----------
    swing : Rows (R,) [m]
        Distances from rest after arrival; the root of their sum of squares is the swing.
    force, moment : Rows (S, 2, d) [N], (S, 2, increment) [N m]
        Of the cable on what holds start and end.
    curvature : Rows (S, n_segments, 2 or 1) [1/m]
    places : Rows (S, n_nodes, d) [m]
    """

    swing: Rows
    force: Rows
    moment: Rows
    curvature: Rows
    places: Rows


def predicted(
    case: Case, course: Course, theta: FloatArray, dt: float, after: float, *, derivatives: bool
) -> Predicted:
    """The motion of a case along a course, and for a time `after` [s] beyond it.

    Raises
    ------
    MotionError
        If a step has no solution.
    """
    cable, size = case.cable, course.size
    count = int(np.ceil(course.duration / dt - 1e-9))
    dt = course.duration / count
    beyond = max(round(after / dt), 1)
    now = still(case.first)
    columns = _none(cable, size) if derivatives else None
    stepper, every = Stepper(cable, SCHEME), []
    for k in range(1, count + beyond + 1):
        t = k * dt
        fixtures = course.fixtures(cable, theta, t)
        done = stepper.step(now, fixtures, dt)
        if done is None:
            raise MotionError(f"no step in time has a solution at {t:.4g} s", t=t)
        tangent = None
        if columns is not None:
            tangent, numbers = Tangent(cable, done.state, fixtures), course.numbers(cable, theta, t)
            columns = sensitivities.stepped(now, done, columns, tangent, numbers, dt, SCHEME)
        every.append(_rows(cable, done, columns, tangent))
        now = done
    force, moment, curvature, places = (
        Rows(np.array([x[i].value for x in every]), np.array([x[i].by for x in every]))
        for i in range(4)
    )
    share = 1 / np.sqrt(beyond * cable.n_nodes)
    swing = Rows(
        share * (places.value[count:] - case.rest).ravel(),
        share * places.by[count:].reshape(beyond * case.rest.size, -1),
    )
    return Predicted(swing, force, moment, curvature, places)


def _none(cable: MovingCable, q: int) -> Columns:
    """No derivatives yet."""
    n, b, d = cable.n_nodes, cable.b, cable.d
    rates = np.zeros((n, b + d, q))
    force = np.zeros((cable.n_segments, d * (1 + 2 * cable.model.n_springs), q))
    turn, place = np.zeros((n, b, q)), np.zeros((n, d, q))
    return Columns(turn, place, rates, rates, rates, force, np.zeros((cable.n_moments, q)))


def _rows(
    cable: MovingCable, now: Moving, columns: Columns | None, tangent: Tangent | None
) -> list[Rows]:
    """Forces, moments, curvatures and places of one step."""
    state, none = now.state, np.zeros((0, 0))
    forces, moments = _held_forces(cable, state), held_moments(cable, state.moment)
    curvature, by_turns = curvatures(cable, state)
    if columns is None or tangent is None:
        return [Rows(x, none) for x in (forces, moments, curvature, state.r)]
    both = np.concatenate([columns.turn[:-1], columns.turn[1:]], axis=1)
    return [
        Rows(forces, _forces_by(cable, columns, tangent)),
        Rows(moments, held_moments(cable, columns.moment)),
        Rows(curvature, by_turns @ both),
        Rows(state.r, columns.place),
    ]


def _held_forces(cable: MovingCable, state: State) -> FloatArray:
    """Forces (2, d) [N] of the cable on its fixtures."""
    b, d = cable.b, cable.d
    (rows,) = cable.segments("residual", state)
    first, last = rows[0, 2 * b : 2 * b + d, 0], rows[-1, 2 * b + d : 2 * (b + d), 0]
    load = np.array(functions_of(cable.model).dead_load(cable.p)).ravel()
    return np.array([load - first, -last if cable.model.end.place else 0 * last])


def _forces_by(cable: MovingCable, columns: Columns, tangent: Tangent) -> FloatArray:
    """Their derivatives (2, d, q)."""
    b, d = cable.b, cable.d
    size, found = 2 * (b + d), []
    moved, rates, changed = (
        both_nodes(cable, x) for x in (columns.moved, columns.rates, columns.accelerations)
    )
    for k, first in ((0, 2 * b), (-1, 2 * b + d)):
        stiff, damp, mass = (
            x[0][k, first : first + d] for x in (tangent.stiffness, tangent.damping, tangent.mass)
        )
        total = stiff[:, :size] @ moved[k] + stiff[:, size:] @ columns.force[k]
        found.append(-(total + damp[:, :size] @ rates[k] + mass[:, :size] @ changed[k]))
    if not cable.model.end.place:
        found[1] = np.zeros_like(found[1])
    return np.array(found)


def held_moments(cable: MovingCable, moment: FloatArray) -> FloatArray:
    """Moments (2, increment, ...) [N m] that hold directions; zero where a cable may turn."""
    found = np.zeros((2 * cable.b, *moment.shape[1:]))
    model = cable.model
    rows = [
        cable.b * k + int(row)
        for k, kind in enumerate((model.start, model.end))
        for row in np.flatnonzero(kind.rotations(model.node))
    ]
    found[rows] = moment
    return found.reshape((2, cable.b, *moment.shape[1:]))


def curvatures(cable: MovingCable, state: State) -> tuple[FloatArray, FloatArray]:
    """Mean curvatures (n_segments, c) [1/m], and their derivatives by both nodes' turns."""
    widths = cable.model.chain.layout.segments[:, 1]
    if cable.b == 1:
        by = np.broadcast_to(np.array([[-1.0, 1.0]]), (len(widths), 1, 2))
        return np.diff(state.x, axis=0) / widths[:, None], by / widths[:, None, None]
    frames = Rotation.from_quat(state.x)
    turns = (frames[:-1].inv() * frames[1:]).as_rotvec()
    after = _inverse_jacobians(turns)
    by = np.concatenate([-after.transpose(0, 2, 1), after], axis=2)[:, 1:]
    return turns[:, 1:] / widths[:, None], by / widths[:, None, None]


def _inverse_jacobians(turns: FloatArray) -> FloatArray:
    """Change (N, 3, 3) of rotation vectors by turns about the turned body's own axes."""
    size = np.linalg.norm(turns, axis=1)
    around = np.cross(turns[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)
    large = np.maximum(size, 1e-3)
    share = 1 / large**2 - (1 + np.cos(large)) / (2 * large * np.sin(large))
    share = np.where(size < 1e-3, 1 / 12, share)
    return np.asarray(np.eye(3) + around / 2 + share[:, None, None] * around @ around)
