"""Many sessions or poses: tables that survive interruptions, and an overview page of sessions."""

from typing import Any

from dlo_casadi.errors import library


def parquet_library() -> tuple[Any, ...]:
    """The library that writes Parquet, and its module for that; DloError without it."""
    return tuple(library(name, "table", "tables") for name in ("pyarrow", "pyarrow.parquet"))
