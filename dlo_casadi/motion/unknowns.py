"""Which unknowns a cable in motion has, and where they are in its balance.

They are ordered along the cable: multipliers of the start's direction, turn and place of node 0,
force of segment 0 and its springs, node 1, ..., multipliers of the end's direction. Places that a
fixture holds are known functions of time and no unknowns, nor are turns that a clip holds.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.motion.anchors import Anchors


class Unknowns:
    """Of a cable on its mesh."""

    def __init__(self, model: CableModel, p: FloatArray, anchors: Anchors | None) -> None:
        self.model, self.p, self.anchors = model, np.asarray(p, float), anchors
        chain, node = model.chain, model.node
        self.n_segments, self.n_nodes = chain.n_segments, chain.n_nodes
        self.b, self.d = node.increment, node.dimension

    @property
    def along(self) -> FloatArray:
        """Arc lengths (n_nodes,) [m] of the nodes."""
        return self.model.chain.places if self.anchors is None else self.anchors.along

    @cached_property
    def layout(self) -> FloatArray:
        """Rows of the segments (n_segments, 6), see `Layout.segments`."""
        if self.anchors is None:
            return self.model.chain.layout.segments
        return self.anchors.segments(self.model)

    @cached_property
    def springs_on(self) -> FloatArray:
        """Which springs are on which segments (n_segments, n_springs): 1 or 0."""
        places = np.array(functions_of(self.model).spring_places(self.p)).ravel()
        low, width = self.layout[:, :2].T
        last = np.arange(self.n_segments) == self.n_segments - 1
        share = (places - low[:, None]) / width[:, None]
        return ((share >= 0) & ((share < 1) | last[:, None])).astype(float)

    @cached_property
    def _condition_rows(self) -> tuple[list[int], list[int]]:
        """Rows of the border of the directions held at the start, and at the end."""
        names = self.model.condition_names
        turns = {f"{side}_{turn}" for side in ("start", "end") for turn in self.model.node.turns}
        rows = [k for k, name in enumerate(names) if name in turns]
        return (
            [k for k in rows if names[k].startswith("start")],
            [k for k in rows if names[k].startswith("end")],
        )

    @cached_property
    def places(self) -> tuple[IntArray, IntArray, IntArray, int]:
        """Unknowns of nodes, forces, moments; their number. -1 for what is no unknown."""
        b, d, count = self.b, self.d, 0
        start, end = self._condition_rows
        nodes = np.full((self.n_nodes, b + d), -1)
        forces = np.full((self.n_segments, d * (1 + 2 * self.model.n_springs)), -1)
        moments = np.full(len(start) + len(end), -1)

        def take(rows: IntArray) -> None:
            nonlocal count
            rows[...] = np.arange(count, count + rows.size).reshape(rows.shape)
            count += rows.size

        free = np.ones(nodes.shape, dtype=bool)
        for _, node in self.held:
            free[node, b:] = False
        if self.anchors is not None:
            free[self.anchors.nodes, :b] = ~self.anchors.blocked
        take(moments[: len(start)])
        for i in range(self.n_nodes):
            own = np.arange(count, count + free[i].sum())
            nodes[i, free[i]], count = own, count + len(own)
            if i < self.n_segments:
                take(forces[i, :d])
                for k in np.flatnonzero(self.springs_on[i]):
                    take(forces[i, d * (1 + 2 * k) : d * (3 + 2 * k)])
        take(moments[len(start) :])
        return nodes, forces, moments, count

    def steps(self, solution: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Increments of turns, places, forces, moments in solutions (N, ...); zero where held."""
        nodes, forces, moments, _ = self.places
        known = np.concatenate([solution, np.zeros((1, *solution.shape[1:]))])
        return known[nodes[:, : self.b]], known[nodes[:, self.b :]], known[forces], known[moments]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.places[3]

    @cached_property
    def index(self) -> tuple[IntArray, IntArray]:
        """Unknowns of each segment (n_segments, L), of the ends (2 b + moments,); -1 for none."""
        nodes, forces, moments, _ = self.places
        b = self.b
        first, last = nodes[:-1], nodes[1:]
        of_segment = np.hstack([first[:, :b], last[:, :b], first[:, b:], last[:, b:], forces])
        return of_segment, np.concatenate([nodes[0, :b], nodes[-1, :b], moments])

    @cached_property
    def width(self) -> int:
        """Half width of the band."""
        widest = 0
        of_segment, at_ends = self.index
        start = len(self._condition_rows[0])
        b = self.b
        sides = (
            np.concatenate([at_ends[:b], at_ends[2 * b : 2 * b + start]]),
            np.concatenate([at_ends[b : 2 * b], at_ends[2 * b + start :]]),
        )
        for row in (*of_segment, *sides):
            known = row[row >= 0]
            widest = max(widest, int(np.ptp(known)))
        return widest

    @cached_property
    def _scatter(self) -> tuple[IntArray, IntArray]:
        """Flat places in the band of the matrices of segments and ends; the last one for none."""
        own = []
        for index in (self.index[0], self.index[1][None]):
            rows, columns = index[:, :, None], index[:, None, :]
            inside = (rows >= 0) & (columns >= 0) & (np.abs(rows - columns) <= self.width)
            flat = (2 * self.width + rows - columns) * self.size + columns
            own.append(np.where(inside, flat, (3 * self.width + 1) * self.size).ravel())
        return own[0], own[1]

    @property
    def held(self) -> list[tuple[int, int]]:
        """Which fixture (0: start, 1: end, then clips) holds the place of which node."""
        ends = [(0, 0), (1, self.n_nodes - 1)] if self.model.end.place else [(0, 0)]
        return ends if self.anchors is None else [*ends, *enumerate(self.anchors.nodes.tolist(), 2)]

    @property
    def held_turns(self) -> list[int]:
        """Rows of the border of all directions that the ends hold."""
        start, end = self._condition_rows
        return [*start, *end]

    @property
    def n_moments(self) -> int:
        """Number of directions that the ends hold."""
        return len(self.places[2])
