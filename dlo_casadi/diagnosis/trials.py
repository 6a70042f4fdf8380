"""Candidates tried beside the effects that a fit has, and fits tried without one of these.

Candidates are screened, and the likely ones refitted. The backward step of a search removes effects
that others have made superfluous, or replaces them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from dlo_casadi.diagnosis import refits
from dlo_casadi.diagnosis.candidates import Candidate, candidates_of
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.found import AddedEffect
from dlo_casadi.diagnosis.from_data import from_data
from dlo_casadi.diagnosis.gram import Gram, Screened, in_order, p_values_of, sidak, survival
from dlo_casadi.diagnosis.near_data import near_data
from dlo_casadi.diagnosis.refits import Confirmed, Tried
from dlo_casadi.diagnosis.selection import decide, shortcoming
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
from dlo_casadi.thresholds import BEST, DIFFERENT, REFITTED, WORTH


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

    @property
    def limits(self) -> tuple[float, float | None]:
        """Significance and doubt, see `decide`."""
        return self.significance, self.doubt

    @cached_property
    def first(self) -> list[Screened]:
        """Score tests in the declared model."""
        return self.screened(self.declared)

    @cached_property
    def known_grams(self) -> list[tuple[Fit, Gram]]:
        """Fits with the Gram matrices of all candidates beside them, as they were made."""
        return []

    @cached_property
    def relaxed(self) -> tuple[Fit, float]:
        """The declared model relaxed at the measured shapes, see `from_data`."""
        return from_data(self.declared)

    @cached_property
    def refitted(self) -> dict[str, Confirmed | None]:
        """Refits of the declared model with a candidate, by name, made only as needed."""
        return {}

    def listed(self, current: Fit) -> list[Candidate]:
        """All `candidates_of` a fit."""
        return candidates_of(current, self.center, self.exclude)

    @accounted_as("scores")
    def screened(self, current: Fit, among: Collection[str] | None = None) -> list[Screened]:
        """Score tests of all candidates for a fit, or of those named, best first."""
        every = self.listed(current)
        listed = [x for x in every if among is None or x.name in among]
        whole = all(x in listed for x in every if x.effect.gradual)
        given = screening_degrees(current), self.significance, self.executor
        try:
            found, gram = refits.scored(current, listed, *given)
        except EstimationError:
            # A held-out pose has no equilibrium: what poses leave behind cannot be determined.
            listed = [x for x in listed if not isinstance(x.effect, StateEffect)]
            found, gram = refits.scored(current, listed, *given)
        if whole and gram is not None:
            self.known_grams.append((current, gram))
        return found

    def gram_beside(self, fit: Fit) -> Gram | None:
        """The last Gram matrix of all candidates beside the effects of a fit; made now if none.

        None if there is no candidate that has a derivative where its effect vanishes.
        """
        labels = {effect.label for effect in fit.model.effects}
        for other, gram in reversed(self.known_grams):
            if {effect.label for effect in other.model.effects} == labels:
                return gram
        before = len(self.known_grams)
        self.screened(fit)
        return self.known_grams[-1][1] if len(self.known_grams) > before else None

    @accounted_as("candidates")
    def tried(self, current: Fit, validation: CrossValidation, *, largest: int) -> Tried:
        """Candidates screened and refitted beside the effects of a fit, which has this validation.

        `largest`: number of candidates that may be tried at once, see `near_data`.
        """
        if self.starts_at_shapes(current):
            near = self.relaxed if current is self.declared else from_data(current)
            given = current, near, self.executor, self.listed(near[0])
            return near_data(*given, largest=largest, bound=self.bound)
        screened = self.first if current is self.declared else self.screened(current)
        known = self.refitted if current is self.declared else {}
        tried = self.leading(current, screened, known)
        if current is self.declared:
            tried = self._at_shapes(tried)
        p_values = p_values_of(screened)
        beside = current, validation, tried, p_values
        pairs = self._simple_pairs(*beside) if largest > 1 else []
        for x in (x for item in pairs for x in item.each):
            name = x.candidate.name
            p_values[name] = min(p_values[name], sidak(x.p_value, len(screened)))
        return Tried(screened, p_values, [*tried, *pairs])

    def _at_shapes(self, tried: list[Confirmed]) -> list[Confirmed]:
        """The refits; if the likeliest leaves more than noise, it is fitted from the shapes, too.

        The better fit counts. A softening has two minima where shapes tell hardly more than the
        largest moment, and what the wrong one leaves looks like a load.
        """
        best = max(tried, key=lambda item: item.fit.log_evidence, default=None)
        if best is None or not (best.candidate.effect.gradual and best.fit.beyond_noise):
            return tried
        with suppress(EstimationError):  # relaxed shapes may not reach the measured ones
            fit = refits.refit_from_shapes(self.declared, self.relaxed[0], best.screened)
            found = Confirmed.of(best.screened, self.declared, fit)
            if found and found.fit.point.objective < best.fit.point.objective:
                self.refitted[best.name] = found
                return [found if item is best else item for item in tried]
        return tried

    def _simple_pairs(
        self,
        current: Fit,
        validation: CrossValidation,
        tried: Sequence[Confirmed],
        p_values: Mapping[str, float],
    ) -> list[Confirmed]:
        """Refits of pairs with no more parameters than a single candidate, which may stand for two.

        Both have to be significant beside one another, and to promise more than any single one.
        Pairs with the likeliest single one are left out if that is better than the fit: what it
        lacks is found in the next step, beside all candidates.
        """
        gram, n = self.gram_beside(current), len(p_values)
        if gram is None or not tried:
            return []
        most = max(len(item.candidate.frees) for item in tried)
        promised = max(item.screened.score for item in tried)
        best = max(tried, key=lambda item: item.fit.log_evidence)
        alone = {best.name} if not shortcoming(best, current, validation, self.doubt) else set()
        pairs = [
            pair
            for pair in gram.subsets(2, BEST)
            if sum(len(x.candidate.frees) for x in pair) <= most
            and not any(x.candidate.name in alone for x in pair)
            and all(sidak(x.p_value, n) < self.significance for x in pair)
            and gram.gain(pair) > promised
        ]
        ceiling = min(refits.ceiling_beside(item.fit) for item in tried)
        confirm = partial(refits.confirm_subset, current, ceiling=ceiling)
        return [x for x in map_in_order(self.executor, confirm, pairs) if x]

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
        ceiling = min((refits.ceiling_beside(x.fit) for x in known.values() if x), default=np.inf)
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

    The fit without an effect is a base beside which the effect is one of the candidates; see
    `judged`. The last one has just been compared with all others, but it may have led out of a
    local minimum and no longer be needed, or stand for an error of the mesh: 80 elements on a table
    were 0.6 mm off. An effect found from the measured shapes may stand for a scatter.
    """
    accepted, fit = fit, trials.fine(fit, FINEST_MESH) if added else fit
    last = [effect for effect in added if effect.after is added[-1].after]
    for effect in added:
        smaller = refits.refit_without(fit, effect.candidate, trials.declared)
        if smaller is None:
            continue
        compared = len(last) == 1 and effect in last  # a pair was compared with few other pairs
        before, after = effect.before, effect.after
        if not (compared and fit is accepted):
            before, after = cross_validate(smaller), cross_validate(fit)
        gain = 2 * (smaller.point.objective - fit.point.objective)
        p_value = survival(gain, len(effect.candidate.frees), screening_degrees(smaller))
        start = Screened(effect.candidate, gain, p_value, {})
        own = Confirmed(start, fit, after, gain, settled=True)
        others = not (compared or trials.bound.met)
        fit, found = judged(trials, own, smaller, before, effect, others=others)
        if compared and not found and not trials.bound.met:
            fit, found = judged(trials, own, smaller, before, effect)
        added = [x for item in added for x in (found if item is effect else [item])]
    return fit, added


def judged(
    trials: Trials,
    own: Confirmed,
    smaller: Fit,
    before: CrossValidation,
    effect: AddedEffect,
    *,
    others: bool = True,
) -> tuple[Fit, list[AddedEffect]]:
    """The likeliest candidate beside a fit without one of its effects, that effect among them.

    Sequential replacement (Miller 1990): an effect may be the best one alone, and another one,
    or that of another clip, beside what was still missing then. Alone, a force explained a tilt
    and a drift better than either. One with fewer parameters may be significant where it is not:
    for a mass off by 30 %, a force gained as much, but was not significant.

    Parameters
    ----------
    own : Confirmed
        The fit with the effect.
    smaller : Fit
        The fit without it. If that misfits, scores are useless and only known rivals are judged.
    before : CrossValidation
        Of the fit without it.
    others : bool
        Whether other candidates are judged.
    """
    label, screened, listed = own.candidate.effect.label, [], trials.listed(smaller)
    if others and (effect.rivals or not misfits(smaller)):
        rivals = {effect.name, *(rival.name for rival in effect.rival_candidates)}
        asked = rivals if misfits(smaller) else {x.name for x in listed}
        # The score of an effect without derivative is the gain of a refit: that is known here.
        known_gain = [] if own.candidate.effect.gradual else [own.screened]
        asked -= {x.candidate.name for x in known_gain}
        screened = in_order([*trials.screened(smaller, asked), *known_gain])
    known: dict[str, Confirmed | None] = {}
    if any(x.candidate.effect.label == label for x in screened):
        known[effect.name] = own
    refitted = trials.leading(smaller, screened, known, own.fit) if screened else []
    refitted = [own, *(item for item in refitted if item is not own)]
    p_values = {x.name: 1.0 for x in listed} | p_values_of(screened)
    decision = decide(smaller, before, Tried(screened, p_values, refitted), *trials.limits)
    with suppress(EstimationError):
        if not decision.chosen:
            return settle(smaller), []
        if decision.chosen[0] is not own:
            return decision.fit, decision.added(before, cross_validate(decision.fit))
    compared = decision.chosen and len(screened) > len(known)
    rivals_now = tuple(decision.chosen[1:]) if compared else effect.rivals
    return own.fit, [replace(effect, rivals=rivals_now)]
