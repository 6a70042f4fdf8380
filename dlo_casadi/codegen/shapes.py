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
    "turns_shed",
)


@dataclass(frozen=True)
class Shape:
    """Shape of the cable in one pose, as in the C header.

    Parameters
    ----------
    points : (n + 1, dimension) [m]
    x : (n_nodes, coordinates)
        States of the nodes: in a plane headings [rad], in space unit quaternions (x, y, z, w).
    start_force, end_force : (dimension,) [N]
        Of the cable on whatever holds its start and its end.
    moments : (2, increment) [N m]
        Of the cable on its clamps (start, end), in space about the world's axes.
    energy : float [J]
    min_bend_radius : float [m]
    max_twist : float [1/m]
        Largest twist of an element, with its sign; 0 in a plane.
    end_error : float [m]
    imbalance : float [N m]
    iterations : int
    turn : int
        +1 counter-clockwise from start to end, -1 clockwise; 0 in space.
    status : str
        One of STATUSES; all numbers are zero unless it is "ok".
    """

    points: FloatArray
    x: FloatArray
    start_force: FloatArray
    end_force: FloatArray
    moments: FloatArray
    energy: float
    min_bend_radius: float
    max_twist: float
    end_error: float
    imbalance: float
    iterations: int
    turn: int
    status: str


@dataclass(frozen=True)
class ShapePath:
    """Shapes along a path of poses.

    `shapes` has one shape per pose; `first_jump` is the first pose that cannot be reached on
    the held branch, None if there is none.
    """

    shapes: tuple[Shape, ...]
    first_jump: int | None


@dataclass(frozen=True)
class Slope:
    """Derivatives of a shape by k numbers of its pose, last index.

    In a plane by end x, y [m], start heading, end heading [rad], k = 4. In space by start x, y, z
    [m], the rotation of the start about the world's axes x, y, z [rad], and the same of the end,
    k = 12.

    Parameters
    ----------
    points : (n + 1, dimension, k)
    rotations : (n_nodes, increment, k)
        Of the nodes, in space about the world's axes.
    end_force : (dimension, k)
    moments : (2, increment, k)
    min_bend_radius : (k,)
    """

    points: FloatArray
    rotations: FloatArray
    end_force: FloatArray
    moments: FloatArray
    min_bend_radius: FloatArray
