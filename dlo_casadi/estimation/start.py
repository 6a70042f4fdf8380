"""Where a fit starts: shapes from the measured lines, all at once, over decades of stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.curve import Observed, ObservedChange
from dlo_casadi.equilibrium.guesses import first_nodes, line_nodes
from dlo_casadi.estimation.problem import NO_INFORMATION, Point, Problem, Values
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import DECADES, Search
from dlo_casadi.model.assembly import Shapes, Tangents
from dlo_casadi.model.cable_model import END_ROLL, STIFFNESSES, CableModel
from dlo_casadi.rod.band import Vector
from dlo_casadi.sensing.measured_pose import MeasuredPose

FloatArray = NDArray[np.floating]

_KINEMATIC_STEPS = 8
# Eight poses with one photograph each, from two starts: what was left of 8 of the 16 fell by more
# than a tenth between 8 and 12 steps, of 3 between 12 and 20.
_STEPS_WITHOUT_DEPTH = 20
# A step of all nodes below this [rad] has settled what is solved for all at once.
SETTLED = 1e-3
# No node turns farther in a step [rad]: linearised, balance holds for moderate turns. A judgement.
LONGEST = 0.7
# Twist [rad] from which the other way round is tried: rolls are tried one radian apart, and a
# quarter of a turn of what is missing may be in the rest shape. Iterations that tell the two apart.
EITHER_WAY, LOOK = np.pi / 2, 4
# A step is taken back where the objective has risen beyond this factor, and this part is tried.
RISE, PART = 1.5, 0.3
# Rolls of the end [rad] about which twists are counted in turn: a standard deviation to both sides.
ROLLS = (0.0, 1.0, -1.0)
# Iterations of all starts.
FIRST_LOOK = 6
# Starts that are descended from, and unknowns [scaled] within which two starts are one.
DESCENTS, ALIKE = 3, 1e-2


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
        [first_nodes(model, model.nominal, flat, item.pose)[0] for item in problem.measured]
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


def turned_either_way(
    problem: Problem, guess: Guess, held: NDArray[np.bool_], roll: float
) -> Guess:
    """A guess whose poses are twisted the other way round where that fits better.

    Where the end clamp is rolled by nearly half a turn and the pose does not tell its turns, the
    twist nearest to none may be either way round within what is known of the roll; poses are
    tried one by one, the most twisted first.

    Parameters
    ----------
    held : (size,) bool
        Entries of theta that stay where they are; the roll should.
    roll : float [rad]
        Of the cable in its end clamp, by which the guess's shapes were found.
    """
    twist = problem.unknowns.model.node.turning(guess.shapes.x)
    order = [j for j in np.argsort(-np.abs(twist)) if abs(twist[j]) > EITHER_WAY]
    order = [j for j in order if j in problem.used and not problem.measured[j].pose.turns]
    first = all_at_once(problem, guess, held, LOOK) if order else None
    if first is None:
        return guess
    others, places = measured_shapes(problem, roll, -np.sign(twist) / 2)
    least = first.objective
    for j in order:
        rows, projections = guess.shapes.x.copy(), list(guess.projections)
        k = problem.used.index(j)
        rows[j], projections[k] = others.x[j], places[k]
        other = replace(guess, shapes=replace(guess.shapes, x=rows), projections=projections)
        tried = all_at_once(problem, other, held, LOOK)
        if tried is not None and tried.objective < least:
            guess, least = other, tried.objective
    return guess


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


@dataclass(frozen=True)
class Guess(Values):
    """Values on the way to a first point: shapes that need not be equilibria yet.

    Parameters
    ----------
    objective : float
        What the linearised balance of forces promises at this theta.
    """

    objective: float = np.inf


@dataclass(frozen=True)
class _Step:
    """A Gauss-Newton step from `here`, values with their objective and projections.

    In theta (size,), shapes and the poses' own deviations (m, n_deviations).
    """

    here: Guess
    theta: FloatArray
    shapes: Vector
    deviation: FloatArray

    @property
    def longest(self) -> float:
        """Largest turn of a node [rad]."""
        return float(np.abs(self.shapes.x).max())


def all_at_once(
    problem: Problem, guess: Guess, held: NDArray[np.bool_], iterations: int
) -> Guess | None:
    """Gauss-Newton on shapes, multipliers and unknowns together, from inconsistent values.

    The force balance is linearised about the measured shapes and solved along with the fit, so
    that no equilibrium is needed before the parameters are about right. A step after which the
    objective is RISE times as large is taken back, and a part of it tried.

    Parameters
    ----------
    held : (size,) bool
        Entries of theta that stay where they are.

    Returns
    -------
    Guess or None
        None if the first matrices are singular.
    """
    last: _Step | None = None
    share = 1.0
    for _ in range(iterations + 1):
        step = _step(problem, guess, held)
        if step and not (last and step.here.objective > RISE * last.here.objective):
            last, share = step, min(1.0, LONGEST / max(step.longest, SETTLED))
        elif last is None:
            return None
        else:
            share *= PART
        if share * last.longest < SETTLED:
            break
        # Multipliers, unknown at first, take the whole of their step.
        change = Vector(share * last.shapes.x, last.shapes.y)
        deviation = last.here.shapes.deviation + share * last.deviation
        moved = replace(problem.equilibria.moved(last.here.shapes, change), deviation=deviation)
        guess = Guess(last.here.theta + share * last.theta, moved, last.here.projections)
    return None if last is None else last.here


def _step(problem: Problem, guess: Guess, held: NDArray[np.bool_]) -> _Step | None:
    """Where the linearised balance and residuals lead; None where matrices are singular."""
    unknowns, equilibria, theta = problem.unknowns, problem.equilibria, guess.theta
    state, moving = problem.state(guess), ~held
    here = replace(guess, projections=problem.located(guess, problem.observed(guess)))
    try:
        along = equilibria.directions(*state, unknowns.slopes(theta), unknowns.rest_slopes)
        force = equilibria.imbalance(*state)
        assert along.tangent is not None
        correction = along.tangent.factor().solve(Vector(-force.x, -force.y))
        ahead = problem.linearize_along(here, along, correction)
        normal = problem.normal_equations(here, ahead)
    except np.linalg.LinAlgError:  # a shape about to snap moves without bounds
        return None
    objective = problem.objective(here, ahead.residuals)[0] - normal.by_deviations
    damped = normal.hessian[np.ix_(moving, moving)]
    damped += np.diag(1e-6 * np.diag(damped) + NO_INFORMATION)
    step = np.zeros_like(theta)
    step[moving] = -np.linalg.solve(damped, normal.gradient[moving])
    lower, upper = unknowns.bounds
    step = np.clip(theta + np.clip(step, -3, 3), lower, upper) - theta
    moved, deviation = problem.moved(along, normal, step)
    change = correction + moved
    # A sum of squares: below zero the matrices are singular but for rounding, and promise anything.
    if not (0 <= objective < np.inf and np.all(np.isfinite(change.x))):
        return None
    return _Step(replace(here, objective=objective), step, change, deviation)


def starting_points(
    problem: Problem,
    theta: FloatArray,
    decades: Sequence[float] = DECADES,
    rolls: Sequence[float] = ROLLS,
    *,
    either_way: bool = False,
) -> list[Fit]:
    """Equilibria near the measured shapes for stiffnesses over decades, best first.

    Where the problem has no weights yet, they are taken at the first shapes.

    Starts take a few iterations, then the most promising take more, until as many as are
    descended from have led to equilibria. Where none has, no decade is left out. `either_way`: see
    `turned_either_way`.
    """
    for whole in (False, True):
        problem, guesses = _guesses(
            problem, theta, decades, rolls, either_way=either_way, whole=whole
        )
        found = _equilibria(problem, guesses)
        if found:
            break
    ranked = sorted(found, key=lambda point: point.objective)
    return [Fit(problem, point) for point in ranked]


def _guesses(
    problem: Problem,
    theta: FloatArray,
    decades: Sequence[float],
    rolls: Sequence[float],
    *,
    either_way: bool,
    whole: bool,
) -> tuple[Problem, list[Guess]]:
    """Starts after a few iterations, each roll's over decades of stiffness; see `_outwards`."""
    names = problem.unknowns.names
    rolls = rolls if END_ROLL in names else (0.0,)
    held = _held(problem)
    guesses: list[Guess] = []
    for roll in rolls:
        shapes, projections = measured_shapes(problem, roll)
        if problem.weights is None:
            problem = problem.weighed(Values(theta, shapes, projections))
        rolled = theta.copy()
        if roll:
            own = names.index(END_ROLL)
            rolled[own] += roll / problem.unknowns.scales[own]
        if either_way:
            still = held | (np.array(names) == END_ROLL)
            turned = turned_either_way(problem, Guess(rolled, shapes, projections), still, roll)
            shapes, projections = turned.shapes, turned.projections
        near = Guess(rolled, shapes, projections)
        guesses += _outwards(problem, near, held, decades, whole=whole)
    return problem, guesses


def _outwards(
    problem: Problem,
    near: Guess,
    held: NDArray[np.bool_],
    decades: Sequence[float],
    *,
    whole: bool,
) -> list[Guess]:
    """Guesses by decade, from the middle outwards until the best of them is not an outermost one.

    Over decades of stiffness the objective has one valley, in one of twelve sessions and a ridge
    beside it. With stiffnesses declared right, and 10 and 100 times off either way, eleven sessions
    end at the minimum to which all decades lead, in 55 of 55 fits; so do twelve in space as they
    are declared. `whole`: all decades.
    """
    # Bending and torsion go together: their ratio is known better than either.
    stiffnesses = [k for k, name in enumerate(problem.unknowns.names) if name in STIFFNESSES]
    found: dict[float, Guess] = {}
    for size in sorted({abs(decade) for decade in decades}):
        for decade in (decade for decade in decades if abs(decade) == size):
            theta = near.theta.copy()
            theta[stiffnesses] += decade * np.log(10)
            guess = all_at_once(problem, replace(near, theta=theta), held, FIRST_LOOK)
            if guess is not None:
                found[decade] = guess
        best = min(found, key=lambda decade: found[decade].objective, default=size)
        if abs(best) < size and not whole:
            break
    return list(found.values())


def _held(problem: Problem) -> NDArray[np.bool_]:
    """Entries of theta that starts leave where they are: all but the rest shape.

    And the roll of a cable in its end clamp, which is as unknown.
    """
    names = problem.unknowns.names
    held = np.array([k < problem.unknowns.n_parameters for k in range(len(names))])
    return held & np.array([name != END_ROLL for name in names])


def _equilibria(problem: Problem, guesses: Sequence[Guess]) -> list[Point]:
    """Equilibria that the most promising guesses lead to."""
    held, found, more = _held(problem), list[Point](), Search.of(problem.unknowns.model).more
    ranked = sorted(guesses, key=lambda guess: guess.objective)
    for k, guess in enumerate(ranked):
        if len(found) == DESCENTS:
            break
        if any(np.allclose(guess.theta, other.theta, atol=ALIKE) for other in ranked[:k]):
            continue
        further = all_at_once(problem, guess, held, more) if more else None
        point = equilibria_near(problem, further, guess)
        found += [point] if point else []
    return found


def equilibria_near(problem: Problem, *guesses: Guess | None) -> Point | None:
    """Equilibria near the first of some guesses that has any; None if none has."""
    points = (problem.balanced(guess, max_iterations=40) for guess in guesses if guess)
    return next((point for point in points if point), None)
