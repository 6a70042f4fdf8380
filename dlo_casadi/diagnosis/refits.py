"""From a candidate to a fit with it: where it starts, the refit, and how it compares.

A refit starts from the candidate's one-step estimate at the minimum without it; or, where that
model has gone far astray and no effect can be followed from its shapes, from one of two others.

An unknown force has found shapes that fit, and in every pose a force f_j at one place r_j of the
cable; a load is its cause if its own law gives these forces. All are linear in their parameters
once the place is known (a tether in k and k a: f = k a - k r): least squares tell where to start.

Or the fit begins at the measured shapes. All at once (`start.all_at_once`) no equilibrium is
needed: nodes stay near what was measured, forces come into balance while parameters become right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.screening import Screened, survival
from dlo_casadi.diagnosis.unknown_force import UnknownForce
from dlo_casadi.effects import PointLoad
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend, refit, with_border_of
from dlo_casadi.estimation.fit import STEPS_OF_A_RIVAL, loosened
from dlo_casadi.estimation.problem import Priors, Problem, Values
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import (
    FIRST_LOOK,
    Guess,
    all_at_once,
    equilibria_near,
    measured_shapes,
)
from dlo_casadi.estimation.unknowns import Search, Unknowns
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import END_ROLL, CableModel
from dlo_casadi.runtime.parallel import map_in_order

FloatArray = NDArray[np.floating]

# Shares of the one-step estimate from which a refit is tried.
SHARES = (1.0, 0.5, 0.2, 0.05)
# Share of the gain that the score promises, from which on a refit that creeps is not tried again.
PROMISED = 0.5
# Starts whose objectives end so near to one another have led to one place, and smaller shares begin
# nearer to the base still. Reports of eighteen sessions were the same without that limit.
ONE_PLACE = 1.0
# Gauss-Newton steps of one refit, and of one from forces that scatter from pose to pose.
MOST_STEPS, STEPS_FROM_FORCES = 25, 60
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
class Confirmed:
    """A candidate refitted with all parameters free.

    Parameters
    ----------
    screened : Screened
    fit : Fit
    validation : CrossValidation
    gain : float
        Decrease of twice the objective.
    bic : float
        Gain minus the price of the parameters, q log N; larger is better.
    """

    screened: Screened
    fit: Fit
    validation: CrossValidation
    gain: float
    bic: float

    @classmethod
    def of(cls, screened: Screened, base: Fit, fit: Fit | None) -> Confirmed | None:
        """Compare a fit with a candidate, if there is one, with the base, the fit without it."""
        if fit is None:
            return None
        gain = 2 * (base.point.objective - fit.point.objective)
        price = float(len(screened.candidate.frees) * np.log(max(base.problem.n_residuals, 2)))
        return cls(screened, fit, cross_validate(fit), gain, gain - price)

    @property
    def candidate(self) -> Candidate:
        """The candidate."""
        return self.screened.candidate


def screened_from_data(
    base: Fit, listed: Sequence[Candidate], executor: Executor
) -> list[tuple[Screened, Start]]:
    """Candidates of a base that is astray, started from the measured shapes, best first.

    The score is by how much twice the objective falls, at the noise of a search, below that of
    the model without a candidate, which starts from the measured shapes, too; where it cannot,
    nothing is listed.
    """
    cable, origins = base.model.cable, origins_of(base)
    without = start_from_data(base, origins, None)
    containing = [x for x in listed if any(x.contains(other, cable) for other in listed)]
    simple = [x for x in listed if x not in containing]
    found = map_in_order(executor, partial(start_from_data, base, origins), simple)
    begun = list(zip(simple, found, strict=True))
    for candidate in containing:
        inside = [(x, start) for x, start in begun if start and candidate.contains(x, cable)]
        smaller = min(inside, key=lambda pair: pair[1].guess.objective, default=None)
        begun.append((candidate, start_from_data(base, origins, candidate, smaller)))
    out = []
    for candidate, start in begun:
        if start is not None and without is not None:
            score = max(2 * (without.guess.objective - start.guess.objective), 0.0)
            p_value = survival(score, len(candidate.frees), np.inf)
            out.append((Screened(candidate, score, p_value, {}), start))
    return sorted(out, key=lambda pair: -pair[0].score)


def confirm(base: Fit, screened: Screened) -> Confirmed | None:
    """Refit with a candidate added; None if no equilibria can be followed to it."""
    return Confirmed.of(screened, base, refit_with(base, screened))


def confirm_cause(base: Fit, force: UnknownForce, screened: Screened) -> Confirmed | None:
    """Refit the base's model with a load in the place of the force; None if none can be followed.

    The base has neither.
    """
    values = start_from(force, screened.candidate)
    fit = _followed(force.fit, screened.candidate.add_to(base.model), values, STEPS_FROM_FORCES)
    return Confirmed.of(screened, base, fit)


def confirm_from_data(base: Fit, begun: tuple[Screened, Start]) -> Confirmed | None:
    """Fit with a candidate added, from where it was started; None if that is no equilibrium."""
    with suppress(EstimationError):
        return Confirmed.of(begun[0], base, fit_from_data(base, begun[1]))
    return None


def _followed(
    start: Fit, model: CableModel, values: Mapping[str, float], steps: int = 40
) -> Fit | None:
    """The refit of a model with new parameters at these values; None without equilibria."""
    with suppress(EstimationError):
        return refit(start, model, values=values, steps=steps)
    return None


def refit_with(base: Fit, screened: Screened) -> Fit | None:
    """Fit the model with a candidate added, from its one-step estimate."""
    model = screened.candidate.add_to(base.model)
    begin = dict(zip(model.names, base.values_in(model), strict=True))
    best: Fit | None = None
    for share in SHARES:
        values = {
            name: begin[name] + (share if name in screened.candidate.screened else 1.0) * way
            for name, way in ((q, value - begin[q]) for q, value in screened.start.items())
        }
        fit = _followed(base, model, values, MOST_STEPS)
        if fit is None:
            continue
        same = best is not None and abs(fit.point.objective - best.point.objective) < ONE_PLACE
        if best is None or fit.point.objective < best.point.objective:
            best = fit
        gain = 2 * (base.point.objective - best.point.objective)
        if same or (gain > 0 and (best.converged or gain > PROMISED * screened.score)):
            break
    return best


def refit_without(fit: Fit, candidate: Candidate) -> Fit | None:
    """Fit without a candidate, from the fit with it; None for a nuisance, or if none is found."""
    if candidate.nuisance:
        return None
    return _followed(fit, fit.model.without_effect(candidate.effect.label), {})


def start_from(force: UnknownForce, candidate: Candidate) -> dict[str, float]:
    """Qualified parameters of a load at one place that come closest to the given forces."""
    fit, model = force.fit, force.fit.model
    effect = candidate.effect.linear()
    assert isinstance(effect, PointLoad)
    place = ca.SX.sym("r", len(model.gravity))
    names = [q.name for q in effect.parameters(model.cable) if q.name != "position"]
    linear = ca.SX.sym("linear", len(names))
    params = {name: linear[k] for k, name in enumerate(names)} | {"position": ca.SX(force.position)}
    law = effect.force(place, ca.SX(ca.DM(model.gravity)), params)
    slopes = ca.Function("slopes", [place], [ca.jacobian(law, linear)])
    seen = fit.problem.observed(fit.point)
    places = [seen[j].curve.at(np.array([force.position]))[0] for j in fit.problem.used]
    arms = np.concatenate([np.array(slopes(at)) for at in places])
    found = np.linalg.lstsq(arms, force.force_per_pose.ravel(), rcond=None)[0]
    values = dict(zip(names, map(float, found), strict=True)) | {"position": force.position}
    return candidate.of_linear(model.cable, values)


@dataclass(frozen=True)
class Start:
    """Where a fit of a model begins: a problem, and nodes and parameters that are near balance."""

    problem: Problem
    guess: Guess


class Origin(NamedTuple):
    """Where starts begin: parameters by name, and shapes of m poses along the measured lines.

    `x` (m, n_nodes, coordinates); `projections` (K_j,) [m] of the points of each fitted pose.
    """

    values: dict[str, float]
    x: FloatArray
    projections: list[FloatArray]


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
        found.append(Origin(values, shapes.x, projections))
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
        problem = replace(_searched_problem(base, model), weights=weights)
        self.base, self.model = base, model
        self.begun: list[tuple[dict[str, float], Shapes, list[FloatArray]]] = []
        for values, x, projections in origins:
            shapes = problem.equilibria.start_shapes(x)
            if len(x) != len(problem.indices):
                # A state makes shapes depend on those of poses that were held out.
                shapes, projections = measured_shapes(problem, values.get(END_ROLL, 0.0))
            self.begun.append((values, shapes, projections))
        if weights is None:
            theta = np.zeros(problem.unknowns.size)
            problem = problem.weighed(Values(theta, *self.begun[0][1:]))
        self.problem = problem
        released = set(base.model.priors) - set(model.priors)
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
        values, shapes, projections = self.begun[k]
        p, stiff = self.base.values_in(self.model, {**values, **scan}), self.model.stiffness_indices
        # Torsion goes with bending: their ratio is known better than what a misfit leaves of it.
        p[stiff] = 10**decade * p[0] / self.model.nominal[0] * self.model.nominal[stiff]
        theta = self.problem.unknowns.pack(p, np.zeros(self.model.n_coefficients))
        held = np.array([name in self.kept or name in scan for name in self.problem.unknowns.names])
        return all_at_once(self.problem, Guess(theta, shapes, projections), held, STEPS[0])

    def beyond(self, candidate: Candidate, smaller: Candidate, start: Start) -> list[Guess]:
        """A guess from where a candidate has led that this one contains."""
        other = start.problem.unknowns
        ended, rest = other.p(start.guess.theta), other.coefficients(start.guess.theta)
        there, here = f"{smaller.effect.label}.", f"{candidate.effect.label}."
        renamed = (
            here + name.removeprefix(there) if name.startswith(there) else name
            for name in other.model.names
        )
        known = dict(zip(renamed, ended, strict=True))
        p = np.array([known.get(q.name, q.nominal) for q in self.model.parameters])
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
    problem, noise = base.problem, loosened(base.noise.before or base.noise, model)
    unknowns = Unknowns(model, base.free_in(model), base.values_in(model))
    return Problem(unknowns, problem.history, noise, Priors.of(problem.priors.tolerances, model))


def fit_from_data(base: Fit, start: Start) -> Fit | None:
    """The fit that a start leads to, weighed as the base; None where it leads to no equilibria."""
    problem = start.problem
    none = np.zeros(problem.unknowns.size, dtype=bool)
    guess = all_at_once(problem, start.guess, none, Search.of(base.model).more)
    point = equilibria_near(problem, guess, start.guess)
    if point is None:
        return None
    near = descend(Fit(problem, point), STEPS_OF_A_RIVAL, tolerance=1e-2)
    return descend(near.reweighed(base.noise, base.problem.priors))
