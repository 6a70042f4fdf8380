"""Fixtures and a cable at one instant; a banded matrix to solve with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from dlo_casadi.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Fixtures:
    """Where the fixtures are at one instant.

    Parameters
    ----------
    pose : (n_pose,)
        See `HeldPose.vector`.
    places, velocities, accelerations : (2 + clips, dimension) [m, m/s, m/s^2]
        True ones of the cable's start and end, then of clips; of a free end they mean nothing.
    """

    pose: FloatArray
    places: FloatArray
    velocities: FloatArray
    accelerations: FloatArray


@dataclass(frozen=True, eq=False)
class State:
    """A cable in motion at one instant.

    Parameters
    ----------
    x, r : (n_nodes, coordinates), (n_nodes, dimension) [m]
        Frames and places of the nodes.
    w, v : (n_nodes, increment) [rad/s], (n_nodes, dimension) [m/s]
        Body rates and velocities.
    alpha, a : likewise [rad/s^2], [m/s^2]
    force : (n_segments, dimension (1 + 2 n_springs))
        See `MovingSegment`.
    moment : (n_n_multipliers,) [N m]
        Multipliers of the directions that the ends hold: of the start, then of the end.
    """

    x: FloatArray
    r: FloatArray
    w: FloatArray
    v: FloatArray
    alpha: FloatArray
    a: FloatArray
    force: FloatArray
    moment: FloatArray


class Banded:
    """A banded matrix, factorised for any number of right-hand sides."""

    def __init__(self, band: FloatArray, width: int) -> None:
        self._width = width
        self._lu, self._pivots, self.singular = lapack.dgbtrf(band, width, width)

    def solve(self, right: FloatArray, *, transposed: bool = False) -> FloatArray:
        """Solution of right-hand sides (N,) or (N, q)."""
        rows = right if right.ndim == 2 else right[:, None]
        found, _ = lapack.dgbtrs(
            self._lu, self._width, self._width, rows, self._pivots, trans=int(transposed)
        )
        return np.asarray(found.reshape(right.shape))
