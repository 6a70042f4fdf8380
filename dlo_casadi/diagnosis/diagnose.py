"""Search for the effects missing from a fit: screen, confirm, add, until the residual is noise."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from dlo_casadi.diagnosis import refits
from dlo_casadi.diagnosis.candidates import candidates_of, equivalents
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.from_data import from_data
from dlo_casadi.diagnosis.from_pose_to_pose import (
    as_repeating,
    at_random_instead,
    bends_at_random,
    enough_poses,
    with_loose_poses,
)
from dlo_casadi.diagnosis.near_data import near_data
from dlo_casadi.diagnosis.next_measurement import hidden_weight
from dlo_casadi.diagnosis.refits import Confirmed, Tried
from dlo_casadi.diagnosis.screening import Screened, p_values_of, sidak, survival
from dlo_casadi.diagnosis.selection import (
    AddedEffect,
    Diagnosis,
    Found,
    Ranked,
    added_by,
    choose,
    p_of_removal,
    ranking,
    with_new_noise,
)
from dlo_casadi.diagnosis.structure import noise_degrees, screening_degrees, structure_of
from dlo_casadi.diagnosis.unknown_force import UnknownForce, estimate_unknown_force
from dlo_casadi.effects import PointLoad, StateEffect
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import (
    FINEST_MESH,
    explains,
    fine_enough,
    misfits,
)
from dlo_casadi.estimation.repeats import different_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import SETTLED_MODES, settle
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.thresholds import (
    DIFFERENT,
    EVIDENCE_APART,
    LARGER_OF_TWO,
    LEAST_PROMISED,
    LEAST_PROMISED_BY_TWO,
    REFITTED,
    SIGNIFICANCE,
    WORTH,
)

RAN_AWAY = "its fit ran away: no noise can be estimated from it"


def diagnose(
    fit: Fit,
    *,
    center: tuple[float, float] | None = None,
    exclude: Sequence[str] = (),
    significance: float = SIGNIFICANCE,
    max_effects: int = 4,
    step: Callable[[str, int, int], None] = lambda name, done, total: None,
    executor: Executor | None = None,
    finest: int | None = None,
) -> Diagnosis:
    """Search for effects that a fitted model lacks.

    Held-out poses are not used.

    Parameters
    ----------
    fit : Fit
        Fit of the declared model.
    center : (float, float), optional [m]
        Middle of the photographs in the board frame.
    exclude : sequence of str
        Effects that are not tried.
    significance : float
        Probability, over all candidates, of a false alarm in a complete model.
    step : callable
        Called with the progress of the search.
    executor : Executor, optional
        Runs the screening and refits of candidates and the trial places of an unknown load, which
        take half a second to some seconds each; in this process by default.
    finest : int, optional
        Maximum number of elements to which the search may refine the mesh; by default none. Found
        effects are tested on up to FINEST_MESH elements.
    """
    run_in = executor or InProcess()
    return Search(fit, center, exclude, significance, max_effects, step, run_in, finest).diagnosis()


@dataclass(frozen=True)
class Search:
    """Search for effects that a declared model lacks: the arguments of `diagnose`."""

    declared: Fit
    center: tuple[float, float] | None
    exclude: Sequence[str]
    significance: float
    max_effects: int
    step: Callable[[str, int, int], None]
    executor: Executor
    finest: int | None = None
    from_shapes: bool = False
    """Whether the first candidates are tried at the measured shapes."""
    wider: Search | None = None
    """Of the same fit among more candidates, whose tests and refits hold here, too."""

    @cached_property
    def validation(self) -> CrossValidation:
        """Cross-validation of the declared model."""
        return cross_validate(self.declared)

    @property
    def several(self) -> bool:
        """Whether an unknown force may have a cause: in one pose a force fits as well as any."""
        return len(self.declared.problem.used) > 1 and self.max_effects > 0

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
        return self._screened(self.declared)

    @cached_property
    def relaxed(self) -> tuple[Fit, float]:
        """The declared model relaxed at the measured shapes, see `from_data`."""
        return from_data(self.declared)

    @cached_property
    def refitted(self) -> dict[str, Confirmed | None]:
        """Refits of the declared model with a candidate, by name, made only as needed."""
        return self.wider.refitted if self.wider is not None else {}

    def _screened(self, current: Fit, among: Collection[str] | None = None) -> list[Screened]:
        """Score tests of all `candidates_of` a fit, or of those named, best first."""
        listed = candidates_of(current, self.center, self.exclude)
        listed = [x for x in listed if among is None or x.name in among]
        given = screening_degrees(current), self.significance, self.executor
        with suppress(EstimationError):
            return refits.scored(current, listed, *given)
        # A held-out pose has no equilibrium, so what poses leave behind cannot be determined.
        listed = [x for x in listed if not isinstance(x.effect, StateEffect)]
        return refits.scored(current, listed, *given)

    def diagnosis(self) -> Diagnosis:
        """Result of the search, without effects that explain too little."""
        fit, force = self.declared, None
        misfit = fit.noise.source == "misfit" and enough_poses(fit)
        near = with_loose_poses(fit, self.relaxed[0], self.finest) if misfit else None
        if near is not None:
            return replace(self, declared=near).diagnosis()
        found = self._searched()
        near = at_random_instead(fit, found, self.finest) if misfit else None
        if near is not None:
            return replace(self, declared=near).diagnosis()
        if found.unexplained:
            found, force = self._or_causes(found)
        if found.unexplained and found.added:
            if not found.leaves_little(self.validation):
                found = self._ended(fit, [], found.ranked)
            if found.added or not fit.errors_known:
                force = estimate_unknown_force(found.fit, self.executor)
        tried = {row.name for row in found.ranked}
        added = (
            replace(x, equivalents=equivalents(found.fit, x.candidate, tried, x.rival_candidates))
            for x in found.added
        )
        return Diagnosis(
            before=fit,
            after=found.fit,
            validation_before=self.validation,
            validation_after=found.validation,
            structure_before=structure_of(fit, screening_degrees(fit)),
            structure_after=found.structure,
            added=tuple(added),
            ranked=found.ranked,
            unexplained=found.unexplained,
            unknown_force=force if found.unexplained else None,
            weight=None if found.unexplained else hidden_weight(found.fit, self.exclude),
        )

    def _searched(self) -> Found:
        """Search from the measured shapes: first if the fit leaves far more than noise, else last.

        A first search that finds nothing does not count: it has tried the nearest candidates only.
        A scatter from pose to pose explains anything: if the declared model and the result have
        one, the search is repeated as if there were none, unless that promises nothing better, and
        from the measured shapes, if what scatters bends the cable, as missing effects do.
        """
        of_shapes = replace(self, from_shapes=True)
        may_be_far = self.several and self.declared.noise.source != "misfit"
        # In such a fit the first effect may stand for two; the next ones then only fit its error.
        first = of_shapes.run() if may_be_far and not explains(self.declared) else None
        if first is not None and first.added and not first.unexplained:
            return first
        found = self._forwards()
        if self.several and found.fit.scatters and self.declared.scatters:
            with suppress(EstimationError):
                repeating = replace(self, declared=as_repeating(self.declared))
                if found.unexplained or repeating._may_gain(self.declared):
                    found = found.or_better(repeating._forwards(), EVIDENCE_APART)
        if may_be_far and (found.unexplained or bends_at_random(found.fit)):
            found = found.or_better(first or of_shapes.run())
        # If left-out poses are not even reached, refits may have started too far from the effect.
        lost = may_be_far and not found.unexplained and not self.validation.complete
        return self._or_causes(found)[0] if lost else found

    def _may_gain(self, scattering: Fit) -> bool:
        """Whether one or two scores promise a fair share of what the scatter gains."""
        gained = 2 * (scattering.log_evidence - self.declared.log_evidence)
        least, by_two = LEAST_PROMISED * gained, LEAST_PROMISED_BY_TWO * gained
        if not self.declared.converged or any(item.score > least for item in self.first):
            return True
        refitted = sorted(self._tried(self.declared, None, 0).refits, key=lambda item: -item.gain)
        return any(x.gain + y.score > by_two for x in refitted[:1] for y in self._screened(x.fit))

    def _forwards(self) -> Found:
        """Result of `run`, or of the same among simpler effects if that is better.

        The first estimate of slow noise is rough, and a large one hides an effect. If nothing is
        found, and the noise of a complete model is smaller, the search begins anew with that.
        """
        found = (first := self.run()).or_better(self.of_simpler_effects(first))
        settled = replace(self, declared=found.fit)
        if not found.added and found.fit.noise.std < self.declared.noise.std:
            with suppress(EstimationError):
                best = min(p_values_of(settled.first).values(), default=1.0)
                if best <= self.significance and (again := settled.run()).added:
                    return again
        return found

    def run(self, force: UnknownForce | None = None) -> Found:
        """Add effects until the residual is noise or left-out data are predicted no better.

        `force`: its causes are tried in the first step; without it all effects, starting from the
        declared model.
        """
        current, validation = self.declared, self.validation
        added: list[AddedEffect] = []
        ranked: list[Ranked] = []
        while len(added) < self.max_effects:
            self.step("search for a missing effect", len(added), self.max_effects)
            first = force if not added else None
            tried = self._tried(current, first, len(added))
            chosen, lost = choose(tried.refits, current, validation, self.doubt)
            lost |= tried.far
            better, p_value = current, 1.0
            if chosen:
                winner, *rivals = chosen
                better, p_value = with_new_noise(
                    winner, current, tried.p_values, self._starts_at_shapes(current)
                )
                if p_value > self.significance:
                    names = [x.candidate.name for item in chosen for x in item.each]
                    lost |= dict.fromkeys(names, f"not significant: p = {p_value:.2g}")
                    if better is current:
                        lost |= dict.fromkeys((x.candidate.name for x in winner.each), RAN_AWAY)
            if not ranked:
                rows = ranking(tried, current, validation)
                ranked = [replace(row, reason=lost.get(row.name, "")) for row in rows]
            if p_value > self.significance:
                break
            if self._starts_at_shapes(current) and force is None:
                # The mesh of a misfit is coarse; its error would look like the next effect.
                better = self._fine(better)
            current, before = better, validation
            validation = cross_validate(current)
            added += added_by(winner, rivals, p_value, before, validation)
        self.step("search for a missing effect", self.max_effects, self.max_effects)
        return self._ended(*self._pruned(current, added), tuple(ranked))

    def _tried(self, current: Fit, force: UnknownForce | None, added: int) -> Tried:
        """Candidates screened and refitted beside those already added."""
        if self._starts_at_shapes(current) and force is None:
            pairs = added + 2 <= self.max_effects
            near = self.relaxed if current is self.declared else from_data(current)
            return near_data(current, near, self.executor, self.center, self.exclude, pairs=pairs)
        screened = self.first if current is self.declared else self._screened(current)
        p_values = p_values_of(screened)
        if force is None:
            known = self.refitted if current is self.declared else {}
            return Tried(screened, p_values, self._leading(current, screened, p_values, known))
        causes = self._causes(force, screened)
        for item in causes:
            single = survival(item.gain, len(item.candidate.frees), noise_degrees(current))
            p_values[item.candidate.name] = sidak(single, len(screened))
        return Tried(screened, p_values, causes)

    def _starts_at_shapes(self, current: Fit) -> bool:
        """Whether candidates start at the measured shapes because the fit is too far from them."""
        first = self.from_shapes and current is self.declared
        return first or current.noise.source == "misfit"

    def of_simpler_effects(self, found: Found) -> Found | None:
        """Search among effects with fewer parameters, if one of these may be the larger of two.

        An effect of many parameters may stand for two effects of one parameter each.
        """
        if not found.added or self.declared.noise.source == "misfit":
            return None
        winner = found.added[0].candidate
        scores = {item.candidate.name: item.score for item in self.first}
        free = {item.candidate.name: len(item.candidate.frees) for item in self.first}
        others = [name for name in scores if free[name] >= len(winner.frees)]
        best = max((scores[name] for name in scores.keys() - others), default=0.0)
        # An effect that only a larger model could screen has no score here.
        if best < LARGER_OF_TWO * scores.get(winner.name, np.inf):
            return None
        return replace(self, exclude=[*self.exclude, *others], wider=self).run()

    def _or_causes(self, found: Found) -> tuple[Found, UnknownForce | None]:
        """The found effects, or causes of an unknown force if these are better; and the force."""
        start = self.declared if found.added else found.fit
        force = estimate_unknown_force(start, self.executor)
        causes = self.run(force) if force is not None and self.several else None
        return found.or_better(causes), force

    def _pruned(self, fit: Fit, added: list[AddedEffect]) -> tuple[Fit, list[AddedEffect]]:
        """Backward step: remove effects that later ones have made superfluous.

        A removed nuisance is held within its declared tolerance again.

        An effect has to be worth its parameters, and as significant as when it was added. The last
        one is significant, but it may have led out of a local minimum and no longer be needed, or
        stand for an error of the mesh: 80 elements on a table were 0.6 mm off. An effect found from
        the measured shapes may stand for a scatter.
        """
        before, fit = fit, self._fine(fit, FINEST_MESH) if added else fit
        significant = added[-1:] if fit is before and not self.from_shapes else []
        for effect in added:
            smaller = refits.refit_without(fit, effect.candidate, self.declared)
            if smaller is None:
                continue
            needless = smaller.log_evidence > fit.log_evidence
            if not needless and effect not in significant:
                tried = len(candidates_of(smaller, self.center, self.exclude))
                needless = p_of_removal(fit, smaller, effect.candidate, tried) > self.significance
            if needless:
                with suppress(EstimationError):  # else there is no fit without it
                    fit = settle(smaller)
                    added = [item for item in added if item is not effect]
            elif effect.after is not added[-1].after and (effect.rivals or not misfits(smaller)):
                fit, chosen = self._judged_again(fit, smaller, effect)
                added = [chosen if item is effect else item for item in added]
        return fit, added

    def _judged_again(self, fit: Fit, smaller: Fit, effect: AddedEffect) -> tuple[Fit, AddedEffect]:
        """The likeliest candidate beside effects that were added later, and its rivals.

        Sequential replacement (Miller 1990): an effect may be the best one alone, and another one,
        or that of another clip, beside what was still missing then. Alone, a force explained a tilt
        and a drift better than either. `smaller` lacks the effect; if it misfits, scores are
        useless and only known rivals are judged.
        """
        before, name, label = cross_validate(smaller), effect.name, effect.candidate.effect.label
        rivals_only = {name, *(rival.name for rival in effect.rival_candidates)}
        screened = self._screened(smaller, rivals_only if misfits(smaller) else None)
        p_values = p_values_of(screened)
        own = [item for item in screened if item.candidate.effect.label == label]
        known = {item.candidate.name: Confirmed.of(item, smaller, fit) for item in own}
        tried = self._leading(smaller, screened, p_values, known, fit)
        chosen, _ = choose(tried, smaller, before, self.doubt)
        others = tuple(item for item in chosen if item.name != name)
        if len(others) < len(chosen):
            effect = replace(effect, rivals=others)
        if not chosen or (chosen[0].name == name and own):
            return fit, effect
        winner = chosen[0]
        better, p_value = with_new_noise(winner, smaller, p_values, self._starts_at_shapes(smaller))
        with suppress(EstimationError):
            if better.log_evidence > fit.log_evidence and p_value <= self.significance:
                after = cross_validate(better)
                (other,) = added_by(winner, chosen[1:], p_value, before, after)
                return better, other
        rivals = {item.name: item for item in (*effect.rivals, winner) if item.name != name}
        return fit, replace(effect, rivals=tuple(rivals.values()))

    def _leading(
        self,
        current: Fit,
        screened: Sequence[Screened],
        p_values: Mapping[str, float],
        known: dict[str, Confirmed | None],
        beside: Fit | None = None,
    ) -> list[Confirmed]:
        """Refits, beside `known` ones, of the significant candidates with the highest scores.

        `beside`: see `confirm`.
        """
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

    def _causes(self, force: UnknownForce, screened: Sequence[Screened]) -> list[Confirmed]:
        """Refits of all loads at one place that explain the forces, whatever their scores.

        A load with the wrong law is less likely than a force in each pose, and is left out.
        """
        loads = [item for item in screened if isinstance(item.candidate.effect, PointLoad)]
        refit = partial(refits.confirm_cause, self.declared, force)
        least = force.fit.log_evidence
        tried = map_in_order(self.executor, refit, loads)
        return [item for item in tried if item is not None and item.fit.log_evidence >= least]

    def _ended(self, fit: Fit, added: list[AddedEffect], ranked: tuple[Ranked, ...]) -> Found:
        """The effects found, and whether they explain the data."""
        fit = fit if added or fit.noise.known else settle(fit)
        return Found.of(fit, added, ranked, len(self.declared.problem.used), self.significance)

    def _fine(self, fit: Fit, finest: int | None = None) -> Fit:
        """A fit with effects on a sufficiently fine mesh, if the mesh may be refined."""
        if self.finest is None:
            return fit
        return fine_enough(fit, fit.model.n, SETTLED_MODES, finest or self.finest)[0]
