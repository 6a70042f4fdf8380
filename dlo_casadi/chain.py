"""Kinematics of a planar chain: coordinates -> curve. No mechanics in here.

The solvers' coordinates are absolute headings `phi`; the paper's relative joint angles are
`theta = diff(phi)`. In headings the energy of bending and of every dead load is a sum of terms of
neighbours, so that its Hessian is banded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import DloError

FloatArray = NDArray[np.floating]
Element = Literal["quadratic", "arc", "link"]
ELEMENTS: tuple[Element, ...] = ("quadratic", "arc", "link")

# Gauss-Legendre on [0, 1]: three points integrate cos and sin of a heading that turns by d in
# one element with an error below d^6 / 2e6.
GAUSS_NODES = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


def link_transform(theta: ca.SX, length: float) -> ca.SX:
    """Homogeneous transform T_a^(a-1) of one link: translate by `length` along x, then turn.

    Source: Eq. 4 of Quartaro et al. 2025.
    """
    c, s = ca.cos(theta), ca.sin(theta)
    return ca.blockcat([[c, -s, 0, length], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def se3_nodes(theta: ca.SX, length: float) -> ca.SX:
    """Node positions of a straight-link chain by the SE(3) product of the paper.

        T_i^0 = T_1^0(theta_1) prod_{a=2..i} T_a^(a-1)(theta_a)             (Eq. 4)

    Reference for the recurrence in headings that the solvers use.

    Parameters
    ----------
    theta : (n,) [rad]
        theta_1 is the heading of link 1, the others are relative joint angles.
    length : float [m]
        Length of the cable; each link is length / n long.

    Returns
    -------
    (n + 1, 2) [m]
        Nodes from the start, which is the origin.
    """
    n = theta.numel()
    h = length / n
    transform = link_transform(theta[0], 0.0)
    nodes = [ca.SX.zeros(1, 2)]
    for i in range(1, n):
        transform = transform @ link_transform(theta[i], h)
        nodes.append(transform[:2, 3].T)
    end = transform @ ca.vertcat(h, 0, 0, 1)
    nodes.append(end[:2].T)
    return ca.vertcat(*nodes)


@dataclass(frozen=True)
class Chain:
    """A cable cut into n equal elements.

    Parameters
    ----------
    length : float [m]
        Declared length along the cable.
    n : int
        Number of elements, >= 2.
    element : "quadratic", "arc" or "link"
        "arc": beyond the rest shape, the heading varies linearly in an element (n + 1 nodal
        headings): an arc, if the cable is straight or round at rest.
        "quadratic": an arc that also bows, by an angle per element that the model eliminates.
        "link": straight links joined by hinges (n headings), the paper's chain.
    start_clamped, end_clamped : bool
        A clamp bends the half cell between itself and the middle of a link; an arc's nodal
        heading is prescribed by a constraint instead and needs no cell of its own.
    """

    length: float
    n: int
    element: Element = "arc"
    start_clamped: bool = False
    end_clamped: bool = False

    def __post_init__(self) -> None:
        if self.n < 2:
            raise DloError(f"a chain needs at least 2 elements, got n = {self.n}")
        if self.element not in ELEMENTS:
            raise DloError(f"element {self.element!r} is not known; use one of {ELEMENTS}")

    @property
    def h(self) -> float:
        """Length of one element [m]."""
        return self.length / self.n

    @property
    def nodal(self) -> bool:
        """Whether the headings are those at the nodes: of arcs, not of links."""
        return self.element != "link"

    @property
    def n_headings(self) -> int:
        """Number of absolute headings among the coordinates."""
        return self.n + 1 if self.nodal else self.n

    @property
    def cells(self) -> FloatArray:
        """Bending cells (n_cells, 2) [m]: where each discrete curvature acts, from s0 to s1."""
        if self.nodal:
            edges = np.linspace(0.0, self.length, self.n + 1)
        else:
            middles = (np.arange(self.n) + 0.5) * self.h
            head = [0.0] if self.start_clamped else []
            tail = [self.length] if self.end_clamped else []
            edges = np.concatenate([head, middles, tail])
        return np.stack([edges[:-1], edges[1:]], axis=1)

    @property
    def n_cells(self) -> int:
        """Number of bending cells."""
        return len(self.cells)

    @property
    def heading_places(self) -> FloatArray:
        """Arc lengths (n_headings,) [m] at which the headings are the cable's direction."""
        if self.nodal:
            return np.linspace(0.0, self.length, self.n + 1)
        return (np.arange(self.n) + 0.5) * self.h

    def curve(
        self,
        phi: ca.SX,
        start: ca.SX,
        start_heading: ca.SX | float = 0.0,
        end_heading: ca.SX | float = 0.0,
        stretch: ca.SX | float = 1.0,
        ratio: ca.SX | None = None,
        rest: ca.SX | None = None,
        bow: ca.SX | None = None,
        square: ca.SX | None = None,
    ) -> Curve:
        """Build the curve of the headings `phi`.

        Parameters
        ----------
        phi : (n_headings,) [rad]
        start : (2,) [m]
            Position of the start fixture.
        start_heading, end_heading : scalar [rad]
            Directions of clamps; used by links only.
        stretch : scalar
            True length over declared length, the same everywhere.
        ratio : (n,), optional
            Length of each element over its declared length; `stretch` everywhere by default.
        rest : (n,), optional [1/m]
            Mean rest curvature of each element; arcs follow its variation inside.
        bow : (n,), optional [rad]
            How far the heading in the middle of an element lies beyond the mean of its ends.
        square : (n,), optional [rad^2]
            What stands for the square of the bow; that by default.
        """
        bent = phi
        if self.element == "link":
            if self.start_clamped:
                bent = ca.vertcat(start_heading, bent)
            if self.end_clamped:
                bent = ca.vertcat(bent, end_heading)
        if ratio is None:
            ratio = ca.SX.ones(self.n) * stretch
        own = ca.SX.zeros(self.n, 2)
        if rest is not None and self.nodal:
            variation = ca.DM(self.rest_variation) @ rest
            own = self.h * stretch * ca.reshape(variation, self.n, 2)
        bow = ca.SX.zeros(self.n) if bow is None else bow
        square = bow**2 if square is None else square
        return Curve(self, phi, bent, ratio, stretch, start, own, bow, square)

    @property
    def rest_variation(self) -> FloatArray:
        """Linear and quadratic part (2 n, n) of the rest curvature in each element.

        From the means m over the element and its neighbours, for x from -1/2 to 1/2,

            kappa_0(x) = m_e + a x + c (x^2 - 1/12),
            a = (m_(e+1) - m_(e-1)) / 2,   c = (m_(e+1) - 2 m_e + m_(e-1)) / 2

        which is exact for parabolas. The first and last element continue their neighbour's.
        """
        linear, quadratic = np.zeros((self.n, self.n)), np.zeros((self.n, self.n))
        if self.n == 2:
            linear[:] = [-1.0, 1.0]
            return np.concatenate([linear, quadratic])
        for e in range(self.n):
            middle = min(max(e, 1), self.n - 2)
            around = slice(middle - 1, middle + 2)
            quadratic[e, around] = [0.5, -1.0, 0.5]
            linear[e, around] = [-0.5, 0.0, 0.5]
            linear[e] += 2 * (e - middle) * quadratic[e]
        return np.concatenate([linear, quadratic])


@dataclass(frozen=True)
class Curve:
    """A planar curve, seen by effects through position, heading and strain at an arc length.

    Arc lengths `s` are material coordinates in [0, declared length]. The bow enters positions to
    second order: of the fourth order in the element's length is what that leaves out.
    """

    chain: Chain
    phi: ca.SX
    bent: ca.SX
    ratio: ca.SX
    stretch: ca.SX | float
    start: ca.SX
    own: ca.SX
    bow: ca.SX
    square: ca.SX

    def _own_turns(self, u: ca.SX | float) -> ca.SX:
        """Headings (n,) of the rest shape beyond its linear part; zero at both ends of elements."""
        x = u - 0.5
        return self.own[:, 0] * (x * x - 0.25) / 2 + self.own[:, 1] * x * (x * x - 0.25) / 3

    def _headings(self, u: ca.SX | float) -> ca.SX:
        """Heading (n,) in each element at the fraction u, or (n,) fractions, without the bow."""
        if not self.chain.nodal:
            return self.phi
        return self.phi[:-1] + u * (self.phi[1:] - self.phi[:-1]) + self._own_turns(u)

    def _tangents(self, u: ca.SX | float) -> ca.SX:
        """Derivative of position by s (n, 2) in each element [1]."""
        headings = self._headings(u)
        c, s = ca.cos(headings), ca.sin(headings)
        straight = ca.horzcat(self.ratio * c, self.ratio * s)
        if self.chain.element != "quadratic":
            return straight
        form = 4 * u * (1 - u)
        across, back = form * self.bow, form**2 * self.square / 2
        bowed = ca.horzcat(-across * s - back * c, across * c - back * s)
        return straight + self.stretch * bowed

    def _advances(self, u: ca.SX | float) -> ca.SX:
        """Vector from the start of each element to the fraction u of its length (n, 2) [m]."""
        h = self.chain.h
        if not self.chain.nodal:
            parts = self._tangents(u)
        else:
            parts = sum(
                weight * self._tangents(u * node)
                for node, weight in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True)
            )
        return ca.horzcat(h * u * parts[:, 0], h * u * parts[:, 1])

    @property
    def strain(self) -> ca.SX:
        """Curvature in each bending cell (n_cells,) [1/m]."""
        width = np.diff(self.chain.cells, axis=1).ravel()
        return (self.bent[1:] - self.bent[:-1]) / (ca.DM(width) * self.stretch)

    @property
    def nodes(self) -> ca.SX:
        """Positions of the element boundaries (n + 1, 2) [m]."""
        return ca.cumsum(ca.vertcat(self.start.T, self._advances(1.0)), 0)

    @property
    def node_headings(self) -> ca.SX:
        """Direction of the cable at the nodes (n + 1,) [rad]; of links, the mean of neighbours."""
        if self.chain.nodal:
            return self.phi
        last = self.chain.n - 1
        return ca.vertcat(self.phi[0], (self.phi[1:] + self.phi[:-1]) / 2, self.phi[last])

    @property
    def node_slopes(self) -> ca.SX:
        """Derivative of position by s at the nodes of a chain of arcs (n + 1, 2) [1]."""
        ratio = ca.vertcat(
            self.ratio[0], (self.ratio[1:] + self.ratio[:-1]) / 2, self.ratio[self.chain.n - 1]
        )
        return ca.horzcat(ca.cos(self.phi) * ratio, ca.sin(self.phi) * ratio)

    def position(self, s: ca.SX | float) -> ca.SX:
        """Position at the arc length s (2,) [m], once differentiable in s."""
        u = ca.fmin(ca.fmax(s / self.chain.h - np.arange(self.chain.n), 0), 1)
        return self.start + ca.sum1(self._advances(u)).T

    def heading(self, s: ca.SX | float) -> ca.SX:
        """Direction of the cable at the arc length s [rad], continuous in s."""
        u = ca.fmin(ca.fmax((s - self.chain.heading_places[:-1]) / self.chain.h, 0), 1)
        turns = u * (self.phi[1:] - self.phi[:-1])
        if self.chain.nodal:
            turns += self._own_turns(u) + 4 * u * (1 - u) * self.bow
        return self.phi[0] + ca.sum1(turns)

    @property
    def start_direction(self) -> ca.SX:
        """Heading at the start [rad]: nodal for arcs, of the first link for links."""
        return self.phi[0]

    @property
    def end_direction(self) -> ca.SX:
        """Heading at the end [rad]: nodal for arcs, of the last link for links."""
        return self.phi[self.chain.n_headings - 1]

    @property
    def first_moment(self) -> ca.SX:
        """Integral of position over the material length (2,) [m^2].

        By parts: int r ds = L r(0) + int (L - s) dr/ds ds, a sum of terms of single elements.
        """
        h, n = self.chain.h, self.chain.n
        rule = [(0.5, 1.0)]
        if self.chain.nodal:
            rule = list(zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True))
        total = self.chain.length * self.start
        for node, weight in rule:
            arm = weight * h * h * (n - node - np.arange(n))
            total += (ca.DM(arm).T @ self._tangents(node)).T
        return total
