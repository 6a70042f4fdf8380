"""What the compiled solver returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]

# As in the header.
STATUSES = (
    "ok",
    "unreachable",
    "iteration_limit",
    "not_finite",
    "unstable",
    "workspace_too_small",
    "bad_argument",
    "other_branch",
)


@dataclass(frozen=True)
class Shape:
    """Shape of the cable in one pose, as in the C header.

    Parameters
    ----------
    points : (n + 1, 2) [m]
    headings : (n_nodes,) [rad]
    lam_start, lam : (2,) [N]
        Force of the cable on whatever holds its start and its end.
    moments : (2,) [N m]
    energy : float [J]
    min_bend_radius : float [m]
    end_error : float [m]
    imbalance : float [N m]
    iterations : int
    turn : int
        +1 counter-clockwise from start to end, -1 clockwise.
    status : str
        One of STATUSES; all numbers are zero unless it is "ok".
    """

    points: FloatArray
    headings: FloatArray
    lam_start: FloatArray
    lam: FloatArray
    moments: FloatArray
    energy: float
    min_bend_radius: float
    end_error: float
    imbalance: float
    iterations: int
    turn: int
    status: str


@dataclass(frozen=True)
class Path2D:
    """Shapes along a path of poses.

    `shapes` has one Shape per pose; `first_jump` is the first pose that cannot be reached on
    the held branch, None if there is none.
    """

    shapes: tuple[Shape, ...]
    first_jump: int | None


@dataclass(frozen=True)
class Slope:
    """Derivatives by (end x, end y, start heading, end heading), last index.

    `points` (n + 1, 2, 4), `headings` (n_nodes, 4), `lam` (2, 4).
    """

    points: FloatArray
    headings: FloatArray
    lam: FloatArray
