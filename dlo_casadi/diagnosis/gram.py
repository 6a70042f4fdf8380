"""One Gram matrix of all candidates at all their places: the gain of every subset follows from it.

With the Gauss-Newton Hessian H and gradient g of the model that holds all candidates at their
nominal values, the columns c of a subset of candidates and those b of the fit itself give

    I = H_cc - H_cb H_bb^-1 H_bc,   u = -g_c + H_cb H_bb^-1 g_b,   T = u^T I^-1 u

with the fit's own directions, nuisances and deviations projected out. T is the predicted decrease
of twice the objective. If nothing is missing it follows chi-square, with one degree of freedom per
linear parameter. One candidate at one place is a subset, too: its T is its score. Beside another
one a candidate f gains

    r^T S^-1 r,   r = u_f - I_fa I_aa^-1 u_a,   S = I_ff - I_fa I_aa^-1 I_af

References
----------
Rao, Proc. Cambridge Phil. Soc. 44 (1948); Miller, Subset Selection in Regression (2002).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.diagnosis.widened import Widened
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.linear_mixed import Normal, Score
from dlo_casadi.thresholds import COLLINEAR, SCANS_PER_TEST

# Ridge of subsets, relative to each direction's information: of two candidates that act alike to a
# hundredth, the difference counts half. The linearisation is not more accurate than that.
RIDGE = 1e-4


class Place(NamedTuple):
    """A candidate, by the label of its effect, at one of its scans."""

    label: str
    scan: int


@dataclass(frozen=True)
class Screened:
    """Score test of one candidate.

    Parameters
    ----------
    score : float
        T, the predicted decrease of twice the objective, at the best scan; of a subset's member
        beside the others.
    p_value : float
        Corrected for the numbers of places scanned and of candidates alike, not for that of others.
    start : dict
        One-step estimate of the candidate's parameters.
    scan : int
    fit : Fit, optional
        The refit that tests a candidate without derivative where it vanishes.
    """

    candidate: Candidate
    score: float
    p_value: float
    start: dict[str, float]
    scan: int = 0
    fit: Fit | None = None


def in_order(screened: Iterable[Screened]) -> list[Screened]:
    """Score tests, best first."""
    return sorted(screened, key=lambda item: (item.p_value, -item.score))


@dataclass(frozen=True, eq=False)
class Gram:
    """Normal equations of a fit and, beside it, all candidates at their places.

    Parameters
    ----------
    larger : Unknowns
        Of the model that has all candidates.
    normal : Normal
        Of the fit's unknowns and then all columns; those of a nuisance are the fit's own, without a
        prior.
    places : dict
        Columns of each candidate at each of its scans.
    noise_dof : float
        Degrees of freedom of the noise estimate; inf where it is declared.
    """

    fit: Fit
    listed: tuple[Candidate, ...]
    larger: Unknowns
    normal: Normal
    places: dict[Place, list[int]]
    noise_dof: float

    @cached_property
    def _known(self) -> int:
        return len(self.fit.problem.unknowns.names)

    @cached_property
    def _score(self) -> Score:
        """Score of all columns, divided by their sizes, and these."""
        return Score.of(self.normal, self._known)

    @cached_property
    def _of(self) -> dict[str, Candidate]:
        """Candidates by their labels."""
        return {c.effect.label: c for c in self.listed}

    @cached_property
    def singles(self) -> list[Screened]:
        """Each candidate at its best place, best first."""
        best: dict[str, Screened] = {}
        for place in self.places:
            (found,) = self.tested([place])
            known = best.get(found.candidate.name)
            if known is None or found.score > known.score:
                best[found.candidate.name] = found
        return in_order(best.values())

    def tested(self, places: Sequence[Place]) -> tuple[Screened, ...]:
        """Score tests of a subset of candidates, each beside the others."""
        total, values = self._gain(places)
        found = []
        for place in places:
            candidate = self._of[place.label]
            others, _ = self._gain([x for x in places if x is not place])
            score, dof = total[0] - others[0], max(total[1] - others[1], 1)
            n_places = max(1.0, len(candidate.scans) / SCANS_PER_TEST)
            p_value = sidak(survival(score, dof, self.noise_dof), n_places * candidate.alike)
            own = {**candidate.scans[place.scan], **values[place.label]}
            start = candidate.of_linear(self.larger.model.cable, own)
            found.append(Screened(candidate, score, p_value, start, place.scan))
        return tuple(found)

    def gain(self, each: Iterable[Screened]) -> float:
        """T of a subset."""
        return self._gain([Place(x.candidate.effect.label, x.scan) for x in each])[0][0]

    def _gain(
        self, places: Sequence[Place]
    ) -> tuple[tuple[float, int], dict[str, dict[str, float]]]:
        """T of a subset and its degrees of freedom; by label the one-step estimates.

        A parameter that vanishes at its bound does not pass it; other bounds are left to the refit.
        """
        if not places:
            return (0.0, 0), {}
        names = [(x.label, name) for x in places for name in self._of[x.label].screened]
        found = self._score.among(self._columns(places))
        model = self.larger.model
        parameters = [model.parameters[model.names.index(name)] for _, name in names]
        score, step, dof = found.scaled.gain(COLLINEAR)
        vanish = np.array([q.lower == q.nominal for q in parameters], dtype=bool)
        inside = ~(vanish & (step < 0))
        if not inside.all():
            score, step[inside], _ = found.scaled.among(inside).gain(COLLINEAR)
            step[~inside] = 0.0
        values: dict[str, dict[str, float]] = {x.label: {} for x in places}
        # The fitted value of a nuisance counts only once: beside a copy without a prior, the copy
        # that has one returns to its mean.
        for (label, name), q, change in zip(names, parameters, step / found.size, strict=True):
            value = np.clip(q.nominal + change * q.scale, q.lower, q.upper)
            values[label][name] = float(value)
        return (score, dof), values

    def _columns(self, places: Iterable[Place]) -> IntArray:
        """Columns of places among those of all candidates."""
        return np.array([k for x in places for k in self.places[x]]) - self._known

    # ---- subsets -----------------------------------------------------------------------------

    def subsets(self, size: int, count: int) -> list[tuple[Screened, ...]]:
        """The `count` single candidates or pairs that gain most, each at its best places."""
        found: dict[frozenset[str], tuple[Screened, ...]] = {}
        every = list(self.places)
        for _, subset in sorted(self._pairs() if size > 1 else self._each(), reverse=True):
            names = frozenset(self._of[every[i].label].name for i in subset)
            if names in found or len(names) < size:
                continue
            tested = self.tested([every[i] for i in subset])
            if all(item.score > 0 for item in tested):
                found[names] = tested
            if len(found) == count:
                break
        return list(found.values())

    def _each(self) -> Iterator[tuple[float, tuple[int, ...]]]:
        """Gain of each place."""
        for i, x in enumerate(self._whitened[0]):
            yield float(x @ x), (i,)

    def _pairs(self) -> Iterator[tuple[float, tuple[int, ...]]]:
        """Gain of each pair of places."""
        for alone, (i,) in self._each():
            for k, more in enumerate(self._beside(i)[i + 1 :], i + 1):
                if more > 0:
                    yield alone + float(more), (i, k)

    @cached_property
    def _whitened(self) -> tuple[FloatArray, FloatArray]:
        """Scores (E, q) of all places and information (E, q, E, q), that of each place a unit.

        Places with fewer columns than q, or collinear ones, have scores of zero.
        """
        scaled, places = self._score.scaled, list(self.places)
        q = max(len(self.places[x]) for x in places)
        halves = np.zeros((len(scaled.slope), len(places), q))
        for i, place in enumerate(places):
            own = self._columns([place])
            values, vectors = np.linalg.eigh(scaled.information[np.ix_(own, own)])
            seen = values > COLLINEAR
            halves[own, i, : seen.sum()] = vectors[:, seen] / np.sqrt(values[seen])
        flat = halves.reshape((len(halves), -1))
        information = flat.T @ scaled.information @ flat
        np.fill_diagonal(information, 1.0)
        n = len(places)
        return (scaled.slope @ flat).reshape((n, q)), information.reshape((n, q, n, q))

    def _beside(self, place: int) -> FloatArray:
        """Gain (E,) of each further place beside one; none of the same candidate."""
        u, information = self._whitened
        ridge, q = 1 + RIDGE, u.shape[1]
        own = information[place]
        left = u - np.einsum("a,ane->ne", u[place], own) / ridge
        remaining = ridge * np.eye(q) - np.einsum("ane,anf->nef", own, own) / ridge
        gains = (left * np.linalg.solve(remaining, left[..., None])[..., 0]).sum(axis=1)
        labels = [x.label for x in self.places]
        return np.where([label == labels[place] for label in labels], 0.0, gains)

    # ---- what is not excluded ----------------------------------------------------------------

    def widened(self, name: str) -> list[Widened]:
        """Each candidate beside the fit at the place that leaves an unknown the least known."""
        widest: dict[str, tuple[float, Widened]] = {}
        for place, columns in self.places.items():
            candidate, kept = self._of[place.label], [*range(self._known), *columns]
            hessian, gradient = self.normal.hessian[np.ix_(kept, kept)], self.normal.gradient[kept]
            normal = Normal(hessian, gradient)
            found = Widened.of(self.fit, candidate, place.scan, normal, self.larger)
            width = found.width(name)
            if candidate.name not in widest or width > widest[candidate.name][0]:
                widest[candidate.name] = width, found
        return [found for _, found in widest.values()]


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
