"""Unknowns, inputs and directions of many poses, stacked in arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.rod.band import BandMatrix
from dlo_casadi.rod.ends import deviation_names
from dlo_casadi.rod.node import Frame, Heading

_NODES = {node.coordinates: node for node in (Heading, Frame)}


@dataclass(frozen=True)
class Shapes:
    """Stacked unknowns of m poses.

    Parameters
    ----------
    x : (m, n_nodes, coordinates)
        States of the nodes: of a planar cable, headings [rad].
    lam : (m, n_border)
        Multipliers of the end conditions; places and multipliers of springs.
    deviation : (m, n_deviations)
        Unknowns that each pose has of its own, see `deviation_names`.
    """

    x: FloatArray
    lam: FloatArray
    deviation: FloatArray

    @classmethod
    def declared(cls, x: FloatArray, lam: FloatArray, clips: int = 0) -> Shapes:
        """Shapes without deviations from the declared ends and that number of clips."""
        return cls(x, lam, np.zeros((len(x), len(deviation_names(_NODES[x.shape[-1]], clips)))))

    def subset(self, index: Any) -> Shapes:
        """Shapes of some of the poses."""
        return Shapes(self.x[index], self.lam[index], self.deviation[index])


@dataclass(frozen=True)
class Inputs:
    """Inputs of the equilibria of m poses.

    `p` (m, n_parameters), `rest` (m, n_rests) [1/m], `poses` (m, n_pose) as declared.
    """

    p: FloatArray
    rest: FloatArray
    poses: FloatArray

    @classmethod
    def of(cls, p: FloatArray, rest: FloatArray, poses: FloatArray) -> Inputs:
        """Parameters and rest curvature of each pose, or the same for all."""
        m = len(poses)
        return cls(
            np.broadcast_to(p, (m, p.shape[-1])), np.broadcast_to(rest, (m, rest.shape[-1])), poses
        )

    def subset(self, index: Any) -> Inputs:
        """Those of some of the poses."""
        return Inputs(self.p[index], self.rest[index], self.poses[index])


@dataclass(frozen=True)
class Tangents:
    """Derivatives of the shapes and inputs of m poses along q directions.

    `x` (m, n_nodes, b, q) increments of the nodes, `lam` (m, k, q), `p` (m, n_parameters, q),
    `rest` (m, n_rests, q), `deviation` (m, n_deviations, q). `tangent`: the tangent matrices from
    which those of the shapes were solved, if they were.
    """

    x: FloatArray
    lam: FloatArray
    p: FloatArray
    rest: FloatArray
    deviation: FloatArray
    tangent: BandMatrix | None = None
