"""Rows on the disk: one small file per session, folded into one Parquet table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dlo_casadi import __version__
from dlo_casadi.errors import DloError
from dlo_casadi.fleet.columns import COLUMNS, SCHEMA, Row
from dlo_casadi.io.files import write_file

if TYPE_CHECKING:
    import pyarrow

TABLE = "table.parquet"
_ROWS = "rows"


def row_file(output: Path, key: str) -> Path:
    """Where the row of a session lies."""
    return output / _ROWS / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.json"


def write_row(output: Path, row: Row) -> None:
    """Write a session's row; it is durable when this returns. A second one replaces the first."""
    write_file(row_file(output, row["session"]), json.dumps(row, allow_nan=False))


def read_row(output: Path, key: str, digest: str) -> Row | None:
    """Read the row of a session if it belongs to what the session is now."""
    try:
        row: Row = json.loads(row_file(output, key).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    valid = isinstance(row, dict) and row.keys() == COLUMNS.keys()
    return row if valid and (row["session"], row["config_hash"]) == (key, digest) else None


def write_table(output: Path, rows: Iterable[Row]) -> Path:
    """Write all rows, in the order of their keys, into one table: equal rows, equal bytes."""
    pyarrow, parquet = parquet_library()
    table = pyarrow.Table.from_pylist(
        sorted(rows, key=lambda row: str(row["session"])), schema=arrow_schema()
    )
    path = output / TABLE
    write_file(path, lambda stream: parquet.write_table(table, stream))
    return path


def parquet_library() -> tuple[Any, Any]:
    """The library that writes Parquet.

    Raises
    ------
    DloError
        If it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise DloError("tables need pyarrow.\n  Try: pip install 'dlo-casadi[table]'") from None
    return pyarrow, pyarrow.parquet


def arrow_schema() -> pyarrow.Schema:
    """Types and units of the columns."""
    pa, _ = parquet_library()
    values = [("name", pa.string()), ("value", pa.float64()), ("std", pa.float64())]
    parameters = pa.list_(pa.struct([*values, ("unit", pa.string())]))
    numbers = ("p_value", "rmse_cross_validated_before", "rmse_cross_validated_after")
    kinds = {
        "text": pa.string(),
        "number": pa.float64(),
        "count": pa.int64(),
        "truth": pa.bool_(),
        "texts": pa.list_(pa.string()),
        "numbers": pa.list_(pa.float64()),
        "parameters": parameters,
        "effects": pa.list_(
            pa.struct(
                [
                    ("name", pa.string()),
                    *((name, pa.float64()) for name in numbers),
                    ("indistinguishable_from", pa.list_(pa.string())),
                    ("parameters", parameters),
                ]
            )
        ),
    }
    fields = [
        pa.field(name, kinds[kind], metadata={"unit": unit} if unit else None)
        for name, (kind, unit) in COLUMNS.items()
    ]
    return pa.schema(fields, metadata={"schema": SCHEMA, "dlo_casadi": __version__})
