"""From a residual to the effects that are missing: screen, confirm, add, until it is noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.diagnosis.candidates import Candidate, candidates
from dlo_casadi.diagnosis.confirm import Confirmed, confirm
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.equivalents import untried_equivalents
from dlo_casadi.diagnosis.next_pose import NextPose, next_pose
from dlo_casadi.diagnosis.pull import Pull, estimate_pull
from dlo_casadi.diagnosis.repeatability import limiting_spread
from dlo_casadi.diagnosis.screening import Screen, Screened, survival
from dlo_casadi.diagnosis.structure import (
    Structure,
    noise_degrees,
    screening_degrees,
    structure_of,
)
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.hyperparameters import noise_of, settle
from dlo_casadi.estimation.result import Fit
from dlo_casadi.executors import InProcess
from dlo_casadi.parallel import map_in_order

FloatArray = NDArray[np.floating]
Verdict = Literal["complete", "effect_found", "unexplained"]

# Candidates that are refitted at most in one step, and the share of the leading score below
# which one is not worth a refit.
REFITTED = 6
WORTH = 0.1
# A rival whose BIC falls short by more than this is told apart by the data ("very strong",
# Kass and Raftery 1995), whatever its cross-validated error.
BIC_APART = 10.0
# Effects are no explanation if a pose that is left out is predicted worse than so many times the
# noise, and than half of what it was without them.
UNSEEN = 2.0


@dataclass(frozen=True)
class AddedEffect:
    """An effect that the data ask for.

    Parameters
    ----------
    candidate : Candidate
    p_value : float
        Score test, corrected for places and candidates. Where the noise is estimated, the larger
        of it and of the test under the noise that is left once the effect is in the model.
    before, after : CrossValidation
        Without and with the effect.
    rivals : tuple of Confirmed
        Candidates that could not be told apart from it.
    untried : tuple of str
        Effects that act as it does and were not among the candidates.
    """

    candidate: Candidate
    p_value: float
    before: CrossValidation
    after: CrossValidation
    rivals: tuple[Confirmed, ...]
    untried: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ranked:
    """A candidate in the list of all that were tried."""

    name: str
    score: float
    p_value: float
    rmse_cross_validated: float | None


@dataclass(frozen=True)
class Diagnosis:
    """What the residual of a fit has led to.

    Parameters
    ----------
    before, after : Fit
        The declared model, and the model with the effects that were added.
    validation_before, validation_after : CrossValidation
    structure_before, structure_after : Structure
    added : tuple of AddedEffect
    ranked : tuple of Ranked
        All candidates of the first step: those confirmed by BIC, then the others by score.
    unexplained : bool
        Whether structure is left, or poses that were left out are not predicted.
    pull : Pull or None
        Where that is so: the load that assumes no cause; None where none fits.
    proposal : NextPose or None
        What separates an effect from its best rival.
    proposal_for : tuple of str
        Names of those two; empty where there is no rival.
    """

    before: Fit
    after: Fit
    validation_before: CrossValidation
    validation_after: CrossValidation
    structure_before: Structure
    structure_after: Structure
    added: tuple[AddedEffect, ...] = ()
    ranked: tuple[Ranked, ...] = ()
    unexplained: bool = False
    pull: Pull | None = None
    proposal: NextPose | None = None
    proposal_for: tuple[str, ...] = field(default_factory=tuple)

    @property
    def verdict(self) -> Verdict:
        """Whether the model is complete, an effect was found, or neither explains the data."""
        if self.unexplained:
            return "unexplained"
        return "effect_found" if self.added else "complete"


def diagnose(
    fit: Fit,
    *,
    center: tuple[float, float] | None = None,
    exclude: Sequence[str] = (),
    significance: float = 0.005,
    max_effects: int = 4,
    step: Callable[[str, int, int], None] = lambda name, done, total: None,
    executor: Executor | None = None,
) -> Diagnosis:
    """Search for effects that a fitted model lacks.

    Held-out poses are not looked at.

    Parameters
    ----------
    fit : Fit
        Of the declared model.
    center : (float, float), optional [m]
        Middle of the photographs in the board frame.
    exclude : sequence of str
        Effects that are not tried.
    significance : float
        Probability of a false alarm in a complete model, over all candidates.
    max_effects : int
    step : callable
        Told how far the search has come.
    executor : Executor, optional
        Where candidates are refitted and places of an unknown load tried, half a second to some
        seconds each; in this process by default.
    """
    executor = executor or InProcess()
    current, validation = fit, cross_validate(fit)
    before, first_structure = validation, structure_of(fit, screening_degrees(fit))
    doubt = significance if limiting_spread(fit) is not None else None
    added: list[AddedEffect] = []
    ranked: list[Ranked] = []
    for k in range(max_effects):
        step("search for a missing effect", k, max_effects)
        screened = screen(current, center, exclude)
        corrected = [_corrected(item.p_value, len(screened)) for item in screened]
        significant = [
            item for item, p in zip(screened, corrected, strict=True) if p < significance
        ]
        confirmed = _confirmed(current, significant, validation, executor, doubt)
        if k == 0:
            ranked = _ranking(screened, corrected, confirmed)
        # What a second effect explains may be what the first one, if wrong, has left.
        chosen = _choose(confirmed, np.inf if added else BIC_APART)
        if chosen is None:
            break
        winner, rivals = chosen
        p_value = corrected[screened.index(winner.screened)]
        closed = settle(winner.fit)
        if not fit.noise.declared:
            p_value = max(p_value, _p_with_closed_noise(current, closed, winner, len(screened)))
            if p_value > significance:
                break
        current = closed
        after = cross_validate(current)
        added.append(AddedEffect(winner.candidate, p_value, validation, after, tuple(rivals)))
        validation = after
    if not added and not fit.noise.declared:
        current = settle(current)
    step("search for a missing effect", max_effects, max_effects)
    current, added = prune(current, added, significance)
    validation = cross_validate(current)
    structure = structure_of(current, noise_degrees(current))
    pull, found = None, bool(added)
    unpredicted = found and validation.rmse > max(UNSEEN * current.noise.std, before.rmse / 2)
    unexplained = structure.p_value < significance or unpredicted
    if unexplained:
        pull, current, added = _unexplained(fit, current, added, executor)
    tried = {row.name for row in ranked}
    added = [
        replace(item, untried=untried_equivalents(current, item.candidate, tried)) for item in added
    ]
    proposal, names = _proposal(current, added)
    return Diagnosis(
        fit,
        current,
        before,
        validation,
        first_structure,
        structure,
        tuple(added),
        tuple(ranked),
        unexplained,
        pull,
        proposal,
        names,
    )


def screen(fit: Fit, center: tuple[float, float] | None, exclude: Sequence[str]) -> list[Screened]:
    """Score tests of all candidates at a fit, best first."""
    phi = fit.point.shapes.phi
    directions = (float(phi[:, 0].mean()), float(phi[:, -1].mean()))
    history = fit.problem.history
    camera = any(item.pose.camera_center is not None for item in history)
    listed = candidates(fit.model, center, len(history), exclude, directions, camera)
    return Screen(fit, listed).run(screening_degrees(fit)) if listed else []


def _corrected(p_value: float, tried: int) -> float:
    """Probability that the best of so many independent tests is as good (Sidak)."""
    return float(-np.expm1(tried * np.log1p(-min(p_value, 1 - 1e-16))))


def _p_with_closed_noise(open_: Fit, closed: Fit, winner: Confirmed, tried: int) -> float:
    """Significance of an effect under the noise that is left once it is in the model.

    The noise estimated without the effect holds a part of the effect, or, where it was kept out,
    lacks a part of the noise. Where nothing else is missing all that is left is noise, its slow
    modes included; where something is, the noise is too large and the significance too low.
    """
    try:
        noise = noise_of(closed.problem, closed.point, closed.linearization, modes=0)
    except EstimationError:  # with the effect hardly a point is left over: nothing is shown
        return 1.0
    problem = open_.problem.changed(noise, open_.problem.roughness_std, open_.problem.scatter)
    problem.refresh(open_.point.feet)
    point = problem.evaluate(open_.point.theta, open_.point.shapes, open_.point.feet)
    point, _ = problem.descend(point)
    larger = closed.problem.changed(noise, open_.problem.roughness_std, open_.problem.scatter)
    larger.refresh(closed.point.feet)
    other = larger.evaluate(closed.point.theta, closed.point.shapes, closed.point.feet)
    other, _ = larger.descend(other)
    gain = max(2 * (point.objective - other.objective), 0.0)
    dof = len(winner.candidate.frees)
    return _corrected(survival(gain, dof, max(4.0, noise.slow_dof)), tried)


def _confirmed(
    current: Fit,
    significant: Sequence[Screened],
    validation: CrossValidation,
    executor: Executor,
    doubt: float | None,
) -> list[Confirmed]:
    """Refits of the leading candidates that improve the fit and what it predicts.

    Where the same pose does not repeat to the noise, scores count points as if they were
    independent, and they are not. There whole poses alone decide: a gain as large must have less
    than the probability `doubt` if poses that are left out are predicted no better (Student's t).
    """
    if not significant:
        return []
    top = max(item.score for item in significant)
    leading = sorted(significant, key=lambda item: -item.score)[:REFITTED]
    worthy = [item for item in leading if item.score >= WORTH * top]
    out = []
    for tried in map_in_order(executor, partial(confirm, current), worthy):
        if tried is None or tried.bic <= 0 or not tried.validation.complete:
            continue
        # An effect that explains the fitted poses but predicts the others worse is none.
        if tried.validation.rmse > validation.rmse:
            continue
        if doubt is None or validation.chance_of_gain(tried.validation) < doubt:
            out.append(tried)
    return out


def _choose(
    confirmed: Sequence[Confirmed], apart: float
) -> tuple[Confirmed, list[Confirmed]] | None:
    """The best by cross-validation (BIC among those not clearly worse), and its rivals.

    Rivals are those not clearly worse whose BIC falls short by less than `apart`.
    """
    if not confirmed:
        return None
    leader = min(confirmed, key=lambda item: item.validation.rmse)
    close = [
        item for item in confirmed if not item.validation.clearly_worse_than(leader.validation)
    ]
    winner = max(close, key=lambda item: item.bic)
    rivals = [item for item in close if item is not winner and item.bic > winner.bic - apart]
    return winner, sorted(rivals, key=lambda item: -item.bic)


def _ranking(
    screened: Sequence[Screened], corrected: Sequence[float], confirmed: Sequence[Confirmed]
) -> list[Ranked]:
    """All candidates: those refitted by BIC, then the others by score."""
    refitted = {item.candidate.name: item for item in confirmed}
    rows = [
        Ranked(
            item.candidate.name,
            item.score,
            p,
            refitted[item.candidate.name].validation.rmse
            if item.candidate.name in refitted
            else None,
        )
        for item, p in zip(screened, corrected, strict=True)
    ]

    def order(row: Ranked) -> tuple[float, float]:
        known = refitted.get(row.name)
        return (-known.bic if known else np.inf, -row.score)

    return sorted(rows, key=order)


def prune(fit: Fit, added: list[AddedEffect], significance: float) -> tuple[Fit, list[AddedEffect]]:
    """Backward step: drop an effect that a later one has made superfluous."""
    if len(added) < 2:
        return fit, added
    for effect in list(added[:-1]):
        smaller = _drop(fit, effect.candidate)
        if smaller is None:
            continue
        again = [
            item
            for item in screen(smaller, None, ())
            if item.candidate.name == effect.candidate.name
        ]
        price = len(effect.candidate.frees) * np.log(fit.problem.n_points)
        gain = 2 * (smaller.point.objective - fit.point.objective)
        if gain < price or (again and again[0].p_value > significance):
            fit = settle(smaller)
            added = [item for item in added if item is not effect]
    return fit, added


def _drop(fit: Fit, candidate: Candidate) -> Fit | None:
    """Fit without a candidate, from the fit with it."""
    if candidate.nuisance:
        return None
    model = fit.model.without_effect(candidate.effect.label)
    try:
        return fit_model(model, fit.problem.history, fit.problem.tolerances, start=fit)
    except EstimationError:
        return None


def _unexplained(
    declared: Fit, current: Fit, added: list[AddedEffect], executor: Executor
) -> tuple[Pull | None, Fit, list[AddedEffect]]:
    """Estimate the load without a cause; effects that it makes needless are withdrawn."""
    pull = estimate_pull(current, executor)
    # In one pose a force fits as well as any cause; in many, at one place, it is a cause.
    if not added or len(current.problem.used) < 2:
        return pull, current, added
    alone = estimate_pull(declared, executor)
    if alone is None:
        return pull, current, added
    # One force per pose on the declared model against the same on top of the added effects.
    n = np.log(declared.problem.n_points)
    extra = sum(len(item.candidate.frees) for item in added) * n
    better = pull is None or (2 * alone.fit.point.objective < 2 * pull.fit.point.objective + extra)
    p_alone, p_current = (structure_of(x, noise_degrees(x)).p_value for x in (alone.fit, current))
    if better and p_alone > p_current:
        return alone, declared, []
    return pull, current, added


def _proposal(
    current: Fit, added: Sequence[AddedEffect]
) -> tuple[NextPose | None, tuple[str, ...]]:
    """Pose that separates an added effect from its closest rival."""
    for item in added:
        if item.rivals:
            rival = item.rivals[0]
            return next_pose(current, rival.fit), (item.candidate.name, rival.candidate.name)
    return None, ()
