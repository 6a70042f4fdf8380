"""Layouts of the structures of the generated C, as NumPy records."""

from __future__ import annotations

from typing import Any

import numpy as np

from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import EndConditions


def pose_size(model: CableModel) -> int:
    """Numbers of the C solver's dlo_pose: both ends, and in space the turns.

    Headings count their turns themselves.
    """
    return EndConditions.size(model.node) + int(model.in_space)


def n_columns(model: CableModel) -> int:
    """Numbers of a pose by which dlo_slope has derivatives; in a plane not of the start."""
    node = model.node
    return 2 * (node.dimension + node.increment) - (0 if model.in_space else node.dimension)


def shape_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_shape."""
    node = model.node
    return _record(
        points=(float, (model.n + 1, node.dimension)),
        x=(float, (model.chain.n_nodes, node.coordinates)),
        start_force=(float, node.dimension),
        end_force=(float, node.dimension),
        moments=(float, (2, node.increment)),
        energy=float,
        min_bend_radius=float,
        max_twist=float,
        end_error=float,
        imbalance=float,
        iterations=np.intc,
        turn=np.intc,
    )


def slope_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_slope."""
    node, k = model.node, n_columns(model)
    return _record(
        points=(float, (model.n + 1, node.dimension, k)),
        rotations=(float, (model.chain.n_nodes, node.increment, k)),
        end_force=(float, (node.dimension, k)),
        moments=(float, (2, node.increment, k)),
        min_bend_radius=(float, k),
    )


def obstacle_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_obstacle."""
    place = (float, model.node.dimension)
    return _record(kind=np.intc, a=place, b=place, radius=float)


def gap_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_gap."""
    d = model.node.dimension
    return _record(
        distance=float,
        place=float,
        point=(float, d),
        normal=(float, d),
        gradient=(float, n_columns(model)),
        obstacle=np.uintp,
    )


def _record(**fields: Any) -> np.dtype[Any]:
    return np.dtype({"names": list(fields), "formats": list(fields.values())}, align=True)
