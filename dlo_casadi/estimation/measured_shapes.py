"""Shapes of all poses along their measured lines, by kinematics alone."""

from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed, ObservedChange
from dlo_casadi.equilibrium.guesses import line_nodes
from dlo_casadi.equilibrium.spans import first_guesses
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.model.assembly import Shapes, Tangents
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose

_KINEMATIC_STEPS = 8
# Eight poses with one photograph each, from two starts: what was left of 8 of the 16 fell by more
# than a tenth between 8 and 12 steps, of 3 between 12 and 20.
_STEPS_WITHOUT_DEPTH = 20


def measured_shapes(
    problem: Problem, roll: float = 0.0, turns: FloatArray | None = None
) -> tuple[Shapes, list[FloatArray]]:
    """Shapes of all poses: along the measured line where there is one, guessed elsewhere.

    Gauss-Newton on the kinematics alone, all poses in step: distances of the points, with a
    small penalty on the second differences of the headings where no point holds them.

    Parameters
    ----------
    roll : float [rad]
        Of the cable in its end clamp, in space: it decides which of the twists that reach the
        clamp is the one nearest to none.
    turns : (m,), optional
        Turns of twist, see `HeldPose`, to which each is the nearest; by default as the poses tell.

    Returns
    -------
    Shapes, list of (K_j,) [m]
        Shapes without multipliers, and arc lengths of the fitted poses' points.
    """
    model, used = problem.unknowns.model, problem.used
    chain = model.chain
    # Without forces an element does not know its inner unknowns.
    equilibria = problem.equilibria
    if chain.kind.n_inner:
        equilibria = BatchEquilibrium(
            model.with_mesh(chain.n, chain.kind.plain), problem.equilibria.poses
        )
    flat = np.zeros(chain.n_rests)
    predicted = np.array(
        [next(first_guesses(model, model.nominal, flat, item.pose))[0] for item in problem.measured]
    )
    along = predicted.copy()
    for j in used:
        item = problem.measured[j].traced
        pose = item.pose.rolled(roll)
        pose = pose if turns is None else replace(pose, turns=float(turns[j]))
        along[j] = line_nodes(item.points, pose, chain, item.places(chain.length))
    shapes, projections, cost = _kinematics(problem, equilibria, along, roll)
    alone = [k for k, j in enumerate(used) if not problem.measured[j].has_line]
    if alone:
        # One photograph shows a bend towards it and one away from it alike.
        others, places, costs = _kinematics(problem, equilibria, predicted, roll)
        for k in alone:
            if costs[k] < cost[k]:
                shapes.x[used[k]], projections[k] = others.x[used[k]], places[k]
    return shapes, projections


def _kinematics(
    problem: Problem, equilibria: BatchEquilibrium, x: FloatArray, roll: float
) -> tuple[Shapes, list[FloatArray], list[float]]:
    """Shapes from nodes x on, arc lengths of the points, and what is left of each (used,) [m^2]."""
    model, used = problem.unknowns.model, problem.used
    lines = [item.traced if item.has_line else item for item in (problem.measured[j] for j in used)]
    shapes = problem.equilibria.start_shapes(x)
    each, flat = _each_node(equilibria), np.zeros(model.chain.n_rests)
    projections = [item.places(model.chain.length) for item in lines]
    cost = [np.inf for _ in used]
    steps = _KINEMATIC_STEPS if all(x.has_line for x in lines) else _STEPS_WITHOUT_DEPTH
    for iteration in range(steps + 1):
        seen = equilibria.observe(shapes, problem.unknowns.fixed, flat, each)
        for k, (j, item) in enumerate(zip(used, lines, strict=True)):
            now, change = seen[j]
            if iteration > 1:
                projections[k] = item.located(now, projections[k])
            elif not item.has_line:
                projections[k] = item.nearest(now.curve)
            if iteration == steps and item is not problem.measured[j]:
                projections[k] = problem.measured[j].nearest(now.curve)
                continue
            rolled = replace(item, pose=item.pose.rolled(roll))
            step, cost[k] = _kinematic_step(rolled, model, now, change, shapes.x[j], projections[k])
            if iteration < steps:
                shapes.x[j] = model.node.moved(shapes.x[j], step)
    return shapes, projections, cost


def _each_node(equilibria: BatchEquilibrium) -> Tangents:
    """Every node moved on its own."""
    a, m = equilibria.assembly, equilibria.m
    q = a.n * a.b
    x = np.broadcast_to(np.eye(q).reshape((a.n, a.b, q)), (m, a.n, a.b, q))
    model = equilibria.model
    counts = (a.k, len(model.parameters), model.chain.n_rests, len(model.deviation_names))
    lam, p, rest, deviation = (np.zeros((m, count, q)) for count in counts)
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
    # 3 mm of noise a point against bends that change by 0.3 turns per length from cell to cell.
    weight = 0.003 / (0.3 * model.cable.curvature_scale * chain.h)
    rough = weight * np.kron(np.diff(np.eye(n), n=2, axis=0), np.eye(b))
    if item.has_line:
        towards = [*curve.moved(s, slopes).transpose((1, 0, 2))]
        gaps = [*(item.points - curve.at(s)).T]
    else:  # a single photograph tells no depth
        on = item.on_points
        residual, moved = item.linearized(now, s, change)
        towards, gaps = [-moved[on]], [residual[on]]
    system: list[FloatArray] = [*towards, rough]
    target: list[FloatArray] = [*gaps, -weight * np.diff(bends, axis=0).ravel()]
    if item.pose.end is not None:
        system.append(10 * slopes[-1, :d])
        target.append(10 * (np.array(item.pose.end) - curve.nodes[-1]))
    for held, index, frame in (
        (model.start == "clamped", 0, item.pose.frames[0]),
        (model.end == "clamped", n - 1, item.pose.frames[1]),
    ):
        if held:
            rows = np.zeros((b, n * b))
            rows[:, index * b : (index + 1) * b] = 0.01 * np.eye(b)
            system.append(rows)
            target.append(0.01 * node.difference(x[index], frame))
    stacked, left = np.concatenate(system), np.concatenate(target)
    step = np.linalg.solve(stacked.T @ stacked, stacked.T @ left)
    step *= min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
    return step.reshape((n, b)), float(left @ left)
