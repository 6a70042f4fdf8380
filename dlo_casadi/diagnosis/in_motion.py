"""Search for what a model lacks in motion: drag, friction, another stiffness, a weight, a delay.

At the fit of still poses and motions, all candidates are added at the values at which they vanish.
One linearisation then gives, with H the Hessian of all unknowns and g the gradient, the score

    T = g_c^2 / (H_cc - H_ca H_aa^-1 H_ac)

of each: twice what it would gain, to first order, with all other unknowns fitted again. A candidate
that the model has within a tolerance is free of it, and gains what the tolerance costs now, too.
The best are fitted. What is then left of a motion is not independent in time: a gain counts as
divided by c = m' J m / m' H m, with the variance J of the gradient (`told_by`) and the change m of
all unknowns along the candidate, and no more than the square of the effect's size in standard
deviations, with what motions and still poses may differ by. The best one is added if it is
significant, as in the search among still poses, until none is. No misfit is asked for: an effect of
six standard deviations leaves a thousand residuals at 1.02 times their noise. Then each of the
others is left out once, those that still poses have shown, too: one that loses less than it would
have to gain is dropped. A weight looks like a taper at rest, and swings like a weight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from dlo_casadi.diagnosis.candidates import Candidate, candidates, setup_of
from dlo_casadi.diagnosis.gram import sidak, survival
from dlo_casadi.effects import IN_MOTION, Load
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import EXPLAINED
from dlo_casadi.estimation.motion_fit import (
    STRETCHES,
    MotionFit,
    joined,
    rejoined,
    repeated_fit,
    stretched,
    told_by,
    with_model,
)
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.thresholds import EVIDENCE_APART, SCANS_PER_TEST, SIGNIFICANCE

# Candidates that are fitted in each round; the share of the best score that they need, and that of
# what a significant one has: scores are of first order.
REFITTED, NEAR, ENOUGH = 3, 0.3, 0.75
# Step, in trial places, between those at which a weight is scored; its fit then moves it.
_APART = 3
# Information below which a candidate is not seen at all.
_UNSEEN = 1e-6
# Most effects that are added.
MOST = 3


@dataclass(frozen=True)
class AddedInMotion:
    """An effect that was added.

    Parameters
    ----------
    gain : float
        Of the log likelihood.
    p_value : float
        Of that gain as the best of all candidates and places.
    rivals : tuple of str
        Other effects that gain nearly as much.
    before, after : float [m]
        Root mean square distance of the fitted motions' points without and with it.
    """

    candidate: Candidate
    gain: float
    p_value: float
    rivals: tuple[str, ...]
    before: float
    after: float


@dataclass(frozen=True)
class InMotion:
    """Result of the search.

    Parameters
    ----------
    before, after : MotionFit
        Without and with the added effects.
    scores : dict
        By name, the score of each candidate in the first round.
    dropped : tuple of Candidate
        Of those that still poses had shown, what the added ones have made superfluous.
    """

    before: MotionFit
    after: MotionFit
    added: tuple[AddedInMotion, ...]
    scores: dict[str, float]
    dropped: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class Score:
    """What a candidate would gain, to first order.

    Parameters
    ----------
    value : float
        T.
    values : dict
        Its parameters, to first order.
    """

    candidate: Candidate
    value: float
    values: dict[str, float]


def in_motion_only(model: CableModel, exclude: Sequence[str] = ()) -> list[Candidate]:
    """Candidates that still poses do not know."""
    found = candidates(model, setup_of(model, moves=True), exclude, IN_MOTION)
    return [item for item in found if item.effect.shown]


def search_in_motion(
    fit: MotionFit,
    exclude: Sequence[str] = (),
    step: Callable[[str, int, int], None] = lambda name, done, total: None,
    significance: float = SIGNIFICANCE,
    shown: Sequence[Candidate] = (),
    declared: CableModel | None = None,
) -> InMotion:
    """Add effects until none is significant, and drop what they have made superfluous.

    `fit`: of the declared model over a first stretch, which hardly tells what is missing. The later
    a fit looks, the farther off what is missing drives it: at the end of each of STRETCHES that the
    model as it is does not explain the candidates are compared with it, all from where the stretch
    before has left it; and at the last one, where it explains them, from its minimum.

    `shown`: what still poses have shown beside the `declared` model.
    """
    now, added, first = fit, list[AddedInMotion](), dict[str, float]()
    level = significance
    before: MotionFit | None = None
    for end in [x for x in STRETCHES if x > fit.until] or [fit.until]:
        start = now
        if end > now.until:
            start = stretched(now, end)
            now = joined(start.fit, start.motions, start.std, end)
        while len(added) < MOST and (end == np.inf or now.chi2_per_dof > EXPLAINED):
            step("search for what motion lacks", len(added), MOST)
            start = start if now.chi2_per_dof > EXPLAINED else now
            moving = in_motion_only(start.fit.model, exclude)
            weights = heavy(start.fit.model, exclude)
            scores = scored(start, moving) | scored_by_place(start, weights)
            first = first or {name: one.value for name, one in scores.items()}
            tried = sum(max(1.0, len(x.scans) / SCANS_PER_TEST) for x in (*moving, *weights))
            level = sidak_level(significance, tried)
            chosen = _best(start, now, scores, level, tried)
            if chosen is None:
                break
            before = before or _whole(now)
            added.append(chosen[1])
            now = start = chosen[0]
    dropped: list[Candidate] = []
    if added:
        others = [*shown, *(one.candidate for one in added[:-1])]
        # What is dropped and only differs within a tolerance gets its prior back.
        priors = {**fit.fit.model.priors, **(declared.priors if declared else {})}
        now, dropped = _needed(now, others, replace(fit.fit.model, priors=priors), level)
    step("search for what motion lacks", MOST, MOST)
    left = tuple(one for one in added if one.candidate not in dropped)
    return InMotion(before or now, now, left, first, tuple(x for x in shown if x in dropped))


def _needed(
    now: MotionFit, others: Sequence[Candidate], declared: CableModel, level: float
) -> tuple[MotionFit, list[Candidate]]:
    """The fit without those of the effects that lose less than their price, and these."""
    dropped = []
    for item in others:
        try:
            smaller = rejoined(now, item.remove_from(now.fit.model, declared), {})
        except EstimationError:
            continue  # what nothing can be followed without is needed
        if _counted(smaller.objective - now.objective, now, item) < _price(item, level):
            dropped.append(item)
            now = smaller
    return now, dropped


def _whole(now: MotionFit) -> MotionFit:
    """A fit beside the whole motions, as far as it goes."""
    try:
        return stretched(now, np.inf)
    except EstimationError:
        return now


def sidak_level(significance: float, tried: float) -> float:
    """Significance of one of so many independent tests of which the best one has that given."""
    return float(-np.expm1(np.log1p(-significance) / tried))


def scored(now: MotionFit, listed: Sequence[Candidate]) -> dict[str, Score]:
    """Scores of candidates by name."""
    if not listed:
        return {}
    model = now.fit.model
    for item in listed:
        model = model if item.nuisance else item.add_to(model)
    return _scores(with_model(now, model, {}, vanishes=True), listed)


def heavy(model: CableModel, exclude: Sequence[str] = ()) -> list[Candidate]:
    """Candidates that have a mass: still shapes know them, too, but a weight swings slower."""
    found = candidates(model, setup_of(model), exclude)
    return [
        item
        for item in found
        if isinstance(item.effect, Load)
        and type(item.effect).masses is not Load.masses
        and not item.nuisance
    ]


def scored_by_place(now: MotionFit, listed: Sequence[Candidate]) -> dict[str, Score]:
    """Best score of each candidate over its places."""
    found: dict[str, Score] = {}
    for item in listed:
        for scan in item.scans[_APART // 2 :: _APART]:
            try:
                extended = with_model(now, item.add_to(now.fit.model), scan, vanishes=True)
            except EstimationError:
                continue
            for name, one in _scores(extended, [item], item.screened).items():
                if one.value > (found[name].value if name in found else 0.0):
                    found[name] = replace(one, values={**scan, **one.values})
    return found


def _scores(
    extended: MotionFit, listed: Sequence[Candidate], asked: Sequence[str] | None = None
) -> dict[str, Score]:
    """Scores of the candidates that a model has; `asked`: of their parameters, all by default."""
    problem, theta = extended.fit.problem, extended.fit.point.theta
    unknowns, names = problem.unknowns, list(problem.unknowns.names)
    told, slope, _ = told_by(extended)
    still = extended.fit.normal
    mean, precision = unknowns.prior(problem.priors.roughness_std)
    added = {name for item in listed if not item.nuisance for name in item.frees}
    lower, upper = unknowns.bounds
    scores: dict[str, Score] = {}
    for item in listed:
        at = [names.index(name) for name in asked or item.frees]
        old = [k for k, name in enumerate(names) if name not in added and k not in at]
        hessian, gradient, costs = told + still.hessian, slope + still.gradient, 0.0
        if item.nuisance:  # what holds it within its tolerance is no evidence against it
            gap, own = theta[at] - mean[at], precision[np.ix_(at, at)]
            hessian[np.ix_(at, at)] -= own
            gradient[at] -= own @ gap
            costs = float(gap @ own @ gap)
        arm = np.linalg.pinv(hessian[np.ix_(old, old)], hermitian=True) @ hessian[np.ix_(old, at)]
        own = hessian[np.ix_(at, at)] - hessian[np.ix_(at, old)] @ arm
        slope_of = gradient[at] - arm.T @ gradient[old]
        if not np.diag(own).min() > _UNSEEN:
            continue  # such as a clock where no fixture moves
        move = -np.linalg.solve(own, slope_of)
        value = np.clip(theta[at] + move, lower[at], upper[at])
        move = value - theta[at]
        score = float(-2 * slope_of @ move - move @ own @ move) + costs
        full = theta.copy()
        full[at] = value
        p = dict(zip(unknowns.model.names, unknowns.p(full), strict=True))
        values = {name: float(p[name]) for name in asked or item.frees}
        scores[item.name] = Score(item, score, values)
    return scores


def _excess(fit: MotionFit, item: Candidate) -> float:
    """Variance of the gradient over that of white noise along an effect's change; at least 1."""
    names = list(fit.fit.problem.unknowns.names)
    told, _, varied = told_by(fit)
    whole = np.linalg.pinv(fit.fit.normal.hessian, hermitian=True)
    largest = 1.0
    for name in item.frees:
        change = whole[names.index(name)]
        largest = max(largest, float(change @ varied @ change) / float(change @ told @ change))
    return largest


def _square(fit: MotionFit, item: Candidate) -> float:
    """Squared size of an effect in standard deviations, see `repeated_fit`.

    Motions tell frequencies to 0.01 %, and repeat still poses to 0.1 %: what vanishes within that
    is no effect, whatever it gains.
    """
    loose = repeated_fit(fit)
    nominal = dict(zip(loose.model.names, loose.model.nominal, strict=True))
    sizes = [
        (loose.value(name) - nominal[name]) / std
        for name in item.screened or item.frees
        if (std := loose.std(name)) > 0
    ]
    return max((size**2 for size in sizes), default=0.0)


def _counted(whole: float, fit: MotionFit, item: Candidate) -> float:
    """What a fit with an effect gains, as far as it counts: see the top of this module."""
    if whole <= 0.0:
        return whole
    return min(whole / _excess(fit, item), _square(fit, item) / 2)


class _Refit(NamedTuple):
    """A candidate's fit: what it gains, its gain as `_counted`, and its `_price`."""

    candidate: Candidate
    fit: MotionFit
    whole: float
    gain: float
    price: float


def _best(
    start: MotionFit,
    now: MotionFit,
    scores: Mapping[str, Score],
    level: float,
    tried: float,
) -> tuple[MotionFit, AddedInMotion] | None:
    """The best candidate, fitted from `start`; None if none is significant beside `now`.

    `level`: significance of one of `tried` tests. A gain counts beyond what a significant one has.
    """
    order = sorted(scores.values(), key=lambda one: -one.value)
    likely = [
        one
        for one in order
        if one.value > max(2 * ENOUGH * _price(one.candidate, level), NEAR * order[0].value)
    ]
    fitted: list[_Refit] = []
    for one in likely[:REFITTED]:
        item, model = one.candidate, one.candidate.add_to(start.fit.model)
        try:
            trial = rejoined(start, model, one.values)
        except EstimationError:
            continue
        whole = now.objective - trial.objective
        gain, price = _counted(whole, trial, item), _price(item, level)
        fitted.append(_Refit(item, trial, whole, gain, price))
    significant = [x for x in fitted if x.gain > x.price]
    if not significant:
        return None
    # Candidates are compared at one excess, of what the best fit leaves: that of another one has
    # what it misses, too, and each one's own would decide between like ones.
    likeliest = max(fitted, key=lambda x: x.whole)
    common = _excess(likeliest.fit, likeliest.candidate)

    def net(x: _Refit) -> float:
        return x.whole / common - x.price

    best = max(significant, key=net)
    near = [x for x in fitted if x is not best and net(x) > net(best) - EVIDENCE_APART]
    rivals, item = tuple(x.candidate.name for x in near), best.candidate
    p_value = sidak(survival(2 * best.gain, len(item.frees), np.inf), tried)
    return best.fit, AddedInMotion(item, best.gain, p_value, rivals, now.rmse, best.fit.rmse)


def _price(item: Candidate, level: float) -> float:
    """Gain of the log likelihood by chance with this probability."""
    return float(chdtri(len(item.frees), level)) / 2
