"""What a segment between two nodes adds to the Lagrangian: its section, and how it interpolates.

A chain of N nodes has S segments, N - 1 or N; segment j joins the nodes j and j + 1. The rod's
energy and its shape are sums over segments, so that derivatives couple neighbouring nodes only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import factorial
from typing import ClassVar

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.rod.node import Node

# Number of values per segment in `Layout.segments`.
LAYOUT_SIZE = 6
# Highest derivative of a law by the square of the bend: two by the internal unknowns, and two by
# nodes, or one by nodes and one by rest strains. With 3, Hessians were a third off.
_ORDER = 4


@dataclass(frozen=True)
class Cell:
    """Interval of the cable on which one discrete strain acts: what `SectionLaw.along` is given.

    Parameters
    ----------
    low : scalar [m]
        Arc length of its start, from the start of the cable; `middle` and `high` are those of its
        middle and end.
    width : scalar [m]
    mesh : scalar [m]
        Largest width of a cell of the mesh: a law rounds its kinks over a share of it.
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
    def halves(self) -> tuple[Cell, Cell]:
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
    expansion: Expansion | None = None

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


@dataclass(frozen=True)
class Layout:
    """Positions of the nodes and segments of a chain.

    Parameters
    ----------
    nodes : (N,) [m]
        Arc lengths of the nodes.
    segments : (S, 6) [m, m, m, m, 1, m]
        For each segment: start and length of the piece of cable it covers, start and width of its
        bending cell, whether it has a cell (1 or 0), and the length of an element.
    stations : (n + 1, 2) int
        The two nodes whose mean direction is that of the cable at each element boundary.
    """

    nodes: FloatArray
    segments: FloatArray
    stations: IntArray

    @cached_property
    def bends(self) -> IntArray:
        """Segments that have a bending cell, in order."""
        return np.flatnonzero(self.segments[:, 4])

    @cached_property
    def cells(self) -> FloatArray:
        """Bending cells (n_cells, 2) [m]."""
        low, width = self.segments[self.bends, 2:4].T
        return np.stack([low, low + width], axis=1)

    @cached_property
    def advancing(self) -> IntArray:
        """Segments whose ends are element boundaries, in order (n,)."""
        return np.flatnonzero(self.segments[:, 1])


@dataclass(frozen=True)
class Segment:
    """Symbols of one segment.

    Parameters
    ----------
    local : (n_local,)
        Local coordinates of its nodes, see `Element.local`.
    rest : (3 strains,) [1/m]
        Rest strains of the cell: for each strain the mean, linear and quadratic variation.
    place : (6,)
        A row of `Layout.segments`.
    stretch : scalar
        True length over declared length without tension, the same for all segments.
    ratio : scalar
        True length over declared length of this segment, including axial strain under tension.
    inner : (n_inner,)
        Internal unknowns of the element.
    square : scalar
        Square of the internal unknown, or the expression used in its place, see `_stiffening`.
    """

    local: ca.SX
    rest: ca.SX
    place: ca.SX
    stretch: ca.SX
    ratio: ca.SX
    inner: ca.SX
    square: ca.SX

    @property
    def first(self) -> ca.SX:
        """Heading of its first node, in a plane [rad]."""
        return self.local[0]

    @property
    def last(self) -> ca.SX:
        """Heading of its last node, in a plane [rad]."""
        return self.local[1]

    @property
    def start(self) -> ca.SX:
        """Arc length at which it starts [m]."""
        return self.place[0]

    @property
    def length(self) -> ca.SX:
        """Declared length of the piece of cable it covers [m]."""
        return self.place[1]

    @property
    def cell(self) -> Cell:
        """Its bending cell."""
        return Cell(self.place[2], self.place[3], self.place[5])

    @property
    def has_cell(self) -> ca.SX:
        """1 with a bending cell, 0 without."""
        return self.place[4]


@dataclass(frozen=True)
class Condensed:
    """A Lagrangian after elimination of the internal unknowns, and the values of these."""

    lagrangian: ca.SX
    inner: ca.SX
    square: ca.SX


class Element(ABC):
    """One way to interpolate the rod between nodes.

    Attributes
    ----------
    name : str
    nodes_are : str
        Where its nodes are, in words.
    node : Node
        State of its nodes.
    order : int
        Order of the shape's error in the element's length, measured.
    smooth : bool
        Whether the cable has a tangent at element boundaries. If so, the curve between them is a
        cubic Hermite interpolant, otherwise a chord.
    plain : str
        Name of the element without internal unknowns, on the same nodes.
    framed : bool
        Whether its Lagrangian is differentiated in the frame of its middle, see `in_frame`.
    n_inner : int
        Number of internal unknowns, which are eliminated.
    rule : (nodes, weights)
        Quadrature on [0, 1] along the element.
    """

    name: ClassVar[str]
    node: ClassVar[type[Node]]
    order: ClassVar[int] = 2
    smooth: ClassVar[bool] = True
    plain: ClassVar[str] = "arc"
    nodes_are: ClassVar[str] = "at the nodes"
    framed: ClassVar[bool] = False
    n_inner: ClassVar[int] = 0
    # Three Gauss points integrate cos and sin of a heading that turns by d within one element, with
    # an error below d^6 / 2e6.
    rule: ClassVar[tuple[FloatArray, FloatArray]] = (
        np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)]),
        np.array([5.0, 8.0, 5.0]) / 18.0,
    )

    def layout(self, length: float, n: int, clamped: tuple[bool, bool]) -> Layout:
        """Nodes and segments of a cable of n elements; `clamped`: whether its start, its end is.

        Nodes are at the element boundaries.
        """
        nodes = np.linspace(0.0, length, n + 1)
        width = np.full(n, length / n)
        segments = np.column_stack([nodes[:-1], width, nodes[:-1], width, np.ones(n), width])
        return Layout(nodes, segments, np.stack([np.arange(n + 1)] * 2, axis=1))

    def local(self, first: ca.SX, last: ca.SX) -> ca.SX:
        """Local coordinates (n_local,) of two nodes, the arguments of all other methods."""
        return ca.vertcat(first, last)

    @abstractmethod
    def strain(self, segment: Segment) -> ca.SX:
        """Mean strains of the cell [1/m], see `Node.strains`; 0 if it has no cell."""

    @abstractmethod
    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """Derivative of position by s (dimension,) [1] at the fraction u of the element."""

    def advance(self, segment: Segment, u: ca.SX | float = 1.0) -> ca.SX:
        """Vector (dimension,) [m] from the start of the element to the fraction u of it."""
        parts = [w * self.tangent(segment, u * x) for x, w in zip(*self.rule, strict=True)]
        return segment.length * u * sum(parts[1:], start=parts[0])

    def elastic(self, segment: Segment, section: Section) -> ca.SX:
        """Elastic energy [J] of the cell: the mean over the points of `bends`."""
        bends = self.bends(segment)
        cells = [segment.cell] if len(bends) == 1 else list(segment.cell.halves)
        pairs = enumerate(zip(bends, cells, strict=True))
        densities = [section.density(bend, cell, point) for point, (bend, cell) in pairs]
        mean = sum(densities[1:], start=densities[0]) / len(densities)
        return segment.has_cell * segment.cell.width * mean * segment.stretch

    def bends(self, segment: Segment) -> list[ca.SX]:
        """Strains minus rest strains [1/m]: of the cell, or at a Gauss point in each half."""
        return [self.strain(segment) - segment.rest[::3]]

    def condensed(
        self, segment: Segment, lagrangian: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> Condensed:
        """Eliminate the internal unknowns from the segment's Lagrangian."""
        return Condensed(lagrangian, segment.inner, segment.square)

    def expanded(
        self, segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> ca.SX:
        """Energy to be minimised over the internal unknowns; its minimum is that of `condensed`."""
        return energy
