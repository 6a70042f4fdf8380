"""The minimum of a relaxed problem followed as its balance of forces becomes strict."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import BoolArray
from dlo_casadi.equilibrium.solve import solve_after
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.estimation.problem import Problem, Values
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.model.functions import functions_of

# Standard deviation of points, over the length, from which the strict ones are approached. Of a
# strong softening hidden in poses of 12 markers of 0.3 mm the strict search left 4464 or 6497, from
# two starts; through 1e-3 or 3e-3 it leaves 529 from both, in a third of the time.
LOOSE = 3e-3


def relaxed(
    problem: Problem,
    values: Values,
    softness: Sequence[float] = SOFTNESS,
    fixed: BoolArray | None = None,
) -> Values:
    """Follow the minimum of a relaxed problem from some values through falling softness."""
    for soft in softness:
        values = Relaxation(problem, soft).solve(with_unseen_predicted(problem, values), fixed)
    return values


def loosened(problem: Problem, values: Values) -> Problem:
    """The problem, its points taken for less sure than they are.

    Between points known to a fraction of a millimetre every turn of a node that matters bends the
    others off them by more: steps were refused, and the descent ended where it began.
    """
    noise = problem.noise.doubted(LOOSE * problem.unknowns.model.cable.length)
    return replace(problem, noise=noise, weights=None).weighed(values)


def loosely_relaxed(problem: Problem, values: Values, fixed: BoolArray | None = None) -> Values:
    """The first minimum of a relaxed problem, approached by that of the loosened one."""
    values = relaxed(loosened(problem, values), values, SOFTNESS[:1], fixed)
    return relaxed(problem, values, SOFTNESS[:1], fixed)


def with_unseen_predicted(problem: Problem, values: Values) -> Values:
    """Values whose poses that no measurement holds are where the model predicts them.

    They count where a state is carried through them. First guesses are made without forces: the
    relaxed balance may keep such a pose in an equilibrium that the fitted model is never in.
    """
    model, shapes = problem.unknowns.model, values.shapes
    if not model.has_state:
        return values
    p, rest = problem.unknowns.p(values.theta), problem.unknowns.rest(values.theta)
    x, lam = shapes.x.copy(), shapes.lam.copy()
    for j in sorted(set(range(len(x))) - set(problem.used)):
        own = problem.equilibria.rests(replace(shapes, x=x, lam=lam), p, rest)[j]
        before = (problem.measured[j - 1].pose, x[j - 1]) if j else None
        with suppress(EquilibriumError):
            found = solve_after(model, p, own, problem.measured[j].pose, before)
            x[j], lam[j] = found.x, found.multipliers
    return replace(values, shapes=replace(shapes, x=x, lam=lam))


def with_springs_in_place(problem: Problem, values: Values) -> Values:
    """Values whose springs, which need not pull yet, are where they hang on the cable."""
    model = problem.unknowns.model
    if not model.n_springs:
        return values
    places = functions_of(model).spring_places(problem.unknowns.p(values.theta))
    lam, seen = values.shapes.lam.copy(), problem.observed(values)
    for k, place in enumerate(np.array(places)):
        names = [f"spring_{k}.place_{axis}" for axis in model.node.axes]
        columns = [model.border_names.index(name) for name in names]
        lam[:, columns] = [one.curve.at(place)[0] for one in seen]
    return replace(values, shapes=replace(values.shapes, lam=lam))
