"""Clips of a cable in motion: nodes at arc lengths of their own, held in place and direction.

In motion every segment has a force of its own, so that a clip adds nothing to the segments: they
are those of the cable without clips, on a mesh with a node at each clip. What a clip holds of its
node is no unknown, and its force is what the balance of the node leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clipped import Clipped, alike, rolled_with
from dlo_casadi.model.stacked import Beyond
from dlo_casadi.rod.chain import moved_rest


@dataclass(frozen=True, eq=False)
class Anchors:
    """The mesh of a clipped cable, and what its clips hold.

    Parameters
    ----------
    along : (n_nodes,) [m]
        Arc lengths of the nodes.
    nodes : (k,)
        Those at the clips.
    places : (k, dimension) [m]
    frames : (k, coordinates)
        Of clips that hold a direction.
    blocked : (k, increment)
        Which turns of its node, about the node's own axes, a clip holds.
    pull : (n_segments, dimension) [N]
        Part of the force in the segments that the clips add in the shape at rest.
    """

    along: FloatArray
    nodes: IntArray
    places: FloatArray
    frames: FloatArray
    blocked: BoolArray
    pull: FloatArray

    @classmethod
    def of(
        cls,
        model: CableModel,
        p: FloatArray,
        rest: FloatArray,
        eq: Equilibrium,
        pose: HeldPose,
    ) -> Anchors:
        """The clips of a cable in an equilibrium."""
        own = Assembly(model, eq.shapes, Inputs.of(p, rest, pose.vector[None]))
        clipped: Clipped = own.clipped
        nodes, x = clipped.nodes[0], clipped.in_frames(eq.x[None])[0]
        blocked = np.array([kind.rotations(model.node) for kind in model.clips])
        lam = np.broadcast_to(eq.multipliers, (1, model.chain.n_segments, len(eq.multipliers)))
        beyond = Beyond.of(model, clipped.before)
        pull = beyond.summed(lam)[0][:, beyond.rows[1]]
        if model.end_pull:
            pull = pull - eq.multipliers[model.end_pull]
        places = own.nodes()[0, nodes]
        return cls(clipped.places[0], nodes, places, x[nodes], blocked, pull)

    def released(self) -> Anchors:
        """The same mesh, held by no clip."""
        kept = {name: getattr(self, name)[:0] for name in ("nodes", "places", "frames", "blocked")}
        return replace(self, **kept, pull=np.zeros_like(self.pull))

    def like(self, other: Anchors) -> bool:
        """Whether both have the same nodes, at the same arc lengths."""
        same = np.array_equal(self.nodes, other.nodes) and len(self.along) == len(other.along)
        return same and np.allclose(self.along, other.along, rtol=0, atol=1e-9)

    def segments(self, model: CableModel) -> FloatArray:
        """Rows of the segments (n_segments, 6), see `Layout.segments`."""
        low, width = self.along[:-1], np.diff(self.along)
        full, mesh = np.ones_like(low), np.full_like(low, model.chain.h)
        return np.stack([low, width, low, width, full, mesh], axis=1)

    def rest_inside(self, model: CableModel, even: FloatArray) -> FloatArray:
        """Rest strains (n_segments, 3 strains) [1/m] inside, given those of the even elements."""
        x = (self.along[:-1] + self.along[1:]) / 2 - model.chain.layout.segments[:, 0]
        x, w = x / model.chain.h - 0.5, np.diff(self.along) / model.chain.h
        parts = (moved_rest(even[:, k : k + 3].T, x, w) for k in range(0, even.shape[1], 3))
        return np.stack([row for part in parts for row in part], axis=1)

    def held(self, x: FloatArray) -> FloatArray:
        """Nodes (n_nodes, coordinates), at clips that hold a direction with their frames."""
        x = x.copy()
        for node, frame, blocked in zip(self.nodes, self.frames, self.blocked, strict=True):
            if not blocked.any():
                continue
            rolls = frame[None] if blocked.all() else rolled_with(frame[None], x[[node]])
            x[node] = alike(rolls, x[[node]])[0]
        return x
