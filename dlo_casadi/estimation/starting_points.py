"""Where to start: equilibria near the measured shapes for stiffnesses over decades."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.composition import END_ROLL, STIFFNESSES
from dlo_casadi.estimation.gauss_newton import BatchProblem
from dlo_casadi.estimation.linearization import Point
from dlo_casadi.estimation.start import (
    Guess,
    all_at_once,
    equilibria_near,
    measured_shapes,
    turned_either_way,
)

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
    problem: BatchProblem,
    theta: FloatArray,
    decades: Sequence[float] = DECADES,
    rolls: Sequence[float] = ROLLS,
    *,
    either_way: bool = False,
) -> list[Point]:
    """Equilibria near the measured shapes for stiffnesses over decades, best first.

    All starts take a few iterations, then the most promising take more, until as many as are
    descended from have led to equilibria. `either_way`: see `turned_either_way`.
    """
    names = problem.unknowns.names
    # Bending and torsion go together: their ratio is known better than either.
    stiffnesses = [k for k, name in enumerate(names) if name in STIFFNESSES]
    rolls = rolls if END_ROLL in names else (0.0,)
    # The roll of a cable in its end clamp is as unknown as its rest shape.
    held = np.array([k < problem.unknowns.n_parameters for k in range(len(names))])
    held &= np.array([name != END_ROLL for name in names])
    guesses: list[Guess] = []
    for roll in rolls:
        shapes, feet = measured_shapes(problem, roll)
        if not problem.has_metric:
            problem.refresh(theta, shapes, feet)
        rolled = theta.copy()
        if roll:
            own = names.index(END_ROLL)
            rolled[own] += roll / problem.unknowns.scales[own]
        if either_way:
            still = held | (np.array(names) == END_ROLL)
            turned = turned_either_way(problem, Guess(rolled, shapes, feet), still, roll)
            shapes, feet = turned.shapes, turned.feet
        for decade in decades:
            start = rolled.copy()
            start[stiffnesses] += decade * np.log(10)
            guess = all_at_once(problem, Guess(start, shapes, feet), held, FIRST_LOOK)
            if guess is not None:
                guesses.append(guess)
    found: list[Point] = []
    for guess in _promising(guesses):
        if len(found) == DESCENTS:
            break
        more = all_at_once(problem, guess, held, MORE) if problem.unknowns.model.in_space else None
        for one in (more, guess):
            point = None if one is None else equilibria_near(problem, one)
            if point is not None:
                found.append(point)
                break
    return sorted(found, key=lambda point: point.objective)


def _promising(guesses: Sequence[Guess]) -> list[Guess]:
    """Guesses that differ, the best first."""
    ranked = sorted(guesses, key=lambda guess: guess.objective)
    return [
        guess
        for k, guess in enumerate(ranked)
        if not any(np.allclose(guess.theta, other.theta, atol=ALIKE) for other in ranked[:k])
    ]
