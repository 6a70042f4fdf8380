"""Shapes along the measured lines, before any force is known."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.effects import BoundaryEffect, Kinematics, MeasurementEffect
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed, ObservedChange
from dlo_casadi.equilibrium.measured_line import line_nodes
from dlo_casadi.equilibrium.spans import fed_rows, first_guesses
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.model.assembly import Shapes, Tangents
from dlo_casadi.model.cable_model import END_ROLL, STIFFNESSES, CableModel
from dlo_casadi.model.clipped import rolled_with
from dlo_casadi.sensing.measured_pose import MeasuredPose

_KINEMATIC_STEPS = 8
# Evidence: eight poses with one photograph each, from two starts. Between 8 and 12 steps the
# residual of 8 of the 16 fell by more than a tenth; between 12 and 20 steps that of 3.
_STEPS_WITHOUT_DEPTH = 20
# Damping of a step, relative to the mean diagonal: nothing holds the roll of a cable between ball
# joints about its axis, and undamped steps of 20 to 1e10 rad in it left no room for the others. It
# moves no shape in a plane or between clamps by a micrometre.
_DAMPING = 1e-6
# Maximum number of results kept: a session asks for about twenty, many of them repeatedly.
_KINEMATICS = 24


def measured_shapes(
    problem: Problem, roll: float = 0.0, turns: FloatArray | None = None
) -> tuple[Shapes, list[FloatArray]]:
    """Shapes of all poses: along the measured line if there is one, else a first guess.

    Gauss-Newton on the kinematics alone, all poses at once: distances of the points, with a small
    penalty on the second differences of the headings where no point determines them.

    Parameters
    ----------
    roll : float [rad]
        Roll of the cable in its end clamp, in space: it selects the smallest twist that reaches
        the clamp.
    turns : (m,), optional
        Turns of twist to which each pose is nearest, see `HeldPose`; by default as poses name them.

    Returns
    -------
    Shapes, list of (K_j,) [m]
        Shapes without multipliers, and arc lengths of the fitted poses' points.
    """
    model, chain = problem.unknowns.model, problem.unknowns.model.chain
    # Without forces only effects that move the measured curve count, and the internal unknowns of
    # an element are undetermined.
    moving = Kinematics | MeasurementEffect | BoundaryEffect
    kept = tuple(effect for effect in model.effects if isinstance(effect, moving))
    bare = replace(model, effects=kept, priors={}).with_mesh(chain.n, chain.kind.plain)
    if all(j in problem.used and item.has_line for j, item in enumerate(problem.measured)):
        # Only first guesses depend on gravity: sessions under several gravities share the result.
        bare = replace(bare, gravity=tuple(0.0 for _ in model.gravity))
    p = dict(zip(model.names, problem.unknowns.fixed.tolist(), strict=True))
    # These change nothing here: with the same values for all fits, results are found again.
    p |= dict.fromkeys(p.keys() & {*STIFFNESSES, END_ROLL}, 1.0)
    x, projections = _along(
        bare,
        tuple(p[name] for name in bare.names),
        problem.measured,
        tuple(problem.used),
        roll,
        None if turns is None else tuple(turns.tolist()),
    )
    shapes = problem.equilibria.start_shapes(x.copy())
    shapes = with_fed_lengths(shapes, model, enumerate(problem.measured))
    return shapes, [places.copy() for places in projections]


def with_fed_lengths(
    shapes: Shapes, model: CableModel, measured: Iterable[tuple[int, MeasuredPose]]
) -> Shapes:
    """Shapes fed through ends that slide as much as measured lines are longer than the cable.

    `measured`: index and measurement of some poses.
    """
    lam = shapes.lam.copy()
    for j, item in measured if model.slides else ():
        if item.has_line:
            ends = item.ends(model.cable.length, model.loose)
            for row, end in fed_rows(model).items():
                lam[j, row] = ends[end]
    return replace(shapes, lam=lam)


@lru_cache(maxsize=_KINEMATICS)
def _along(
    model: CableModel,
    p: tuple[float, ...],
    measured: tuple[MeasuredPose, ...],
    used: tuple[int, ...],
    roll: float,
    turns: tuple[float, ...] | None,
) -> tuple[FloatArray, list[FloatArray]]:
    """Nodes (m, n_nodes, coordinates) of `measured_shapes`, and arc lengths of points."""
    chain, flat = model.chain, np.zeros(model.chain.n_rests)
    guesses = (first_guesses(model, model.nominal, flat, item.pose) for item in measured)
    predicted = np.array([next(guess)[0] for guess in guesses])
    along = predicted.copy()
    for j in used:
        item = measured[j].traced
        pose = item.pose.rolled(roll)
        pose = pose if turns is None else replace(pose, turns=turns[j])
        if item.has_points:  # of readings alone it stays the first guess
            at = item.places(chain.length, model.loose)
            along[j] = line_nodes(item.points, pose, model, at)
    seen = [j for j in used if measured[j].has_points]
    fitted = [measured[j] for j in seen]
    wrenches = any(item.reactions for item in fitted if not item.has_line)
    equilibria = BatchEquilibrium(model, [item.pose for item in measured], wrenches=wrenches)
    if not seen:
        return along, [np.zeros(0) for _ in used]
    shapes, projections, cost = _kinematics(equilibria, np.array(p), fitted, seen, along, roll)
    alone = [k for k, item in enumerate(fitted) if not item.has_line]
    if alone:
        # One photograph cannot distinguish a bend towards the camera from one away from it.
        others, places, costs = _kinematics(equilibria, np.array(p), fitted, seen, predicted, roll)
        for k in alone:
            if costs[k] < cost[k]:
                shapes.x[seen[k]], projections[k] = others.x[seen[k]], places[k]
    places_of = dict(zip(seen, projections, strict=True))
    return shapes.x, [places_of.get(j, np.zeros(0)) for j in used]


def _kinematics(
    equilibria: BatchEquilibrium,
    p: FloatArray,
    fitted: Sequence[MeasuredPose],
    used: Sequence[int],
    x: FloatArray,
    roll: float,
) -> tuple[Shapes, list[FloatArray], list[float]]:
    """Shapes from nodes x on, arc lengths of points, and residual of each (used,) [m^2]."""
    model = equilibria.model
    shapes = with_fed_lengths(equilibria.start_shapes(x), model, zip(used, fitted, strict=True))
    lines = [item.traced if item.has_line else item for item in fitted]
    each, flat = _each_node(equilibria), np.zeros(model.chain.n_rests)
    projections = [item.places(model.chain.length, model.loose) for item in lines]
    cost = [np.inf for _ in used]
    steps = _KINEMATIC_STEPS if all(x.has_line for x in lines) else _STEPS_WITHOUT_DEPTH
    for iteration in range(steps + 1):
        seen = equilibria.observe(shapes, p, flat, each)
        for k, (j, item) in enumerate(zip(used, lines, strict=True)):
            now, change = seen[j]
            if iteration > 1:
                projections[k] = item.located(now, projections[k])
            elif not item.has_line:
                projections[k] = item.nearest(now.curve)
            if iteration == steps and item is not fitted[k]:
                projections[k] = fitted[k].nearest(now.curve)
                continue
            rolled = replace(item, pose=item.pose.rolled(roll))
            step, cost[k] = _kinematic_step(rolled, model, now, change, shapes.x[j], projections[k])
            if iteration < steps:
                shapes.x[j] = model.node.moved(shapes.x[j], step)
    return shapes, projections, cost


def _each_node(equilibria: BatchEquilibrium) -> Tangents:
    """Directions: each increment of each node."""
    model, m = equilibria.model, equilibria.m
    n, b = model.chain.n_nodes, model.node.increment
    x = np.broadcast_to(np.eye(n * b).reshape((n, b, n * b)), (m, n, b, n * b))
    counts = model.n_border, len(model.names), model.chain.n_rests, len(model.deviation_names)
    lam, p, rest, deviation = (np.zeros((m, count, n * b)) for count in counts)
    return Tangents(x, lam, p, rest, deviation)


def _kinematic_step(
    item: MeasuredPose,
    model: CableModel,
    now: Observed,
    change: ObservedChange,
    x: FloatArray,
    s: FloatArray,
) -> tuple[FloatArray, float]:
    """Increments (n_nodes, b) towards the points, at most half a radian, and what is left [m^2]."""
    chain, node = model.chain, model.node
    n, b, d = len(x), node.increment, node.dimension
    curve, slopes = now.curve, change.curve
    bends = node.difference(x[:-1], x[1:])
    # Weight of 3 mm noise per point against bends that vary by 0.3 turns per length between cells.
    weight = 0.003 / (0.3 * model.cable.curvature_scale * chain.h)
    rough = weight * np.kron(np.diff(np.eye(n), n=2, axis=0), np.eye(b))
    if item.has_line:
        towards = [*curve.moved(s, slopes, change.knots).transpose((1, 0, 2))]
        gaps = [*(item.points - curve.at(s)).T]
    else:  # a single photograph does not show depth
        on = item.on_points
        residual, moved = item.linearized(now, s, change)
        towards, gaps = [-moved[on]], [residual[on]]
    system: list[FloatArray] = [*towards, rough]
    target: list[FloatArray] = [*gaps, -weight * np.diff(bends, axis=0).ravel()]
    if item.pose.end is not None:
        system.append(10 * slopes[-1, :d])
        target.append(10 * (np.array(item.pose.end) - curve.nodes[-1]))
    for kind, index, frame in (
        (model.start, 0, item.pose.frames[0]),
        (model.end, n - 1, item.pose.frames[1]),
    ):
        if kind.direction:
            own = frame if kind.roll or not node.twists else rolled_with(frame[None], x[[index]])[0]
            rows = np.zeros((b, n * b))
            rows[:, index * b : (index + 1) * b] = 0.01 * np.diag(kind.rotations(node))
            system.append(rows)
            target.append(0.01 * node.difference(x[index], own))
    stacked, left = np.concatenate(system), np.concatenate(target)
    matrix = stacked.T @ stacked
    matrix.flat[:: len(matrix) + 1] += _DAMPING * np.trace(matrix) / len(matrix)
    step = np.linalg.solve(matrix, stacked.T @ left)
    step *= min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
    return step.reshape((n, b)), float(left @ left)
