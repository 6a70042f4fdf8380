"""Fits that begin at the measured shapes, of a model with something more than one that is astray.

Equilibria of a model that lacks an effect may be far from the measured shapes, and its stiffness
far from the cable's: no path of equilibria leads from there to the model with the effect. All at
once (`start.all_at_once`) no equilibrium is needed: nodes stay near what was measured, forces come
into balance while parameters become right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.estimation.fit import (
    FIRST_LOOK,
    MORE,
    ROUGHNESS_START,
    SEARCH_STD,
    STEPS_OF_A_RIVAL,
)
from dlo_casadi.estimation.gauss_newton import BatchProblem
from dlo_casadi.estimation.rest_scatter import RestScatter
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import Guess, all_at_once, equilibria_near, measured_shapes
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model import END_ROLL, STIFFNESSES, CableModel

FloatArray = NDArray[np.floating]

# Decades of stiffness about that of the fit that is astray: in four sessions in which an effect is
# missing its bending stiffness was off by factors of 0.6 to 2.1.
DECADES_NEAR = (0.0, -0.5, 0.5)
# Places of an effect that are tried first.
PLACES_TRIED = 5
# Iterations with the effect's size free, its place and the stiffnesses held; with the stiffnesses,
# too; with all.
STEPS = (FIRST_LOOK, 4, 8)


@dataclass(frozen=True)
class Start:
    """Where a fit of a model begins: a problem, and nodes and parameters that are near balance."""

    problem: BatchProblem
    guess: Guess


def start_afresh(
    base: Fit, model: CableModel, scans: Sequence[Mapping[str, float]] = ({},)
) -> Start | None:
    """The best of some starts from the measured shapes.

    Parameters
    ----------
    base : Fit
        Of a model that lacks something.
    model : CableModel
        Its model, with something more.
    scans : sequence of dict
        Values of parameters that are held at first; PLACES_TRIED of them are tried.
    """
    problem, values = _searched_problem(base, model), base.values_in(model)
    names, free = list(model.names), problem.unknowns.names
    # Torsion goes with bending: their ratio is known better than what a misfit leaves of it.
    values[model.stiffness_indices] = (
        model.nominal[model.stiffness_indices] * values[0] / model.nominal[0]
    )
    roll = float(values[names.index(END_ROLL)]) if END_ROLL in names else 0.0
    shapes, feet = measured_shapes(problem, roll)
    shared = {name for name in base.model.names if name not in _released(base.model, model)}
    placed = np.array([name in scans[0] for name in free])
    held = placed | np.array([name in shared and name != END_ROLL for name in free])
    stiffnesses = [k for k, name in enumerate(free) if name in STIFFNESSES]

    def look(scan: Mapping[str, float], decade: float) -> Guess | None:
        begin = values.copy()
        for name, value in scan.items():
            begin[names.index(name)] = value
        theta = problem.unknowns.pack(begin, np.zeros(model.n_coefficients))
        theta[stiffnesses] += decade * np.log(10)
        if not problem.has_metric:
            problem.refresh(theta, shapes, feet)
        return all_at_once(problem, Guess(theta, shapes, feet), held, STEPS[0])

    looks = {k: look(scans[k], 0.0) for k in range(0, len(scans), -(-len(scans) // PLACES_TRIED))}
    known = {k: guess for k, guess in looks.items() if guess is not None}
    if not known:
        return None
    place = min(known, key=lambda k: known[k].objective)
    found = []
    for decade in DECADES_NEAR:
        guess = look(scans[place], decade) if decade else known[place]
        for still, steps in ((placed, STEPS[1]), (np.zeros_like(placed), STEPS[2])):
            guess = guess and all_at_once(problem, guess, still, steps)
        if guess is not None:
            found.append(guess)
    best = min(found, key=lambda guess: guess.objective, default=None)
    return None if best is None else Start(problem, best)


def _searched_problem(base: Fit, model: CableModel) -> BatchProblem:
    """A model's batch problem as a search weighs it."""
    known, problem = base.noise.before or base.noise, base.problem
    noise = known.doubted(SEARCH_STD * model.cable.length)
    scatter = problem.tolerances.deviation(model.node)
    unknowns = Unknowns(model, base.free_in(model), base.values_in(model))
    rest = RestScatter()
    return BatchProblem(
        unknowns, problem.history, noise, problem.tolerances, ROUGHNESS_START, scatter, rest
    )


def _released(model: CableModel, other: CableModel) -> set[str]:
    """Parameters that one model knows within their tolerances and another does not."""
    return {name for name in model.priors if name not in other.priors}


def fit_afresh(base: Fit, start: Start) -> Fit | None:
    """The fit that a start leads to, weighed as the base; None where it leads to no equilibria."""
    problem = start.problem
    none = np.zeros(problem.unknowns.size, dtype=bool)
    guess = all_at_once(problem, start.guess, none, MORE)
    for one in (guess, start.guess):
        point = None if one is None else equilibria_near(problem, one)
        if point is not None:
            break
    else:
        return None
    point, _ = problem.descend(point, STEPS_OF_A_RIVAL, tolerance=1e-2)
    alike = base.problem.of(problem.unknowns)
    point = alike.taken_over(point)
    return Fit(alike, *alike.descend(point))
