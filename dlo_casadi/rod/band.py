"""Symmetric block-tridiagonal matrices with a border, of many poses at once.

    [ A    B ] [ x ]   [ f ]
    [ B^T  C ] [ y ] = [ g ]

A couples neighbouring nodes; B and C belong to the unknowns of the whole pose: the multipliers of
the end conditions. Block cyclic reduction eliminates every other node, log2(n) times. Its work
grows linearly with the nodes, and one array operation handles a level of all nodes and poses. The
elimination is a congruence of A: the signs of the pivots give the inertia (Sylvester, Haynsworth).

References
----------
Heller, SIAM J. Numer. Anal. 13 (1976); Haynsworth, Linear Algebra Appl. 1 (1968).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dsytrf, dsytrs

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray

# Smallest pivot, relative to the largest entry; it replaces smaller ones. As it is the square root
# of rounding, half of the digits are lost, and one step of refinement restores them.
LEAST_PIVOT = 1e-8
# Maximum number of steps of iterative refinement, and the relative residual at which they end.
REFINEMENTS = 3
RESIDUAL = 1e-13
# Relative residual beyond which a matrix is eliminated more carefully.
_INEXACT = 1e-10
# Conditions whose eigenvalue is below this share depend on each other: that is the rounding error.
ZERO_PIVOT = 1e-13
# Eigenvalues below this share of the largest entry count as zero: the elimination cannot tell them
# from zero where a pivot is that small. A cable without weight that may swing about its chord has
# 1e-16, stable equilibria on 20 elements have 2.5e-4 to 2e-3; these fall with 1 / n^2.
NEUTRAL = LEAST_PIVOT


@dataclass(frozen=True)
class Vector:
    """Right-hand sides or solutions: `x` (m, n, b, q) of the nodes, `y` (m, k, q) of the border."""

    x: FloatArray
    y: FloatArray

    def __add__(self, other: Vector) -> Vector:
        return Vector(self.x + other.x, self.y + other.y)

    def __sub__(self, other: Vector) -> Vector:
        return Vector(self.x - other.x, self.y - other.y)

    @property
    def size(self) -> FloatArray:
        """Largest entry of each pose and column (m, q)."""
        inner = np.abs(self.x).max(axis=(1, 2))
        return np.maximum(inner, np.abs(self.y).max(axis=1, initial=0.0))

    @property
    def rows(self) -> FloatArray:
        """All rows (m, n b + k, q): those of the nodes, then those of the border."""
        m, n, b, q = self.x.shape
        return np.concatenate([self.x.reshape((m, n * b, q)), self.y], axis=1)


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Product of stacks of small blocks; blocks of one number are plain factors."""
    return a * b if a.shape[-2:] == (1, 1) else a @ b


@dataclass(frozen=True)
class _Level:
    """One reduction: inverse pivots of the odd nodes and their couplings to both sides."""

    inverse: FloatArray
    left: FloatArray  # (m, odd, b, b): rows of the node before, columns of the odd node
    right: FloatArray  # (m, odd or one less, b, b): rows of the odd node, columns of the next

    @property
    def counts(self) -> tuple[int, int]:
        """Number of odd nodes, and of those that have a next one."""
        return self.left.shape[1], self.right.shape[1]

    def subset(self, index: IntArray) -> _Level:
        """The reduction of some of the poses."""
        return _Level(self.inverse[index], self.left[index], self.right[index])

    def reduced(self, diagonal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Diagonal and couplings of the even nodes after elimination of the odd ones."""
        even, (odd, inner) = diagonal[:, 0::2].copy(), self.counts
        to_left = _product(self.left, self.inverse)
        even[:, :odd] -= _product(to_left, self.left.mT)
        to_right = _product(self.right.mT, self.inverse[:, :inner])
        even[:, 1 : inner + 1] -= _product(to_right, self.right)
        return even, -_product(to_left[:, :inner], self.right)


@dataclass(frozen=True)
class BandMatrix:
    """Matrices of m poses.

    Parameters
    ----------
    diagonal : (m, n, b, b)
    upper : (m, n - 1, b, b)
        Rows of a node, columns of the next one.
    border : (m, n, b, k)
    corner : (m, k, k)
    internal : int
        Number of auxiliary unknowns, the last ones of the border, that stand for outer products
        added to A. They are eliminated; right-hand sides and solutions do not contain them.
    """

    diagonal: FloatArray
    upper: FloatArray
    border: FloatArray
    corner: FloatArray
    internal: int = 0

    @property
    def _parts(self) -> tuple[FloatArray, ...]:
        return self.diagonal, self.upper, self.border, self.corner

    def subset(self, index: IntArray | BoolArray) -> BandMatrix:
        """Matrices of some of the poses."""
        diagonal, upper, border, corner = (part[index] for part in self._parts)
        return BandMatrix(diagonal, upper, border, corner, self.internal)

    def replaced(self, index: IntArray, other: BandMatrix) -> BandMatrix:
        """Matrices of all poses, with those at `index` taken from `other`."""
        internal = max(self.internal, other.internal)
        parts = [part.copy() for part in self._widened(internal)._parts]
        for part, new in zip(parts, other._widened(internal)._parts, strict=True):
            part[index] = new
        diagonal, upper, border, corner = parts
        return BandMatrix(diagonal, upper, border, corner, internal)

    def _widened(self, internal: int) -> BandMatrix:
        """The same matrices with `internal` internal unknowns; the new ones have no effect."""
        more = internal - self.internal
        if not more:
            return self
        size = self.corner.shape[1]
        corner = np.pad(self.corner, [(0, 0), (0, more), (0, more)])
        corner[:, range(size, size + more), range(size, size + more)] = 1.0
        border = np.pad(self.border, [(0, 0), (0, 0), (0, 0), (0, more)])
        return BandMatrix(self.diagonal, self.upper, border, corner, internal)

    def with_border(self, columns: FloatArray) -> BandMatrix:
        """Return the matrices with further conditions, columns (m, n, b, k'), in the border."""
        more = (0, columns.shape[3])
        border = np.concatenate([self.border, columns], axis=3)
        return replace(self, border=border, corner=np.pad(self.corner, [(0, 0), more, more]))

    @property
    def columns(self) -> FloatArray:
        """The border as matrices (m, n b, k)."""
        m, n, b, k = self.border.shape
        return self.border.reshape((m, n * b, k))

    @cached_property
    def scale(self) -> FloatArray:
        """Largest entry of the diagonal blocks (m,)."""
        return np.maximum(np.abs(self.diagonal).max(axis=(1, 2, 3)), 1e-300)

    @property
    def row_sum(self) -> FloatArray:
        """Largest row sum of |A| (m,), a bound on the absolute values of its eigenvalues."""
        rows = np.abs(self.diagonal).sum(axis=3)
        rows[:, :-1] += np.abs(self.upper).sum(axis=3)
        rows[:, 1:] += np.abs(self.upper).sum(axis=2)
        return np.asarray(rows.max(axis=(1, 2)))

    def apply(self, vector: Vector) -> Vector:
        """Products of the matrices with (m, n, b, q), (m, k, q)."""
        x = _product(self.diagonal, vector.x)
        x[:, :-1] += _product(self.upper, vector.x[:, 1:])
        x[:, 1:] += _product(self.upper.mT, vector.x[:, :-1])
        if not self.corner.shape[1]:
            return Vector(x, vector.y)
        x += self.border @ vector.y[:, None]
        m, rows, _ = self.columns.shape
        across = self.columns.mT @ vector.x.reshape((m, rows, -1))
        return Vector(x, across + self.corner @ vector.y)

    def of_border(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Rows (m, k, q) of the border in the products with x (m, n, b, q), y (m, k, q)."""
        m, rows, k = *self.columns.shape[:2], y.shape[1]
        across = self.columns.mT[:, :k] @ x.reshape((m, rows, x.shape[3]))
        return np.asarray(across + self.corner[:, :k, :k] @ y)

    def dense(self) -> FloatArray:
        """Full matrices (m, n b + k, n b + k), without internal unknowns."""
        m, n, b, k = self.border.shape
        inner, i = np.zeros((m, n, b, n, b)), np.arange(n)
        inner[:, i, :, i] = self.diagonal.swapaxes(0, 1)
        inner[:, i[:-1], :, i[1:]] = self.upper.swapaxes(0, 1)
        inner[:, i[1:], :, i[:-1]] = self.upper.mT.swapaxes(0, 1)
        full = np.zeros((m, n * b + k, n * b + k))
        full[:, : n * b, : n * b] = inner.reshape((m, n * b, n * b))
        full[:, : n * b, n * b :] = self.columns
        full[:, n * b :, : n * b] = self.columns.mT
        full[:, n * b :, n * b :] = self.corner
        kept = full.shape[1] - self.internal
        if not self.internal:
            return full
        own, across = full[:, kept:, kept:], full[:, :kept, kept:]
        return full[:, :kept, :kept] - across @ np.linalg.solve(own, across.mT)

    @property
    def coupled(self) -> BoolArray:
        """Whether each unknown of the border (k,) depends on any other, in any pose."""
        others = np.asarray(self.corner.any(axis=0))
        others[np.diag_indices(len(others))] = False
        unsure = (np.diagonal(self.corner, axis1=1, axis2=2) == 0).any(axis=0)
        return np.asarray(others.any(axis=0) | self.border.any(axis=(0, 1, 2)) | unsure)

    def factor(self) -> BandFactor:
        """Eliminate the nodes."""
        return BandFactor(self)

    def negative(self, below: float = NEUTRAL) -> IntArray:
        """Number of negative eigenvalues of each matrix (m,), border included.

        Eigenvalues of A up to `below` times its scale count as negative: by default neutral ones,
        so that a neutral shape does not count as stable. The result is -1 if conditions in the
        border depend on each other.
        """
        least = below * self.scale[:, None, None, None] * np.eye(self.diagonal.shape[2])
        return replace(self, diagonal=self.diagonal - least).factor().negative


class BandFactor:
    """The elimination of a `BandMatrix`, to solve with and to read the inertia from."""

    def __init__(self, matrix: BandMatrix) -> None:
        coupled = matrix.coupled
        self._coupled, self._alone = np.flatnonzero(coupled), np.flatnonzero(~coupled)
        own = np.diagonal(matrix.corner, axis1=1, axis2=2)
        self._of_alone = own[:, self._alone]
        # Internal unknowns do not count as negative eigenvalues.
        self._internal = matrix.internal
        self._not_counted = (own[:, own.shape[1] - matrix.internal :] < 0).sum(axis=1)
        if len(self._alone):
            at = self._coupled
            corner = matrix.corner[:, at[:, None], at]
            matrix = replace(matrix, border=matrix.border[..., at], corner=corner)
        self.matrix = matrix
        self._least = LEAST_PIVOT * matrix.scale[:, None, None]
        self._levels: list[_Level] = []
        self._eigenvalues: list[FloatArray] = []
        diagonal, upper = matrix.diagonal, matrix.upper
        while diagonal.shape[1] > 1:
            level = _Level(self._inverse(diagonal[:, 1::2]), upper[:, 0::2], upper[:, 1::2])
            self._levels.append(level)
            diagonal, upper = level.reduced(diagonal)
        self._top = self._inverse(diagonal)
        # The border columns are eliminated once; the result serves every right-hand side.
        self._arm = self._nodes(matrix.border)
        arm = self._arm.reshape(matrix.columns.shape)
        self.schur = matrix.corner - matrix.columns.mT @ arm

    def subset(self, index: IntArray) -> BandFactor:
        """The elimination of some of the poses."""
        other = copy(self)
        vars(other).pop("negative", None)
        other._conditions = self._conditions[0][index], self._conditions[1][index]
        other.matrix = self.matrix.subset(index)
        other._levels = [level.subset(index) for level in self._levels]
        other._eigenvalues = [values[index] for values in self._eigenvalues]
        other._of_alone, other._not_counted = self._of_alone[index], self._not_counted[index]
        other._least, other._top = self._least[index], self._top[index]
        other._arm, other.schur = self._arm[index], self.schur[index]
        return other

    def _inverse(self, pivots: FloatArray) -> FloatArray:
        """Inverses of pivots (m, h, b, b), whose eigenvalues are at least `LEAST_PIVOT` in size."""
        single = pivots.shape[-1] == 1
        values, vectors = (pivots[..., 0], None) if single else np.linalg.eigh(pivots)
        self._eigenvalues.append(values)
        values = np.where(
            np.abs(values) < self._least, np.where(values < 0, -1, 1) * self._least, values
        )
        if vectors is None:
            return 1 / values[..., None]
        return np.asarray((vectors / values[..., None, :]) @ vectors.mT)

    def _nodes(self, f: FloatArray) -> FloatArray:
        """Solve A x = f for columns (m, n, b, q)."""
        halves: list[tuple[FloatArray, FloatArray]] = []
        for level in self._levels:
            even, (count, inner) = f[:, 0::2].copy(), level.counts
            taken = _product(level.inverse, f[:, 1::2])
            even[:, :count] -= _product(level.left, taken)
            even[:, 1 : inner + 1] -= _product(level.right.mT, taken[:, :inner])
            halves.append((taken, even))
            f = even
        x = _product(self._top, f)
        for level, (taken, even) in zip(self._levels[::-1], halves[::-1], strict=True):
            count, inner = level.counts
            coupling = _product(level.left.mT, x[:, :count])
            coupling[:, :inner] += _product(level.right, x[:, 1 : inner + 1])
            out = np.empty((*even.shape[:1], even.shape[1] + count, *even.shape[2:]))
            out[:, 0::2], out[:, 1::2] = x, taken - _product(level.inverse, coupling)
            x = out
        return x

    def _once(self, right: Vector) -> Vector:
        x = self._nodes(right.x)
        m, rows, k = self.matrix.columns.shape
        if not k:
            return Vector(x, right.y)
        gap = right.y - self.matrix.columns.mT @ x.reshape((m, rows, -1))
        values, vectors = self._conditions
        dependent = np.abs(values) < ZERO_PIVOT
        inverse = np.where(dependent, 0.0, 1 / np.where(dependent, 1.0, values))
        y = vectors @ (inverse[..., None] * (vectors.mT @ gap))
        return Vector(x - self._arm @ y[:, None], y)

    @cached_property
    def _conditions(self) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues (m, k) and vectors (m, k, k) of the Schur complement, scaled to unit size."""
        size = np.sqrt(np.abs(np.diagonal(self.schur, axis1=1, axis2=2)))
        size = np.where(size > 0, size, 1.0)
        values, vectors = np.linalg.eigh(self.schur / (size[:, :, None] * size[:, None, :]))
        return values, np.asarray(vectors / size[:, :, None])

    def solve(self, right: Vector) -> Vector:
        """Solution of each pose for columns (m, n, b, q), (m, k, q), refined to rounding.

        Conditions that depend on each other share the smallest possible multiplier. Right-hand
        sides have no rows for internal unknowns. Raises numpy.linalg.LinAlgError if a matrix is not
        finite.
        """
        k = right.y.shape[1]
        rows = np.pad(right.y, [(0, 0), (0, self._internal), (0, 0)])
        right = Vector(right.x, rows[:, self._coupled])
        found = self._once(right)
        size = right.size
        before = np.inf
        for _ in range(REFINEMENTS):
            left = right - self.matrix.apply(found)
            worst = float((left.size / np.maximum(size, 1e-300)).max(initial=0.0))
            if not RESIDUAL < worst < before:
                break
            before = worst
            found = found + self._once(left)
        rows[:, self._coupled] = found.y
        rows[:, self._alone] /= self._of_alone[..., None]
        return Vector(found.x, rows[:, :k])

    @cached_property
    def negative(self) -> IntArray:
        """Number of negative eigenvalues (m,), see `BandMatrix.negative`, but without its shift."""
        total = np.zeros(len(self.schur), dtype=np.intp)
        singular = np.zeros(len(self.schur), dtype=bool)
        for values in self._eigenvalues:
            total += (values < 0).sum(axis=tuple(range(1, values.ndim)))
        if self.schur.shape[1]:
            values, _ = self._conditions
            total += (values < 0).sum(axis=1)
            singular = np.abs(values).min(axis=1) < ZERO_PIVOT
        total += (self._of_alone < 0).sum(axis=1) - self._not_counted
        return np.where(singular, -1, total)


class DenseFactor:
    """The elimination of one matrix as a whole: for a single pose that is faster than by levels.

    Bunch and Kaufman's L D L^T, whose blocks of two have a negative and a positive eigenvalue.
    """

    def __init__(self, matrix: BandMatrix) -> None:
        self._matrix, self._full = matrix, matrix.dense()[0]
        self._factor, self._pivots, self._info = dsytrf(self._full, lower=1)

    def solve(self, right: Vector) -> Vector:
        """Solution for columns (1, n, b, q), (1, k, q); as `BandFactor` if it is inexact."""
        rows = right.rows[0]
        found, _ = dsytrs(self._factor, self._pivots, rows, lower=1)
        left = np.abs(rows - self._full @ found).max(initial=0.0)
        if self._info or not left <= _INEXACT * np.abs(rows).max(initial=0.0):
            return self._matrix.factor().solve(right)
        _, n, b, q = right.x.shape
        return Vector(found[: n * b].reshape((1, n, b, q)), found[None, n * b :])

    @property
    def negative(self) -> int:
        """Number of negative eigenvalues, border included."""
        single = self._pivots > 0
        below = (np.diag(self._factor) < 0) & single
        return int(below.sum() + (~single).sum() // 2)
