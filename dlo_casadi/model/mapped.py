"""A CasADi function called with NumPy's memory, for all segments of poses at once."""

from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray

# Poses that are evaluated in one call, which costs as much as the evaluation of a few segments.
TOGETHER = 64


class Mapped:
    """A CasADi function of a segment (or node), mapped over the segments of poses.

    It reads and writes NumPy's memory: a conversion to CasADi's matrices takes several times as
    long as the evaluation.
    """

    def __init__(self, function: ca.Function, count: int) -> None:
        self._function, self._count = function, count
        self._shapes = [
            (count, function.size2_out(i), function.size1_out(i)) for i in range(function.n_out())
        ]
        # By numbers of poses. Any, here and below: by the stubs a buffer takes no NumPy memory.
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
