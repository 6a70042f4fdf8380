"""The symbols that a model's expressions are written in."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca

from dlo_casadi.effects import Viewpoint
from dlo_casadi.model.cable_model import VIEWPOINT_SIZE, CableModel
from dlo_casadi.rod.ends import EndConditions


class Symbols:
    """Unknowns, parameters and numbers of one segment, of the ends and of one pose.

    Parameters
    ----------
    model : CableModel
    """

    def __init__(self, model: CableModel) -> None:
        self.model = model

    def effects_of(self, base: type[Any]) -> list[tuple[Any, dict[str, ca.SX]]]:
        """Effects of one segment of the model with their own parameters."""
        picked = []
        for effect in self.model.effects:
            if isinstance(effect, base):
                local = {
                    parameter.name: self.p[
                        self.model.names.index(f"{effect.label}.{parameter.name}")
                    ]
                    for parameter in effect.parameters(self.model.cable)
                }
                for name in effect.per_pose(self.model.cable):
                    local[name] = self.deviation[self.model.deviation_names.index(name)]
                picked.append((effect, local))
        return picked

    @cached_property
    def p(self) -> ca.SX:
        """Parameters, in the order of `model.names`."""
        return ca.SX.sym("p", len(self.model.parameters))

    @cached_property
    def pose(self) -> ca.SX:
        """What is declared of one pose, see `pose.Pose.vector`."""
        return ca.SX.sym("pose", self.model.n_pose)

    @property
    def declared_ends(self) -> ca.SX:
        """The ends as declared, see `EndConditions.vector`."""
        return self.pose[:-VIEWPOINT_SIZE]

    @property
    def viewpoint(self) -> Viewpoint:
        """From where the points of a pose are measured."""
        start = EndConditions.of(self.declared_ends, self.model.node).start
        return Viewpoint(start, self.pose[-3:-1], self.pose[-1])

    @cached_property
    def deviation(self) -> ca.SX:
        """Deviation of one pose from its declared ends: `deviation_names`."""
        return ca.SX.sym("deviation", len(self.model.deviation_names))

    @cached_property
    def lam(self) -> ca.SX:
        """Border: multipliers of the end conditions, then place and pull of each spring."""
        return ca.SX.sym("lam", self.model.n_border)

    @cached_property
    def nodes(self) -> tuple[ca.SX, ca.SX]:
        """Coordinates of the two nodes of a segment, and their increments."""
        node = self.model.chain.kind.node
        return ca.SX.sym("x", 2 * node.coordinates), ca.SX.sym("delta", 2 * node.increment)

    @cached_property
    def local(self) -> tuple[ca.SX, ca.SX]:
        """Local coordinates of a segment, and their increments: see `Element.local`."""
        return ca.SX.sym("local", self.local_of_nodes.numel()), ca.SX.sym(
            "step", 2 * self.model.node.increment
        )

    @property
    def local_of_nodes(self) -> ca.SX:
        """Local coordinates of a segment, of its nodes."""
        return self.model.chain.kind.local(
            *ca.vertsplit(self.nodes[0], self.model.node.coordinates)
        )

    @cached_property
    def local_slope(self) -> ca.SX:
        """Derivative (2b, 2b) of the local increments by the nodes'."""
        kind, (x, delta) = self.model.chain.kind, self.nodes
        pairs = zip(
            ca.vertsplit(x, self.model.node.coordinates),
            ca.vertsplit(delta, self.model.node.increment),
            strict=True,
        )
        moved = kind.local(*(self.model.node.retract(own, step) for own, step in pairs))
        slope = ca.jacobian(kind.local_gap(self.local_of_nodes, moved), delta)
        return ca.substitute(slope, delta, ca.SX.zeros(delta.shape))

    @cached_property
    def rest_strains(self) -> ca.SX:
        """Rest strains inside a segment, see `Chain.rest_stencils`."""
        return ca.SX.sym("rest", 3 * len(self.model.node.strains))

    @cached_property
    def place(self) -> ca.SX:
        """A row of `Layout.segments`."""
        return ca.SX.sym("place", self.model.chain.layout.segments.shape[1])

    def spring_unknowns(self, k: int) -> tuple[ca.SX, ca.SX]:
        """Place and pull of a spring."""
        d = self.model.node.dimension
        own = self.lam[
            self.model.n_conditions + 2 * d * k : self.model.n_conditions + 2 * d * (k + 1)
        ]
        return own[:d], own[d:]

    @cached_property
    def inner(self) -> ca.SX:
        """Unknowns inside an element that are eliminated from it."""
        return ca.SX.sym("inner", self.model.chain.kind.n_inner)
