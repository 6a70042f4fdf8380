"""Elements of a rod in space: helices, and helices whose curvature changes inside.

Between the frames R_0 and R_1 of two nodes the rod is a helix of the rotation vector phi,

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

from dlo_casadi.rod.arc import Arc
from dlo_casadi.rod.element import Condensed, Element, Layout, Segment
from dlo_casadi.rod.node import SINE, Frame, conjugate, quaternion_product, rotated, series

# Gauss points on [-1/2, 1/2] at which bend and twist are compared with the rest shape.
_GAUSS = 0.5 / np.sqrt(3)
# asin(x) / x in powers of x^2. Of a quarter of the half angle of an element that turns by a
# quarter turn, x = 0.2, what is left out is 1e-13.
_ARCSINE = tuple(factorial(2 * k) / (4**k * factorial(k) ** 2 * (2 * k + 1)) for k in range(8))
# (1 - cos x) / x^2 in powers of x^2: to 2e-15 for x = 0.785, half of a quarter turn.
_COSINE = tuple((-1) ** k / factorial(2 * k + 2) for k in range(7))


class Helix(Element):
    """Constant curvature and twist between nodal frames."""

    name = "arc"
    plain = "arc"
    nodes_are = "at the nodes"
    node = Frame
    order = 2
    smooth = True
    rule = Arc.rule

    def layout(self, length: float, n: int, clamped: tuple[bool, bool]) -> Layout:
        """Nodes at the element boundaries, as those of a planar cable."""
        return Arc().layout(length, n, clamped)

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

    def local_moved(self, local: ca.SX, step: ca.SX) -> ca.SX:
        """The frame turned, the rotation vector added to."""
        return ca.vertcat(Frame.retract(local[:4], step[:3]), local[4:] + step[3:])

    def local_gap(self, local: ca.SX, other: ca.SX) -> ca.SX:
        """Turn of the frame, difference of the rotation vectors."""
        return ca.vertcat(Frame.gap(local[:4], other[:4]), other[4:] - local[4:])

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
        torque, given, own = self._of_bow(segment, lagrangian, elastic)
        bow = -ca.mtimes(inverse_of(own), torque)
        return Condensed(given + ca.dot(torque, bow) / 2, bow, segment.square)

    def expanded(
        self, segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> ca.SX:
        """To second order in the bow, as in `condensed`."""
        torque, given, own = self._of_bow(segment, energy, elastic)
        bow = segment.inner
        return given + ca.dot(torque, bow) + ca.dot(bow, ca.mtimes(own, bow)) / 2

    @staticmethod
    def _of_bow(
        segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Slope of an energy by the bow at 0, its value, and the section's own stiffness."""
        own, _ = ca.hessian(elastic(segment), segment.inner)
        whole = [ca.gradient(energy, segment.inner), energy, own]
        torque, given, own = ca.substitute(whole, [segment.inner], [ca.SX.zeros(3)])
        return torque, given, own


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
