"""Which refitted candidates are added: evidence, cross-validation, significance."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb, prod

import numpy as np

from dlo_casadi.diagnosis.crossval import CrossValidation, density_of_declared
from dlo_casadi.diagnosis.found import AddedEffect, Ranked
from dlo_casadi.diagnosis.gram import Screened, sidak, survival
from dlo_casadi.diagnosis.refits import Confirmed, Tried
from dlo_casadi.diagnosis.structure import noise_degrees
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import errors_of, settle
from dlo_casadi.thresholds import EVIDENCE_APART

RAN_AWAY = "its fit ran away: no noise can be estimated from it"


@dataclass(frozen=True)
class Decision:
    """What is added to a base: the one place in which refits are accepted or refused.

    Parameters
    ----------
    fit : Fit
        The accepted refit with its noise estimated anew, or the base.
    chosen : tuple of Confirmed
        The accepted refit, then its rivals; empty if none is accepted.
    p_value : float
        Of the accepted refit.
    reasons : dict of str
        By name, why candidates are neither accepted nor rivals.
    """

    fit: Fit
    chosen: tuple[Confirmed, ...]
    p_value: float
    reasons: dict[str, str]

    def added(self, before: CrossValidation, after: CrossValidation) -> list[AddedEffect]:
        """The effects of the accepted refit; their rivals differ in one effect alone."""
        winner, *rivals = self.chosen
        others = [turned for rival in rivals for turned in rival.beside_others()]
        return [
            AddedEffect(
                own.candidate,
                self.p_value,
                before,
                after,
                tuple(x for x in others if _names(x.beside) == _names(own.beside)),
            )
            for own in winner.beside_others()
        ]


def decide(
    base: Fit,
    before: CrossValidation,
    tried: Tried,
    significance: float,
    doubt: float | None,
    *,
    from_shapes: bool = False,
) -> Decision:
    """Accept the best of the refits tried beside a base that is significant, or none.

    Adding, keeping and replacing an effect are the same decision: for the latter two the base is
    the fit without it, and the fit that has it is one of the refits.

    Parameters
    ----------
    before : CrossValidation
        Of the base.
    doubt : float or None
        See `shortcoming`.
    from_shapes : bool
        Whether the refits started at the measured shapes, see `with_new_noise`.
    """
    chosen, reasons = choose(tried.refits, base, before, doubt)
    reasons |= tried.far
    for winner in chosen:
        fit, p_value = with_new_noise(winner, base, tried.p_values, from_shapes)
        if p_value <= significance:
            others = (item for item in chosen if item is not winner)
            return Decision(fit, (winner, *others), p_value, reasons)
        why = RAN_AWAY if fit is base else f"not significant: p = {p_value:.2g}"
        reasons |= dict.fromkeys((x.candidate.name for x in winner.each), why)
    return Decision(base, (), 1.0, reasons)


def with_new_noise(
    winner: Confirmed, base: Fit, p_values: Mapping[str, float], from_shapes: bool
) -> tuple[Fit, float]:
    """A refit with its noise estimated anew, and its p-value, also under that noise.

    Noise estimated without an effect includes part of it or, where it was kept out, lacks part of
    the noise. If nothing else is missing, all that is left with it is noise, including its slow
    modes; otherwise the noise is too large and the significance too low.

    A refit that is weighed by its misfit stays so. If a refit has run away (no noise can be
    estimated, or poses are lost), the base and 1 are returned. With `from_shapes`, a
    refit that explains the shapes is tested by its gain in evidence: scores at a soft balance may
    miss what counts, and the base is too far off for a test of likelihoods at equal weights.
    """
    if winner.settled:
        return winner.fit, p_of(winner, winner.fit, base, len(p_values))
    fit, p_value = winner.fit, max(p_values[item.candidate.name] for item in winner.each)
    try:
        fit = settle(fit) if fit.noise.source != "misfit" else descend(fit)
    except EstimationError:
        return base, 1.0
    if from_shapes and fit.noise.source != "misfit":
        return fit, p_of_evidence(winner, fit, base, len(p_values))
    if from_shapes or not (base.scatters or not fit.errors_known):
        return fit, p_value
    again = p_under_new_noise(winner, fit, base, len(p_values))
    if not base.scatters:
        return fit, max(p_value, again)
    # A scatter from pose to pose may be due to the effect alone, or explain as much as it does.
    if not fit.scatters:
        again = max(again, p_of_evidence(winner, fit, base, len(p_values)))
    return fit, again


def p_of_evidence(item: Confirmed, fit: Fit, base: Fit, tried: int) -> float:
    """Significance of what a refit's effects together gain over a base of other weights."""
    gain = 2 * (fit.log_evidence - base.log_evidence)
    return _p_of_gain(item, gain, noise_degrees(fit), tried)


def _p_of_gain(item: Confirmed, gain: float, degrees: float, tried: int) -> float:
    """Probability that the best of all sets of as many candidates gains as much by chance."""
    sets = comb(tried, len(item.each)) * prod(x.candidate.alike for x in item.each)
    return sidak(survival(gain, _parameters(item), degrees), sets)


def _parameters(item: Confirmed) -> int:
    """Number of parameters of all effects of a refit."""
    return sum(len(x.candidate.frees) for x in item.each)


def p_under_new_noise(winner: Confirmed, fit: Fit, base: Fit, tried: int) -> float:
    """`p_of` under the noise and the scatter that are left in a refit's settled fit."""
    try:
        noise, pose_scatter = errors_of(
            fit,
            modes=0,
            estimated=not fit.noise.known,
            repeats=fit.problem.priors.pose_scatter.std == 0,
        )
    except EstimationError:  # too few points are left with the effect to show anything
        return 1.0
    priors = replace(base.problem.priors, pose_scatter=pose_scatter)
    larger = fit.reweighed(noise, priors)
    try:
        without = descend(base.weighed_as(larger))
    except EstimationError:  # with this scatter alone a pose has no equilibrium near its shape
        return 0.0
    return p_of(winner, descend(larger), without, tried, settled=False)


def p_of(item: Confirmed, fit: Fit, smaller: Fit, tried: int, *, settled: bool = True) -> float:
    """Significance of the effects of a refit, from its fit and one without them of equal weights.

    If the fit is `settled`, a scatter from pose to pose is estimated anew without the effects, as
    it may explain as much: a length 9 tolerances off, which no scatter explains, was not
    significant beside the given one. If both fits estimate one variance of Gaussian residuals, with
    the effect from nu degrees of freedom, twice the log likelihood ratio is (nu + dof) log(1 + dof
    F / nu). F is computed from this, with the ratio of the evidences, which also counts the
    parameters, for the likelihoods'.
    """
    gain = 2 * (smaller.point.objective - fit.point.objective)
    dof, degrees = _parameters(item), noise_degrees(fit)
    if settled and fit.scatters:
        try:
            gain = 2 * (fit.log_evidence - settle(smaller).log_evidence)
        except EstimationError:  # without the effect there is no fit
            return 0.0
        if np.isfinite(degrees):
            # A larger exponent would overflow; its probability is zero anyway.
            gain = degrees * np.expm1(min(gain / (degrees + dof), 500.0))
    return _p_of_gain(item, gain, degrees, tried)


def support(item: Confirmed, base: Fit, validation: CrossValidation) -> float:
    """Log of how much likelier a refit makes the data than its base: a mean of two measures.

    The two are the gains in marginal likelihood and in the predictive density of left-out poses
    (`validation` is that of the base) and of the values declared for the base's nuisances. They
    agree if nothing else is missing. A wrong effect adapts to the fitted data but predicts left-out
    data badly. The mean is harmonic, so the smaller gain decides; if that is not positive, it is
    returned alone.
    """
    one = item.fit.log_evidence - base.log_evidence
    if item.validation is None:
        return one
    held = base.model.priors
    declared = density_of_declared(item.fit, held) - density_of_declared(base, held) if held else 0
    other = item.validation.log_density - validation.log_density + declared
    smaller = min(one, other)
    return smaller if smaller <= 0 else 2 * one * other / (one + other)


def shortcoming(
    item: Confirmed, base: Fit, validation: CrossValidation, doubt: float | None
) -> str:
    """Why a refit is no better than its base; empty if it is better.

    Repeats of few poses share any error of their measurement. For these, whole repeats
    decide: if left-out repeats were predicted no better, a gain as large must have a
    probability below `doubt` (Student's t).
    """
    if item.validation is not None and item.validation.loses_most_of(validation):
        return "with it most poses that are left out cannot be predicted"
    behind = -support(item, base, validation)
    if item.validation is None or behind >= 0:
        return f"makes the data less likely than no effect: log likelihood {behind:.3g} behind"
    chance = 0.0 if doubt is None else validation.chance_of_gain(item.validation)
    if doubt is not None and chance >= doubt:
        least = f"p = {chance:.2g}, not below {doubt:.2g}"
        return f"may predict left-out poses better by chance: {least}"
    return ""


def choose(
    refits: Sequence[Confirmed],
    base: Fit,
    validation: CrossValidation,
    doubt: float | None,
) -> tuple[list[Confirmed], dict[str, str]]:
    """The best refit by `support` and its rivals; by name, why candidates are neither of these.

    Both gains have to be positive. Rivals fall short of the best by less than EVIDENCE_APART. Of a
    candidate in several refits the likeliest one's reason counts.
    """
    why = {id(item): shortcoming(item, base, validation, doubt) for item in refits}
    order = {id(item): support(item, base, validation) for item in refits}
    better = [item for item in refits if not why[id(item)]]
    better.sort(key=lambda item: -order[id(item)])
    behind = {id(item): order[id(better[0])] - order[id(item)] for item in better}
    chosen = [item for item in better if behind[id(item)] < EVIDENCE_APART]
    for item in better[1:]:
        why[id(item)] = f"log likelihood {behind[id(item)]:.3g} behind {better[0].name}"
    reasons = {
        x.candidate.name: why[id(item)]
        for item in sorted(refits, key=lambda item: order[id(item)])
        for x in item.each
    }
    beside = [_names(own.beside) for item in chosen[:1] for own in item.beside_others()]
    turned = (x for item in chosen for x in item.beside_others())
    kept = {x.candidate.name for x in turned if _names(x.beside) in beside}
    return chosen, {name: reason for name, reason in reasons.items() if name not in kept}


def _names(screened: Iterable[Screened]) -> set[str]:
    return {x.candidate.name for x in screened}


def ranking(tried: Tried, base: Fit, validation: CrossValidation) -> list[Ranked]:
    """All candidates: the refitted ones by `support`, then the rest by score."""
    refits = [x for item in tried.refits for x in item.beside_others()]
    refits.sort(key=lambda item: support(item, base, validation))
    refitted = {item.candidate.name: item for item in refits}
    order = {name: support(item, base, validation) for name, item in refitted.items()}

    def error(name: str) -> float | None:
        found = refitted.get(name)
        left_out = found.validation if found else None
        return left_out.rmse if left_out and left_out.complete else None

    names = [item.candidate.name for item in tried.screened]
    rows = [
        Ranked(name, item.score, tried.p_values[name], error(name))
        for name, item in zip(names, tried.screened, strict=True)
    ]
    return sorted(rows, key=lambda row: (-order.get(row.name, -np.inf), -row.score))
