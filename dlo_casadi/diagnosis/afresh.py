"""Fits that begin at the measured shapes, of a model with something more than one that is astray.

Equilibria of a model that lacks an effect may be far from the measured shapes, and its stiffness
far from the cable's: no path of equilibria leads from there to the model with the effect. All at
once (`start.all_at_once`) no equilibrium is needed: nodes stay near what was measured, forces come
into balance while parameters become right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.estimation.fit import (
    FIRST_LOOK,
    MORE,
    ROUGHNESS_START,
    SEARCH_STD,
    STEPS_OF_A_RIVAL,
    with_border_of,
)
from dlo_casadi.estimation.gauss_newton import BatchProblem
from dlo_casadi.estimation.rest_scatter import RestScatter
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import Guess, all_at_once, equilibria_near, measured_shapes
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model import END_ROLL, CableModel

FloatArray = NDArray[np.floating]

# Decades of stiffness about that of the fit that is astray, and about the prior's. In five sessions
# in which an effect is missing such fits were off by factors of 0.35 to 2.3, priors by 0.6 to 1.9.
DECADES_NEAR = (0.0, -0.5, 0.5)
# Places of an effect that are tried first, and starts that are followed.
PLACES_TRIED, FOLLOWED = 5, 2
# Iterations with the effect's size free, its place and the stiffnesses held; with the stiffnesses,
# too; with all.
STEPS = (FIRST_LOOK, 4, 8)


@dataclass(frozen=True)
class Start:
    """Where a fit of a model begins: a problem, and nodes and parameters that are near balance."""

    problem: BatchProblem
    guess: Guess


def start_afresh(
    base: Fit, candidate: Candidate | None, smaller: tuple[Candidate, Start] | None = None
) -> Start | None:
    """The best of some starts from the measured shapes.

    Parameters
    ----------
    base : Fit
        Of a model that lacks something.
    candidate : Candidate, optional
        What is added to its model; by default nothing.
    smaller : (Candidate, Start), optional
        A candidate that this one contains, and where that has led.
    """
    model = base.model if candidate is None else candidate.add_to(base.model)
    scans: tuple[dict[str, float], ...] = ({},) if candidate is None else candidate.scans
    first = _First(base, base.model if candidate is None else candidate.add_linear_to(base.model))
    tried = [scans[k] for k in range(0, len(scans), -(-len(scans) // PLACES_TRIED))]
    looks = [(guess, scan) for scan in tried for guess in first.looks(scan, DECADES_NEAR[:1])]
    if not looks:
        return None
    _, place = min(looks, key=lambda look: look[0].objective)
    looks += [(guess, place) for guess in first.looks(place, DECADES_NEAR[1:])]
    if candidate is not None and smaller is not None:
        looks += [(guess, place) for guess in first.beyond(candidate, *smaller)]
    looks.sort(key=lambda look: look[0].objective)
    problem, best = _searched_problem(base, model), None
    problem.share_metric(first.problem)
    for look, scan in looks[:FOLLOWED]:
        guess: Guess | None = look
        if candidate is not None and not candidate.nuisance:
            guess = first.continued(look, problem, candidate)
        placed = np.array([name in scan for name in problem.unknowns.names])
        for still, steps in ((placed, STEPS[1]), (np.zeros_like(placed), STEPS[2])):
            guess = guess and all_at_once(problem, guess, still, steps)
        if guess is not None and (best is None or guess.objective < best.objective):
            best = guess
    return None if best is None else Start(problem, best)


class _First:
    """First looks at a model, in parameters in which what it has more is linear."""

    def __init__(self, base: Fit, model: CableModel) -> None:
        self.problem, self.model = _searched_problem(base, model), model
        # What the fit that is astray has found, and what was declared.
        astray, free = base.values_in(model), self.problem.unknowns.free
        self.origins = [astray, np.where(free, model.nominal, astray)]
        names = model.names
        rolls = [
            float(p[names.index(END_ROLL)]) if END_ROLL in names else 0.0 for p in self.origins
        ]
        self.measured = [measured_shapes(self.problem, roll) for roll in rolls]
        priors = base.model.priors
        released = {name for name in priors if name not in model.priors}
        self.kept = set(base.model.names) - released - {END_ROLL}

    def looks(self, scan: Mapping[str, float], decades: Sequence[float]) -> list[Guess]:
        """Guesses after a few steps at a place and at stiffnesses, which stay."""
        held = np.array([name in self.kept or name in scan for name in self.problem.unknowns.names])
        out = []
        for decade in decades:
            for values, (shapes, feet) in zip(self.origins, self.measured, strict=True):
                theta = self._theta(values, scan, decade)
                if not self.problem.has_metric:
                    self.problem.refresh(theta, shapes, feet)
                guess = all_at_once(self.problem, Guess(theta, shapes, feet), held, STEPS[0])
                if guess is not None:
                    out.append(guess)
        return out

    def beyond(self, candidate: Candidate, smaller: Candidate, start: Start) -> list[Guess]:
        """A guess from where a candidate has led that this one contains."""
        other = start.problem.unknowns
        ended, rest = other.p(start.guess.theta), other.coefficients(start.guess.theta)
        there, here = f"{smaller.effect.label}.", f"{candidate.effect.label}."
        values = dict(zip(self.model.names, map(float, self.model.nominal), strict=True))
        for name, value in zip(other.model.names, map(float, ended), strict=True):
            values[here + name.removeprefix(there) if name.startswith(there) else name] = value
        p = np.array([values[name] for name in self.model.names])
        shapes = with_border_of(start.guess.shapes, other.model, self.model)
        begun = Guess(self.problem.unknowns.pack(p, rest), shapes, start.guess.feet)
        held = np.array([name in self.kept for name in self.problem.unknowns.names])
        guess = all_at_once(self.problem, begun, held, STEPS[0])
        return [] if guess is None else [guess]

    def _theta(self, origin: FloatArray, scan: Mapping[str, float], decade: float) -> FloatArray:
        p, stiff = origin.copy(), self.model.stiffness_indices
        # Torsion goes with bending: their ratio is known better than what a misfit leaves of it.
        p[stiff] = 10**decade * origin[0] / self.model.nominal[0] * self.model.nominal[stiff]
        for name, value in scan.items():
            p[self.model.names.index(name)] = value
        return self.problem.unknowns.pack(p, np.zeros(self.model.n_coefficients))

    def continued(self, guess: Guess, problem: BatchProblem, candidate: Candidate) -> Guess:
        """A guess in the candidate's own parameters."""
        names, found = problem.unknowns.model.names, self.problem.unknowns.p(guess.theta)
        values = dict(zip(self.model.names, map(float, found), strict=True))
        prefix = f"{candidate.effect.label}."
        linear = {name: value for name, value in values.items() if name.startswith(prefix)}
        values.update(candidate.of_linear(self.model.cable, linear))
        rest = self.problem.unknowns.coefficients(guess.theta)
        theta = problem.unknowns.pack(np.array([values[name] for name in names]), rest)
        return replace(guess, theta=theta)


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
