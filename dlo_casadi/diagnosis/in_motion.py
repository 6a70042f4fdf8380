"""Search for what a model lacks in motion: drag, friction, another stiffness, a clock's delay.

At the fit of still poses and motions, all candidates are added at the values at which they vanish.
One linearisation then gives, with H the Hessian of all unknowns and g the gradient, the score

    T = g_c^2 / (H_cc - H_ca H_aa^-1 H_ac)

of each: twice what it would gain, to first order, with all other unknowns fitted again. The best
are fitted. What is then left of a motion is not independent in time: a gain counts as divided by
c = m' J m / m' H m, with the variance J of the gradient (`motion_fit`) and the change m of all
unknowns along the candidate. The best one is added if its gain exceeds its price, until none does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate, candidates, setup_of
from dlo_casadi.effects import IN_MOTION, Load
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import EXPLAINED
from dlo_casadi.estimation.motion_fit import (
    STRETCHES,
    MotionFit,
    joined,
    rejoined,
    stretched,
    told_by,
    with_model,
)
from dlo_casadi.model.cable_model import CableModel

# Gain of the log likelihood that an effect of one parameter must exceed: twice it, 15, is exceeded
# by chance in 1e-4 of cases, and by one of seven candidates in less than 1e-3.
PRICE = 7.5
# Candidates that are fitted in each round, and the share of the best score that they need.
REFITTED, NEAR = 3, 0.3
# Information below which a candidate is not seen at all.
_UNSEEN = 1e-6
# Most effects that are added.
MOST = 3
# Gain by which the best of two must exceed the other to be told apart.
APART = 3.0


@dataclass(frozen=True)
class AddedInMotion:
    """An effect that was added.

    Parameters
    ----------
    gain : float
        Of the log likelihood.
    rivals : tuple of str
        Other effects that gain nearly as much.
    before, after : float [m]
        Root mean square distance of the fitted motions' points without and with it.
    """

    candidate: Candidate
    gain: float
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
    """

    before: MotionFit
    after: MotionFit
    added: tuple[AddedInMotion, ...]
    scores: dict[str, float]


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
) -> InMotion:
    """Add effects until none gains more than its price.

    `fit`: of the declared model over a first stretch, which hardly tells what is missing. The later
    a fit looks, the farther off what is missing drives it: at the end of each of STRETCHES the
    candidates are compared with the model as it is, all from where the stretch before has left it.
    """
    now, added, first = fit, list[AddedInMotion](), dict[str, float]()
    before: MotionFit | None = None
    for end in [x for x in STRETCHES if x > fit.until] or [fit.until]:
        start = now
        if end > now.until:
            start = stretched(now, end)
            now = joined(start.fit, start.motions, start.std, end)
        while len(added) < MOST and (end == np.inf or now.chi2_per_dof > EXPLAINED):
            step("search for what motion lacks", len(added), MOST)
            scores = scored(start, in_motion_only(start.fit.model, exclude))
            if now.chi2_per_dof > EXPLAINED:
                scores |= heavy(start, exclude)
            first = first or {name: one.value for name, one in scores.items()}
            chosen = _best(start, now, scores)
            if chosen is None:
                break
            before = before or _whole(now)
            added.append(chosen[1])
            now = start = chosen[0]
    step("search for what motion lacks", MOST, MOST)
    return InMotion(before or now, now, tuple(added), first)


def _whole(now: MotionFit) -> MotionFit:
    """A fit beside the whole motions, as far as it goes."""
    try:
        return stretched(now, np.inf)
    except EstimationError:
        return now


def scored(now: MotionFit, listed: Sequence[Candidate]) -> dict[str, Score]:
    """Scores of candidates by name."""
    if not listed:
        return {}
    model = now.fit.model
    for item in listed:
        model = item.add_to(model)
    return _scores(with_model(now, model, {}), listed)


def heavy(now: MotionFit, exclude: Sequence[str] = ()) -> dict[str, Score]:
    """Best score over their places of effects that have a mass; a weight swings slower.

    Still shapes know them, too, but a motion may be the first to show them.
    """
    found: dict[str, Score] = {}
    for item in candidates(now.fit.model, setup_of(now.fit.model), exclude):
        effect = item.effect
        if not isinstance(effect, Load) or type(effect).masses is Load.masses or item.nuisance:
            continue
        for scan in item.scans:
            try:
                extended = with_model(now, item.add_to(now.fit.model), scan)
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
    unknowns, theta = extended.fit.problem.unknowns, extended.fit.point.theta
    told, slope, _ = told_by(extended)
    still = extended.fit.normal
    hessian, gradient = told + still.hessian, slope + still.gradient
    names = list(unknowns.names)
    new = [names.index(name) for item in listed for name in item.frees]
    old = [k for k in range(len(names)) if k not in new]
    inverse = np.linalg.pinv(hessian[np.ix_(old, old)], hermitian=True)
    lower, upper = unknowns.bounds
    scores: dict[str, Score] = {}
    for item in listed:
        at = [names.index(name) for name in asked or item.frees]
        arm = inverse @ hessian[np.ix_(old, at)]
        own = hessian[np.ix_(at, at)] - hessian[np.ix_(at, old)] @ arm
        slope_of = gradient[at] - arm.T @ gradient[old]
        if not np.diag(own).min() > _UNSEEN:
            continue  # such as a clock where no fixture moves
        move = -np.linalg.solve(own, slope_of)
        value = np.clip(theta[at] + move, lower[at], upper[at])
        move = value - theta[at]
        score = float(-2 * slope_of @ move - move @ own @ move)
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


def _best(
    start: MotionFit, now: MotionFit, scores: dict[str, Score]
) -> tuple[MotionFit, AddedInMotion] | None:
    """The best candidate, fitted from `start`; None if none gains its price over `now`."""
    order = sorted(scores.values(), key=lambda one: -one.value)
    least = max(2 * PRICE, NEAR * order[0].value) if order else np.inf
    fitted: list[tuple[float, Candidate, MotionFit]] = []
    for one in [x for x in order if x.value > least][:REFITTED]:
        item, model = one.candidate, one.candidate.add_to(start.fit.model)
        try:
            trial = rejoined(start, model, one.values)
        except EstimationError:
            continue
        gain = (now.objective - trial.objective) / _excess(trial, item)
        fitted.append((gain - PRICE * len(item.frees), item, trial))
    if not fitted:
        return None
    net, item, trial = max(fitted, key=lambda x: x[0])
    if net <= 0:
        return None
    rivals = tuple(x.name for gain, x, _ in fitted if x is not item and gain > net - APART)
    gain = net + PRICE * len(item.frees)
    return trial, AddedInMotion(item, gain, rivals, now.rmse, trial.rmse)
