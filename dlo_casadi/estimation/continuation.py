"""Follow the minimum of a relaxed problem while its balance of forces becomes strict."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import BoolArray
from dlo_casadi.equilibrium.solve import solve_after
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.estimation.point import Values
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.model.functions import functions_of

# Std of points, over the length, of the first minimum; the true std follows. Evidence: a strong
# softening hidden in poses of 12 markers of 0.3 mm. Directly, the strict search left 4464 or 6497
# from two starts; by way of 1e-3 or 3e-3 it leaves 529 from both, in a third of the time.
LOOSE = 3e-3


def relaxed(
    problem: Problem,
    values: Values,
    softness: Sequence[float] = SOFTNESS,
    fixed: BoolArray | None = None,
) -> Values:
    """Follow the minimum of a relaxed problem from some values as the softness falls."""
    for soft in softness:
        values = Relaxation(problem, soft).solve(with_unseen_predicted(problem, values), fixed)
    return values


def loosened(problem: Problem, values: Values) -> Problem:
    """The problem with a larger standard deviation of its points.

    If points are known to a fraction of a millimetre, any useful rotation of a node moves the
    other nodes off their points by more: steps were refused, and the descent did not move.
    """
    noise = problem.noise.doubted(LOOSE * problem.unknowns.model.cable.length)
    return replace(problem, noise=noise, weights=None).weighed(values)


def loosely_relaxed(problem: Problem, values: Values, fixed: BoolArray | None = None) -> Values:
    """First minimum of a relaxed problem, starting from that of the loosened problem."""
    values = relaxed(loosened(problem, values), values, SOFTNESS[:1], fixed)
    return relaxed(problem, values, SOFTNESS[:1], fixed)


def with_unseen_predicted(problem: Problem, values: Values) -> Values:
    """Values in which every pose without measurements is at its predicted equilibrium.

    Such poses matter where a state is carried through them. Their first guesses ignore forces, so
    the relaxed balance may keep them in an equilibrium that the fitted model never takes.
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
    """Values with every spring's place set to its point on the cable, even at zero force."""
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
