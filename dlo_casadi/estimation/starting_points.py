"""Where to start: equilibria near the measured shapes for stiffnesses over decades."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.estimation.problem import Point, Problem, Values
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import (
    Guess,
    all_at_once,
    measured_shapes,
    turned_either_way,
)
from dlo_casadi.model.cable_model import END_ROLL, STIFFNESSES

FloatArray = NDArray[np.floating]

# Decades about the prior stiffness from which fits are started.
DECADES = (0, -1, 1, -2, 2, -3, 3)
# Rolls of the end [rad] about which twists are counted in turn: a standard deviation to both sides.
ROLLS = (0.0, 1.0, -1.0)
# Iterations of all starts, and how many more the promising ones take in space, where frames take
# longer: at the true stiffnesses, none of three sessions in which an effect is missing had settled
# after 6 whole steps, two had after 12 to 20, one had not.
FIRST_LOOK, MORE = 6, 14
# Starts that are descended from, and unknowns [scaled] within which two starts are one.
DESCENTS, ALIKE = 3, 1e-2


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
    held, found = _held(problem), list[Point]()
    for guess in _promising(guesses):
        if len(found) == DESCENTS:
            break
        more = all_at_once(problem, guess, held, MORE) if problem.unknowns.model.in_space else None
        for one in (more, guess):
            point = None if one is None else problem.balanced(one, max_iterations=40)
            if point is not None:
                found.append(point)
                break
    return found


def _promising(guesses: Sequence[Guess]) -> list[Guess]:
    """Guesses that differ, the best first."""
    ranked = sorted(guesses, key=lambda guess: guess.objective)
    return [
        guess
        for k, guess in enumerate(ranked)
        if not any(np.allclose(guess.theta, other.theta, atol=ALIKE) for other in ranked[:k])
    ]
