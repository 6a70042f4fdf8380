"""What a course does to a cable: its swing after arrival, forces, curvatures, places.

The cable is simulated in equal steps. The swing is the distance of the nodes from where they rest:

    swing^2 = mean over nodes and steps after arrival of |r(t) - r_rest|^2
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MotionError
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion.sensitivities import Columns, Stepping, both_nodes
from dlo_casadi.motion.state import State
from dlo_casadi.motion.steps import still
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
    steps : Stepping
        Its steps in time.
    weight : float
        Of its swing among those of other cases; they sum up to one.
    """

    cable: MovingCable
    first: State
    rest: FloatArray
    steps: Stepping
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
    states, slopes = [], []
    for k in range(1, count + beyond + 1):
        t = k * dt
        fixtures = course.fixtures(cable, theta, t)
        done = case.steps.step(now, fixtures, dt)
        if done is None:
            raise MotionError(f"no step in time has a solution at {t:.4g} s", t=t)
        if columns is not None:
            numbers = course.numbers(cable, theta, t)
            columns = case.steps.derived(now, done, columns, fixtures, numbers, dt)
            slopes.append(columns)
        states.append(done.state)
        now = done
    places = Rows(*_stacked([x.r for x in states], [x.place for x in slopes]))
    share = 1 / np.sqrt(beyond * cable.n_nodes)
    swing = Rows(
        share * (places.value[count:] - case.rest).ravel(),
        share * places.by[count:].reshape(beyond * case.rest.size, -1),
    )
    moments = [held_moments(cable, x.moment) for x in states]
    moment = Rows(*_stacked(moments, [held_moments(cable, x.moment) for x in slopes]))
    bent, by_turns = zip(*(curvatures(cable, x) for x in states), strict=True)
    both = [
        one @ np.concatenate([x.turn[:-1], x.turn[1:]], axis=1)
        for one, x in zip(by_turns, slopes, strict=False)
    ]
    curvature = Rows(*_stacked(bent, both))
    return Predicted(swing, _held_forces(cable, states, slopes), moment, curvature, places)


def _stacked(
    values: Sequence[FloatArray], slopes: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Of all steps; no derivatives without any."""
    return np.stack(values), np.stack(slopes) if slopes else np.zeros((len(values), 0, 0))


def _none(cable: MovingCable, q: int) -> Columns:
    """No derivatives yet."""
    n, b, d = cable.n_nodes, cable.b, cable.d
    rates = np.zeros((n, b + d, q))
    force = np.zeros((cable.n_segments, d * (1 + 2 * cable.model.n_springs), q))
    turn, place = np.zeros((n, b, q)), np.zeros((n, d, q))
    return Columns(turn, place, rates, rates, rates, force, np.zeros((cable.n_moments, q)))


def _held_forces(cable: MovingCable, states: Sequence[State], slopes: Sequence[Columns]) -> Rows:
    """Forces (S, 2, d) [N] of the cable on its fixtures, from its first and last segments."""
    b, d = cable.b, cable.d
    edges = [0, cable.n_segments - 1]
    every = zip(*(cable.arguments(state) for state in states), strict=True)
    rows = [np.stack([x[edges] for x in own]) for own in every]
    (found,) = cable.segment.mapped("residual")(*rows)
    load = np.array(functions_of(cable.model).dead_load(cable.p)).ravel()
    value, by = np.zeros((len(states), 2, d)), np.zeros((len(states), 2, d, 0))
    if slopes:
        by = np.zeros((len(states), 2, d, slopes[0].place.shape[-1]))
        stiff, damp, mass = cable.segment.mapped("linear")(*rows)[:3]
    sides = ((0, 2 * b, load), (1, 2 * b + d, np.zeros(d)))
    for k, first, known in sides[: 1 + cable.model.end.place]:
        own = slice(first, first + d)
        value[:, k] = known - found[:, k, own, 0]
        for n, x in enumerate(slopes):
            node, size = edges[k], 2 * (b + d)
            moved, rates, changed = (
                both_nodes(cable, one)[node] for one in (x.moved, x.rates, x.accelerations)
            )
            total = stiff[n, k, own, :size] @ moved + stiff[n, k, own, size:] @ x.force[node]
            total = total + damp[n, k, own, :size] @ rates + mass[n, k, own, :size] @ changed
            by[n, k] = -total
    return Rows(value, by)


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
