"""From a candidate to a fit with it: where it starts, the refit, and how it compares.

A refit starts from the candidate's one-step estimate at the minimum without it. Where the shapes
there are too far from the measured ones to follow any effect, it starts in two other ways.

An unknown force has found shapes that fit, and in every pose a force f_j at one place r_j of the
cable; a load is its cause if its own law gives these forces. All are linear in their parameters
once the place is known (a tether in k and k a: f = k a - k r): least squares tell where to start.

Or the fit begins at the measured shapes with the balance of forces relaxed, which needs no
equilibrium, see `estimation.relaxation`. The imbalance tells which effect is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np

from dlo_casadi.arrays import BoolArray
from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.screening import (
    RelaxedScreen,
    Screen,
    Screened,
    in_order,
    survival,
)
from dlo_casadi.diagnosis.unknown_force import UnknownForce
from dlo_casadi.effects import PointLoad
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.continuation import relaxed, with_springs_in_place
from dlo_casadi.estimation.descent import carried_shapes, descend, refit
from dlo_casadi.estimation.fit import FIRST_STD, misfits
from dlo_casadi.estimation.problem import Priors, Problem, Values
from dlo_casadi.estimation.relaxation import SOFTNESS, Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import begin, fit_from
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.estimation.variances import refine
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.sensing.noise import NoiseModel

# Shares of the one-step estimate from which a refit is tried.
SHARES = (1.0, 0.5, 0.2, 0.05)
# Share of the gain that the score promises, from which on a refit that creeps is not tried again.
PROMISED = 0.5
# Starts whose objectives end so near to one another have led to one place, and smaller shares begin
# nearer to the base still. Reports of eighteen sessions were the same without that limit.
ONE_PLACE = 1.0
# Softness [rad] at which candidates may be scored; largest sum of squares per residual at which the
# relaxed shapes still count as the measured ones.
SCORED, MEASURED = (1e-1, 3e-2, 1e-2), 2.0
# Softness [rad] through which candidates are relaxed before they are compared, and what one may
# leave there of the objective, relative to the one that leaves least. In two sessions in space the
# hidden effect left 3105 and 8250, its only rival 8051, and all others 27800 and more.
COMPARED, NEAR_LEAST = SOFTNESS[:4], 3.0
# Largest sum of squares per residual at which a start counts as having reached the noise.
REACHED = 1.5
# Gauss-Newton steps of one refit, of one from forces that scatter from pose to pose, and of one
# that is a candidate's score.
MOST_STEPS, STEPS_FROM_FORCES, SHORT = 25, 60, 5


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
    """

    screened: Screened
    fit: Fit
    validation: CrossValidation
    gain: float

    @classmethod
    def of(cls, screened: Screened, base: Fit, fit: Fit | None) -> Confirmed | None:
        """Compare a fit with a candidate, if there is one, with the base, the fit without it."""
        if fit is None:
            return None
        gain = 2 * (base.point.objective - fit.point.objective)
        return cls(screened, fit, cross_validate(fit), gain)

    @property
    def candidate(self) -> Candidate:
        """The candidate."""
        return self.screened.candidate


def from_data(base: Fit) -> tuple[Fit, float]:
    """A base that lacks something, relaxed at the measured shapes; no equilibrium.

    At its known noise, or that of the shapes alone, and from nominal parameters: those of the base
    fit what it lacks. Its softness [rad] is the least of SCORED at which the shapes are still those
    measured.
    """
    model, alone = base.model, replace(NoiseModel(FIRST_STD), readings=base.noise.readings)
    known: NoiseModel = base.noise.before or alone
    p = np.where(base.problem.unknowns.free, model.nominal, base.p)
    problem = replace(_from_data(base, model), noise=known, weights=None)
    start = problem.unknowns.pack(p, np.zeros(model.n_coefficients))
    problem, values = begin(problem, start)
    best = None
    for softness in SCORED:
        values = Relaxation(problem, softness).solve(values)
        near = Fit(problem, problem.evaluate(values))
        if best is not None and near.point.data > MEASURED * problem.n_residuals:
            break
        best = near, softness
    assert best is not None
    return best


def _from_data(base: Fit, model: CableModel) -> Problem:
    """The problem of a model beside a base, at its noise and with priors that know no scatter."""
    unknowns = Unknowns(model, base.free_in(model), base.values_in(model))
    priors = Priors.of(base.problem.priors.tolerances, model)
    return replace(base.problem, unknowns=unknowns, priors=priors)


def screened_from_data(near: Fit, softness: float, listed: Sequence[Candidate]) -> list[Screened]:
    """Score tests in a relaxed model, best first."""
    gradual = [x for x in listed if x.effect.gradual]
    found = RelaxedScreen(near, gradual, softness).run(np.inf) if gradual else []
    found += [scored_from_data(near, softness, x) for x in listed if not x.effect.gradual]
    return in_order(found)


def scored(
    base: Fit, listed: Sequence[Candidate], noise_dof: float, executor: Executor
) -> list[Screened]:
    """Score tests of candidates, best first; see `Screen.run`."""
    gradual = [x for x in listed if x.effect.gradual]
    found = Screen(base, gradual).run(noise_dof, executor) if gradual else []
    others = (x for x in listed if not x.effect.gradual)
    return in_order([*found, *(scored_by_refit(base, x, noise_dof) for x in others)])


def scored_by_refit(base: Fit, candidate: Candidate, noise_dof: float) -> Screened:
    """Test of a candidate that has no derivative where it vanishes: what a refit gains.

    It starts from the base; and from the measured shapes, unless the base leaves no more than a
    declared noise: else its noise may hold what it lacks.
    """
    start = dict(candidate.scans[0])
    fits = [_followed(base, candidate.add_to(base.model), start, MOST_STEPS)]
    if base.beyond_noise or not base.noise.known:
        near, _ = from_data(base)
        begun = RelaxedStart.of(near, Screened(candidate, 0.0, 1.0, start))
        fit = _fit_from_data(near, begun, 3)
        fits.append(fit and fit.reweighed(base.noise, base.problem.priors))
    best = min((x for x in fits if x), key=lambda x: x.point.objective, default=None)
    if best is None:
        return Screened(candidate, 0.0, 1.0, start)
    gain = max(2 * (base.point.objective - best.point.objective), 0.0)
    start = {name: best.value(name) for name in candidate.frees}
    return Screened(candidate, gain, survival(gain, len(start), noise_dof), start, best)


def scored_from_data(near: Fit, softness: float, candidate: Candidate) -> Screened:
    """The same in a relaxed model, at the measured shapes."""
    problem, begun = _begun(near, candidate.add_to(near.model), candidate.scans[0])
    values = Relaxation(problem, softness).solve(begun, steps=SHORT)
    before = Relaxation(near.problem, softness).objective(near.point)
    gain = max(before - Relaxation(problem, softness).objective(values), 0.0)
    p = dict(zip(problem.unknowns.model.names, problem.unknowns.p(values.theta), strict=True))
    start = {name: float(p[name]) for name in candidate.frees}
    return Screened(candidate, gain, survival(gain, len(start), np.inf), start)


def confirm(base: Fit, screened: Screened) -> Confirmed | None:
    """Refit with a candidate added; None if no equilibria can be followed to it."""
    return Confirmed.of(screened, base, screened.fit or refit_with(base, screened))


def confirm_cause(base: Fit, force: UnknownForce, screened: Screened) -> Confirmed | None:
    """Refit the base's model with a load in the place of the force; None if none can be followed.

    The base has neither.
    """
    values = start_from(force, screened.candidate)
    fit = _followed(force.fit, screened.candidate.add_to(base.model), values, STEPS_FROM_FORCES)
    if fit is not None and base.noise.before is not None and not misfits(fit):
        fit = _at_noise(fit, base.noise.before)
    return Confirmed.of(screened, base, fit)


def explains(item: Confirmed | None) -> bool:
    """Whether a refit comes to its points as near as their noise lets expect."""
    if item is None or item.fit.noise.source == "misfit":
        return False
    return item.fit.chi2_per_dof < REACHED


def _at_noise(fit: Fit, noise: NoiseModel) -> Fit:
    """A fit that comes to its points, weighed by their noise instead of that of a misfit."""
    priors = Priors.of(fit.problem.priors.tolerances, fit.model)
    return refine(fit.reweighed(noise, priors), first=True)


@dataclass(frozen=True)
class RelaxedStart:
    """A candidate beside a relaxed fit, its balance nearly strict: no equilibrium yet.

    Parameters
    ----------
    screened : Screened
    problem : Problem
    begun, values : Values
        Before and after.
    left : float
        Twice the objective.
    """

    screened: Screened
    problem: Problem
    begun: Values
    values: Values
    left: float

    @classmethod
    def of(cls, near: Fit, screened: Screened) -> RelaxedStart:
        """From the relaxed shapes, the candidate not there yet.

        In parameters in which it is linear: an anchor is nowhere while its tether does not pull.
        """
        candidate = screened.candidate
        scan = {k: v for k, v in screened.start.items() if k in candidate.scans[0]}
        linear, begun = _begun(near, candidate.add_linear_to(near.model), scan)
        values = relaxed(linear, begun, COMPARED[:1], _places(linear, candidate))
        values = relaxed(linear, values, COMPARED[1:-1])
        problem, values = _in_own_parameters(near, candidate, linear, values)
        strict = Relaxation(problem, COMPARED[-1])
        values = strict.solve(values)
        return cls(screened, problem, begun, values, strict.objective(values))


def nearest(
    near: Fit, likely: Sequence[Screened], executor: Executor
) -> tuple[list[RelaxedStart], list[str]]:
    """Starts of the candidates that leave little more than the one that leaves least.

    Last: names of the others.
    """
    begun = list(map_in_order(executor, partial(RelaxedStart.of, near), likely))
    most = NEAR_LEAST * min((start.left for start in begun), default=np.inf)
    kept = [start for start in begun if start.left <= most]
    return kept, [start.screened.candidate.name for start in begun if start.left > most]


def confirm_from_data(
    base: Fit, near: Fit, start: RelaxedStart, *, starts: int = 3
) -> Confirmed | None:
    """Fit with a candidate added, from the relaxed base; None if that leads to no equilibrium.

    From so many starts at most. Weighed as the base where the candidate does not bring it to the
    noise of the points.
    """
    with suppress(EstimationError):
        fit = _fit_from_data(near, start, starts)
        if fit is not None and misfits(fit):
            fit = descend(fit.reweighed(base.noise, base.problem.priors))
        if fit is not None and not misfits(fit):
            fit = _at_noise(fit, start.problem.noise)
        return Confirmed.of(start.screened, base, fit)
    return None


def _fit_from_data(near: Fit, start: RelaxedStart, starts: int) -> Fit | None:
    """The fit that a relaxed model leads to with a candidate, from the first start that succeeds.

    Starts: the relaxed shapes with the candidate not there yet; the measured shapes anew, in
    parameters in which the candidate is linear; the relaxed shapes with its one-step estimate. A
    pose that turns into another equilibrium on the way of one rarely does so on the others'.
    """
    screened, own, best = start.screened, start.problem.unknowns.model, None
    left = SOFTNESS[len(COMPARED) :]
    ways: tuple[Callable[[], Fit | None], ...] = (
        partial(fit_from, start.problem, start.begun, left, followed=start.values),
        partial(_anew, near, screened),
        lambda: fit_from(*_begun(near, own, screened.start), SOFTNESS),
    )
    for way in ways[:starts]:
        fit = way()
        if fit and (best is None or fit.point.objective < best.point.objective):
            best = fit
        near_noise = best and best.point.data < REACHED * best.problem.n_residuals
        if best and best.converged and near_noise:
            break
    return best


def _begun(near: Fit, model: CableModel, values: Mapping[str, float]) -> tuple[Problem, Values]:
    """A model with a candidate at relaxed shapes, its parameters at values or nominal."""
    problem = _from_data(near, model)
    theta = problem.unknowns.pack(near.values_in(model, values), near.coefficients)
    shapes = carried_shapes(problem, near, relaxed=True)
    begun = Values(problem.unknowns.off_bounds(theta), shapes, near.point.projections)
    return problem, with_springs_in_place(problem, begun)


def _anew(near: Fit, screened: Screened) -> Fit | None:
    """Fit with a candidate from the measured shapes and nominal parameters, at its best place."""
    candidate = screened.candidate
    linear = candidate.add_linear_to(near.model)
    problem = _from_data(near, linear)
    known = dict(zip(linear.names, linear.nominal.tolist(), strict=True))
    known |= {name: screened.start[name] for name in candidate.scans[0] if name in screened.start}
    begun = np.array([known[name] for name in linear.names])
    p = np.where(problem.unknowns.free, begun, problem.unknowns.fixed)
    theta = problem.unknowns.pack(p, np.zeros(linear.n_coefficients))
    theta, fixed = problem.unknowns.off_bounds(theta), _places(problem, candidate)
    problem, found = begin(problem, theta, fixed)
    found = relaxed(problem, found, SOFTNESS[1:3])
    return fit_from(*_in_own_parameters(near, candidate, problem, found), SOFTNESS[2:])


def _places(problem: Problem, candidate: Candidate) -> BoolArray:
    """Which unknowns say where or which way a candidate acts.

    They stay where its score is largest until it acts: before, a step of theirs leads anywhere.
    """
    return np.isin(problem.unknowns.names, list(candidate.scans[0]))


def _in_own_parameters(
    near: Fit, candidate: Candidate, linear: Problem, values: Values
) -> tuple[Problem, Values]:
    """Relaxed values of parameters in which a candidate is linear, in its own parameters."""
    before, model = linear.unknowns.model, candidate.add_to(near.model)
    if before == model:
        return linear, values
    known = dict(zip(before.names, linear.unknowns.p(values.theta).tolist(), strict=True))
    prefix = f"{candidate.effect.label}."
    part = {name: value for name, value in known.items() if name.startswith(prefix)}
    known |= candidate.of_linear(model.cable, part)
    problem, rest = _from_data(near, model), linear.unknowns.coefficients(values.theta)
    p = np.array([known[name] for name in model.names])
    return problem, replace(values, theta=problem.unknowns.pack(p, rest))


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
