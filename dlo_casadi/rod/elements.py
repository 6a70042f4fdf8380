"""The elements: links, arcs and quadratic arcs in a plane, helices and quadratic ones in space.

Between the frames R_0 and R_1 of two nodes in space the rod is a helix of the rotation vector phi,

    R_1 = R_0 exp(phi),   r(u) = r_0 + h int_0^u R_0 exp(v phi) e_x dv

with twist phi_x / h and curvatures phi_y / h, phi_z / h about the material axes y and z.

References
----------
Kirchhoff rods: Antman, Nonlinear Problems of Elasticity, 2005. Elements of constant strain:
Sonneville, Cardona, Bruels, Comput. Methods Appl. Mech. Eng. 268 (2014). Strain varying linearly,
to fourth order: Magnus expansion, e.g. Iserles et al., Acta Numerica 9 (2000).
"""

from collections.abc import Callable
from math import factorial

import casadi as ca
import numpy as np

from dlo_casadi.rod.element import Condensed, Element, Layout, Section, Segment
from dlo_casadi.rod.node import Frame, Heading
from dlo_casadi.rod.quaternions import SINE, conjugate, quaternion_product, rotated, series, traced

# Gauss points on [-1/2, 1/2] at which bend and twist are compared with the rest shape.
_GAUSS = 0.5 / np.sqrt(3)
# Coefficients of asin(x) / x in powers of x^2. An element that turns by a quarter turn needs
# x = 0.2, where the truncation error is 1e-13.
_ARCSINE = tuple(factorial(2 * k) / (4**k * factorial(k) ** 2 * (2 * k + 1)) for k in range(8))
# Coefficients of (1 - cos x) / x^2 in powers of x^2: error 2e-15 at x = pi/4.
_COSINE = tuple((-1) ** k / factorial(2 * k + 2) for k in range(7))


class Link(Element):
    """Straight links: a node in the middle of each link, and one more for each clamp.

    Segment j is link j with the hinge at its end, which represents the cell between the middles of
    links j and j + 1. A clamp bends the half cell between itself and the middle of a link.
    """

    name = "link"
    plain = "link"
    nodes_are = "in the middles of the links, and of the clamps"
    node = Heading
    smooth = False
    rule = (np.array([0.5]), np.array([1.0]))

    def layout(self, length: float, n: int, clamped: tuple[bool, bool]) -> Layout:
        """One node per link, and one per clamp."""
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
        # No cell follows the last node; its values repeat those of the cell before.
        low = np.concatenate([nodes[:-1], nodes[-2:-1]])
        width = np.concatenate([np.diff(nodes), nodes[-1:] - nodes[-2:-1]])
        has_cell = np.ones(len(nodes))
        has_cell[-1] = 0.0
        rows = np.column_stack([links, low, width, has_cell, np.full(len(nodes), h)])
        return Layout(nodes, rows, stations)

    def strain(self, segment: Segment) -> ca.SX:
        """Bend of the hinge divided by the width of its cell."""
        return (
            segment.has_cell
            * (segment.last - segment.first)
            * (1 / (segment.cell.width * segment.stretch))
        )

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The link's direction."""
        return segment.ratio * Heading.tangent(segment.first)


class Arc(Element):
    """Heading linear between the nodes, plus the variation of the rest curvature inside.

        phi(u) = phi_0 + u (phi_1 - phi_0) + own(u)

    with own(u) the integral of the rest curvature's linear and quadratic variation inside the
    element, which vanishes at both ends.
    """

    name = "arc"
    node = Heading

    def strain(self, segment: Segment) -> ca.SX:
        """Difference of the nodal headings divided by the true length."""
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
    """An arc with a bubble: an internal unknown b adds 4 u (1 - u) b to its heading.

    Positions and energy are expanded to second order in the bubble; the error is of fourth order
    in the element's length. The bubble minimises the Lagrangian at given nodes and multipliers.
    """

    name = "quadratic"
    order = 4
    n_inner = 1

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The arc's, turned by the bubble to second order."""
        c, s = ca.vertsplit(Heading.tangent(self.heading(segment, u)))
        form = 4 * u * (1 - u)
        across, back = form * segment.inner, form**2 * segment.square / 2
        bowed = ca.vertcat(-across * s - back * c, across * c - back * s)
        return segment.ratio * ca.vertcat(c, s) + segment.stretch * bowed

    def elastic(self, segment: Segment, section: Section) -> ca.SX:
        """Energy of the bend at a Gauss point in each half, to second order in the bubble."""
        (bend,), q = self.bends(segment), ca.SX.sym("q")
        moment = bend * ca.substitute(ca.gradient(section.of_bend(q) * q, q), q, bend**2)
        first, second = (section.along(half) for half in segment.cell.halves)
        # The bubble's curvature is 4 b (1 - 2u) / h: at the Gauss points, +- 4/sqrt(3) b / h.
        bowed = 4 / np.sqrt(3) * segment.inner * (1 / (segment.length * segment.stretch))
        mean = section.of_bend(bend**2) * bend**2 + section.tangent(bend**2) * bowed**2
        # If the stiffness of the two halves differs, a mean bend drives the bubble.
        density = (first + second) / 2 * mean + (first - second) * moment * bowed
        return segment.cell.width * section.bending / 2 * density * segment.stretch

    def condensed(
        self, segment: Segment, lagrangian: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> Condensed:
        """Second-order minimum over the bubble; its stiffness stays positive under compression."""
        torque = ca.gradient(lagrangian, segment.inner)
        own = ca.jacobian(ca.gradient(elastic(segment), segment.inner), segment.inner)
        whole = [lagrangian, torque, ca.jacobian(torque, segment.inner), own]
        given, torque, stiffness, own = ca.substitute(whole, [segment.inner], [ca.SX(0)])
        factor, derivative = _stiffening(stiffness / own - 1)
        bubble = -torque / (own * factor)
        return Condensed(given + torque * bubble / 2, bubble, bubble**2 * derivative)

    def expanded(
        self, segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> ca.SX:
        """To second order in the bubble; as `condensed` where `_stiffening` is 1 + x."""
        torque = ca.gradient(energy, segment.inner)
        whole = [energy, torque, ca.jacobian(torque, segment.inner)]
        given, torque, stiffness = ca.substitute(whole, [segment.inner], [ca.SX(0)])
        return given + torque * segment.inner + stiffness * segment.inner**2 / 2


def _stiffening(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Relative stiffness of a bubble and its derivative: 1 + x for x >= -0.1, above 0.6 for any x.

    x is positive under tension. Without the lower bound, elements of a limp cable buckle one by one
    on the way to an equilibrium. The function is twice differentiable. Equilibria pressed by
    obstacles reach x = -0.03; there an error of O(x^3) changed energies by 3e-8 of m g L + EI/L.

    Lower bound                                      0.25   0.6  0.7  0.8  0.85
    600 descents of a limp cable on a strong tether   600   599  590  568   490  converge
    108 ropes between pins, 6 to 20 elements           89   100  103  105   104  have their tension
    (`scripts/check_ropes.py`)

    A bound of 0.7 leaves a cable in space of 20 elements that is carried and stops without a step
    in time: where the function bends, massless insides of elements are not definite.
    """
    y, room = x + 0.1, 0.3
    a = ca.fmin(y, 0) / room
    pressed = 1 - a + a**2
    return ca.fmax(y, 0) + 0.6 + room / pressed, (1 - 2 * a) / pressed**2


class Helix(Element):
    """Constant curvature and twist between nodal frames."""

    name = "arc"
    node = Frame
    framed = True

    def local(self, first: ca.SX, last: ca.SX) -> ca.SX:
        """Frame in the middle (4,), and the rotation vector phi (3,) [rad] from node to node."""
        return _between(first, last)

    def strain(self, segment: Segment) -> ca.SX:
        """Mean twist, and mean curvatures about the axes y and z."""
        return segment.local[4:] / (segment.length * segment.stretch)

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The x axis of the frame at the fraction u."""
        return segment.ratio * rotated(segment.local[:4], _turned(segment.local[4:], u - 0.5))


@traced
def _between(first: ca.SX, last: ca.SX) -> ca.SX:
    """Frame in the middle of two frames, and the rotation vector from one to the other."""
    x, y, z, w = quaternion_product(conjugate(ca.vertsplit(first)), ca.vertsplit(last))
    # Halve the angle once more: the series of the arc sine then needs few terms.
    vector, halves = ca.vertcat(x, y, z), []
    for _ in range(2):
        cosine = ca.sqrt((1 + w) / 2)
        vector, w = vector / (2 * cosine), cosine
        halves.append((vector, w))
    phi = 8 * series(_ARCSINE, ca.sumsqr(vector)) * vector
    half, w = halves[0]
    middle = quaternion_product(ca.vertsplit(first), (*ca.vertsplit(half), w))
    return ca.vertcat(*middle, phi)


@traced
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


class QuadraticHelix(Helix):
    """Curvature and twist that change linearly inside the element: fourth order.

        h omega(x) = phi - 8 x beta + 2/3 phi x beta,      -1/2 <= x <= 1/2

    turns the frame at x, relative to the helix, by (1 - 4 x^2) (beta - x/3 phi x beta) about its
    own axes. Positions are expanded in the bubble beta to first order, and to second order along
    the element, which tension resists; beta minimises the elastic energy minus the work of the
    loads at given nodes. The error is of fifth order in h per element.
    """

    name = "quadratic"
    order = 4
    n_inner = 3

    def bends(self, segment: Segment) -> list[ca.SX]:
        """Strains minus rest strains at the two Gauss points."""
        phi, beta = segment.local[4:], segment.inner
        mean = phi + 2 / 3 * ca.cross(phi, beta)
        width = segment.length * segment.stretch
        rest, linear = segment.rest[::3], segment.rest[1::3]
        return [(mean - 8 * x * beta) / width - rest - x * linear for x in (-_GAUSS, _GAUSS)]

    def tangent(self, segment: Segment, u: ca.SX | float) -> ca.SX:
        """The helix's, turned by the bubble."""
        across = ca.sum1(segment.square[1:]) if segment.square.numel() > 1 else segment.square
        given = segment.local, segment.inner, across, segment.ratio, segment.stretch
        return _bowed(*given, u - 0.5)

    def condensed(
        self, segment: Segment, lagrangian: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> Condensed:
        """Minimum over the bubble; its stiffness stays positive under compression."""
        given, torque, own, derivative = self._of_bubble(segment, lagrangian, elastic)
        bubble = -ca.mtimes(inverse_of(own), torque)
        return Condensed(given + ca.dot(torque, bubble) / 2, bubble, bubble**2 * derivative)

    def expanded(
        self, segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> ca.SX:
        """To second order in the bubble, as in `condensed`."""
        given, torque, own, _ = self._of_bubble(segment, energy, elastic)
        bubble = segment.inner
        return given + ca.dot(torque, bubble) + ca.dot(bubble, ca.mtimes(own, bubble)) / 2

    @staticmethod
    def _of_bubble(
        segment: Segment, energy: ca.SX, elastic: Callable[[Segment], ca.SX]
    ) -> list[ca.SX]:
        """Energy without a bubble, its derivative by the bubble, and the bubble's stiffness.

        The stiffness is that of the section, and of the tension for bubbles about y and z. Then
        that of each bubble by its relative stiffness, see `_stiffening`; 0 about x.
        """
        own, _ = ca.hessian(elastic(segment), segment.inner)
        slope = ca.gradient(energy, segment.inner)
        # Along one axis: the tension is the same about both.
        whole = ca.gradient(slope[1], segment.inner[1])
        parts = [energy, slope, own, whole - own[1, 1]]
        given, torque, own, tension = ca.substitute(parts, [segment.inner], [ca.SX.zeros(3)])
        derivatives = [ca.SX(0)]
        for k in (1, 2):
            factor, derivative = _stiffening(tension / own[k, k])
            own[k, k] *= factor
            derivatives.append(derivative)
        return [given, torque, own, ca.vertcat(*derivatives)]


@traced
def _bowed(
    local: ca.SX, inner: ca.SX, across: ca.SX, ratio: ca.SX, stretch: ca.SX, x: ca.SX | float
) -> ca.SX:
    """`QuadraticHelix.tangent` at x from the middle of the element."""
    middle, phi = local[:4], local[4:]
    form = 1 - 4 * x * x
    turn = form * (inner - x / 3 * ca.cross(phi, inner))
    moved = ca.vertcat(0, turn[2], -turn[1])
    bowed = moved + x * ca.cross(phi, moved) - ca.vertcat(form * form * across / 2, 0, 0)
    return rotated(middle, ratio * _turned(phi, x) + stretch * bowed)


@traced
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
