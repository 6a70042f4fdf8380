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


def _pose_columns(model: CableModel) -> list[str]:
    """Columns of a pose that have a meaning for this boundary."""
    meaningless = {
        f"{side}_heading" for side in ("start", "end") if getattr(model, side) != "clamped"
    }
    if model.end == "free":
        meaningless |= {"end_x", "end_y"}
    return [name for name in COLUMNS if name not in meaningless]


def _result_columns(model: CableModel) -> dict[str, tuple[str, int | None]]:
    """Column -> field of a part and its component."""
    columns: dict[str, tuple[str, int | None]] = {"energy": ("energy", None)}
    for side in ("start", "end"):
        for k, axis in enumerate("xy"):
            columns[f"force_on_{side}_{axis}"] = (f"{side}_force", k)
    for k, side in enumerate(("start", "end")):
        if getattr(model, side) == "clamped":
            columns[f"moment_on_{side}"] = ("moments", k)
    columns["min_bend_radius"] = ("min_bend_radius", None)
    return columns


def _unit(name: str) -> str:
    if name.startswith("force"):
        return "N"
    if name.startswith("moment"):
        return "N m"
    if name.endswith("heading"):
        return "rad"
    return "J" if name == "energy" else "m"


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
        values = part[field] if k is None else part[field][:, k]
        columns[name] = pa.array(values.copy(), mask=lost)
    points = pa.array(part["points"].ravel())
    columns["points"] = pa.FixedSizeListArray.from_arrays(
        points, 2 * (model.n + 1), mask=pa.array(lost)
    )
    return pa.table(columns, schema=schema)
