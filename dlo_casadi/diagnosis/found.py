"""What a search finds: the effects added, the list of all that were tried, what is unexplained."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import comb, log
from typing import Self

import numpy as np

from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.refits import Confirmed
from dlo_casadi.diagnosis.structure import Structure, noise_degrees, structure_of
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import refine_mesh
from dlo_casadi.estimation.result import Fit
from dlo_casadi.thresholds import EVIDENCE_APART, LEFT, UNSEEN


@dataclass(frozen=True)
class AddedEffect:
    """An effect for which the data give evidence.

    Parameters
    ----------
    p_value : float
        Corrected for places and candidates. Of the score test; if the noise is estimated, the
        larger of this and of the test under the noise left with the effect in the model. From the
        measured shapes: of the evidence that all effects accepted together gain.
    before, after : CrossValidation
        Cross-validation without and with the effect.
    rivals : tuple of Confirmed
        Candidates that the data could not distinguish from it.
    equivalents : tuple of str
        Other possible causes, see `candidates.equivalents`.
    """

    candidate: Candidate
    p_value: float
    before: CrossValidation
    after: CrossValidation
    rivals: tuple[Confirmed, ...]
    equivalents: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.candidate.name

    @property
    def rival_candidates(self) -> list[Candidate]:
        """Candidates that the data could not distinguish from it."""
        return [rival.candidate for rival in self.rivals]


@dataclass(frozen=True)
class Ranked:
    """A candidate in the list of all candidates tried.

    `reason`: why a refitted candidate is neither added nor a rival; empty for the others.
    """

    name: str
    score: float
    p_value: float
    rmse_cross_validated: float | None
    reason: str = ""


@dataclass(frozen=True)
class Found:
    """Result of one search.

    Parameters
    ----------
    fit : Fit
        The model with the effects that were added.
    ranked : tuple of Ranked
        All candidates of the first step: the refitted ones by `support`, then the others by score.
    unexplained : bool
        Whether structure is left, or most left-out poses are not predicted.
    as_likely : tuple of str
        If no effect was added: those of another search, which explain the data as well.
    """

    fit: Fit
    added: tuple[AddedEffect, ...]
    ranked: tuple[Ranked, ...]
    validation: CrossValidation
    structure: Structure
    unexplained: bool
    as_likely: tuple[str, ...]

    @staticmethod
    def of(
        fit: Fit, added: Sequence[AddedEffect], ranked: tuple[Ranked, ...], significance: float
    ) -> "Found":
        """A fit with effects, and whether it explains what was measured."""
        validation, structure = cross_validate(fit), structure_of(fit, noise_degrees(fit))
        limit = UNSEEN * max(fit.expected_error, validation.expected)
        # One pose alone does not predict another one to first order of the covariance.
        told = bool(added) or len(fit.problem.used) > 2
        unpredicted = told and validation.error_of_most > limit
        unexplained = structure.p_noise < significance or unpredicted
        unexplained |= fit.noise.source == "misfit"
        return Found(fit, tuple(added), ranked, validation, structure, unexplained, ())

    def or_better(self, other: Self | None, margin: float = 0.0) -> Self:
        """The other search's result if only that explains the data, or better; else this one.

        `margin`: log evidence by which the other one has to be better if both explain the data.
        """
        if other is None:
            return self
        candidates = max(len(self.ranked), len(other.ranked))
        if self.unexplained == other.unexplained:
            likelier = likelier_by(self.fit, other.fit) - other._sets(candidates)
            likelier += self._sets(candidates)
            better = likelier > margin
        else:
            likelier, better = -np.inf, self.unexplained
        if not better:
            tied = likelier > -EVIDENCE_APART and not (self.added or self.unexplained)
            return replace(self, as_likely=other.names) if tied and other.added else self
        names = " and ".join(other.names) or "no effect"
        known = {item.name for item in other.ranked}
        chosen = {x.name for item in self.added for x in (item.candidate, *item.rival_candidates)}
        rest = (
            replace(x, reason=f"less likely than {names}") if x.name in chosen else x
            for x in self.ranked
            if x.name not in known
        )
        return replace(other, ranked=(*other.ranked, *rest))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects that were added."""
        return tuple(item.name for item in self.added)

    def leaves_little(self, validation: CrossValidation) -> bool:
        """Whether its effects explain nearly all of what the declared model lacks.

        If something is still missing, a wrong effect may stand for part of it. The mean square
        error of left-out data, beyond noise and fixtures, has to fall below LEFT times its value
        without the effects, that of `validation`: what is missing beside them is then small
        compared with what they explain.
        """
        # If the declared model did not predict every pose, no effect counts as an explanation.
        known = validation.error if validation.complete else 0.0
        floor = self.fit.expected_error**2
        after, before = (max(x**2 - floor, 0.0) for x in (self.validation.error, known))
        return after <= LEFT * before

    def _sets(self, candidates: int) -> float:
        """Log of the number of sets of this many effects, all taken as equally likely."""
        return log(comb(candidates, min(len(self.added), candidates)))


def rivals_of(fit: Fit, item: AddedEffect) -> dict[str, Confirmed]:
    """Rivals of one of a fit's added effects by name, the closest first.

    A rival fitted before another effect was found does not count: shapes would differ by that
    effect, too.
    """
    own, label = {effect.label for effect in fit.model.effects}, item.candidate.effect.label
    return {
        rival.candidate.name: rival
        for rival in item.rivals
        if own ^ {effect.label for effect in rival.fit.model.effects}
        <= {label, rival.candidate.effect.label}
    }


def likelier_by(fit: Fit, other: Fit) -> float:
    """Log evidence of the other fit minus that of the first, on the finer of both meshes."""
    n = max(fit.model.n, other.model.n)
    return _on_mesh(other, n).log_evidence - _on_mesh(fit, n).log_evidence


def _on_mesh(fit: Fit, n: int) -> Fit:
    """The fit on n elements; unchanged if that has no equilibria near the measured shapes."""
    with suppress(EstimationError):
        return refine_mesh(fit, n) if n > fit.model.n and fit.noise.source != "misfit" else fit
    return fit
