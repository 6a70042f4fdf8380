"""Unknowns, inputs and directions of many poses in arrays, and functions mapped over them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
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
        """Shapes with ends and that number of clips as declared, without deviations."""
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
        """Inputs from parameters and rest curvature of each pose, or the same for all."""
        m = len(poses)
        return cls(
            np.broadcast_to(p, (m, p.shape[-1])), np.broadcast_to(rest, (m, rest.shape[-1])), poses
        )

    def subset(self, index: Any) -> Inputs:
        """Inputs of some of the poses."""
        return Inputs(self.p[index], self.rest[index], self.poses[index])


@dataclass(frozen=True)
class Tangents:
    """Derivatives of the shapes and inputs of m poses along q directions.

    `x` (m, n_nodes, b, q) increments of the nodes, `lam` (m, k, q), `p` (m, n_parameters, q),
    `rest` (m, n_rests, q), `deviation` (m, n_deviations, q). `tangent`: the tangent matrices with
    which the derivatives of the shapes were solved, if any.
    """

    x: FloatArray
    lam: FloatArray
    p: FloatArray
    rest: FloatArray
    deviation: FloatArray
    tangent: BandMatrix | None = None


# Number of poses evaluated in one call; a call costs as much as evaluating a few segments.
TOGETHER = 64


class Mapped:
    """A CasADi function of a segment (or node), mapped over the segments of poses.

    It reads and writes NumPy's memory, because conversion to CasADi's matrices takes several times
    as long as the evaluation.
    """

    def __init__(self, function: ca.Function, count: int) -> None:
        self._function, self._count = function, count
        self._shapes = [
            (count, function.size2_out(i), function.size1_out(i)) for i in range(function.n_out())
        ]
        # By number of poses. Any, here and below: CasADi's stubs do not allow NumPy memory.
        self._buffers: dict[int, tuple[Any, Any]] = {}

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Arguments (m, count, rows) -> outputs (m, count, rows, columns)."""
        given: list[Any] = [np.ascontiguousarray(block, dtype=float) for block in arguments]
        m = len(given[0])
        outputs: list[Any] = [np.zeros((m, *shape)) for shape in self._shapes]
        for first in range(0, m, TOGETHER):
            some, number = slice(first, first + TOGETHER), min(TOGETHER, m - first)
            if number not in self._buffers:
                self._buffers[number] = self._function.map(number * self._count).buffer()
            buffer, run = self._buffers[number]
            for i, block in enumerate(given):
                buffer.set_arg(i, memoryview(block[some]))
            for i, out in enumerate(outputs):
                buffer.set_res(i, memoryview(out[some]))
            run()
        return [out.transpose(0, 1, 3, 2) for out in outputs]
