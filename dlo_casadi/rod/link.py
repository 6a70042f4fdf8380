"""Straight links joined by hinges: the paper's chain."""

from __future__ import annotations

import casadi as ca
import numpy as np

from dlo_casadi.rod.element import Element, Layout, Segment
from dlo_casadi.rod.node import Heading


class Link(Element):
    """Straight links; nodes are in their middles, a clamp is a node of its own.

    Segment j is link j and the hinge at its end, which stands for the cell between the middles of
    links j and j + 1. A clamp bends the half cell between itself and the middle of a link.
    """

    name = "link"
    plain = "link"
    nodes_are = "in the middles of the links, and of the clamps"
    node = Heading
    order = 2
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
