"""From a residual to the effects that are missing: screen, confirm, add, until it is noise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.diagnosis.candidates import Candidate, candidates, setup_of
from dlo_casadi.diagnosis.causes import refit_from
from dlo_casadi.diagnosis.confirm import Confirmed, confirm, confirm_afresh, screened_afresh
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.equivalents import equivalents
from dlo_casadi.diagnosis.hidden_weight import HiddenWeight, hidden_weight
from dlo_casadi.diagnosis.next_pose import NextPose, next_pose
from dlo_casadi.diagnosis.pull import Pull, estimate_pull
from dlo_casadi.diagnosis.screening import Screen, Screened, survival
from dlo_casadi.diagnosis.structure import (
    Structure,
    noise_degrees,
    screening_degrees,
    structure_of,
)
from dlo_casadi.effects import PointLoad
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import fit_model, fitted_closely
from dlo_casadi.estimation.hyperparameters import SETTLED_MODES, errors_of, settle
from dlo_casadi.estimation.mesh import fine_enough
from dlo_casadi.estimation.prediction import predicted_shapes
from dlo_casadi.estimation.repeats import different_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.executors import InProcess
from dlo_casadi.parallel import map_in_order
from dlo_casadi.thresholds import (
    BIC_APART,
    DIFFERENT,
    LEAST_NOISE_DEGREES,
    LEFT,
    MISLEADING,
    NEAREST,
    REFITTED,
    SIGNIFICANCE,
    UNSEEN,
    UNSEEN_LEFT,
    WORTH,
)

FloatArray = NDArray[np.floating]
Verdict = Literal["complete", "effect_found", "unexplained"]


@dataclass(frozen=True)
class AddedEffect:
    """An effect that the data ask for.

    Parameters
    ----------
    candidate : Candidate
    p_value : float
        Score test, corrected for places and candidates. Where the noise is estimated, the larger
        of it and of the test under the noise that is left once the effect is in the model.
    before, after : CrossValidation
        Without and with the effect.
    rivals : tuple of Confirmed
        Candidates that could not be told apart from it.
    equivalents : tuple of str
        What it may stand for, see `equivalents`.
    """

    candidate: Candidate
    p_value: float
    before: CrossValidation
    after: CrossValidation
    rivals: tuple[Confirmed, ...]
    equivalents: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ranked:
    """A candidate in the list of all that were tried."""

    name: str
    score: float
    p_value: float
    rmse_cross_validated: float | None


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
    pull : Pull or None
        Where that is so: the load that assumes no cause; None where none fits.
    proposal : NextPose or None
        What separates an effect from its best rival.
    proposal_for : tuple of str
        Names of those two; empty where there is no rival.
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
    pull: Pull | None = None
    proposal: NextPose | None = None
    proposal_for: tuple[str, ...] = field(default_factory=tuple)
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
        Where candidates are refitted and places of an unknown load tried, half a second to some
        seconds each; in this process by default.
    finest : int, optional
        Elements up to which the mesh may be refined where what effects leave is not noise; by
        default it stays.
    """
    run_in = executor or InProcess()
    search = _Search(fit, center, exclude, significance, max_effects, step, run_in, finest)
    # Where left-out poses are not even reached no effect can be followed: first what pulls.
    lost = search.astray and fit.noise.source != "misfit"
    pull = estimate_pull(fit, search.executor) if lost else None
    found = search.run(pull)
    if found.unexplained and pull is not None:
        found = search.run()
    elif found.unexplained:
        pull = estimate_pull(fit if found.added else found.fit, search.executor)
        found = search.with_cause_of(pull, found)
    if found.unexplained and found.added:
        found = search.without_wrong_causes(found, pull)
        if found.added or not fit.errors_known:
            pull = estimate_pull(found.fit, search.executor)
    tried = {row.name for row in found.ranked}
    added = tuple(
        replace(
            item,
            equivalents=equivalents(
                found.fit, item.candidate, tried, [rival.candidate for rival in item.rivals]
            ),
        )
        for item in found.added
    )
    proposal, names = _proposal(found.fit, added)
    return Diagnosis(
        before=fit,
        after=found.fit,
        validation_before=search.validation,
        validation_after=found.validation,
        structure_before=structure_of(fit, screening_degrees(fit)),
        structure_after=found.structure,
        added=added,
        ranked=found.ranked,
        unexplained=found.unexplained,
        pull=pull if found.unexplained else None,
        proposal=proposal,
        proposal_for=names,
        weight=None if found.unexplained else hidden_weight(found.fit, exclude),
    )


@dataclass(frozen=True)
class _Found:
    """Where a search has ended.

    Parameters
    ----------
    fit : Fit
    added : tuple of AddedEffect
    ranked : tuple of Ranked
    validation : CrossValidation
    structure : Structure
    unexplained : bool
    """

    fit: Fit
    added: tuple[AddedEffect, ...]
    ranked: tuple[Ranked, ...]
    validation: CrossValidation
    structure: Structure
    unexplained: bool


@dataclass(frozen=True)
class _Search:
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
    def astray(self) -> bool:
        """Whether the declared model cannot follow the poses that are left out."""
        return self.several and not self.validation.complete

    @property
    def several(self) -> bool:
        """Whether a pull may have a cause: in one pose a force fits as well as any."""
        return len(self.declared.problem.used) > 1 and self.max_effects > 0

    @property
    def doubt(self) -> float | None:
        """What a gain has to be held against where a pose or two were taken again and again."""
        problem = self.declared.problem
        count = different_poses(problem.history, problem.unknowns.model.cable.length)
        return self.significance if count < min(DIFFERENT, len(problem.used)) else None

    @cached_property
    def first(self) -> list[Screened]:
        """Score tests in the declared model."""
        return screen(self.declared, self.center, self.exclude)

    def run(self, pull: Pull | None = None) -> _Found:
        """Add effects until the residual is noise, or nothing improves what is left out.

        Parameters
        ----------
        pull : Pull, optional
            Whose causes are tried in the first step; else all effects, followed from the
            declared model.
        """
        current, validation = self.declared, self.validation
        added: list[AddedEffect] = []
        ranked: list[Ranked] = []
        for k in range(self.max_effects):
            self.step("search for a missing effect", k, self.max_effects)
            astray = current.noise.source == "misfit"
            tried: list[Confirmed | None] = []
            if astray and pull is None:
                screened, tried = self._afresh(current)
            else:
                screened = self.first if k == 0 else screen(current, self.center, self.exclude)
            p_values = {
                item.candidate.name: _corrected(item.p_value, len(screened)) for item in screened
            }
            if k == 0 and pull is not None:
                tried = self._causes(pull, screened)
            elif not astray:
                tried = self._leading(current, screened, p_values)
            explaining = _explaining(current, tried)
            confirmed = explaining or _improving(tried, validation, self.doubt)
            if k == 0:
                ranked = _ranking(screened, p_values, confirmed)
            # What a second effect explains may be what the first one, if wrong, has left.
            apart = np.inf if added and not explaining else BIC_APART
            chosen = _choose(confirmed, apart)
            while (
                chosen
                and not (explaining or chosen[0].candidate.nuisance)
                and _misleads(chosen[0].fit, current, validation)
            ):
                confirmed.remove(chosen[0])
                chosen = _choose(confirmed, apart)
            if chosen is None:
                break
            winner, rivals = chosen
            p_value = p_values[winner.candidate.name]
            if k == 0 and pull is not None:
                single = survival(winner.gain, len(winner.candidate.frees), noise_degrees(current))
                p_value = _corrected(single, len(screened))
            closed = winner.fit if explaining else _closed(winner.fit)
            if not (closed.errors_known or astray):
                again = _p_with_closed_noise(current, closed, winner, len(screened))
                p_value = max(p_value, again)
            if p_value > self.significance:
                break
            current = closed
            after = cross_validate(current)
            added.append(AddedEffect(winner.candidate, p_value, validation, after, tuple(rivals)))
            validation = after
        self.step("search for a missing effect", self.max_effects, self.max_effects)
        return self._ended(*prune(current, added, self.significance), tuple(ranked))

    def _leading(
        self, current: Fit, screened: Sequence[Screened], p_values: Mapping[str, float]
    ) -> list[Confirmed | None]:
        """Refits of the significant candidates with the highest scores."""
        significant = [
            item for item in screened if p_values[item.candidate.name] < self.significance
        ]
        leading = sorted(significant, key=lambda item: -item.score)[:REFITTED]
        worthy = [item for item in leading if item.score >= WORTH * leading[0].score]
        return list(map_in_order(self.executor, partial(confirm, current), worthy))

    def _afresh(self, current: Fit) -> tuple[list[Screened], list[Confirmed | None]]:
        """Fits from the measured shapes of the candidates that come nearest to them.

        Beside a misfit scores are no order, and a refit leads where the declared model has gone.
        """
        listed = _listed(current, self.center, self.exclude)
        begun = screened_afresh(current, listed, self.executor)
        least = min((start.guess.objective for _, start in begun), default=0.0)
        near = [pair for pair in begun if pair[1].guess.objective <= NEAREST * least]
        refit = partial(confirm_afresh, current)
        tried = list(map_in_order(self.executor, refit, near[:REFITTED]))
        return [item for item, _ in begun], tried

    def _causes(self, pull: Pull, screened: Sequence[Screened]) -> list[Confirmed | None]:
        """Refits of all loads at one place, whatever their scores, that give the pull's forces.

        Two free forces in each pose would gain more than their price if the law were wrong.
        """
        loads = [item for item in screened if isinstance(item.candidate.effect, PointLoad)]
        refit = partial(refit_from, self.declared, pull)
        free = 2 * len(self.declared.problem.used) + 1
        price = free * np.log(self.declared.problem.n_residuals)
        return [
            item
            for item in map_in_order(self.executor, refit, loads)
            if item is not None and item.bic >= pull.gain - price
        ]

    def _ended(self, fit: Fit, added: list[AddedEffect], ranked: tuple[Ranked, ...]) -> _Found:
        """What has been found, and whether it explains the data."""
        if not added and not fit.noise.known:
            fit = settle(fit)
        found = self._judged(fit, added, ranked)
        if not (found.unexplained and added and self.finest):
            return found
        # What effects leave may be the mesh's, which was fine enough for what they explain.
        finer, _ = fine_enough(fit, fit.model.n, SETTLED_MODES, self.finest)
        return found if finer is fit else self._judged(finer, added, ranked)

    def _judged(self, fit: Fit, added: list[AddedEffect], ranked: tuple[Ranked, ...]) -> _Found:
        validation, structure = cross_validate(fit), structure_of(fit, noise_degrees(fit))
        limit = UNSEEN * max(fit.expected_error, validation.expected)
        if added:
            limit = max(limit, UNSEEN_LEFT * self.error)
        unpredicted = (bool(added) or self.several) and validation.error > limit
        unexplained = structure.p_noise < self.significance or unpredicted
        unexplained |= fit.noise.source == "misfit"
        return _Found(fit, tuple(added), ranked, validation, structure, unexplained)

    def with_cause_of(self, pull: Pull | None, found: _Found) -> _Found:
        """Return a search that begins with a cause of the pull, if it explains the data."""
        if pull is None or not self.several:
            return found
        other = self.run(pull)
        return found if other.unexplained else other

    def without_wrong_causes(self, found: _Found, pull: Pull | None) -> _Found:
        """Withdraw effects that do not explain nearly all of what the declared model lacks.

        Something is missing still, and a wrong effect may stand for a part of it. Effects stay
        if the mean square error of what is left out, beyond noise and fixtures, falls to less
        than LEFT of what it was: then what is missing beside them is small against what they
        explain. And all go if one force in each pose explains more than they do.
        """
        floor = found.fit.expected_error**2
        after, before = (max(x**2 - floor, 0.0) for x in (found.validation.error, self.error))
        if after <= LEFT * before and not self._needless(found, pull):
            return found
        return self._ended(self.declared, [], found.ranked)

    def _needless(self, found: _Found, alone: Pull | None) -> bool:
        """Whether one force per pose on the declared model does better than with the effects."""
        if alone is None or not self.several:
            return False
        pull = estimate_pull(found.fit, self.executor)
        n = np.log(self.declared.problem.n_residuals)
        extra = sum(len(item.candidate.frees) for item in found.added) * n
        if pull is None:
            return True
        if 2 * alone.fit.point.objective >= 2 * pull.fit.point.objective + extra:
            return False
        p_alone, p_found = (
            structure_of(x, noise_degrees(x)).p_value for x in (alone.fit, found.fit)
        )
        return p_alone > p_found


def screen(fit: Fit, center: tuple[float, float] | None, exclude: Sequence[str]) -> list[Screened]:
    """Score tests of all candidates at a fit, best first."""
    listed = _listed(fit, center, exclude)
    return Screen(fit, listed).run(screening_degrees(fit)) if listed else []


def _listed(
    fit: Fit, center: tuple[float, float] | None, exclude: Sequence[str]
) -> list[Candidate]:
    """All effects that may be missing."""
    problem, shapes = fit.problem, fit.point.shapes
    setup = setup_of(
        fit.model,
        n_poses=len(problem.used),
        center=center,
        camera=any(item.pose.camera_center is not None for item in problem.history),
        readings=tuple({name for item in problem.history for name in item.reactions}),
        directions=(float(shapes.x[:, 0].mean()), float(shapes.x[:, -1].mean())),
        largest_bend=float(problem.sweep.bends(shapes, fit.p, fit.rest).max()),
    )
    return candidates(fit.model, setup, exclude)


def _explaining(current: Fit, tried: Iterable[Confirmed | None]) -> list[Confirmed]:
    """Candidates that leave none of a misfit once the points are taken as sure as they are.

    Beside a misfit their gains tell little; they are compared by their evidence.
    """
    if current.noise.source != "misfit":
        return []
    most = current.point.objective / 2
    likely = [item for item in tried if item is not None and item.fit.point.objective < most]
    fits = [(item, _closed(item.fit)) for item in likely]
    close = [(item, fit) for item, fit in fits if fit.noise.source != "misfit"]
    least = min((fit.log_evidence for _, fit in close), default=0.0)
    return [
        replace(
            item,
            fit=fit,
            validation=cross_validate(fit),
            bic=2 * (fit.log_evidence - least),
        )
        for item, fit in close
    ]


def _closed(fit: Fit) -> Fit:
    """A fit with an effect added, as that of a model that may be complete now."""
    if fit.noise.source != "misfit":
        return settle(fit)
    try:
        return fitted_closely(fit)
    except EstimationError:
        return fit


def _corrected(p_value: float, tried: int) -> float:
    """Probability that the best of so many independent tests is as good (Sidak)."""
    return float(-np.expm1(tried * np.log1p(-min(p_value, 1 - 1e-16))))


def _p_with_closed_noise(open_: Fit, closed: Fit, winner: Confirmed, tried: int) -> float:
    """Significance of an effect under the noise that is left once it is in the model.

    The noise estimated without the effect holds a part of the effect, or, where it was kept out,
    lacks a part of the noise. Where nothing else is missing all that is left is noise, its slow
    modes included; where something is, the noise is too large and the significance too low.
    """
    try:
        noise, rest_scatter = errors_of(
            closed.problem,
            closed.point,
            closed.linearization,
            modes=0,
            estimated=not closed.noise.known,
            repeats=closed.problem.rest_scatter.std == 0,
        )
    except EstimationError:  # with the effect hardly a point is left over: nothing is shown
        return 1.0
    rough, scatter = open_.problem.roughness_std, open_.problem.scatter
    larger = closed.problem.changed(noise, rough, scatter, rest_scatter)
    larger.refresh(closed.point.theta, closed.point.shapes, closed.point.feet)
    problem = open_.problem.changed(noise, rough, scatter, rest_scatter)
    problem.share_metric(larger)
    point = problem.evaluate(open_.point.theta, open_.point.shapes, open_.point.feet)
    point, _ = problem.descend(point)
    other = larger.evaluate(closed.point.theta, closed.point.shapes, closed.point.feet)
    other, _ = larger.descend(other)
    gain = max(2 * (point.objective - other.objective), 0.0)
    dof = len(winner.candidate.frees)
    return _corrected(survival(gain, dof, max(LEAST_NOISE_DEGREES, noise.slow_dof)), tried)


def _improving(
    tried: Iterable[Confirmed | None], validation: CrossValidation, doubt: float | None
) -> list[Confirmed]:
    """Refits that improve both the fit and what it predicts.

    Hangings of one or two poses have in common whatever is wrong with their measurement. There
    whole hangings decide: a gain as large must have less than the probability `doubt` if those
    left out are predicted no better (Student's t).
    """
    out = []
    for item in tried:
        if item is None or item.bic <= 0 or not item.validation.complete:
            continue
        # An effect that explains the fitted poses but predicts the others worse is none. A nuisance
        # is in the model already; without its prior it predicts about as well.
        worse = item.validation.error > validation.error
        if item.candidate.nuisance:
            worse = item.validation.clearly_worse_than(validation)
        if worse:
            continue
        if doubt is None or validation.chance_of_gain(item.validation) < doubt:
            out.append(item)
    return out


def _choose(
    confirmed: Sequence[Confirmed], apart: float
) -> tuple[Confirmed, list[Confirmed]] | None:
    """The best by cross-validation (BIC among those not clearly worse), and its rivals.

    Rivals are those not clearly worse whose BIC falls short by less than `apart`.
    """
    if not confirmed:
        return None
    leader = min(confirmed, key=lambda item: item.validation.error)
    close = [
        item for item in confirmed if not item.validation.clearly_worse_than(leader.validation)
    ]
    winner = max(close, key=lambda item: item.bic)
    rivals = [item for item in close if item is not winner and item.bic > winner.bic - apart]
    return winner, sorted(rivals, key=lambda item: -item.bic)


def _misleads(fit: Fit, before: Fit, validation: CrossValidation) -> bool:
    """Whether a fit with an effect tells a user, who knows the ends alone, worse than one without.

    `validation` follows the branches on which poses were measured, without the effect.
    """
    told = _told(fit)
    return told > validation.rmse and told > MISLEADING * _told(before)


def _told(fit: Fit) -> float:
    """Cross-validated error [m] of poses of which nothing but the ends is known."""
    shapes = predicted_shapes(fit.problem, fit.point.shapes, fit.p, fit.rest)
    return cross_validate(fit, shapes=shapes).rmse


def _ranking(
    screened: Sequence[Screened], p_values: Mapping[str, float], confirmed: Sequence[Confirmed]
) -> list[Ranked]:
    """All candidates: those refitted by BIC, then the others by score."""
    refitted = {item.candidate.name: item for item in confirmed}
    rows = [
        Ranked(
            item.candidate.name,
            item.score,
            p_values[item.candidate.name],
            refitted[item.candidate.name].validation.rmse
            if item.candidate.name in refitted
            else None,
        )
        for item in screened
    ]

    def order(row: Ranked) -> tuple[float, float]:
        known = refitted.get(row.name)
        return (-known.bic if known else np.inf, -row.score)

    return sorted(rows, key=order)


def prune(fit: Fit, added: list[AddedEffect], significance: float) -> tuple[Fit, list[AddedEffect]]:
    """Backward step: drop an effect that a later one has made superfluous."""
    if len(added) < 2:
        return fit, added
    for effect in list(added[:-1]):
        smaller = _drop(fit, effect.candidate)
        if smaller is None:
            continue
        again = [
            item
            for item in screen(smaller, None, ())
            if item.candidate.name == effect.candidate.name
        ]
        price = len(effect.candidate.frees) * np.log(fit.problem.n_residuals)
        gain = 2 * (smaller.point.objective - fit.point.objective)
        if gain < price or (again and again[0].p_value > significance):
            fit = settle(smaller)
            added = [item for item in added if item is not effect]
    return fit, added


def _drop(fit: Fit, candidate: Candidate) -> Fit | None:
    """Fit without a candidate, from the fit with it."""
    if candidate.nuisance:
        return None
    model = fit.model.without_effect(candidate.effect.label)
    try:
        return fit_model(model, fit.problem.history, fit.problem.tolerances, start=fit)
    except EstimationError:
        return None


def _proposal(
    current: Fit, added: Sequence[AddedEffect]
) -> tuple[NextPose | None, tuple[str, ...]]:
    """Pose that separates an added effect from its closest rival."""
    for item in added:
        if item.rivals:
            rival = item.rivals[0]
            return next_pose(current, rival.fit), (item.candidate.name, rival.candidate.name)
    return None, ()
