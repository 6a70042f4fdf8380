"""What the compiled solver returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

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
    "turns_shed",
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
class SpaceShape:
    """Shape of a cable in space in one pose, as in the C header.

    Parameters
    ----------
    points : (n + 1, 3) [m]
    frames : (n + 1, 4)
        Material frames of the nodes: unit quaternions (x, y, z, w).
    lam_start, lam : (3,) [N]
        Force of the cable on whatever holds its start and its end.
    moments : (2, 3) [N m]
        Of the cable on its clamps, about the world's axes.
    energy : float [J]
    min_bend_radius : float [m]
    max_twist : float [1/m]
        Largest twist of an element, with its sign.
    end_error : float [m]
    imbalance : float [N m]
    iterations : int
    status : str
        One of STATUSES; all numbers are zero unless it is "ok".
    """

    points: FloatArray
    frames: FloatArray
    lam_start: FloatArray
    lam: FloatArray
    moments: FloatArray
    energy: float
    min_bend_radius: float
    max_twist: float
    end_error: float
    imbalance: float
    iterations: int
    status: str


S_co = TypeVar("S_co", bound=Shape | SpaceShape, covariant=True)


@dataclass(frozen=True)
class ShapePath(Generic[S_co]):
    """Shapes along a path of poses.

    `shapes` has one shape per pose; `first_jump` is the first pose that cannot be reached on
    the held branch, None if there is none.
    """

    shapes: tuple[S_co, ...]
    first_jump: int | None


@dataclass(frozen=True)
class Slope:
    """Derivatives by (end x, end y, start heading, end heading), last index.

    `points` (n + 1, 2, 4), `headings` (n_nodes, 4), `lam` (2, 4), `moments` (2, 4),
    `min_bend_radius` (4,).
    """

    points: FloatArray
    headings: FloatArray
    lam: FloatArray
    moments: FloatArray
    min_bend_radius: FloatArray


@dataclass(frozen=True)
class SpaceSlope:
    """Derivatives of a shape in space by the pose, last index (12,).

    By start x, y, z [m], turn of the start about the world's axes x, y, z [rad], and the same of
    the end. `points` (n + 1, 3, 12), `turns` (n + 1, 3, 12) of the frames about the world's axes,
    `lam` (3, 12), `moments` (2, 3, 12), `min_bend_radius` (12,).
    """

    points: FloatArray
    turns: FloatArray
    lam: FloatArray
    moments: FloatArray
    min_bend_radius: FloatArray
