"""Candidates tried beside the effects that a fit has, and fits tried without one of these.

Candidates are screened, and the likely ones refitted. The backward step of a search removes effects
that others have made superfluous, or replaces them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from dlo_casadi.diagnosis import refits
from dlo_casadi.diagnosis.candidates import Candidate, candidates_of
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.from_data import from_data
from dlo_casadi.diagnosis.near_data import near_data
from dlo_casadi.diagnosis.refits import Confirmed, Tried
from dlo_casadi.diagnosis.screening import Screened, p_values_of, sidak, survival
from dlo_casadi.diagnosis.selection import (
    AddedEffect,
    added_by,
    choose,
    p_of_removal,
    with_new_noise,
)
from dlo_casadi.diagnosis.structure import noise_degrees, screening_degrees
from dlo_casadi.diagnosis.unknown_force import UnknownForce
from dlo_casadi.effects import PointLoad, StateEffect
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import FINEST_MESH, fine_enough, misfits
from dlo_casadi.estimation.repeats import different_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import SETTLED_MODES, settle
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.runtime.work import UNBOUNDED, Bound, accounted_as
from dlo_casadi.thresholds import DIFFERENT, REFITTED, WORTH


@dataclass(frozen=True)
class Trials:
    """How candidates are tried on the way from a declared model; see `diagnose`."""

    declared: Fit
    center: tuple[float, float] | None
    exclude: Sequence[str]
    significance: float
    executor: Executor
    finest: int | None = None
    bound: Bound = UNBOUNDED
    """Once it is met no further effect, pair or rival is tried."""
    from_shapes: bool = False
    """Whether the first candidates are tried at the measured shapes."""
    wider: Trials | None = None
    """Of the same fit among more candidates, whose tests and refits hold here, too."""

    @cached_property
    def validation(self) -> CrossValidation:
        """Cross-validation of the declared model."""
        return cross_validate(self.declared)

    @property
    def doubt(self) -> float | None:
        """Probability that a gain must beat if few poses were measured repeatedly."""
        problem = self.declared.problem
        count = different_poses(problem.history, self.declared.model)
        return self.significance if count < min(DIFFERENT, len(problem.used)) else None

    @cached_property
    def first(self) -> list[Screened]:
        """Score tests in the declared model."""
        if self.wider is not None:
            return [x for x in self.wider.first if x.candidate.name not in self.exclude]
        return self.screened(self.declared)

    @cached_property
    def known_scores(self) -> list[tuple[Fit, list[Screened]]]:
        """Fits with the score tests of all candidates beside them, as they were made."""
        return []

    @cached_property
    def relaxed(self) -> tuple[Fit, float]:
        """The declared model relaxed at the measured shapes, see `from_data`."""
        return from_data(self.declared)

    @cached_property
    def refitted(self) -> dict[str, Confirmed | None]:
        """Refits of the declared model with a candidate, by name, made only as needed."""
        return self.wider.refitted if self.wider is not None else {}

    def listed(self, current: Fit) -> list[Candidate]:
        """All `candidates_of` a fit."""
        return candidates_of(current, self.center, self.exclude)

    @accounted_as("scores")
    def screened(self, current: Fit, among: Collection[str] | None = None) -> list[Screened]:
        """Score tests of all candidates for a fit, or of those named, best first."""
        listed = [x for x in self.listed(current) if among is None or x.name in among]
        given = screening_degrees(current), self.significance, self.executor
        try:
            found = refits.scored(current, listed, *given)
        except EstimationError:
            # A held-out pose has no equilibrium: what poses leave behind cannot be determined.
            listed = [x for x in listed if not isinstance(x.effect, StateEffect)]
            found = refits.scored(current, listed, *given)
        if among is None:
            self.known_scores.append((current, found))
        return found

    def screened_last(self, fit: Fit) -> list[Screened]:
        """The last score tests of all candidates beside the effects of a fit, here or made now."""
        labels = {effect.label for effect in fit.model.effects}
        for known, found in reversed(self.known_scores):
            if {effect.label for effect in known.model.effects} == labels:
                return found
        return self.screened(fit)

    @accounted_as("candidates")
    def tried(self, current: Fit, *, pairs: bool) -> Tried:
        """Candidates screened and refitted beside the effects of a fit.

        `pairs`: whether two at once may be tried, see `near_data`.
        """
        if self.starts_at_shapes(current):
            near = self.relaxed if current is self.declared else from_data(current)
            given = current, near, self.executor, self.listed
            return near_data(*given, pairs=pairs, bound=self.bound)
        screened = self.first if current is self.declared else self.screened(current)
        known = self.refitted if current is self.declared else {}
        return Tried(screened, p_values_of(screened), self.leading(current, screened, known))

    @accounted_as("causes of a force")
    def tried_as_causes(self, force: UnknownForce) -> Tried:
        """Refits of all loads at one place that explain the forces, whatever their scores.

        A load with the wrong law is less likely than a force in each pose, and is left out.
        """
        loads = [item for item in self.first if isinstance(item.candidate.effect, PointLoad)]
        refit = partial(refits.confirm_cause, self.declared, force)
        found = map_in_order(self.executor, refit, loads)
        least, p_values = force.fit.log_evidence, p_values_of(self.first)
        causes = [item for item in found if item is not None and item.fit.log_evidence >= least]
        for item in causes:
            single = survival(item.gain, len(item.candidate.frees), noise_degrees(self.declared))
            p_values[item.candidate.name] = sidak(single, len(self.first))
        return Tried(self.first, p_values, causes)

    def starts_at_shapes(self, current: Fit) -> bool:
        """Whether candidates start at the measured shapes because the fit is too far from them."""
        first = self.from_shapes and current is self.declared
        return first or current.noise.source == "misfit"

    def leading(
        self,
        current: Fit,
        screened: Sequence[Screened],
        known: dict[str, Confirmed | None],
        beside: Fit | None = None,
    ) -> list[Confirmed]:
        """Refits, beside `known` ones, of the significant candidates with the highest scores.

        `beside`: see `confirm`.
        """
        p_values = p_values_of(screened)
        # A scatter from pose to pose may hide the effect: test the refit with what is left.
        significant = [
            x
            for x in screened
            if current.scatters or p_values[x.candidate.name] < self.significance
        ]
        leading = sorted(significant, key=lambda item: -item.score)[:REFITTED]
        worthy = [item for item in leading if item.score >= WORTH * leading[0].score]
        new = [item for item in worthy if item.candidate.name not in known]
        among = [known.get(item.candidate.name) for item in worthy]
        ceiling = min((refits.ceiling_beside(x.fit) for x in among if x), default=np.inf)
        confirm = partial(refits.confirm, current, ceiling=ceiling, beside=beside)
        found = map_in_order(self.executor, confirm, new)
        known.update(zip((item.candidate.name for item in new), found, strict=True))
        tried = [x for item in worthy if (x := known[item.candidate.name]) is not None]
        return refits.loads_from_best(current, worthy, tried, self.executor)

    @accounted_as("meshes")
    def fine(self, fit: Fit, finest: int | None = None) -> Fit:
        """A fit with effects on a sufficiently fine mesh, if the mesh may be refined."""
        if self.finest is None:
            return fit
        return fine_enough(fit, fit.model.n, SETTLED_MODES, finest or self.finest)


@accounted_as("fits without an effect")
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
        elif trials.bound.met:
            continue
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
    own = [item for item in screened if item.candidate.effect.label == label]
    known = {item.candidate.name: Confirmed.of(item, smaller, fit) for item in own}
    tried = trials.leading(smaller, screened, known, fit)
    chosen, _ = choose(tried, smaller, before, trials.doubt)
    others = tuple(item for item in chosen if item.name != name)
    if len(others) < len(chosen):
        effect = replace(effect, rivals=others)
    if not chosen or (chosen[0].name == name and own):
        return fit, effect
    if found := _winner_added(trials, smaller, before, chosen, screened, fit.log_evidence):
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
    tried = trials.leading(smaller, screened, {})
    before = cross_validate(smaller)
    chosen, _ = choose(tried, smaller, before, trials.doubt)
    found = _winner_added(trials, smaller, before, chosen, screened, smaller.log_evidence)
    return (found[0], [found[1]]) if found else (smaller, [])


def _winner_added(
    trials: Trials,
    base: Fit,
    before: CrossValidation,
    chosen: Sequence[Confirmed],
    screened: Sequence[Screened],
    least: float,
) -> tuple[Fit, AddedEffect] | None:
    """The best of the chosen refits, if it is significant and its log evidence above the least."""
    if not chosen:
        return None
    winner, *rivals = chosen
    from_shapes = trials.starts_at_shapes(base)
    fit, p_value = with_new_noise(winner, base, p_values_of(screened), from_shapes)
    with suppress(EstimationError):
        if fit.log_evidence > least and p_value <= trials.significance:
            (effect,) = added_by(winner, rivals, p_value, before, cross_validate(fit))
            return fit, effect
    return None
