"""Fits of a model with an added effect that begin at the measured shapes.

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
from dlo_casadi.estimation.descent import descend, with_border_of
from dlo_casadi.estimation.fit import SEARCH_STD, STEPS_OF_A_RIVAL
from dlo_casadi.estimation.problem import Priors, Problem, Values
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import Guess, all_at_once, measured_shapes
from dlo_casadi.estimation.starting_points import FIRST_LOOK, MORE
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import END_ROLL, CableModel

FloatArray = NDArray[np.floating]

# Decades of stiffness about that of the fit without the effect, and about the prior's. In five
# sessions in which an effect is missing such fits were off by factors of 0.35 to 2.3, priors by 0.6
# to 1.9.
DECADES_NEAR = (-0.5, 0.5)
# Places of an effect that are tried first, and starts that are followed.
PLACES_TRIED, FOLLOWED = 5, 2
# Iterations with the effect's size free, its place and the stiffnesses held; with the stiffnesses,
# too; with all.
STEPS = (FIRST_LOOK, 4, 8)


@dataclass(frozen=True)
class Start:
    """Where a fit of a model begins: a problem, and nodes and parameters that are near balance."""

    problem: Problem
    guess: Guess


@dataclass(frozen=True)
class Origin:
    """Where starts begin: parameters, and shapes along the measured lines.

    Parameters
    ----------
    values : dict
        By the names of the base's parameters.
    x : (m, n_nodes, coordinates)
    projections : list of (K_j,) [m]
    indices : tuple of int
        Places of the m poses in the session.
    """

    values: dict[str, float]
    x: FloatArray
    projections: list[FloatArray]
    indices: tuple[int, ...]


def origins_of(base: Fit) -> tuple[Origin, ...]:
    """What a fit that is astray has found, and what was declared."""
    names, problem = base.model.names, _searched_problem(base, base.model)
    declared = np.where(problem.unknowns.free, base.model.nominal, base.p)
    # Either way round, as the fit has found to fit best.
    turns = base.model.node.turning(base.point.shapes.x) / (2 * np.pi)
    found = []
    for p, own in ((base.p, turns), (declared, None)):
        values = dict(zip(names, map(float, p), strict=True))
        shapes, projections = measured_shapes(problem, values.get(END_ROLL, 0.0), own)
        found.append(Origin(values, shapes.x, projections, tuple(problem.indices)))
    return tuple(found)


def start_from_data(
    base: Fit,
    origins: Sequence[Origin],
    candidate: Candidate | None,
    smaller: tuple[Candidate, Start] | None = None,
) -> Start | None:
    """The best of some starts from the measured shapes.

    Parameters
    ----------
    base : Fit
        Of a model that lacks something.
    origins : sequence of Origin
        Of that fit.
    candidate : Candidate, optional
        What is added to its model; by default nothing.
    smaller : (Candidate, Start), optional
        A candidate that this one contains, and where that has led: the start, if it can be.
    """
    model = linear = base.model if candidate is None else candidate.add_to(base.model)
    scans: tuple[dict[str, float], ...] = ({},)
    if candidate is not None:
        scans, linear = candidate.scans, candidate.add_linear_to(base.model)
    weights = None if smaller is None else smaller[1].problem.weights
    first = _First(base, linear, origins, weights)
    looks: list[tuple[Guess, dict[str, float]]] = []
    if candidate is not None and smaller is not None:
        looks = [(guess, scans[0]) for guess in first.beyond(candidate, *smaller)]
    looks = looks or first.looks(scans[:: -(-len(scans) // PLACES_TRIED)])
    problem, best = first.problem, None
    if linear != model:
        problem = replace(_searched_problem(base, model), weights=problem.weights)
    for look, scan in sorted(looks, key=lambda look: look[0].objective)[:FOLLOWED]:
        guess: Guess | None = look
        if candidate is not None and linear != model:
            guess = first.continued(look, problem, candidate)
        placed = np.array([name in scan for name in problem.unknowns.names])
        for still, steps in ((placed, STEPS[1]), (np.zeros_like(placed), STEPS[2])):
            guess = guess and all_at_once(problem, guess, still, steps)
        if guess is not None and (best is None or guess.objective < best.objective):
            best = guess
    return None if best is None else Start(problem, best)


class _First:
    """First looks at a model, in parameters in which what it has more is linear."""

    def __init__(
        self,
        base: Fit,
        model: CableModel,
        origins: Sequence[Origin],
        weights: tuple[FloatArray, ...] | None,
    ) -> None:
        self.problem = replace(_searched_problem(base, model), weights=weights)
        self.model = model
        self.begun: list[tuple[FloatArray, Shapes, list[FloatArray]]] = []
        for origin in origins:
            p = base.values_in(model)
            for name, value in origin.values.items():
                p[model.names.index(name)] = value
            if tuple(self.problem.indices) == origin.indices:
                shapes, projections = (
                    self.problem.equilibria.start_shapes(origin.x),
                    origin.projections,
                )
            else:  # a state makes shapes depend on those of poses that were held out
                shapes, projections = measured_shapes(
                    self.problem, origin.values.get(END_ROLL, 0.0)
                )
            self.begun.append((p, shapes, projections))
        if weights is None:
            p, shapes, projections = self.begun[0]
            theta = self.problem.unknowns.pack(p, np.zeros(model.n_coefficients))
            self.problem = self.problem.weighed(Values(theta, shapes, projections))
        priors = base.model.priors
        released = {name for name in priors if name not in model.priors}
        self.kept = set(base.model.names) - released - {END_ROLL}

    def looks(self, scans: Sequence[dict[str, float]]) -> list[tuple[Guess, dict[str, float]]]:
        """Guesses after a few steps at places and at stiffnesses, which stay."""
        found = [
            (guess, scan, k)
            for scan in scans
            for k in range(len(self.begun))
            if (guess := self._look(scan, k)) is not None
        ]
        if not found:
            return []
        _, scan, k = min(found, key=lambda look: look[0].objective)
        others = [self._look(scan, k, decade) for decade in DECADES_NEAR]
        return [
            *((guess, scan) for guess, scan, _ in found),
            *((guess, scan) for guess in others if guess is not None),
        ]

    def _look(self, scan: Mapping[str, float], k: int, decade: float = 0.0) -> Guess | None:
        p, shapes, projections = self.begun[k]
        p, stiff = p.copy(), self.model.stiffness_indices
        # Torsion goes with bending: their ratio is known better than what a misfit leaves of it.
        p[stiff] = 10**decade * p[0] / self.model.nominal[0] * self.model.nominal[stiff]
        for name, value in scan.items():
            p[self.model.names.index(name)] = value
        theta = self.problem.unknowns.pack(p, np.zeros(self.model.n_coefficients))
        held = np.array([name in self.kept or name in scan for name in self.problem.unknowns.names])
        return all_at_once(self.problem, Guess(theta, shapes, projections), held, STEPS[0])

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
        begun = Guess(self.problem.unknowns.pack(p, rest), shapes, start.guess.projections)
        held = np.array([name in self.kept for name in self.problem.unknowns.names])
        guess = all_at_once(self.problem, begun, held, STEPS[0])
        return [] if guess is None else [guess]

    def continued(self, guess: Guess, problem: Problem, candidate: Candidate) -> Guess:
        """A guess in the candidate's own parameters."""
        names, found = problem.unknowns.model.names, self.problem.unknowns.p(guess.theta)
        values = dict(zip(self.model.names, map(float, found), strict=True))
        prefix = f"{candidate.effect.label}."
        linear = {name: value for name, value in values.items() if name.startswith(prefix)}
        values.update(candidate.of_linear(self.model.cable, linear))
        rest = self.problem.unknowns.coefficients(guess.theta)
        theta = problem.unknowns.pack(np.array([values[name] for name in names]), rest)
        return replace(guess, theta=theta)


def _searched_problem(base: Fit, model: CableModel) -> Problem:
    """A model's batch problem as a search weighs it."""
    known, problem = base.noise.before or base.noise, base.problem
    noise = known.doubted(SEARCH_STD * model.cable.length)
    unknowns = Unknowns(model, base.free_in(model), base.values_in(model))
    return Problem(unknowns, problem.history, noise, Priors.of(problem.priors.tolerances, model))


def fit_from_data(base: Fit, start: Start) -> Fit | None:
    """The fit that a start leads to, weighed as the base; None where it leads to no equilibria."""
    problem = start.problem
    none = np.zeros(problem.unknowns.size, dtype=bool)
    guess = all_at_once(problem, start.guess, none, MORE)
    for one in (guess, start.guess):
        point = None if one is None else problem.balanced(one, max_iterations=40)
        if point is not None:
            break
    else:
        return None
    near = descend(Fit(problem, point), STEPS_OF_A_RIVAL, tolerance=1e-2)
    return descend(near.reweighed(base.noise, base.problem.priors))
