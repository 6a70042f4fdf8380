"""Candidates tried beside the effects that a fit has: screened, and the likely ones refitted."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from dlo_casadi.diagnosis import refits
from dlo_casadi.diagnosis.candidates import Candidate, candidates_of
from dlo_casadi.diagnosis.crossval import CrossValidation, cross_validate
from dlo_casadi.diagnosis.from_data import from_data
from dlo_casadi.diagnosis.near_data import near_data
from dlo_casadi.diagnosis.refits import Confirmed, Tried
from dlo_casadi.diagnosis.screening import Screened, p_values_of, sidak, survival
from dlo_casadi.diagnosis.structure import noise_degrees, screening_degrees
from dlo_casadi.diagnosis.unknown_force import UnknownForce
from dlo_casadi.effects import PointLoad, StateEffect
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import fine_enough
from dlo_casadi.estimation.repeats import different_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import SETTLED_MODES
from dlo_casadi.runtime.parallel import map_in_order
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

    def screened(self, current: Fit, among: Collection[str] | None = None) -> list[Screened]:
        """Score tests of all candidates for a fit, or of those named, best first."""
        listed = [x for x in self.listed(current) if among is None or x.name in among]
        given = screening_degrees(current), self.significance, self.executor
        with suppress(EstimationError):
            return refits.scored(current, listed, *given)
        # A held-out pose has no equilibrium, so what poses leave behind cannot be determined.
        listed = [x for x in listed if not isinstance(x.effect, StateEffect)]
        return refits.scored(current, listed, *given)

    def tried(self, current: Fit, *, pairs: bool) -> Tried:
        """Candidates screened and refitted beside the effects of a fit.

        `pairs`: whether two at once may be tried, see `near_data`.
        """
        if self.starts_at_shapes(current):
            near = self.relaxed if current is self.declared else from_data(current)
            return near_data(current, near, self.executor, self.listed, pairs=pairs)
        screened = self.first if current is self.declared else self.screened(current)
        p_values = p_values_of(screened)
        known = self.refitted if current is self.declared else {}
        return Tried(screened, p_values, self.leading(current, screened, p_values, known))

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

    def fine(self, fit: Fit, finest: int | None = None) -> Fit:
        """A fit with effects on a sufficiently fine mesh, if the mesh may be refined."""
        if self.finest is None:
            return fit
        return fine_enough(fit, fit.model.n, SETTLED_MODES, finest or self.finest)[0]
