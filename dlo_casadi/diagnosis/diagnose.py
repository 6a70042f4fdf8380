"""Search for the effects missing from a fit: screen, confirm, add, until the residual is noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dlo_casadi.diagnosis.candidates import equivalents
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.from_pose_to_pose import (
    as_repeating,
    at_random_instead,
    bends_at_random,
    with_loose_poses,
)
from dlo_casadi.diagnosis.if_hidden import IfHidden, if_hidden
from dlo_casadi.diagnosis.screening import p_values_of
from dlo_casadi.diagnosis.selection import (
    AddedEffect,
    Found,
    Ranked,
    added_by,
    choose,
    ranking,
    with_new_noise,
)
from dlo_casadi.diagnosis.structure import Structure, screening_degrees, structure_of
from dlo_casadi.diagnosis.trials import Trials, pruned
from dlo_casadi.diagnosis.unknown_force import UnknownForce, estimate_unknown_force
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import explains
from dlo_casadi.estimation.repeats import enough_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import settle
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.work import Bound, accounted_as
from dlo_casadi.thresholds import (
    EVIDENCE_APART,
    LARGER_OF_TWO,
    LEAST_PROMISED,
    LEAST_PROMISED_BY_TWO,
    SIGNIFICANCE,
)

# Steps of a diagnosis after which no search, no further effect and no further pair is begun. Whole
# sessions in space with a stiff section took 420 and 730 steps, space_pull, in which no single
# candidate reaches the noise at first, 1480: a step of it takes 0.12 s on a loaded machine.
DIAGNOSIS_STEPS = 4000
Verdict = Literal["complete", "effect_found", "unexplained"]
RAN_AWAY = "its fit ran away: no noise can be estimated from it"


@dataclass(frozen=True)
class Diagnosis(Found):
    """Result of a search for missing effects, and the declared model before it.

    Parameters
    ----------
    before : Fit
        The declared model.
    validation_before : CrossValidation
    structure_before : Structure
    unknown_force : UnknownForce or None
        If unexplained: the load that assumes no cause; None if no load fits.
    if_hidden : dict
        By stiffness, what one effect could do to it that the data do not exclude; empty if
        unexplained.
    cut_off : bool
        Whether the bound on its work was met, so that not everything was tried.
    """

    before: Fit
    validation_before: CrossValidation
    structure_before: Structure
    unknown_force: UnknownForce | None
    if_hidden: Mapping[str, IfHidden]
    cut_off: bool = False

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
    given = fit, center, exclude, significance, executor or InProcess(), finest
    trials = Trials(*given, bound=Bound(DIAGNOSIS_STEPS))
    return Search(trials, max_effects, step).diagnosis()


@dataclass(frozen=True)
class Search:
    """Search for effects that a declared model lacks: the arguments of `diagnose`."""

    trials: Trials
    max_effects: int
    step: Callable[[str, int, int], None]

    @property
    def declared(self) -> Fit:
        """Fit of the declared model."""
        return self.trials.declared

    def beginning_with(self, **changes: Any) -> Search:
        """The search with other `Trials`: these fields changed."""
        return replace(self, trials=replace(self.trials, **changes))

    @property
    def several(self) -> bool:
        """Whether an unknown force may have a cause: in one pose a force fits as well as any."""
        return len(self.declared.problem.used) > 1 and self.max_effects > 0

    @property
    def goes_on(self) -> bool:
        """Whether another search may begin."""
        return self.several and not self.trials.bound.met

    def diagnosis(self) -> Diagnosis:
        """Result of the search, without effects that explain too little."""
        trials, force = self.trials, None
        fit = trials.declared
        many = enough_poses(fit.problem.history, fit.model)
        misfit = fit.noise.source == "misfit" and many
        near = with_loose_poses(fit, trials.relaxed[0], trials.finest) if misfit else None
        if near is not None:
            return self.beginning_with(declared=near).diagnosis()
        found = self._searched()
        again = misfit and self.goes_on
        near = at_random_instead(fit, found, trials.finest) if again else None
        if near is not None:
            return self.beginning_with(declared=near).diagnosis()
        if found.unexplained:
            found, force = self._or_causes(found)
        if found.unexplained and found.added:
            if not found.leaves_little(trials.validation):
                found = self._ended(fit, [], found.ranked)
            if found.added or not fit.errors_known:
                force = estimate_unknown_force(found.fit, trials.executor)
        tried = {row.name for row in found.ranked}
        added = (
            replace(x, equivalents=equivalents(found.fit, x.candidate, tried, x.rival_candidates))
            for x in found.added
        )
        return Diagnosis(
            **vars(replace(found, added=tuple(added))),
            before=fit,
            validation_before=trials.validation,
            structure_before=structure_of(fit, screening_degrees(fit)),
            unknown_force=force if found.unexplained else None,
            if_hidden=self._if_hidden(found),
            cut_off=trials.bound.met,
        )

    def _if_hidden(self, found: Found) -> dict[str, IfHidden]:
        """What one effect could do to the stiffnesses of a model that explains the data."""
        if found.unexplained:
            return {}
        return if_hidden(found.fit, self.trials.screened_last(found.fit))

    def _searched(self) -> Found:
        """Search from the measured shapes: first if the fit leaves far more than noise, else last.

        A first search that finds nothing does not count: it has tried the nearest candidates only.
        A scatter from pose to pose explains anything: if the declared model and the result have
        one, the search is repeated as if there were none, unless that promises nothing better, and
        from the measured shapes, if what scatters bends the cable, as missing effects do.
        """
        of_shapes = self.beginning_with(from_shapes=True)
        may_be_far = self.several and self.declared.noise.source != "misfit"
        # In such a fit the first effect may stand for two; the next ones then only fit its error.
        first = of_shapes.run() if may_be_far and not explains(self.declared) else None
        if first is not None and first.added and not first.unexplained:
            return first
        found = self._forwards()
        if self.goes_on and found.fit.scatters and self.declared.scatters:
            with suppress(EstimationError):
                repeating = self.beginning_with(declared=as_repeating(self.declared))
                if found.unexplained or repeating._may_gain(self.declared):
                    found = found.or_better(repeating._forwards(), EVIDENCE_APART)
        if may_be_far and (found.unexplained or bends_at_random(found.fit)):
            other = first or (of_shapes.run() if self.goes_on else None)
            found = found.or_better(other)
        # If left-out poses are not even reached, refits may have started too far from the effect.
        lost = may_be_far and not found.unexplained and not self.trials.validation.complete
        return self._or_causes(found)[0] if lost and self.goes_on else found

    def _may_gain(self, scattering: Fit) -> bool:
        """Whether one or two scores promise a fair share of what the scatter gains."""
        gained = 2 * (scattering.log_evidence - self.declared.log_evidence)
        least, by_two = LEAST_PROMISED * gained, LEAST_PROMISED_BY_TWO * gained
        if not self.declared.converged or any(item.score > least for item in self.trials.first):
            return True
        refitted = self.trials.tried(self.declared, pairs=self.max_effects > 1).refits
        best = sorted(refitted, key=lambda item: -item.gain)[:1]
        return any(x.gain + y.score > by_two for x in best for y in self.trials.screened(x.fit))

    def _forwards(self) -> Found:
        """Result of `run`, or of the same among simpler effects if that is better.

        The first estimate of slow noise is rough, and a large one hides an effect. If nothing is
        found, and the noise of a complete model is smaller, the search begins anew with that.
        """
        found = (first := self.run()).or_better(self.of_simpler_effects(first))
        settled = self.beginning_with(declared=found.fit)
        met = self.trials.bound.met
        if not (found.added or met) and found.fit.noise.std < self.declared.noise.std:
            with suppress(EstimationError):
                best = min(p_values_of(settled.trials.first).values(), default=1.0)
                if best <= self.trials.significance and (again := settled.run()).added:
                    return again
        return found

    @accounted_as("searches")
    def run(self, force: UnknownForce | None = None) -> Found:
        """Add effects until the residual is noise or left-out data are predicted no better.

        `force`: its causes are tried in the first step; without it all effects, starting from the
        declared model.
        """
        trials = self.trials
        current, validation = trials.declared, trials.validation
        added: list[AddedEffect] = []
        ranked: list[Ranked] = []
        while len(added) < self.max_effects and not (ranked and trials.bound.met):
            self.step("search for a missing effect", len(added), self.max_effects)
            if force is not None and not added:
                tried = trials.tried_as_causes(force)
            else:
                tried = trials.tried(current, pairs=len(added) + 2 <= self.max_effects)
            chosen, lost = choose(tried.refits, current, validation, trials.doubt)
            lost |= tried.far
            better, p_value = current, 1.0
            if chosen:
                winner, *rivals = chosen
                better, p_value = with_new_noise(
                    winner, current, tried.p_values, trials.starts_at_shapes(current)
                )
                if p_value > trials.significance:
                    names = [x.candidate.name for item in chosen for x in item.each]
                    lost |= dict.fromkeys(names, f"not significant: p = {p_value:.2g}")
                    if better is current:
                        lost |= dict.fromkeys((x.candidate.name for x in winner.each), RAN_AWAY)
            if not ranked:
                rows = ranking(tried, current, validation)
                ranked = [replace(row, reason=lost.get(row.name, "")) for row in rows]
            if p_value > trials.significance:
                break
            if trials.starts_at_shapes(current) and force is None:
                # The mesh of a misfit is coarse; its error would look like the next effect.
                better = trials.fine(better)
            current, before = better, validation
            validation = cross_validate(current)
            added += added_by(winner, rivals, p_value, before, validation)
        self.step("search for a missing effect", self.max_effects, self.max_effects)
        return self._ended(*pruned(trials, current, added), tuple(ranked))

    def of_simpler_effects(self, found: Found) -> Found | None:
        """Search among effects with fewer parameters, if one of these may be the larger of two.

        An effect of many parameters may stand for two effects of one parameter each.
        """
        if not found.added or self.declared.noise.source == "misfit" or not self.goes_on:
            return None
        trials, winner = self.trials, found.added[0].candidate
        scores = {item.candidate.name: item.score for item in trials.first}
        free = {item.candidate.name: len(item.candidate.frees) for item in trials.first}
        others = [name for name in scores if free[name] >= len(winner.frees)]
        best = max((scores[name] for name in scores.keys() - others), default=0.0)
        # An effect that only a larger model could screen has no score here.
        if best < LARGER_OF_TWO * scores.get(winner.name, np.inf):
            return None
        return self.beginning_with(exclude=[*trials.exclude, *others], wider=trials).run()

    def _or_causes(self, found: Found) -> tuple[Found, UnknownForce | None]:
        """The found effects, or causes of an unknown force if these are better; and the force."""
        start = self.declared if found.added else found.fit
        force = estimate_unknown_force(start, self.trials.executor)
        causes = self.run(force) if force is not None and self.goes_on else None
        return found.or_better(causes), force

    def _ended(self, fit: Fit, added: list[AddedEffect], ranked: tuple[Ranked, ...]) -> Found:
        """The effects found, and whether they explain the data."""
        fit = fit if added or fit.noise.known else settle(fit)
        return Found.of(fit, added, ranked, self.trials.significance)
