"""Tangent matrices that are eliminated once for several Newton steps."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from dlo_casadi.arrays import BoolArray, IntArray
from dlo_casadi.rod.band import BandFactor, BandMatrix, Vector


@dataclass(frozen=True, eq=False)
class Factored:
    """Tangent matrices of the active poses, eliminated; those that are `finite` (active,)."""

    matrix: BandMatrix
    active: IntArray
    finite: BoolArray
    factor: BandFactor

    @classmethod
    def made(cls, matrix: BandMatrix, active: IntArray) -> Self:
        """From the matrices of all poses."""
        finite = np.asarray(np.isfinite(matrix.diagonal[active]).all(axis=(1, 2, 3)))
        return cls(matrix, active, finite, matrix.subset(active[finite]).factor())

    def of(self, matrix: BandMatrix, active: IntArray) -> bool:
        """Whether it is of these matrices and poses, which only become fewer."""
        return self.matrix is matrix and len(self.active) == len(active)

    def newton(self, force: Vector) -> Vector:
        """Newton step, one column; not finite for a shape that is not."""
        step = Vector(np.full_like(force.x, np.nan), np.full_like(force.y, np.nan))
        finite = self.finite
        found = self.factor.solve(Vector(-force.x[finite], -force.y[finite]))
        step.x[finite], step.y[finite] = found.x, found.y
        return step
