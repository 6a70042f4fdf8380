"""Score test of every candidate at the fitted model, without refitting.

With the Gauss-Newton Hessian H and gradient g of the model that holds all candidates at their
nominal values, a candidate's columns c and those b of the fit itself give

    I = H_cc - H_cb H_bb^-1 H_bc,   u = -g_c + H_cb H_bb^-1 g_b,   T = u^T I^-1 u

with the fit's own directions, nuisances and deviations projected out. T is the predicted decrease
of twice the objective. If nothing is missing it follows chi-square, with one degree of freedom per
linear parameter of the candidate.

References
----------
Rao, Proc. Cambridge Phil. Soc. 44 (1948); sensitivities through the equilibrium by the implicit
function theorem, exact from CasADi.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np
from scipy.special import chdtrc, fdtrc

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.widened import Widened
from dlo_casadi.effects import StateEffect
from dlo_casadi.estimation.descent import carried_shapes
from dlo_casadi.estimation.problem import Problem
from dlo_casadi.estimation.relaxation import Relaxation
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.start import with_springs_in_place
from dlo_casadi.estimation.unknowns import Values
from dlo_casadi.linear_mixed import LinearMixed, Normal, Score
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import STIFFNESSES, CableModel
from dlo_casadi.runtime.executors import InProcess
from dlo_casadi.runtime.parallel import begin, workers_of
from dlo_casadi.thresholds import COLLINEAR, IN_QUESTION, SCANS_APART, SCANS_PER_TEST


@dataclass(frozen=True)
class Screened:
    """Score test of one candidate.

    Parameters
    ----------
    score : float
        T, the predicted decrease of twice the objective, at the best scan.
    p_value : float
        Corrected for the numbers of places scanned and of candidates alike, not for that of others.
    start : dict
        One-step estimate of the candidate's parameters.
    widest : dict
        By stiffness, the candidate beside the fit at the scan that leaves it the least known.
    fit : Fit, optional
        The refit that tests a candidate without derivative where it vanishes.
    """

    candidate: Candidate
    score: float
    p_value: float
    start: dict[str, float]
    widest: Mapping[str, Widened] = field(default_factory=dict)
    fit: Fit | None = None


def in_order(screened: Iterable[Screened]) -> list[Screened]:
    """Score tests, best first."""
    return sorted(screened, key=lambda item: item.p_value - 1e-9 * item.score)


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
    """Groups of candidates that share a model: at scan 0 all, then those that have a k-th scan.

    Effects on the state act through all later poses, which costs more: they have their own model.
    """
    if k == 0:
        return [list(listed)] if listed else []
    several = [c for c in listed if len(c.scans) > 1]
    apart = ([c for c in several if isinstance(c.effect, StateEffect) == s] for s in (False, True))
    return [group for group in apart if any(k < len(c.scans) for c in group)]


# Whitened columns (R_j, q) of each pose, by the label of the candidate.
Columns = dict[str, list[FloatArray]]


def _columns(fit: Fit, listed: Sequence[Candidate], scans: Sequence[int]) -> list[Columns]:
    """For each scan the columns of the candidates that have one; of a nuisance those of the fit."""
    names, lin = fit.problem.unknowns.names, fit.linearization
    moving: dict[tuple[str, ...], _Moving] = {}
    out = []
    for k in scans:
        found: Columns = {}
        for nuisance in (c for c in listed if c.nuisance and k == 0):
            own = [names.index(name) for name in nuisance.screened]
            found[nuisance.effect.label] = [by_theta[:, own] for by_theta in lin.by_theta]
        for group in _moved_together([c for c in listed if not c.nuisance], k):
            key = tuple(candidate.effect.label for candidate in group)
            if key not in moving:
                moving[key] = _Moving.of(fit, group)
            rows = moving[key].by_names(_scan(group, k))
            ends = np.cumsum([len(candidate.screened) for candidate in group])[:-1]
            parts = zip(*(np.split(row, ends, axis=1) for row in rows), strict=True)
            each = zip(group, parts, strict=True)
            found |= {c.effect.label: list(part) for c, part in each if k < len(c.scans)}
        out.append(found)
    return out


@dataclass(frozen=True)
class AtScan:
    """Normal equations of a fit and, beside it, candidates at their scan `k`, each at `places`."""

    k: int
    normal: Normal
    known: int
    places: dict[str, list[int]]

    @classmethod
    def of(cls, k: int, mixed: LinearMixed, columns: Columns) -> AtScan:
        """From the columns of the candidates; a nuisance's are the fit's own, without a prior."""
        known = len(mixed.gap)
        ends = known + np.cumsum([0, *(part[0].shape[1] for part in columns.values())])
        places = {x: [*range(*ends[i : i + 2])] for i, x in enumerate(columns)}
        every = [np.hstack(parts) for parts in zip(*columns.values(), strict=True)]
        return cls(k, mixed.beside(every).normal, known, places)

    def beside(self, candidate: Candidate) -> Normal:
        """Normal equations of the fit's unknowns and one candidate's parameters."""
        kept = [*range(self.known), *self.places[candidate.effect.label]]
        return Normal(self.normal.hessian[np.ix_(kept, kept)], self.normal.gradient[kept])


class Screen:
    """All candidates beside a fit."""

    # Whether a likely candidate is also scanned between the first scans, next to its best one.
    between = True

    def __init__(self, fit: Fit, listed: Sequence[Candidate]) -> None:
        self.fit = fit
        self.listed = list(listed)
        self.unknowns = fit.problem_in(extended(fit, listed)).unknowns

    def normals(self, executor: Executor, scans: Sequence[int]) -> Iterator[AtScan]:
        """Normal equations at scans; these are split into one part per worker."""
        workers = max(1, min(workers_of(executor), len(scans)))
        parts = [scans[i::workers] for i in range(workers)]
        begun = [begin(executor, _columns, self.fit, self.listed, part) for part in parts[1:]]
        found = [_columns(self.fit, self.listed, parts[0]), *(wait() for wait in begun)]
        for i, k in enumerate(scans):
            yield AtScan.of(k, self.fit.mixed, found[i % workers][i // workers])

    def run(self, noise_dof: float, executor: Executor | None = None) -> list[Screened]:
        """Score all candidates, best first.

        `noise_dof`: degrees of freedom of the noise estimate; inf where it is declared. `executor`:
        runs the scans; in this process by default.
        """
        best: dict[str, tuple[Screened, int]] = {}
        widest: dict[str, dict[str, tuple[float, Widened]]] = {}

        def improved(scans: Sequence[int]) -> None:
            for normal in self.normals(executor or InProcess(), scans) if scans else ():
                for candidate in self.listed:
                    if candidate.effect.label not in normal.places:
                        continue
                    tried = self._score(candidate, normal, noise_dof)
                    known = best.get(candidate.name)
                    if known is None or tried.score > known[0].score:
                        best[candidate.name] = tried, normal.k
                    self._widen(widest.setdefault(candidate.name, {}), candidate, normal)

        n_scans = max(len(candidate.scans) for candidate in self.listed)
        first = range(0, n_scans, SCANS_APART)
        improved(first)
        likely = [(x, k) for x, k in best.values() if x.p_value < IN_QUESTION and self.between]
        near = {j for x, k in likely for j in (k - 1, k + 1) if j < len(x.candidate.scans)}
        improved(sorted(near & {*range(1, n_scans)} - {*first}))
        kept = {name: {q: x for q, (_, x) in own.items()} for name, own in widest.items()}
        return in_order(replace(x, widest=kept[name]) for name, (x, _) in best.items())

    def _widen(
        self, known: dict[str, tuple[float, Widened]], candidate: Candidate, normal: AtScan
    ) -> None:
        """Keep a candidate at a scan for each stiffness that it leaves less known than others."""
        names = [name for name in STIFFNESSES if name in self.fit.problem.unknowns.names]
        if not self.between or not names:
            return
        found = Widened.of(self.fit, candidate, normal.k, normal.beside(candidate), self.unknowns)
        for name in names:
            width = found.width(name)
            if name not in known or width > known[name][0]:
                known[name] = width, found

    def _score(self, candidate: Candidate, normal: AtScan, noise_dof: float) -> Screened:
        found, model = Score.of(normal.beside(candidate), normal.known), self.unknowns.model
        score, step, dof = found.scaled.gain(COLLINEAR)
        parameters = [model.parameters[model.names.index(q)] for q in candidate.screened]
        # Not below a bound at which a parameter vanishes; other bounds are left to the refit.
        vanish = np.array([q.lower == q.nominal for q in parameters], dtype=bool)
        inside = ~(vanish & (step < 0))
        if not inside.all():
            score, step[inside], _ = found.scaled.among(inside).gain(COLLINEAR)
            step[~inside] = 0.0
        step = step / found.size
        n_places = max(1.0, len(candidate.scans) / SCANS_PER_TEST)
        single = survival(score, max(dof, 1), noise_dof)
        p_value = sidak(single, n_places * candidate.alike)
        values = dict(candidate.scans[normal.k])
        # The fitted value of a nuisance counts only once: beside a copy without a prior, the copy
        # that has one returns to its mean.
        for name, q, change in zip(candidate.screened, parameters, step, strict=True):
            values[name] = float(np.clip(q.nominal + change * q.scale, q.lower, q.upper))
        return Screened(candidate, score, p_value, candidate.of_linear(model.cable, values))


class RelaxedScreen(Screen):
    """Screen at a relaxed fit: its shapes are the measured ones, its forces do not balance.

    Parameters
    ----------
    near : Fit
        The relaxed fit, see `estimation.relaxation`.
    softness : float [rad]
        Softness of its balance.
    """

    between = False  # The screen only selects the nearest candidates.

    def __init__(self, near: Fit, listed: Sequence[Candidate], softness: float) -> None:
        super().__init__(near, listed)
        self.softness = softness

    def normals(self, executor: Executor, scans: Sequence[int]) -> Iterator[AtScan]:
        """Normal equations at scans, with each pose's own unknowns eliminated."""
        begun: dict[tuple[str, ...], _Moving] = {}
        for k in scans:
            for group in _moved_together(self.listed, k):
                key = tuple(candidate.effect.label for candidate in group)
                if key not in begun:
                    begun[key] = _Moving.of(self.fit, group, relaxed=True)
                problem, values = begun[key].problem, begun[key].at(_scan(group, k))
                mixed = Relaxation(problem, self.softness).mixed(values)
                (rows,), every = mixed.by_shared, problem.unknowns.names
                columns = {
                    c.effect.label: [rows[:, [every.index(name) for name in c.screened]]]
                    for c in group
                    if k < len(c.scans)
                }
                own = [every.index(name) for name in self.fit.problem.unknowns.names]
                yield AtScan.of(k, mixed.among(own), columns)


def sidak(p_value: float, tried: float) -> float:
    """Probability that the best of `tried` independent tests is as good (Sidak)."""
    return float(-np.expm1(tried * np.log1p(-min(p_value, 1 - 1e-16))))


def p_values_of(screened: Sequence[Screened]) -> dict[str, float]:
    """p-value of each score as the best of all, by name."""
    return {item.candidate.name: sidak(item.p_value, len(screened)) for item in screened}


def survival(score: float, dof: int, noise_dof: float) -> float:
    """Probability of a larger score if nothing is missing: chi-square, or F; 1 if it is negative.

    `dof`: degrees of freedom of the score, at least one. `noise_dof`: those with which the noise is
    known; inf if it is declared.
    """
    score = max(score, 0.0)
    if np.isinf(noise_dof):
        return float(chdtrc(dof, score))
    return float(fdtrc(dof, noise_dof, score / dof))
