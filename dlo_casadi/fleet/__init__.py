"""Many sessions or poses: tables that survive interruptions, and an overview page of sessions."""

from typing import Any

from dlo_casadi.errors import DloError


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
