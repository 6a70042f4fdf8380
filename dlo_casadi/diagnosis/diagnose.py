"""From a residual to the effects that are missing: screen, confirm, add, until it is noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Literal

from dlo_casadi.diagnosis.crossval import CrossValidation
from dlo_casadi.diagnosis.equivalents import equivalents
from dlo_casadi.diagnosis.hidden_weight import HiddenWeight, hidden_weight
from dlo_casadi.diagnosis.next_pose import NextPose, next_pose
from dlo_casadi.diagnosis.pull import Pull, estimate_pull
from dlo_casadi.diagnosis.search import Search
from dlo_casadi.diagnosis.selection import AddedEffect, Ranked
from dlo_casadi.diagnosis.structure import Structure, screening_degrees, structure_of
from dlo_casadi.estimation.result import Fit
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.thresholds import SIGNIFICANCE

Verdict = Literal["complete", "effect_found", "unexplained"]


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
    search = Search(fit, center, exclude, significance, max_effects, step, run_in, finest)
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
        weight=None if found.unexplained else hidden_weight(found.fit, exclude),
    )


def separating_pose(diagnosis: Diagnosis) -> NextPose | None:
    """Pose that separates an added effect from its closest rival.

    Both as fits on the mesh of the search.
    """
    for item in diagnosis.added:
        if item.rivals:
            rival = item.rivals[0]
            found = next_pose(diagnosis.after, rival.fit)
            names = (item.candidate.name, rival.candidate.name)
            return None if found is None else replace(found, separates=names)
    return None
