"""Search for the effects missing from a fit: screen, confirm, add, until the residual is noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, Literal

from dlo_casadi.diagnosis.candidates import equivalents
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.found import AddedEffect, Found, Ranked, likelier_by
from dlo_casadi.diagnosis.from_pose_to_pose import (
    as_line,
    as_repeating,
    at_random,
    few_places,
    with_loose_poses,
)
from dlo_casadi.diagnosis.gram import sidak, survival
from dlo_casadi.diagnosis.if_hidden import IfHidden, if_hidden
from dlo_casadi.diagnosis.selection import decide, ranking
from dlo_casadi.diagnosis.structure import Structure, screening_degrees, structure_of
from dlo_casadi.diagnosis.trials import Trials, pruned
from dlo_casadi.diagnosis.unknown_force import UnknownForce, estimate_unknown_force
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import explains
from dlo_casadi.estimation.repeats import enough_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import A_LINE, settle
from dlo_casadi.model.pose_scatter import REST_CURVATURE
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.work import Bound, accounted_as
from dlo_casadi.thresholds import (
    EVIDENCE_APART,
    LEAST_PROMISED,
    SIGNIFICANCE,
)

# Steps of a diagnosis after which no search, no further effect and no further pair is begun. Of 131
# simulated sessions of seven kinds (check_false_alarms.py --each) 90 % took up to 940 steps in all
# and 99 % up to 1850; one that took 5300 found nothing after 2000.
DIAGNOSIS_STEPS = 2000
Verdict = Literal["complete", "effect_found", "unexplained"]


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
    """Search for effects that a declared model lacks: the arguments of `diagnose`.

    `force`: an unknown one whose causes are tried in the first step; without it all effects.
    """

    trials: Trials
    max_effects: int
    step: Callable[[str, int, int], None]
    force: UnknownForce | None = None

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

    @property
    def may_be_far(self) -> bool:
        """Whether a search from the fit may begin too far from the effects.

        A misfit's begins at the measured shapes anyway.
        """
        return self.several and self.declared.noise.source != "misfit"

    def diagnosis(self) -> Diagnosis:
        """Result of the search, without effects that explain too little."""
        trials, fit = self.trials, self.declared
        many = enough_poses(fit.problem.history, fit.model)
        misfit = fit.noise.source == "misfit" and many
        near = with_loose_poses(fit, trials.relaxed[0], trials.finest) if misfit else None
        if near is not None:
            return self.beginning_with(declared=near).diagnosis()
        found, _ = self.best()
        if misfit and self.goes_on and (found.unexplained or found.fit.scatters):
            near = at_random(fit, found.fit.model.n, trials.finest)
        if near is not None and self._random_is_better(found, near):
            return self.beginning_with(declared=near).diagnosis()
        found, force = self.best((CAUSES,), found)
        if found.unexplained and found.added:
            if not found.leaves_little(trials.validation):
                found = self._ended(fit, [], found.ranked)
            if found.added or not fit.errors_known:
                force = estimate_unknown_force(found.fit, trials.executor)
        tried = {row.name for row in found.ranked}
        wavy = (REST_CURVATURE,) if self._waves_explain_as_much(found.fit) else ()
        added = (
            replace(
                x,
                equivalents=(
                    *equivalents(found.fit, x.candidate, tried, x.rival_candidates),
                    *wavy,
                ),
            )
            for x in found.added
        )
        gram = None if found.unexplained else trials.gram_beside(found.fit)
        return Diagnosis(
            **vars(replace(found, added=tuple(added))),
            before=fit,
            validation_before=trials.validation,
            structure_before=structure_of(fit, screening_degrees(fit)),
            unknown_force=force if found.unexplained else None,
            if_hidden={} if gram is None else if_hidden(found.fit, gram),
            cut_off=trials.bound.met,
        )

    def _waves_explain_as_much(self, fit: Fit) -> bool:
        """Whether waves of the rest curvature explain as much as effects beside a line."""
        line = fit.problem.priors.roughness_std <= A_LINE
        return line and likelier_by(self.declared, fit) < EVIDENCE_APART

    def _random_is_better(self, found: Found, near: Fit) -> bool:
        """Whether effects that were found in a misfit are no better than a random difference.

        They were never tested against the scatter that they leave: the mean over 12 poses of a
        scatter of 8 mm was taken for an offset. From that fit on they are.
        """
        return found.or_better(self._ended(near, [], ()), -EVIDENCE_APART) is not found

    def best(
        self, beginnings: Sequence[Beginning] | None = None, found: Found | None = None
    ) -> tuple[Found, UnknownForce | None]:
        """The best result of searches that begin in different ways, and the last unknown force."""
        force, failed = None, None
        for beginning in beginnings or (*NEAR, SHAPES):
            if found is None and beginning not in (NEAR[0], SHAPES):
                continue  # they begin from what has been found
            if found is not None and not (self.goes_on and beginning.applies(self, found)):
                continue
            try:
                search = beginning.begin(self, found)
                force = search.force
                result = search.run() if force is not None or beginning is not CAUSES else None
                found = result if found is None else found.or_better(result, beginning.margin)
            except EstimationError as error:
                failed = error
        if found is None:
            assert failed is not None
            raise failed
        return found, force

    def may_gain(self, scattering: Fit) -> bool:
        """Whether an effect and a second one beside it promise what the scatter gains, nearly."""
        if not self.declared.converged:
            return True
        least = 2 * LEAST_PROMISED * (scattering.log_evidence - self.declared.log_evidence)
        given = self.declared, self.trials.validation
        refitted = self.trials.tried(*given, largest=min(2, self.max_effects)).refits
        best = sorted(refitted, key=lambda item: -item.gain)[:1]
        return any(x.gain + y.score > least for x in best for y in self.trials.screened(x.fit))

    @accounted_as("searches")
    def run(self) -> Found:
        """Add effects until the residual is noise or left-out data are predicted no better."""
        trials, force = self.trials, self.force
        current, validation = trials.declared, trials.validation
        added: list[AddedEffect] = []
        ranked: list[Ranked] = []
        while len(added) < self.max_effects and not (ranked and trials.bound.met):
            self.step("search for a missing effect", len(added), self.max_effects)
            if force is not None and not added:
                tried = trials.tried_as_causes(force)
            else:
                tried = trials.tried(current, validation, largest=self.max_effects - len(added))
            from_shapes = trials.starts_at_shapes(current)
            decision = decide(current, validation, tried, *trials.limits, from_shapes=from_shapes)
            if not ranked:
                rows = ranking(tried, current, validation)
                why = decision.reasons
                ranked = [replace(row, reason=why.get(row.name, "")) for row in rows]
            if not decision.chosen:
                break
            current, before = decision.fit, validation
            if from_shapes and force is None:
                # The mesh of a misfit is coarse; its error would look like the next effect.
                current = trials.fine(current)
            validation = cross_validate(current)
            added += decision.added(before, validation)
        self.step("search for a missing effect", self.max_effects, self.max_effects)
        return self._ended(*pruned(trials, current, added), tuple(ranked))

    def _ended(self, fit: Fit, added: list[AddedEffect], ranked: tuple[Ranked, ...]) -> Found:
        """The effects found, and whether they explain the data."""
        fit = fit if added or fit.noise.known else settle(fit)
        return Found.of(fit, added, ranked, self.trials.significance)


@dataclass(frozen=True)
class Beginning:
    """One way to begin a search, once others have found something.

    Parameters
    ----------
    applies : callable
        Whether it may find something better than what was found.
    begin : callable
        The search that begins so.
    margin : float
        Log evidence by which its result has to be better.
    """

    applies: Callable[[Search, Found], bool]
    begin: Callable[[Search, Found | None], Search]
    margin: float = 0.0


def _as_if_repeating(search: Search, found: Found) -> bool:
    """Whether a scatter may hide effects: it explains anything."""
    if not (found.fit.scatters and search.declared.scatters):
        return False
    return found.unexplained or _repeating(search).may_gain(search.declared)


def _repeating(search: Search, _: Found | None = None) -> Search:
    return search.beginning_with(declared=as_repeating(search.declared))


def _waves_may_hide_one(search: Search, found: Found) -> bool:
    """Whether few markers leave open if an effect or waves of the rest curvature are the cause."""
    if found.added or not few_places(search.declared):
        return False
    return likelier_by(_on_a_line(search).declared, found.fit) > EVIDENCE_APART


def _on_a_line(search: Search, _: Found | None = None) -> Search:
    return search.beginning_with(declared=as_line(search.declared))


def _noise_is_smaller(search: Search, found: Found) -> bool:
    """Whether scores may be significant under the noise of a complete model.

    The first estimate of it is rough. To first order, scores grow as the noise's variance, or that
    of its correlated part, falls.
    """
    if found.added or found.fit.noise.std >= search.declared.noise.std:
        return False
    before, now = search.declared.noise, found.fit.noise
    slow = before.share * before.length / max(now.share * now.length, 1e-300)
    growth, dof = max(1.0, slow) * (before.std / now.std) ** 2, screening_degrees(found.fit)
    first = search.trials.first
    p_values = (survival(growth * x.score, max(len(x.candidate.screened), 1), dof) for x in first)
    likely = any(sidak(p, len(first)) < search.trials.significance for p in p_values)
    return found.fit.scatters or likely


def _under_its_noise(search: Search, found: Found | None) -> Search:
    assert found is not None
    return search.beginning_with(declared=found.fit)


def _with_force(search: Search, found: Found | None) -> Search:
    assert found is not None
    start = search.declared if found.added else found.fit
    return replace(search, force=estimate_unknown_force(start, search.trials.executor))


# If nothing explains the data, the search may have begun too far from the effect.
SHAPES = Beginning(
    lambda search, found: search.may_be_far and found.unexplained,
    lambda search, _: search.beginning_with(from_shapes=True),
)
NEAR = (
    Beginning(lambda *_: True, lambda search, _: search),
    Beginning(_noise_is_smaller, _under_its_noise),
    Beginning(_as_if_repeating, _repeating, EVIDENCE_APART),
    Beginning(_waves_may_hide_one, _on_a_line),
)
CAUSES = Beginning(
    lambda search, found: (
        found.unexplained
        or (
            search.may_be_far
            and explains(search.declared)
            and not search.trials.validation.complete
        )
    ),
    _with_force,
)
