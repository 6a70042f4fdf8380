"""Process many sessions or poses: tables that survive interruptions, and an overview page."""

from typing import Any

from dlo_casadi.errors import library


def parquet_library() -> tuple[Any, ...]:
    """The Parquet library and its Parquet module; raises DloError without it."""
    return tuple(library(name, "table", "tables") for name in ("pyarrow", "pyarrow.parquet"))
