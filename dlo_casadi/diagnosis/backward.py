"""Backward step of a search: effects that others have made superfluous, or that others replace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

from dlo_casadi.diagnosis import refits
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.refits import Confirmed
from dlo_casadi.diagnosis.screening import p_values_of
from dlo_casadi.diagnosis.selection import (
    AddedEffect,
    added_by,
    choose,
    p_of_removal,
    with_new_noise,
)
from dlo_casadi.diagnosis.trials import Trials
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import FINEST_MESH, misfits
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import settle


def pruned(trials: Trials, fit: Fit, added: list[AddedEffect]) -> tuple[Fit, list[AddedEffect]]:
    """Backward step: remove effects that later ones have made superfluous.

    A removed nuisance is held within its declared tolerance again.

    An effect has to be worth its parameters, and as significant as when it was added. The last
    one is significant, but it may have led out of a local minimum and no longer be needed, or
    stand for an error of the mesh: 80 elements on a table were 0.6 mm off. An effect found from
    the measured shapes may stand for a scatter. One with fewer parameters may take the place of a
    removed one: for a mass off by 30 %, a force gained as much, but was not significant.
    """
    before, fit = fit, trials.fine(fit, FINEST_MESH) if added else fit
    significant = added[-1:] if fit is before and not trials.from_shapes else []
    last = [effect for effect in added if effect.after is added[-1].after]
    compared = last if len(last) == 1 else []  # a pair was compared with few other pairs
    for effect in added:
        smaller = refits.refit_without(fit, effect.candidate, trials.declared)
        if smaller is None:
            continue
        needless = smaller.log_evidence > fit.log_evidence
        if not needless and effect not in significant:
            tried = len(trials.listed(smaller))
            needless = p_of_removal(fit, smaller, effect.candidate, tried) > trials.significance
        if needless:
            with suppress(EstimationError):  # else there is no fit without it
                fit, instead = in_its_place(trials, settle(smaller), effect)
                added = [x for item in added for x in (instead if item is effect else [item])]
        elif effect not in compared and (effect.rivals or not misfits(smaller)):
            fit, chosen = judged_again(trials, fit, smaller, effect)
            added = [chosen if item is effect else item for item in added]
    return fit, added


def judged_again(
    trials: Trials, fit: Fit, smaller: Fit, effect: AddedEffect
) -> tuple[Fit, AddedEffect]:
    """The likeliest candidate beside effects that were added later or with it, and its rivals.

    Sequential replacement (Miller 1990): an effect may be the best one alone, and another one,
    or that of another clip, beside what was still missing then. Alone, a force explained a tilt
    and a drift better than either. `smaller` lacks the effect; if it misfits, scores are
    useless and only known rivals are judged.
    """
    before, name, label = cross_validate(smaller), effect.name, effect.candidate.effect.label
    rivals_only = {name, *(rival.name for rival in effect.rival_candidates)}
    screened = trials.screened(smaller, rivals_only if misfits(smaller) else None)
    p_values = p_values_of(screened)
    own = [item for item in screened if item.candidate.effect.label == label]
    known = {item.candidate.name: Confirmed.of(item, smaller, fit) for item in own}
    tried = trials.leading(smaller, screened, p_values, known, fit)
    chosen, _ = choose(tried, smaller, before, trials.doubt)
    others = tuple(item for item in chosen if item.name != name)
    if len(others) < len(chosen):
        effect = replace(effect, rivals=others)
    if not chosen or (chosen[0].name == name and own):
        return fit, effect
    if found := _winner_added(trials, smaller, before, chosen, p_values, fit.log_evidence):
        return found
    rivals = {item.name: item for item in (*effect.rivals, chosen[0]) if item.name != name}
    return fit, replace(effect, rivals=tuple(rivals.values()))


def in_its_place(
    trials: Trials, smaller: Fit, effect: AddedEffect
) -> tuple[Fit, list[AddedEffect]]:
    """The fit without a removed effect, or the likeliest other candidate added to it."""
    label = effect.candidate.effect.label
    screened = [] if misfits(smaller) else trials.screened(smaller)  # in a misfit no score counts
    screened = [item for item in screened if item.candidate.effect.label != label]
    p_values = p_values_of(screened)
    tried = trials.leading(smaller, screened, p_values, {})
    before = cross_validate(smaller)
    chosen, _ = choose(tried, smaller, before, trials.doubt)
    found = _winner_added(trials, smaller, before, chosen, p_values, smaller.log_evidence)
    return (found[0], [found[1]]) if found else (smaller, [])


def _winner_added(
    trials: Trials,
    base: Fit,
    before: CrossValidation,
    chosen: Sequence[Confirmed],
    p_values: Mapping[str, float],
    least: float,
) -> tuple[Fit, AddedEffect] | None:
    """The best of the chosen refits, if it is significant and its log evidence above the least."""
    if not chosen:
        return None
    winner, *rivals = chosen
    fit, p_value = with_new_noise(winner, base, p_values, trials.starts_at_shapes(base))
    with suppress(EstimationError):
        if fit.log_evidence > least and p_value <= trials.significance:
            (effect,) = added_by(winner, rivals, p_value, before, cross_validate(fit))
            return fit, effect
    return None
