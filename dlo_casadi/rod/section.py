"""The section of the rod: its energy per length, and an expansion of the laws of a section."""

from collections.abc import Callable
from dataclasses import dataclass
from math import factorial

import casadi as ca

# Highest derivative of a law by the square of the bend: two by the internal unknowns, and two by
# nodes, or one by nodes and one by rest strains. With 3, Hessians were a third off.
_ORDER = 4


@dataclass(frozen=True)
class Cell:
    """Interval of the cable on which one discrete strain acts: `width` [m], beginning at `low` [m].

    `mesh` [m] is the largest width of such a cell; kinks are rounded over a share of this width.
    """

    low: ca.SX
    width: ca.SX
    mesh: ca.SX | float

    @property
    def middle(self) -> ca.SX:
        """Arc length of its middle [m]."""
        return self.low + self.width / 2

    @property
    def high(self) -> ca.SX:
        """Arc length of its end [m]."""
        return self.low + self.width

    @property
    def halves(self) -> "tuple[Cell, Cell]":
        """The two halves."""
        half = self.width / 2
        return Cell(self.low, half, self.mesh / 2), Cell(self.middle, half, self.mesh / 2)


def one(_: object) -> ca.SX:
    """The factor of a section without laws."""
    return ca.SX(1)


@dataclass(frozen=True)
class Section:
    """Energy of a section that is bent and twisted.

        W = a (b(|k|) k^T B k + GJ tau^2) / 2                           [N]

    for the curvature k and the twist tau beyond those at rest [1/m]; a and b are products of the
    section laws' factors, see `SectionLaw`.

    Parameters
    ----------
    bending : (1, 1) or (2, 2) [N m^2]
        B: EI in a plane; in space about the material axes y and z.
    torsion : scalar GJ [N m^2]
    along : callable
        Cell -> a.
    of_bend, tangent : callable
        Square of the bend -> b; and -> the factor on the stiffness against a small change of that
        bend, which is exact for a single law.
    expansion : Expansion, optional
        Takes the place of `of_bend` at the points of a segment.
    """

    bending: ca.SX
    torsion: ca.SX
    along: Callable[[Cell], ca.SX] = one
    of_bend: Callable[[ca.SX], ca.SX] = one
    tangent: Callable[[ca.SX], ca.SX] = one
    expansion: "Expansion | None" = None

    def density(self, strain: ca.SX, cell: Cell, point: int = 0) -> ca.SX:
        """Energy per length [N] of strains beyond those at rest [1/m], see `Node.strains`.

        `point`: index of the point of the segment, see `Element.bends`.
        """
        axes = self.bending.size1()
        twist, bend = strain[:-axes], strain[-axes:]
        square, law = ca.sumsqr(bend), self.expansion
        factor = law.at(point, square) if law else self.of_bend(square)
        bent = factor * ca.dot(bend, ca.mtimes(self.bending, bend))
        return self.along(cell) * (bent + self.torsion * ca.sumsqr(twist)) / 2


class Expansion:
    """Taylor polynomial of a law b(q, p), q the square of the bend, about the bends of a segment.

        b = sum_k (b_k + sum_i b_ki (p_i - p_i0)) (q - q_0)^k / k!,     k = 0 ... 4

    A segment is differentiated in many directions. Meanwhile `symbols` stand for the coefficients
    b_k, b_ki, q_0 and p_i0; their `values` are inserted at the end. The law's own operations are
    then not repeated in every derivative: quadratic elements of a softening cable in space need
    half as many.

    Parameters
    ----------
    of_bend : callable
        q -> b.
    squares : list of scalars [1/m^2]
        q_0 of each point of the segment.
    p : (n_numbers,)
        Symbols on which the law may depend.
    """

    def __init__(self, of_bend: Callable[[ca.SX], ca.SX], squares: list[ca.SX], p: ca.SX) -> None:
        q = ca.SX.sym("q")
        rows = [ca.SX(of_bend(q))]
        for _ in range(_ORDER):
            rows.append(ca.gradient(rows[-1], q))
        column = ca.vertcat(*rows)
        by_p = ca.jacobian(column, p)
        own = [k for k in range(p.numel()) if by_p[:, k].nnz()]
        # One block of columns per point: b and its derivatives by q, then the derivatives of all
        # these by each parameter; in the last row q_0 and the parameters.
        law = ca.vertcat(ca.horzcat(column, by_p[:, own]), ca.horzcat(q, p[own].T))
        blocks = [ca.substitute(ca.densify(law), q, square) for square in squares]
        self.values = ca.horzcat(ca.SX(law.size1(), 0), *blocks)
        self.symbols = ca.SX.sym("law", *self.values.shape)
        self._own = p[own]

    def at(self, point: int, square: ca.SX) -> ca.SX:
        """The polynomial of a point, at a square of the bend."""
        width = 1 + self._own.numel()
        block = self.symbols[:, point * width : (point + 1) * width]
        rows = block[:-1, 0] + block[:-1, 1:] @ (self._own - block[-1, 1:].T)
        total = ca.SX(0)
        for k in reversed(range(_ORDER + 1)):
            total = total * (square - block[-1, 0]) + rows[k] / factorial(k)
        return total
