"""The elements: links, arcs and bowed arcs in a plane, helices and bowed helices in space.

Between the frames R_0 and R_1 of two nodes in space the rod is a helix of the rotation vector phi,

    R_1 = R_0 exp(phi),   r(u) = r_0 + h int_0^u R_0 exp(v phi) e_x dv

with twist phi_x / h and curvatures phi_y / h, phi_z / h about the material axes y and z.

References
----------
Kirchhoff rods: Antman, Nonlinear Problems of Elasticity, 2005. Elements of constant strain:
Sonneville, Cardona, Bruels, Comput. Methods Appl. Mech. Eng. 268 (2014). Strain varying linearly,
to fourth order: Magnus expansion, e.g. Iserles et al., Acta Numerica 9 (2000).
"""

from __future__ import annotations

from collections.abc import Callable
from math import factorial

import casadi as ca
import numpy as np

from dlo_casadi.rod.element import Condensed, Element, Layout, Section, Segment
from dlo_casadi.rod.node import (
    SINE,
    Frame,
    Heading,
    conjugate,
    quaternion_product,
    rotated,
    series,
)

# Gauss points on [-1/2, 1/2] at which bend and twist are compared with the rest shape.
_GAUSS = 0.5 / np.sqrt(3)
# asin(x) / x in powers of x^2. Of a quarter of the half angle of an element that turns by a
# quarter turn, x = 0.2, what is left out is 1e-13.
_ARCSINE = tuple(factorial(2 * k) / (4**k * factorial(k) ** 2 * (2 * k + 1)) for k in range(8))
# (1 - cos x) / x^2 in powers of x^2: to 2e-15 for x = 0.785, half of a quarter turn.
_COSINE = tuple((-1) ** k / factorial(2 * k + 2) for k in range(7))


class Link(Element):
    """Straight links; nodes are in their middles, a clamp is a node of its own.

    Segment j is link j and the hinge at its end, which stands for the cell between the middles of
    links j and j + 1. A clamp bends the half cell between itself and the middle of a link.
    """

    name = "link"
    plain = "link"
    nodes_are = "in the middles of the links, and of the clamps"
    node = Heading
    smooth = False
    rule = (np.array([0.5]), np.array([1.0]))

    def layout(self, length: float, n: int, clamped: tuple[bool, bool]) -> Layout:
        """One node a link, and one a clamp."""
        h = length / n
        nodes = (np.arange(n) + 0.5) * h
        links = np.stack([np.arange(n) * h, np.full(n, h)], axis=1)
        stations = np.stack([np.arange(-1, n), np.arange(n + 1)], axis=1).clip(0, n - 1)
        if clamped[0]:
            nodes = np.concatenate([[0.0], nodes])
            links = np.concatenate([[[0.0, 0.0]], links])
            stations = stations + 1
        if clamped[1]:
            nodes = np.concatenate([nodes, [length]])
            links = np.concatenate([links, [[length, 0.0]]])
        # Behind the last node there is no cell: its numbers are those of the one before.
        low = np.concatenate([nodes[:-1], nodes[-2:-1]])
        width = np.concatenate([np.diff(nodes), nodes[-1:] - nodes[-2:-1]])
        has_cell = np.ones(len(nodes))
        has_cell[-1] = 0.0
        return Layout(nodes, np.column_stack([links, low, width, has_cell]), stations)

    def strain(self, segment: Segment) -> ca.SX:
        """Bend of the hinge over the width of its cell."""
        return (
            segment.has_cell
            * (segment.last - segment.first)
            * (1 / (segment.cell.width * segment.stretch))
        )

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The link's direction."""
        return segment.ratio * Heading.tangent(segment.first)


class Arc(Element):
    """Between nodal headings the heading is linear, and follows the rest shape's own variation.

        phi(u) = phi_0 + u (phi_1 - phi_0) + own(u)

    with own(u) the integral of the rest curvature's linear and quadratic variation inside the
    element, which vanishes at both ends.
    """

    name = "arc"
    node = Heading

    def strain(self, segment: Segment) -> ca.SX:
        """Turning over true length."""
        return (segment.last - segment.first) * (1 / (segment.length * segment.stretch))

    def heading(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """Heading [rad] at the fraction u."""
        x = u - 0.5
        linear, quadratic = segment.rest[1], segment.rest[2]
        own = linear * (x * x - 0.25) / 2 + quadratic * x * (x * x - 0.25) / 3
        turn = segment.length * segment.stretch * own
        return segment.first + u * (segment.last - segment.first) + turn

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """(cos phi, sin phi) of the heading."""
        return segment.ratio * Heading.tangent(self.heading(segment, u))


class Quadratic(Arc):
    """An arc whose heading in the middle lies by the angle `bow` beyond the mean of its ends.

    Positions and energy are taken to second order in the bow, which leaves out what is of fourth
    order in the element's length. The bow is the minimum for given nodes and multipliers.
    """

    name = "quadratic"
    order = 4
    n_inner = 1

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The arc's, turned by the bow to second order."""
        c, s = ca.vertsplit(Heading.tangent(self.heading(segment, u)))
        form = 4 * u * (1 - u)
        across, back = form * segment.inner, form**2 * segment.square / 2
        bowed = ca.vertcat(-across * s - back * c, across * c - back * s)
        return segment.ratio * ca.vertcat(c, s) + segment.stretch * bowed

    def elastic(self, segment: Segment, section: Section) -> ca.SX:
        """Energy of the bend at two Gauss points, one a half, to second order in the bow."""
        (bend,), q = self.bends(segment), ca.SX.sym("q")
        moment = bend * ca.substitute(ca.gradient(section.of_bend(q) * q, q), q, bend**2)
        first, second = (section.along(half) for half in segment.cell.halves)
        # The bow's own curvature is 4 bow (1 - 2u) / h: at Gauss points, +- 4/sqrt(3) bow / h.
        bowed = 4 / np.sqrt(3) * segment.inner * (1 / (segment.length * segment.stretch))
        mean = section.of_bend(bend**2) * bend**2 + section.tangent(bend**2) * bowed**2
        # Where the halves resist differently, a mean bend bows the cell.
        density = (first + second) / 2 * mean + (first - second) * moment * bowed
        return segment.cell.width * section.bending / 2 * density * segment.stretch

    def condensed(
        self, segment: Segment, lagrangian: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> Condensed:
        """Second-order minimum over the bow, its stiffness kept positive under compression."""
        torque = ca.gradient(lagrangian, segment.inner)
        own = ca.jacobian(ca.gradient(elastic(segment), segment.inner), segment.inner)
        whole = [lagrangian, torque, ca.jacobian(torque, segment.inner), own]
        given, torque, stiffness, own = ca.substitute(whole, [segment.inner], [ca.SX(0)])
        factor, slope = _stiffening(stiffness / own - 1)
        bow = -torque / (own * factor)
        return Condensed(given + torque * bow / 2, bow, bow**2 * slope)

    def expanded(
        self, segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> ca.SX:
        """To second order in the bow, as in `condensed`."""
        torque = ca.gradient(energy, segment.inner)
        whole = [energy, torque, ca.jacobian(torque, segment.inner)]
        given, torque, stiffness = ca.substitute(whole, [segment.inner], [ca.SX(0)])
        return given + torque * segment.inner + stiffness * segment.inner**2 / 2


def _stiffening(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Stiffness 1 + x of a bow under tension and its slope; compressed, x < 0, it stays above 1/4.

    Elements of a limp cable would buckle one by one on the way to an equilibrium. Twice
    differentiable, and 1 + x + O(x^3) everywhere.
    """
    a = 4 / 3 * ca.fmin(x, 0)
    pressed = 1 - a + a**2
    return ca.fmax(x, 0) + 0.25 + 0.75 / pressed, (1 - 2 * a) / pressed**2


class Helix(Element):
    """Constant curvature and twist between nodal frames."""

    name = "arc"
    node = Frame
    framed = True

    def local(self, first: ca.SX, last: ca.SX) -> ca.SX:
        """Frame in the middle (4,), and the rotation vector phi (3,) [rad] from node to node."""
        x, y, z, w = quaternion_product(conjugate(ca.vertsplit(first)), ca.vertsplit(last))
        # Halving the angle once more leaves an arc sine of which few terms are enough.
        vector, halves = ca.vertcat(x, y, z), []
        for _ in range(2):
            cosine = ca.sqrt((1 + w) / 2)
            vector, w = vector / (2 * cosine), cosine
            halves.append((vector, w))
        phi = 8 * series(_ARCSINE, ca.sumsqr(vector)) * vector
        half, w = halves[0]
        middle = quaternion_product(ca.vertsplit(first), (*ca.vertsplit(half), w))
        return ca.vertcat(*middle, phi)

    def strain(self, segment: Segment) -> ca.SX:
        """Mean twist, and mean curvatures about the axes y and z."""
        return segment.local[4:] / (segment.length * segment.stretch)

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The x axis of the frame at the fraction u."""
        return segment.ratio * rotated(segment.local[:4], _turned(segment.local[4:], u - 0.5))


def _turned(phi: ca.SX, x: ca.SX | float) -> ca.SX:
    """exp(x phi) e_x."""
    a = x * phi
    y = ca.sumsqr(a)
    sine, cosine = series(SINE, y), series(_COSINE, y)
    # a x e_x = (0, a_z, -a_y), a x (a x e_x) = a a_x - |a|^2 e_x.
    return ca.vertcat(
        1 + cosine * (a[0] * a[0] - y),
        sine * a[2] + cosine * a[0] * a[1],
        -sine * a[1] + cosine * a[0] * a[2],
    )


class BowedHelix(Helix):
    """Curvature and twist that change linearly inside the element: fourth order.

        h omega(x) = phi - 8 x beta + 2/3 phi x beta,      -1/2 <= x <= 1/2

    turns the frame at x, against the helix, by (1 - 4 x^2) (beta - x/3 phi x beta) about its own
    axes. Positions are taken to first order in the bow beta; it is the minimum of the elastic
    energy and the work of the loads for given nodes, which leaves out what is of the fifth order
    in h per element.
    """

    name = "quadratic"
    order = 4
    n_inner = 3

    def bends(self, segment: Segment) -> list[ca.SX]:
        """At the two Gauss points."""
        phi, beta = segment.local[4:], segment.inner
        mean = phi + 2 / 3 * ca.cross(phi, beta)
        width = segment.length * segment.stretch
        rest, slope = segment.rest[::3], segment.rest[1::3]
        return [(mean - 8 * x * beta) / width - rest - x * slope for x in (-_GAUSS, _GAUSS)]

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The helix's, turned by the bow to first order."""
        middle, phi = segment.local[:4], segment.local[4:]
        x = u - 0.5
        turn = (1 - 4 * x * x) * (segment.inner - x / 3 * ca.cross(phi, segment.inner))
        across = ca.vertcat(0, turn[2], -turn[1])
        bowed = across + x * ca.cross(phi, across)
        return rotated(middle, segment.ratio * _turned(phi, x) + segment.stretch * bowed)

    def condensed(
        self, segment: Segment, lagrangian: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> Condensed:
        """Minimum over the bow, resisted by the section alone."""
        given, torque, own = self._of_bow(segment, lagrangian, elastic)
        bow = -ca.mtimes(inverse_of(own), torque)
        return Condensed(given + ca.dot(torque, bow) / 2, bow, segment.square)

    def expanded(
        self, segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> ca.SX:
        """To second order in the bow, as in `condensed`."""
        given, torque, own = self._of_bow(segment, energy, elastic)
        bow = segment.inner
        return given + ca.dot(torque, bow) + ca.dot(bow, ca.mtimes(own, bow)) / 2

    @staticmethod
    def _of_bow(
        segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> list[ca.SX]:
        """Value of an energy at no bow, its slope by the bow, and the section's own stiffness."""
        own, _ = ca.hessian(elastic(segment), segment.inner)
        whole = [energy, ca.gradient(energy, segment.inner), own]
        return list(ca.substitute(whole, [segment.inner], [ca.SX.zeros(3)]))


def inverse_of(a: ca.SX) -> ca.SX:
    """Inverse of a symmetric matrix (3, 3), by cofactors."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] ** 2
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    c11 = a[0, 0] * a[2, 2] - a[0, 2] ** 2
    c12 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    c22 = a[0, 0] * a[1, 1] - a[0, 1] ** 2
    determinant = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    rows = [[c00, c01, c02], [c01, c11, c12], [c02, c12, c22]]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) / determinant
