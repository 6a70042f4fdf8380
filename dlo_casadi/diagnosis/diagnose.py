"""From a residual to the effects that are missing: screen, confirm, add, until it is noise."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np

from dlo_casadi.diagnosis import refits
from dlo_casadi.diagnosis.candidates import candidates_of, equivalents
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.next_measurement import HiddenWeight, hidden_weight
from dlo_casadi.diagnosis.refits import Confirmed, confirm_from_data
from dlo_casadi.diagnosis.screening import Screened, survival
from dlo_casadi.diagnosis.selection import (
    AddedEffect,
    Found,
    Ranked,
    as_complete,
    choose,
    explained_by,
    improving,
    in_place_of,
    misleads,
    p_with_closed_noise,
    ranking,
    shortcoming,
    sidak,
    why_lost,
)
from dlo_casadi.diagnosis.structure import (
    Structure,
    noise_degrees,
    screening_degrees,
    structure_of,
)
from dlo_casadi.diagnosis.unknown_force import UnknownForce, estimate_unknown_force
from dlo_casadi.effects import PointLoad
from dlo_casadi.estimation.fit import at_random, fine_enough
from dlo_casadi.estimation.repeats import different_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import SETTLED_MODES, settle
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.thresholds import (
    BIC_APART,
    DIFFERENT,
    LARGER_OF_TWO,
    LEFT,
    NEAR_LEADER,
    PLAUSIBLE,
    REFITTED,
    SIGNIFICANCE,
    UNSEEN,
    UNSEEN_LEFT,
    WORTH,
)

Verdict = Literal["complete", "effect_found", "unexplained"]
NOT_NEAR = "does not come near the measured shapes"


@dataclass(frozen=True)
class Diagnosis:
    """What the residual of a fit has led to.

    Parameters
    ----------
    before, after : Fit
        The declared model, and the model with the effects that were added.
    validation_before, validation_after : CrossValidation
    structure_before, structure_after : Structure
    added : tuple of AddedEffect
    ranked : tuple of Ranked
        All candidates of the first step: those confirmed by BIC, then the others by score.
    unexplained : bool
        Whether structure is left, or poses that were left out are not predicted.
    pull : UnknownForce or None
        Where that is so: the load that assumes no cause; None where none fits.
    weight : HiddenWeight or None
        That the fit would not notice.
    """

    before: Fit
    after: Fit
    validation_before: CrossValidation
    validation_after: CrossValidation
    structure_before: Structure
    structure_after: Structure
    added: tuple[AddedEffect, ...] = ()
    ranked: tuple[Ranked, ...] = ()
    unexplained: bool = False
    pull: UnknownForce | None = None
    weight: HiddenWeight | None = None

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

    Held-out poses are not looked at.

    Parameters
    ----------
    fit : Fit
        Of the declared model.
    center : (float, float), optional [m]
        Middle of the photographs in the board frame.
    exclude : sequence of str
        Effects that are not tried.
    significance : float
        Probability of a false alarm in a complete model, over all candidates.
    max_effects : int
    step : callable
        Told how far the search has come.
    executor : Executor, optional
        Where candidates are screened and refitted and places of an unknown load tried, half a
        second to some seconds each; in this process by default.
    finest : int, optional
        Elements up to which the mesh may be refined where what effects leave is not noise; by
        default it stays.
    """
    run_in = executor or InProcess()
    return Search(fit, center, exclude, significance, max_effects, step, run_in, finest).closed()


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

    @cached_property
    def validation(self) -> CrossValidation:
        """Of the declared model."""
        return cross_validate(self.declared)

    @property
    def error(self) -> float:
        """Cross-validated error of the declared model [m], 0 where it tells nothing."""
        return self.validation.error if self.validation.complete else 0.0

    @property
    def loses_poses(self) -> bool:
        """Whether the declared model cannot follow the poses that are left out."""
        return self.several and not self.validation.complete

    @property
    def several(self) -> bool:
        """Whether an unknown force may have a cause: in one pose a force fits as well as any."""
        return len(self.declared.problem.used) > 1 and self.max_effects > 0

    @property
    def doubt(self) -> float | None:
        """What a gain is compared with where a pose or two were taken again and again."""
        problem = self.declared.problem
        count = different_poses(problem.history, problem.unknowns.model.cable.length)
        return self.significance if count < min(DIFFERENT, len(problem.used)) else None

    @cached_property
    def first(self) -> list[Screened]:
        """Score tests in the declared model."""
        return self._screened(self.declared)

    def _screened(self, current: Fit) -> list[Screened]:
        """Score tests of all `candidates_of` a fit, best first."""
        listed = candidates_of(current, self.center, self.exclude)
        return refits.scored(current, listed, screening_degrees(current), self.executor)

    def closed(self) -> Diagnosis:
        """What the search finds, without effects that explain too little."""
        fit = self.declared
        # Where left-out poses are not even reached no effect can be followed: first the force.
        lost = self.loses_poses and fit.noise.source != "misfit"
        force = estimate_unknown_force(fit, self.executor) if lost else None
        found = self.among_simpler(self.run(force))
        other = self.at_random(found)
        if other is not None:
            return replace(self, declared=other).closed()
        if found.unexplained and force is not None:
            found = self.run()
        elif found.unexplained:
            force = estimate_unknown_force(fit if found.added else found.fit, self.executor)
            found = self.with_cause_of(force, found)
        if found.unexplained and found.added:
            found = self.without_wrong_causes(found, force)
            if found.added or not fit.errors_known:
                force = estimate_unknown_force(found.fit, self.executor)
        tried = {row.name for row in found.ranked}
        added = [
            replace(x, equivalents=equivalents(found.fit, x.candidate, tried, x.rival_candidates))
            for x in found.added
        ]
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
            pull=force if found.unexplained else None,
            weight=None if found.unexplained else hidden_weight(found.fit, self.exclude),
        )

    def run(self, force: UnknownForce | None = None) -> Found:
        """Add effects until the residual is noise, or nothing improves what is left out.

        Parameters
        ----------
        force : UnknownForce, optional
            Whose causes are tried in the first step; else all effects, followed from the
            declared model.
        """
        current, validation = self.declared, self.validation
        added: list[AddedEffect] = []
        ranked: list[Ranked] = []
        lost: dict[str, str] = {}
        for k in range(self.max_effects):
            self.step("search for a missing effect", k, self.max_effects)
            misfit = current.noise.source == "misfit"
            tried, far = list[Confirmed | None](), list[str]()
            if misfit and force is None:
                screened, tried, far = self._from_data(current)
            else:
                screened = self.first if k == 0 else self._screened(current)
            p_values = {x.candidate.name: sidak(x.p_value, len(screened)) for x in screened}
            if k == 0 and force is not None:
                tried = self._causes(force, screened)
            elif not misfit:
                tried = self._leading(current, screened, p_values)
            explaining = explained_by(current, tried)
            confirmed = explaining or improving(tried, validation, self.doubt)
            if k == 0:
                ranked = ranking(screened, p_values, confirmed, tried)
            # What a second effect explains may be what the first one, if wrong, has left.
            apart = np.inf if added and not explaining else BIC_APART
            chosen, misleading = choose(confirmed, apart), []
            while chosen and not explaining and misleads(chosen[0], current, validation):
                misleading.append(chosen[0])
                confirmed.remove(chosen[0])
                chosen = choose(confirmed, apart)
            if k == 0:
                why = partial(shortcoming, validation=validation, doubt=self.doubt)
                other = (lambda _: NOT_NEAR) if explaining else why
                lost = why_lost(tried, confirmed, misleading, chosen, other)
                lost |= dict.fromkeys(far, NOT_NEAR)
            if chosen is None:
                break
            winner, rivals = chosen
            p_value = p_values[winner.candidate.name]
            if k == 0 and force is not None:
                single = survival(winner.gain, len(winner.candidate.frees), noise_degrees(current))
                p_value = sidak(single, len(screened))
            closed = winner.fit if explaining else as_complete(winner.fit)
            scatters = current.problem.priors.pose_scatter.std > 0
            if (scatters or not closed.errors_known) and not misfit:
                again = p_with_closed_noise(current, closed, winner, len(screened))
                # A scatter from pose to pose may be nothing but the effect.
                p_value = again if scatters else max(p_value, again)
            if p_value > self.significance:
                if not added:
                    names = [item.candidate.name for item in (winner, *rivals)]
                    lost |= dict.fromkeys(names, f"not significant: p = {p_value:.2g}")
                break
            current = closed
            after = cross_validate(current)
            added.append(AddedEffect(winner.candidate, p_value, validation, after, tuple(rivals)))
            validation = after
        self.step("search for a missing effect", self.max_effects, self.max_effects)
        listed = tuple(replace(row, reason=lost.get(row.name, "")) for row in ranked)
        return self._ended(*self._pruned(current, added), listed)

    def among_simpler(self, found: Found) -> Found:
        """What is found, or effects of fewer parameters each that are likelier together.

        An effect of many parameters may stand for two of one each.
        """
        if not found.added or self.declared.noise.source == "misfit":
            return found
        winner = found.added[0].candidate
        scores = {item.candidate.name: item.score for item in self.first}
        enough = LARGER_OF_TWO * scores[winner.name]
        free = {item.candidate.name: len(item.candidate.frees) for item in self.first}
        others = [name for name in scores if free[name] >= len(winner.frees)]
        if not any(scores[name] >= enough for name in scores.keys() - others):
            return found
        other = replace(self, exclude=[*self.exclude, *others]).run()
        likelier = other.fit.log_evidence >= found.fit.log_evidence
        return in_place_of(found, other) if likelier and not other.unexplained else found

    def at_random(self, found: Found) -> Fit | None:
        """The declared model with random effects, if it misfits and they explain more."""
        scatter = found.fit.problem.priors.pose_scatter
        if self.declared.noise.source != "misfit" or not (found.unexplained or scatter.std):
            return None
        near = at_random(self.declared)
        if near is None or not (found.unexplained or near.log_evidence > found.fit.log_evidence):
            return None
        return fine_enough(near, near.model.n, finest=self.finest)[0] if self.finest else near

    def _pruned(self, fit: Fit, added: list[AddedEffect]) -> tuple[Fit, list[AddedEffect]]:
        """Backward step: without the effects that a later one has made superfluous.

        An effect has to be as significant as when it was added, and worth its parameters.
        """
        for effect in added[:-1]:
            smaller = refits.refit_without(fit, effect.candidate)
            if smaller is None:
                continue
            screened = self._screened(smaller)
            single = {item.candidate.name: item.p_value for item in screened}
            p_value = sidak(single.get(effect.candidate.name, 0.0), len(screened))
            price = len(effect.candidate.frees) * np.log(fit.problem.n_residuals)
            gain = 2 * (smaller.point.objective - fit.point.objective)
            if gain < price or p_value > self.significance:
                fit = settle(smaller)
                added = [item for item in added if item is not effect]
        return fit, added

    def _leading(
        self, current: Fit, screened: Sequence[Screened], p_values: Mapping[str, float]
    ) -> list[Confirmed | None]:
        """Refits of the significant candidates with the highest scores."""
        scatters = current.problem.priors.pose_scatter.std > 0
        most = PLAUSIBLE if scatters else self.significance
        significant = [x for x in screened if p_values[x.candidate.name] < most]
        leading = sorted(significant, key=lambda item: -item.score)[:REFITTED]
        worthy = [item for item in leading if item.score >= WORTH * leading[0].score]
        return list(map_in_order(self.executor, partial(refits.confirm, current), worthy))

    def _from_data(self, current: Fit) -> tuple[list[Screened], list[Confirmed | None], list[str]]:
        """Fits from the measured shapes of the candidates that come nearest to them.

        Beside a misfit scores tell nothing, and a refit leads where the declared model has gone.
        Other starts are tried where none explains the shapes. Last: who stays far from them.
        """
        near, softness = refits.from_data(current)
        listed = candidates_of(near, self.center, self.exclude)
        screened = refits.screened_from_data(near, softness, listed)
        likely = [x for x in screened if x.score >= NEAR_LEADER * screened[0].score][:REFITTED]
        kept, far = refits.nearest(near, likely, self.executor)
        for starts in (1, 3):
            refit = partial(confirm_from_data, current, near, starts=starts)
            tried = list(map_in_order(self.executor, refit, kept))
            if explained_by(current, tried):
                break
        return screened, tried, far

    def _causes(self, force: UnknownForce, screened: Sequence[Screened]) -> list[Confirmed | None]:
        """Refits of all loads at one place, whatever their scores, that explain the forces.

        Two free forces in each pose would gain more than their price if the law were wrong.
        """
        loads = [item for item in screened if isinstance(item.candidate.effect, PointLoad)]
        refit = partial(refits.confirm_cause, self.declared, force)
        free = 2 * len(self.declared.problem.used) + 1
        price = free * np.log(self.declared.problem.n_residuals)
        return [
            item
            for item in map_in_order(self.executor, refit, loads)
            if item is not None and item.bic >= force.gain - price
        ]

    def _ended(self, fit: Fit, added: list[AddedEffect], ranked: tuple[Ranked, ...]) -> Found:
        """What has been found, and whether it explains the data."""
        if not added and not fit.noise.known:
            fit = settle(fit)
        found = self._judged(fit, added, ranked)
        # What effects leave may be the mesh's, which was fine enough for what they explain.
        if found.unexplained and added and self.finest:
            finer, _ = fine_enough(fit, fit.model.n, SETTLED_MODES, self.finest)
            found = found if finer is fit else self._judged(finer, added, ranked)
        return found

    def _judged(self, fit: Fit, added: list[AddedEffect], ranked: tuple[Ranked, ...]) -> Found:
        validation, structure = cross_validate(fit), structure_of(fit, noise_degrees(fit))
        limit = UNSEEN * max(fit.expected_error, validation.expected)
        if added:
            limit = max(limit, UNSEEN_LEFT * self.error)
        # From one pose alone another one is not predicted to first order of the covariance.
        told = bool(added) or len(self.declared.problem.used) > 2
        unpredicted = told and validation.error > limit
        unexplained = structure.p_noise < self.significance or unpredicted
        unexplained |= fit.noise.source == "misfit"
        return Found(fit, tuple(added), ranked, validation, structure, unexplained)

    def with_cause_of(self, force: UnknownForce | None, found: Found) -> Found:
        """Return a search that begins with a cause of the force, if it explains the data."""
        if force is None or not self.several:
            return found
        other = self.run(force)
        return found if other.unexplained else other

    def without_wrong_causes(self, found: Found, force: UnknownForce | None) -> Found:
        """Withdraw effects that do not explain nearly all of what the declared model lacks.

        Something is missing still, and a wrong effect may stand for a part of it. Effects stay
        if the mean square error of what is left out, beyond noise and fixtures, falls to less
        than LEFT of what it was: then what is missing beside them is small against what they
        explain. And all go if one force in each pose explains more than they do.
        """
        floor = found.fit.expected_error**2
        after, before = (max(x**2 - floor, 0.0) for x in (found.validation.error, self.error))
        if after <= LEFT * before and not self._needless(found, force):
            return found
        return self._ended(self.declared, [], found.ranked)

    def _needless(self, found: Found, alone: UnknownForce | None) -> bool:
        """Whether one force per pose on the declared model does better than with the effects."""
        if alone is None or not self.several:
            return False
        force = estimate_unknown_force(found.fit, self.executor)
        n = np.log(self.declared.problem.n_residuals)
        extra = sum(len(item.candidate.frees) for item in found.added) * n
        if force is None:
            return True
        if 2 * alone.fit.point.objective >= 2 * force.fit.point.objective + extra:
            return False
        p = [structure_of(x, noise_degrees(x)).p_value for x in (alone.fit, found.fit)]
        return p[0] > p[1]
