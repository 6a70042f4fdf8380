"""Elements whose heading runs from node to node: arcs, if the cable is round at rest."""

from __future__ import annotations

import casadi as ca
import numpy as np

from dlo_casadi.rod.element import Element, Layout, Segment
from dlo_casadi.rod.node import Heading


class Arc(Element):
    """Between nodal headings the heading is linear, and follows the rest shape's own variation.

        phi(u) = phi_0 + u (phi_1 - phi_0) + own(u)

    with own(u) the integral of the rest curvature's linear and quadratic variation inside the
    element, which vanishes at both ends.
    """

    name = "arc"
    plain = "arc"
    nodes_are = "at the nodes"
    node = Heading
    order = 2
    smooth = True
    # Three Gauss points integrate cos and sin of a heading that turns by d in one element with an
    # error below d^6 / 2e6.
    rule = (
        np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)]),
        np.array([5.0, 8.0, 5.0]) / 18.0,
    )

    def layout(self, length: float, n: int, clamped: tuple[bool, bool]) -> Layout:
        """Nodes at the element boundaries."""
        nodes = np.linspace(0.0, length, n + 1)
        width = np.full(n, length / n)
        segments = np.column_stack([nodes[:-1], width, nodes[:-1], width, np.ones(n)])
        return Layout(nodes, segments, np.stack([np.arange(n + 1)] * 2, axis=1))

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
