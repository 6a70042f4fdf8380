"""A fit's unknowns if a candidate's parameters are unknown, too: to first order about the fit.

With Hessian H and gradient g over the fit's unknowns theta and a candidate's parameters c, and B of
what the bounds alone tell,

    (theta, c) ~ N(-(H + B)^-1 g, (H + B)^-1),   c >= 0 where an effect vanishes at its bound
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from dlo_casadi.arrays import FloatArray
from dlo_casadi.diagnosis.candidates import Candidate
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.unknowns import Unknowns
from dlo_casadi.linear_mixed import Normal
from dlo_casadi.thresholds import NORMAL_95

# Number of equally likely values that stand for a parameter with a bound.
VALUES = 100


@dataclass(frozen=True)
class Widened:
    """A fit's unknowns and a candidate's parameters, normally distributed about the fit.

    Parameters
    ----------
    names : tuple of str
        Of the unknowns, those of the candidate last; those of a nuisance are among the fit's, too,
        and their difference is the sum of both.
    mean, covariance : (m,), (m, m)
        Of their differences from the fit and from zero, scaled as the unknowns are.
    bounded : int or None
        Entry of a parameter of the candidate that vanishes at its lower bound.
    """

    candidate: Candidate
    scan: dict[str, float]
    names: tuple[str, ...]
    mean: FloatArray
    covariance: FloatArray
    bounded: int | None

    @classmethod
    def of(
        cls,
        fit: Fit,
        candidate: Candidate,
        scan: int,
        normal: Normal,
        larger: Unknowns,
    ) -> Widened:
        """From normal equations of a fit and a candidate, of `larger` unknowns with all of them."""
        every = larger.names
        names = (*fit.problem.unknowns.names, *candidate.screened)
        bounds = 1 / larger.widest[[every.index(name) for name in names]] ** 2
        total = normal.hessian + np.diag(bounds)
        size = np.sqrt(np.diag(total))
        inverse = np.linalg.pinv(total / np.outer(size, size), hermitian=True)
        covariance = inverse / np.outer(size, size)
        parameters = {q.name: q for q in larger.model.parameters}
        vanish = [parameters[q].lower == parameters[q].nominal for q in candidate.screened]
        known = len(names) - len(vanish)
        bounded = known + vanish.index(True) if any(vanish) else None
        mean = -covariance @ normal.gradient
        return cls(candidate, candidate.scans[scan], names, mean, covariance, bounded)

    @property
    def gain(self) -> float:
        """Fall of twice the objective, to first order, if the candidate is in the model."""
        return float(self.mean @ np.linalg.pinv(self.covariance, hermitian=True) @ self.mean)

    def ends(self, name: str, spread: float) -> tuple[float, float]:
        """95 % interval of an unknown's difference, all standard deviations times `spread`."""
        k, b = self.names.index(name), self.bounded
        mean, covariance = self.mean, spread**2 * self.covariance
        std = float(np.sqrt(covariance[k, k]))
        if b is None:
            return mean[k] - NORMAL_95 * std, mean[k] + NORMAL_95 * std
        size = np.sqrt(covariance[b, b])
        below = ndtr(-mean[b] / size)
        shares = below + (1 - below) * (np.arange(VALUES) + 0.5) / VALUES
        values = size * ndtri(np.clip(shares, 1e-300, 1 - 1e-16))
        centers = mean[k] + covariance[k, b] / size**2 * values
        left = np.sqrt(max(std**2 - covariance[k, b] ** 2 / size**2, 1e-12 * std**2))

        def beyond(x: float, share: float) -> float:
            return float(ndtr((x - centers) / left).mean() - share)

        far = 10 * std + np.abs(centers).max()
        low, high = (brentq(beyond, -far, far, args=(p,)) for p in (0.025, 0.975))
        return low, high

    def width(self, name: str) -> float:
        """Width of that interval."""
        low, high = self.ends(name, 1.0)
        return high - low

    def at(self, name: str, difference: float) -> dict[str, float]:
        """The candidate's parameters, as screened, where an unknown differs so much."""
        k = self.names.index(name)
        way = self.covariance[:, k] / self.covariance[k, k]
        moved = self.mean + way * (difference - self.mean[k])
        names = np.array(self.names)
        return {q: float(moved[names == q].sum()) for q in self.candidate.screened}
