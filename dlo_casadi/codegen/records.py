"""Layouts of the structures of the generated C, as NumPy records."""

from __future__ import annotations

from typing import Any

import numpy as np

from dlo_casadi.model.cable_model import CableModel


def shape_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_shape."""
    n, d = model.n, model.node.dimension
    if model.in_space:
        state: tuple[str, Any] = ("frames", (float, (n + 1, 4)))
        extremes, last = ["min_bend_radius", "max_twist"], ["iterations"]
    else:
        state = ("headings", (float, (model.chain.n_nodes,)))
        extremes, last = ["min_bend_radius"], ["iterations", "turn"]
    fields: dict[str, Any] = {
        "points": (float, (n + 1, d)),
        state[0]: state[1],
        "lam_start": (float, d),
        "lam": (float, d),
        "moments": (float, (2, model.node.increment) if model.in_space else 2),
        "energy": float,
        **dict.fromkeys([*extremes, "end_error", "imbalance"], float),
        **dict.fromkeys(last, np.intc),
    }
    return np.dtype({"names": list(fields), "formats": list(fields.values())}, align=True)


def slope_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_slope."""
    n, k = model.n, model.chain.n_nodes
    if not model.in_space:
        return np.dtype(
            [
                ("points", float, (n + 1, 2, 4)),
                ("headings", float, (k, 4)),
                ("lam", float, (2, 4)),
                ("moments", float, (2, 4)),
                ("min_bend_radius", float, 4),
            ]
        )
    return np.dtype(
        [
            ("points", float, (n + 1, 3, 12)),
            ("turns", float, (n + 1, 3, 12)),
            ("lam", float, (3, 12)),
            ("moments", float, (2, 3, 12)),
            ("min_bend_radius", float, 12),
        ]
    )


def obstacle_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_obstacle."""
    place = (float, model.node.dimension)
    fields: dict[str, Any] = {"kind": np.intc, "a": place, "b": place, "radius": float}
    return np.dtype({"names": list(fields), "formats": list(fields.values())}, align=True)


def gap_record(model: CableModel) -> np.dtype[Any]:
    """Layout of the C solver's dlo_gap."""
    d = model.node.dimension
    fields: dict[str, Any] = {
        "distance": float,
        "place": float,
        "point": (float, d),
        "normal": (float, d),
        "gradient": (float, 12 if model.in_space else 4),
        "obstacle": np.uintp,
    }
    return np.dtype({"names": list(fields), "formats": list(fields.values())}, align=True)
