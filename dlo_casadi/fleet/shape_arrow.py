"""Columns of a table of shapes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.shapes import STATUSES
from dlo_casadi.fleet.shape_poses import COLUMNS
from dlo_casadi.model.cable_model import CableModel

if TYPE_CHECKING:
    import pyarrow


_UNITS = {
    "force": "N",
    "moment": "N m",
    "energy": "J",
    "start_heading": "rad",
    "end_heading": "rad",
}


def _pose_columns(model: CableModel) -> list[str]:
    """Columns of a pose that have a meaning for this boundary."""
    held = {
        "start": ("start_x", "start_y"),
        "end": () if model.end == "free" else ("end_x", "end_y"),
    }
    clamped = [f"{side}_heading" for side in held if getattr(model, side) == "clamped"]
    return [name for name in COLUMNS if name in (*held["start"], *held["end"], *clamped)]


def _result_columns(model: CableModel) -> dict[str, tuple[str, Any]]:
    """Column -> field of a part and its component."""
    sides = ("start", "end")
    return {
        "energy": ("energy", ...),
        **{
            f"force_on_{side}_{x}": (f"{side}_force", np.s_[:, k])
            for side in sides
            for k, x in enumerate("xy")
        },
        **{
            f"moment_on_{side}": ("moments", np.s_[:, k])
            for k, side in enumerate(sides)
            if getattr(model, side) == "clamped"
        },
        "min_bend_radius": ("min_bend_radius", ...),
    }


def _unit(name: str) -> str:
    return _UNITS.get(name) or _UNITS.get(name.split("_")[0], "m")


def table_schema(model: CableModel, metadata: dict[str, Any]) -> pyarrow.Schema:
    """Types and units of the columns; numbers of poses without a shape are null."""
    import pyarrow as pa

    numbers = [*_pose_columns(model), *_result_columns(model)]
    fields = [pa.field(name, pa.float64(), metadata={"unit": _unit(name)}) for name in numbers]
    fields.insert(
        len(_pose_columns(model)), pa.field("status", pa.dictionary(pa.int8(), pa.string()))
    )
    points = pa.list_(pa.float32(), 2 * (model.n + 1))
    order = "x and y of the nodes in turn, from start to end"
    fields.append(pa.field("points", points, metadata={"unit": "m", "order": order}))
    said = {
        "cable": model.cable.name,
        "length_m": model.cable.length,
        "n": model.n,
        "element": model.element,
        "boundary": [model.start, model.end],
        **metadata,
    }
    texts = {key: item if isinstance(item, str) else json.dumps(item) for key, item in said.items()}
    return pa.schema(fields, metadata=texts)


def table_of(part: NDArray[np.void], schema: pyarrow.Schema, model: CableModel) -> pyarrow.Table:
    """A chunk as a table."""
    import pyarrow as pa

    lost = part["status"] != 0
    columns: dict[str, Any] = {
        name: part["pose"][:, COLUMNS.index(name)].copy() for name in _pose_columns(model)
    }
    columns["status"] = pa.DictionaryArray.from_arrays(part["status"].copy(), list(STATUSES))
    for name, (field, k) in _result_columns(model).items():
        columns[name] = pa.array(part[field][k].copy(), mask=lost)
    points = pa.array(part["points"].ravel())
    columns["points"] = pa.FixedSizeListArray.from_arrays(
        points, 2 * (model.n + 1), mask=pa.array(lost)
    )
    return pa.table(columns, schema=schema)
