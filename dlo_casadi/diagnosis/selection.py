"""Which of the refitted candidates is added: evidence, cross-validation, significance."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.refits import Confirmed
from dlo_casadi.diagnosis.screening import Screened, survival
from dlo_casadi.diagnosis.structure import Structure
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.prediction import predicted_shapes
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import errors_of, settle
from dlo_casadi.thresholds import LEAST_NOISE_DEGREES, MISLEADING


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
    equivalents : tuple of str
        What it may stand for, see `equivalents`.
    """

    candidate: Candidate
    p_value: float
    before: CrossValidation
    after: CrossValidation
    rivals: tuple[Confirmed, ...]
    equivalents: tuple[str, ...] = ()

    @property
    def rival_candidates(self) -> list[Candidate]:
        """Candidates that could not be told apart from it."""
        return [rival.candidate for rival in self.rivals]


@dataclass(frozen=True)
class Ranked:
    """A candidate in the list of all that were tried.

    `reason`: why one that was refitted is neither added nor a rival; empty of others.
    """

    name: str
    score: float
    p_value: float
    rmse_cross_validated: float | None
    reason: str = ""


def explained_by(current: Fit, tried: Iterable[Confirmed | None]) -> list[Confirmed]:
    """Candidates that leave none of a misfit: with them the points are as sure as they are known.

    Beside a misfit their gains tell little; they are compared by their evidence.
    """
    if current.noise.source != "misfit":
        return []
    refits = [x for x in tried if x is not None and x.validation.complete]
    close = [item for item in refits if item.fit.noise.source != "misfit"]
    least = min((item.fit.log_evidence for item in close), default=0.0)
    return [replace(item, bic=2 * (item.fit.log_evidence - least)) for item in close]


@dataclass(frozen=True)
class Found:
    """Where a search has ended.

    Parameters
    ----------
    fit : Fit
    added : tuple of AddedEffect
    ranked : tuple of Ranked
    validation : CrossValidation
    structure : Structure
    unexplained : bool
    """

    fit: Fit
    added: tuple[AddedEffect, ...]
    ranked: tuple[Ranked, ...]
    validation: CrossValidation
    structure: Structure
    unexplained: bool


def in_place_of(found: Found, other: Found) -> Found:
    """Other effects that are likelier together, with that as the reason against those found."""
    reason = "less likely than " + " and ".join(item.candidate.name for item in other.added)
    first = found.added[0]
    chosen = {item.name for item in (first.candidate, *first.rival_candidates)}
    rows = (replace(x, reason=reason) if x.name in chosen else x for x in found.ranked)
    return replace(other, ranked=tuple(rows))


def as_complete(fit: Fit) -> Fit:
    """A fit with an effect added, as that of a model that may be complete now."""
    return fit if fit.noise.source == "misfit" else settle(fit)


def sidak(p_value: float, tried: int) -> float:
    """Probability that the best of so many independent tests is as good (Sidak)."""
    return float(-np.expm1(tried * np.log1p(-min(p_value, 1 - 1e-16))))


def p_with_closed_noise(open_: Fit, closed: Fit, winner: Confirmed, tried: int) -> float:
    """Significance of an effect under the noise that is left once it is in the model.

    The noise estimated without the effect holds a part of the effect, or, where it was kept out,
    lacks a part of the noise. Where nothing else is missing all that is left is noise, its slow
    modes included; where something is, the noise is too large and the significance too low.
    """
    try:
        noise, pose_scatter = errors_of(
            closed,
            modes=0,
            estimated=not closed.noise.known,
            repeats=closed.problem.priors.pose_scatter.std == 0,
        )
    except EstimationError:  # with the effect hardly a point is left over: nothing is shown
        return 1.0
    priors = replace(open_.problem.priors, pose_scatter=pose_scatter)
    larger = closed.reweighed(noise, priors)
    smaller = replace(larger.problem, unknowns=open_.problem.unknowns)
    without = descend(Fit(smaller, smaller.evaluate(open_.point)))
    gain = max(2 * (without.point.objective - descend(larger).point.objective), 0.0)
    dof = len(winner.candidate.frees)
    return sidak(survival(gain, dof, max(LEAST_NOISE_DEGREES, noise.slow_dof)), tried)


def improving(
    tried: Iterable[Confirmed | None], validation: CrossValidation, doubt: float | None
) -> list[Confirmed]:
    """Refits that improve both the fit and what it predicts."""
    return [x for x in tried if x is not None and not shortcoming(x, validation, doubt)]


def shortcoming(item: Confirmed, validation: CrossValidation, doubt: float | None) -> str:
    """Why a refit does not improve both the fit and what it predicts; empty if it does.

    Repeats of one or two poses have in common whatever is wrong with their measurement. There
    whole repeats decide: a gain as large must have less than the probability `doubt` if those
    left out are predicted no better (Student's t).
    """
    if item.bic <= 0:
        return f"explains less than its parameters cost: BIC {-item.bic:.3g} behind no effect"
    if not item.validation.complete:
        return "with it a pose that is left out cannot be predicted"
    # An effect that explains the fitted poses but predicts the others worse is none. A nuisance
    # is in the model already; without its prior it predicts about as well.
    worse = item.validation.error > validation.error
    if item.candidate.nuisance:
        worse = item.validation.clearly_worse_than(validation)
    if worse:
        return _worse(item.validation, validation)
    chance = 0.0 if doubt is None else validation.chance_of_gain(item.validation)
    if doubt is not None and chance >= doubt:
        return f"predicts what is left out no better than by chance: p = {chance:.2g}"
    return ""


def choose(
    confirmed: Sequence[Confirmed], apart: float
) -> tuple[Confirmed, list[Confirmed]] | None:
    """The best by cross-validation (BIC among those not clearly worse), and its rivals.

    Rivals are those not clearly worse whose BIC falls short by less than `apart`.
    """
    if not confirmed:
        return None
    leader = min(confirmed, key=lambda item: item.validation.error)
    close = [
        item for item in confirmed if not item.validation.clearly_worse_than(leader.validation)
    ]
    winner = max(close, key=lambda item: item.bic)
    rivals = [item for item in close if item is not winner and item.bic > winner.bic - apart]
    return winner, sorted(rivals, key=lambda item: -item.bic)


def why_lost(
    tried: Iterable[Confirmed | None],
    confirmed: Sequence[Confirmed],
    misleading: Sequence[Confirmed],
    chosen: tuple[Confirmed, list[Confirmed]] | None,
    why: Callable[[Confirmed], str],
) -> dict[str, str]:
    """Why refits are neither chosen nor rivals of the one that is, by the candidates' names.

    Parameters
    ----------
    confirmed : sequence of Confirmed
        Among which was chosen, without those that are `misleading`.
    why : callable
        Reason of a refit that is in neither of these.
    """
    reasons = {item.candidate.name: why(item) for item in tried if item is not None}
    for item in misleading:
        reasons[item.candidate.name] = "misleads: where only ends are known it predicts worse"
    if chosen is None:
        return reasons
    winner, rivals = chosen
    leader = min(confirmed, key=lambda item: item.validation.error)
    for item in confirmed:
        if item.validation.clearly_worse_than(leader.validation):
            reasons[item.candidate.name] = _worse(item.validation, leader.validation)
            reasons[item.candidate.name] += f" with {leader.candidate.name}"
        else:
            behind = winner.bic - item.bic
            reasons[item.candidate.name] = f"BIC {behind:.3g} behind {winner.candidate.name}"
    kept = {item.candidate.name for item in (winner, *rivals)}
    return {name: reason for name, reason in reasons.items() if name not in kept}


def _worse(one: CrossValidation, other: CrossValidation) -> str:
    """That one predicts worse than another."""
    errors = f"{1e3 * one.error:.3g} mm instead of {1e3 * other.error:.3g} mm"
    return f"predicts what is left out worse: {errors}"


def misleads(item: Confirmed, before: Fit, validation: CrossValidation) -> bool:
    """Whether a fit with an effect tells a user, who knows the ends alone, worse than one without.

    A nuisance never does. `validation` follows the branches on which poses were measured, without
    the effect.
    """
    told = 0.0 if item.candidate.nuisance else _told(item.fit)
    return told > validation.rmse and told > MISLEADING * _told(before)


def _told(fit: Fit) -> float:
    """Cross-validated error [m] of poses of which nothing but the ends is known."""
    shapes = predicted_shapes(fit.problem, fit.point)
    return cross_validate(fit, shapes=shapes).rmse


def ranking(
    screened: Sequence[Screened],
    p_values: Mapping[str, float],
    confirmed: Sequence[Confirmed],
    tried: Iterable[Confirmed | None],
) -> list[Ranked]:
    """All candidates: those confirmed, then other refits, by BIC; the rest by score."""
    worthy = {item.candidate.name: item for item in confirmed}
    refitted = {item.candidate.name: item for item in tried if item is not None} | worthy

    def error(name: str) -> float | None:
        found = refitted.get(name)
        return found.validation.rmse if found and found.validation.complete else None

    def order(row: Ranked) -> tuple[bool, float, float]:
        known = refitted.get(row.name)
        return (row.name not in worthy, -known.bic if known else np.inf, -row.score)

    names = [item.candidate.name for item in screened]
    rows = [
        Ranked(name, item.score, p_values[name], error(name))
        for name, item in zip(names, screened, strict=True)
    ]
    return sorted(rows, key=order)
