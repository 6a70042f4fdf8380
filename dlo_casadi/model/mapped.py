"""A CasADi function called with NumPy's memory, for all segments of a pose at once."""

from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray


class Mapped:
    """A CasADi function of a segment (or node), mapped over a pose and called pose by pose.

    It reads and writes NumPy's memory: a conversion to CasADi's matrices takes several times as
    long as the evaluation.
    """

    def __init__(self, function: ca.Function, count: int) -> None:
        self._shapes = [
            (count, function.size2_out(i), function.size1_out(i)) for i in range(function.n_out())
        ]
        mapped = function.map(count) if count > 1 else function
        # Any: by CasADi's stubs a buffer does not take NumPy's memory.
        self._buffer: Any
        self._buffer, self._run = mapped.buffer()

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Arguments (m, count, rows) -> outputs (m, count, rows, columns)."""
        given = [np.ascontiguousarray(block, dtype=float) for block in arguments]
        m = len(given[0])
        outputs = [np.zeros((m, *shape)) for shape in self._shapes]
        for j in range(m):
            for i, block in enumerate(given):
                self._buffer.set_arg(i, memoryview(block[j]))
            for i, out in enumerate(outputs):
                self._buffer.set_res(i, memoryview(out[j]))
            self._run()
        return [out.transpose(0, 1, 3, 2) for out in outputs]
