"""Score test of every candidate at the fitted model, without refitting.

The columns of a candidate are the derivatives of the residuals by its parameters, taken where its
effect vanishes; of an effect that is nonlinear in a parameter (a place, a direction) at trial
values of it, its scans. What follows from them stands in `gram`.

References
----------
Rao, Proc. Cambridge Phil. Soc. 44 (1948); sensitivities through the equilibrium by the implicit
function theorem, exact from CasADi.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import reduce

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.gram import Gram, Place, Screened
from dlo_casadi.effects import StateEffect
from dlo_casadi.estimation.descent import carried_shapes
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.relaxation import Further, Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import with_springs_in_place
from dlo_casadi.estimation.unknowns import Values
from dlo_casadi.linear_mixed import LinearMixed
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import begin, workers_of
from dlo_casadi.thresholds import IN_QUESTION, SCANS_APART


def extended(fit: Fit, listed: Sequence[Candidate]) -> CableModel:
    """Return the fitted model with all candidates at their nominal values."""
    new = (candidate.effect.linear() for candidate in listed if not candidate.nuisance)
    return reduce(CableModel.with_effect, new, fit.model)


@dataclass(frozen=True)
class _Moving:
    """Candidates moved from scan to scan together, in a model without the others.

    Moving a local effect that is still absent changes no shape, so only the derivatives by its own
    parameters have to be recomputed.
    """

    fit: Fit
    problem: Problem
    shapes: Shapes
    names: tuple[str, ...]

    @classmethod
    def of(cls, fit: Fit, candidates: Sequence[Candidate], *, relaxed: bool = False) -> _Moving:
        """Candidates beside a fit, which may be `relaxed`."""
        problem = fit.problem_in(extended(fit, candidates))
        names = tuple(name for candidate in candidates for name in candidate.screened)
        return cls(fit, problem, carried_shapes(problem, fit, relaxed=relaxed), names)

    def at(self, scan: Mapping[str, float]) -> Values:
        """The fit's values with the candidates at one scan."""
        fit, unknowns = self.fit, self.problem.unknowns
        theta = unknowns.pack(fit.values_in(unknowns.model, scan), fit.coefficients)
        values = Values(theta, self.shapes, fit.point.projections)
        return with_springs_in_place(self.problem, values)

    def by_names(self, scan: Mapping[str, float]) -> list[FloatArray]:
        """Whitened derivatives (R_j, names) of each pose's residuals, at one scan."""
        problem, unknowns, values = self.problem, self.problem.unknowns, self.at(scan)
        columns = [unknowns.names.index(name) for name in self.names]
        slopes = unknowns.slopes(values.theta)[:, columns]
        still = np.zeros((len(unknowns.rest(values.theta)), len(columns)))
        state = problem.state(values)
        along = problem.equilibria.directions(*state, slopes, still, deviations=False)
        moved = problem.residuals(values, along)
        return [white @ change for white, (_, change) in zip(problem.whitening, moved, strict=True)]


def _scan(candidates: Sequence[Candidate], k: int) -> dict[str, float]:
    """Values of the k-th scan of candidates, or of the last one of those that have fewer."""
    return {q: x for c in candidates for q, x in c.scans[min(k, len(c.scans) - 1)].items()}


def _moved_together(listed: Sequence[Candidate], k: int) -> list[list[Candidate]]:
    """Groups of candidates that share a model, of those that have a k-th scan.

    What a model costs grows faster than the number of its effects, so there are up to four: effects
    on the state, which act through all later poses, and others, of one scan and of several.
    """
    kinds = itertools.product((False, True), repeat=2)
    groups = (
        [c for c in listed if (isinstance(c.effect, StateEffect), len(c.scans) > 1) == kind]
        for kind in kinds
    )
    return [group for group in groups if any(k < len(c.scans) for c in group)]


# Whitened columns (R_j, q) of each pose, by the label of the candidate and its scan.
Columns = dict[Place, list[FloatArray]]
# Candidates that move together, by their labels.
Together = dict[tuple[str, ...], _Moving]


def _columns(
    fit: Fit, listed: Sequence[Candidate], scans: Sequence[int], moving: Together
) -> Columns:
    """The columns of all candidates at their scans; of a nuisance those of the fit.

    `moving`: those known from other scans; new ones are added.
    """
    names, lin = fit.problem.unknowns.names, fit.linearization
    found: Columns = {}
    for k in scans:
        for nuisance in (c for c in listed if c.nuisance and k == 0):
            own = [names.index(name) for name in nuisance.screened]
            found[Place(nuisance.effect.label, 0)] = [by_theta[:, own] for by_theta in lin.by_theta]
        for group in _moved_together([c for c in listed if not c.nuisance], k):
            key = tuple(candidate.effect.label for candidate in group)
            if key not in moving:
                moving[key] = _Moving.of(fit, group)
            rows = moving[key].by_names(_scan(group, k))
            ends = np.cumsum([len(candidate.screened) for candidate in group])[:-1]
            parts = zip(*(np.split(row, ends, axis=1) for row in rows), strict=True)
            each = zip(group, parts, strict=True)
            found |= {Place(c.effect.label, k): list(x) for c, x in each if k < len(c.scans)}
    return found


class Screen:
    """All candidates beside a fit."""

    def __init__(self, fit: Fit, listed: Sequence[Candidate]) -> None:
        self.fit = fit
        self.listed = list(listed)
        self.unknowns = fit.problem_in(extended(fit, listed)).unknowns
        self.moving: Together = {}

    def run(self, noise_dof: float, executor: Executor | None = None) -> list[Screened]:
        """Score all candidates, best first; the arguments are those of `gram`."""
        return self.gram(noise_dof, executor).singles

    def gram(self, noise_dof: float, executor: Executor | None = None) -> Gram:
        """Scores of all candidates at every second place, and next to the best of likely ones.

        `noise_dof`: degrees of freedom of the noise estimate; inf where it is declared. `executor`:
        runs the scans; in this process by default.
        """
        n_scans = max(len(candidate.scans) for candidate in self.listed)
        first = range(0, n_scans, SCANS_APART)
        columns = self._scanned(first, executor or InProcess())
        found = self._gram(self.fit.mixed, columns, noise_dof)
        likely = [x for x in found.singles if x.p_value < IN_QUESTION]
        near = {j for x in likely for j in (x.scan - 1, x.scan + 1) if j < len(x.candidate.scans)}
        more = sorted(near & {*range(1, n_scans)} - {*first})
        if not more:
            return found
        columns |= self._scanned(more, executor or InProcess())
        return self._gram(self.fit.mixed, columns, noise_dof)

    def _scanned(self, scans: Sequence[int], executor: Executor) -> Columns:
        """Columns at scans; these are split into one part per worker."""
        workers = max(1, min(workers_of(executor), len(scans)))
        parts = [scans[i::workers] for i in range(workers)]
        given = self.fit, self.listed
        begun = [begin(executor, _columns, *given, part, Together()) for part in parts[1:]]
        found = [_columns(*given, parts[0], self.moving), *(wait() for wait in begun)]
        return {place: columns for part in found for place, columns in part.items()}

    def _gram(self, mixed: LinearMixed, columns: Columns, noise_dof: float) -> Gram:
        known = len(mixed.gap)
        ends = known + np.cumsum([0, *(part[0].shape[1] for part in columns.values())])
        places = {x: [*range(*ends[i : i + 2])] for i, x in enumerate(columns)}
        every = [np.hstack(parts) for parts in zip(*columns.values(), strict=True)]
        normal = mixed.beside(every).normal
        return Gram(self.fit, tuple(self.listed), self.unknowns, normal, places, noise_dof)


class RelaxedScreen(Screen):
    """Screen at a relaxed fit: its shapes are the measured ones, its forces do not balance.

    Parameters
    ----------
    near : Fit
        The relaxed fit, see `estimation.relaxation`.
    softness : float [rad]
        Softness of its balance.
    """

    def __init__(self, near: Fit, listed: Sequence[Candidate], softness: float) -> None:
        super().__init__(near, listed)
        self.softness = softness

    def gram(self, noise_dof: float, executor: Executor | None = None) -> Gram:
        """Scores at every second place, with each pose's own unknowns eliminated."""
        whole = _Moving.of(self.fit, self.listed, relaxed=True)
        further: list[Further] = []
        asked = [(c, 0) for c in self.listed]
        for of_states in (False, True):
            group = [c for c in self.listed if isinstance(c.effect, StateEffect) == of_states]
            n_scans = max((len(c.scans) for c in group), default=1)
            moving = _Moving.of(self.fit, group, relaxed=True) if n_scans > SCANS_APART else whole
            relaxation, names = (
                Relaxation(moving.problem, self.softness),
                moving.problem.unknowns.names,
            )
            for k in range(SCANS_APART, n_scans, SCANS_APART):
                kept = [c for c in group if k < len(c.scans)]
                columns = [names.index(name) for c in kept for name in c.screened]
                further.append((relaxation, moving.at(_scan(group, k)), columns))
                asked += [(c, k) for c in kept]
        mixed = Relaxation(whole.problem, self.softness).mixed(
            whole.at(_scan(self.listed, 0)), further
        )
        (rows,), every = mixed.by_shared, whole.problem.unknowns.names
        found: Columns = {}
        at = len(every)
        for c, k in asked:
            if k == 0:
                own = [every.index(name) for name in c.screened]
            else:
                own, at = [*range(at, at + len(c.screened))], at + len(c.screened)
            found[Place(c.effect.label, k)] = [rows[:, own]]
        own = [every.index(name) for name in self.fit.problem.unknowns.names]
        return self._gram(mixed.among(own), found, noise_dof)
