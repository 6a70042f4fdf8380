"""Gaussian linear mixed models: the algebra of every fit, test, variance and left-out prediction.

A fit is to first order a regression of residuals e_j in groups j (poses),

    e_j + X_j b + Z_j u_j = noise ~ N(0, 1),    u_j ~ N(0, S),    b ~ N(mean, P^-1)

on unknowns b that all groups share and u_j of each group alone; what is random is an unknown with a
prior, what is fixed one without. One operation gives all that is asked of it: from products M of
all columns, unknowns a of prior precision Q are integrated out, which leaves of the others r

    M_rr - M_ra (M_aa + Q)^-1 M_ar,    log |M_aa + Q|

Of the observations' own column this leaves y^T P y, the sum of squares that nothing explains. Its
sum with the logarithms is -2 log marginal likelihood (evidence); that is the restricted likelihood
of the variances if the shared unknowns have no prior. Of further columns c it leaves their score
and information. In reverse order the means and covariances of all unknowns follow.

References
----------
Henderson, Biometrics 31 (1975): best linear predictions; Patterson and Thompson, Biometrika 58
(1971): restricted likelihood; Rao, Proc. Cambridge Phil. Soc. 44 (1948): score tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, root_of
from dlo_casadi.errors import EstimationError


@dataclass(frozen=True)
class Eliminated:
    """Unknowns integrated out of products of columns, of one group or of many at once.

    Parameters
    ----------
    block : (..., a, a)
        M_aa + Q: their precision, given all others.
    arm : (..., a, r)
        block^-1 M_ar: less their means, by the coefficients of the columns that are left.
    left : (..., r, r)
        Products of those columns.
    """

    block: FloatArray
    arm: FloatArray
    left: FloatArray

    @property
    def logdet(self) -> float:
        """Sum of log |block| over all groups; LinAlgError if one is not positive."""
        return float(2 * np.log(np.linalg.cholesky(self.block).diagonal(0, -2, -1)).sum())

    def joint(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (..., a + r) and covariance of coefficients, from those of the columns left.

        The coefficient of the observations is one, and certain.
        """
        a, r = self.arm.shape[-2:]
        same = np.broadcast_to(np.eye(r), (*self.arm.shape[:-2], r, r))
        way = np.concatenate([-self.arm, same], axis=-2)
        both = way @ covariance @ way.swapaxes(-2, -1)
        both[..., :a, :a] += np.linalg.inv(self.block)
        return (way @ mean[..., None])[..., 0], both


# Precision, in the units of the unknowns, below which a direction counts as undetermined.
NO_INFORMATION = 1e-6
# Coefficient of the observations: mean and covariance.
OBSERVED = np.ones(1), np.zeros((1, 1))


def eliminated(products: FloatArray, precision: FloatArray) -> Eliminated:
    """Integrate the first unknowns, of prior precision (a, a), out of products (..., k, k)."""
    a = len(precision)
    block, cross = products[..., :a, :a] + precision, products[..., :a, a:]
    arm = np.linalg.solve(block, cross)
    return Eliminated(block, arm, products[..., a:, a:] - cross.swapaxes(-2, -1) @ arm)


NONE = eliminated(np.zeros((1, 1, 1)), np.zeros((0, 0)))


@dataclass(frozen=True)
class Normal:
    """Normal equations of the shared unknowns: hessian @ step = -gradient.

    `own`: those of each group, integrated out; none of a part of the equations.
    """

    hessian: FloatArray
    gradient: FloatArray
    own: Eliminated = NONE

    def promised(self, damping: float = 0.0) -> float:
        """Decrease of the objective predicted for a damped step, own unknowns included."""
        step = np.linalg.solve(self.damped(damping), self.gradient)
        held = damping * self.scale @ step**2
        arm = self.own.arm[..., -1:]
        return float(self.gradient @ step + held + (arm * (self.own.block @ arm)).sum()) / 2

    @property
    def scale(self) -> FloatArray:
        """Diagonal of the Hessian, positive."""
        return np.maximum(np.diag(self.hessian), 1e-12)

    def damped(self, damping: float) -> FloatArray:
        """Hessian for damped steps.

        A direction without information, such as the place of a mass of zero, does not move.
        """
        return self.hessian + np.diag(damping * self.scale + NO_INFORMATION)


@dataclass(frozen=True)
class Score:
    """Score u (q,) and information I (q, q) of further columns, all else projected out.

    If none of them is missing u ~ N(0, I). `size` (q,): root of the information before projection.
    """

    slope: FloatArray
    information: FloatArray
    size: FloatArray

    @classmethod
    def of(cls, normal: Normal, known: int) -> Score:
        """From normal equations of `known` unknowns and, after these, of the further columns."""
        slope = normal.gradient
        products = np.block([[normal.hessian, slope[:, None]], [slope, 0.0]])
        left = eliminated(products, NO_INFORMATION * np.eye(known)).left
        size = np.sqrt(np.maximum(np.diag(normal.hessian)[known:], 1e-300))
        information = (left[:-1, :-1] + left[:-1, :-1].T) / 2
        return cls(-left[:-1, -1], information, size)

    @property
    def scaled(self) -> Score:
        """Of the columns divided by their sizes, whatever their units."""
        information = self.information / np.outer(self.size, self.size)
        return Score(self.slope / self.size, information, np.ones(len(self.size)))

    def among(self, kept: BoolArray | IntArray) -> Score:
        """Of some of the columns alone."""
        return Score(self.slope[kept], self.information[np.ix_(kept, kept)], self.size[kept])

    def gain(self, least: float) -> tuple[float, FloatArray, int]:
        """u^T I^-1 u, the fall of twice the objective; the step I^-1 u; its degrees of freedom.

        Directions of less information than `least` cannot be separated from what is known.
        """
        values, vectors = np.linalg.eigh(self.information)
        seen = values > least
        along = vectors[:, seen].T @ self.slope
        step = vectors[:, seen] @ (along / values[seen])
        return float((along**2 / values[seen]).sum()), step, int(seen.sum())


@dataclass(frozen=True, eq=False)
class LinearMixed:
    """A fit to first order about a point; b and u_j are steps from it.

    Parameters
    ----------
    residuals, by_shared, by_own : sequences of (R_j,), (R_j, n), (R_j, a)
        e_j, X_j and Z_j, in units of the noise.
    own, own_std : (groups, a), (a,)
        The groups' own unknowns at the point; roots of S. Their means are zero.
    gap, precision : (n,), (n, n)
        The shared unknowns at the point less their prior means, and P.
    """

    residuals: Sequence[FloatArray]
    by_shared: Sequence[FloatArray]
    by_own: Sequence[FloatArray]
    own: FloatArray
    own_std: FloatArray
    gap: FloatArray
    precision: FloatArray

    @property
    def columns(self) -> list[FloatArray]:
        """Columns (R_j, a + n + 1) of each group: its own, shared ones, residuals."""
        rows = zip(self.by_own, self.by_shared, self.residuals, strict=True)
        return [np.column_stack(parts) for parts in rows]

    @cached_property
    def normal(self) -> Normal:
        """Normal equations; an error if one of the groups is at a fold."""
        known = 1 / self.own_std**2
        products = np.array([columns.T @ columns for columns in self.columns])
        products[:, : len(known), -1] += known * self.own
        try:
            own = eliminated(products, np.diag(known))
        except np.linalg.LinAlgError as error:
            message = "a pose of the fit has come to a fold of its equilibria"
            raise EstimationError(message) from error
        total = own.left.sum(axis=0)
        gradient = self.precision @ self.gap + total[:-1, -1]
        return Normal(self.precision + total[:-1, :-1], gradient, own)

    def beside(self, columns: Sequence[FloatArray]) -> LinearMixed:
        """The model with further shared unknowns without a prior, by columns (R_j, q)."""
        by_shared = [np.hstack(both) for both in zip(self.by_shared, columns, strict=True)]
        more = (0, by_shared[0].shape[1] - len(self.gap))
        wider = np.pad(self.gap, more), np.pad(self.precision, (more, more))
        return replace(self, by_shared=by_shared, gap=wider[0], precision=wider[1])

    def among(self, kept: Sequence[int]) -> LinearMixed:
        """The model with some of the shared unknowns alone, the others held where they are."""
        by_shared = [columns[:, kept] for columns in self.by_shared]
        precision = self.precision[np.ix_(kept, kept)]
        return replace(self, by_shared=by_shared, gap=self.gap[kept], precision=precision)

    def score(self, columns: Sequence[FloatArray]) -> Score:
        """Score and information of further columns (R_j, q)."""
        return Score.of(self.beside(columns).normal, len(self.gap))

    def without(self, k: int) -> Normal:
        """Normal equations without the k-th group."""
        normal, left = self.normal, self.normal.own.left[k]
        return Normal(normal.hessian - left[:-1, :-1], normal.gradient - left[:-1, -1])

    def covariances(self, covariance: FloatArray) -> FloatArray:
        """Covariances (groups, a + n + 1, ...) of own and shared unknowns, given of the latter."""
        return self.normal.own.joint(np.zeros(len(covariance) + 1), np.pad(covariance, (0, 1)))[1]

    def leverages(self, covariance: FloatArray) -> list[FloatArray]:
        """Share, 0 to 1, of each residual (R_j,) that the unknowns absorb."""
        pairs = zip(self.columns, self.covariances(covariance), strict=True)
        return [((columns @ each) * columns).sum(axis=1) for columns, each in pairs]

    def taken(self, k: int, columns: FloatArray) -> FloatArray:
        """Columns (R_k, q) of the k-th group, its own unknowns refitted to them: W_k columns."""
        own, block = self.by_own[k], self.normal.own.block[k]
        return np.asarray(columns - own @ np.linalg.solve(block, own.T @ columns))

    def density(self, k: int, off: FloatArray, covariance: FloatArray) -> float:
        """Log density of residuals (R_k,) of a new group like the k-th, up to a constant.

        `off`: at the means of all unknowns; `covariance`: of the shared ones.
        """
        ways = self.by_shared[k] @ root_of(covariance), self.by_own[k] * self.own_std
        return log_density(off, np.concatenate(ways, axis=1))

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood by Laplace's approximation, up to a constant.

        A direction known worse than its scale counts as known to it.
        """
        square = sum(float(e @ e) for e in self.residuals) + self.gap @ self.precision @ self.gap
        square += ((self.own / self.own_std) ** 2).sum()
        eigen = np.linalg.eigvalsh(self.precision)
        prior = float(np.log(eigen[eigen > 1e-12]).sum())
        shared = float(np.log(np.maximum(np.linalg.eigvalsh(self.normal.hessian), 1.0)).sum())
        own = self.normal.own.logdet + 2 * len(self.own) * float(np.log(self.own_std).sum())
        return (prior - shared - own - float(square)) / 2


def log_density(white: FloatArray, ways: FloatArray) -> float:
    """Log density of residuals (R,) with covariance 1 + ways ways^T, up to a constant."""
    columns = np.column_stack([ways, white])
    found = eliminated(columns.T @ columns, np.eye(ways.shape[1]))
    return float(-found.left[0, 0] - found.logdet) / 2
