"""Poses to solve: a grid or a list, handed out in chunks and never held as a whole."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import DloError

FloatArray = NDArray[np.floating]

# Columns of a pose, as the compiled solver takes them [m, m, m, m, rad, rad].
COLUMNS = ("start_x", "start_y", "end_x", "end_y", "start_heading", "end_heading")
# The same in the header of a list.
HEADER = tuple(f"{name}_rad" if name.endswith("heading") else f"{name}_m" for name in COLUMNS)


class Poses(Protocol):
    """Poses in their order."""

    @property
    def count(self) -> int:
        """How many there are."""

    @property
    def identity(self) -> Mapping[str, Any]:
        """What decides them, as plain data."""

    def chunks(self, size: int) -> Iterator[FloatArray]:
        """Arrays (size, 6) with the columns COLUMNS; the last may be shorter."""


@dataclass(frozen=True)
class Grid:
    """End positions on a grid, x fastest.

    Parameters
    ----------
    x, y : (float, float, int) [m, m, -]
        First, last and number of places.
    fixed : dict
        Start [m] and headings [rad] of all poses, by COLUMNS.
    """

    x: tuple[float, float, int]
    y: tuple[float, float, int]
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, (first, last, number) in (("X", self.x), ("Y", self.y)):
            if number < 1 or number != int(number) or not np.all(np.isfinite([first, last])):
                raise DloError(
                    f"--grid: {name}0 {name}1 N{name} are two finite numbers [m] and a whole "
                    f"number of places, found {first:g} {last:g} {number:g}"
                )

    @property
    def count(self) -> int:
        """How many there are."""
        return int(self.x[2]) * int(self.y[2])

    @property
    def identity(self) -> Mapping[str, Any]:
        """What decides them, as plain data."""
        return {"grid_x": list(self.x), "grid_y": list(self.y), "fixed": dict(self.fixed)}

    def chunks(self, size: int) -> Iterator[FloatArray]:
        """Arrays (size, 6); the last may be shorter."""
        x, y = np.linspace(*self.x), np.linspace(*self.y)
        for begin in range(0, self.count, size):
            index = np.arange(begin, min(begin + size, self.count))
            poses = _fixed(len(index), self.fixed)
            poses[:, 2] = x[index % len(x)]
            poses[:, 3] = y[index // len(x)]
            yield poses


@dataclass(frozen=True)
class PoseList:
    """Poses from a CSV or Parquet file.

    Parameters
    ----------
    path : Path
        With the columns end_x_m, end_y_m and, where they differ from pose to pose, start_x_m,
        start_y_m, start_heading_rad, end_heading_rad.
    needed : tuple of str
        Columns that must be there.
    fixed : dict
        Start [m] and headings [rad] of all poses, by COLUMNS; columns of the file go first.

    Raises
    ------
    DloError
        If the file cannot be read, a column is missing or unknown.
    """

    path: Path
    needed: tuple[str, ...] = ("end_x_m", "end_y_m")
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            names = self._reader()[0]
        except (OSError, ValueError) as error:
            raise DloError(f"--list {self.path}: {error}") from None
        missing = [name for name in self.needed if name not in names]
        unknown = [name for name in names if name not in HEADER]
        if missing or unknown:
            said = [f"{', '.join(missing)} missing"] if missing else []
            said += [f"{', '.join(unknown)} unknown"] if unknown else []
            raise DloError(
                f"--list {self.path}: {'; '.join(said)}.\n  Try: columns {', '.join(HEADER)}; "
                "the first row of a CSV names them."
            )

    @property
    def count(self) -> int:
        """How many there are; of a CSV the number of its lines."""
        if self._is_parquet:
            import pyarrow.parquet as pq

            return int(pq.read_metadata(self.path).num_rows)
        with self.path.open("rb") as stream:
            return max(sum(1 for line in stream if line.strip()) - 1, 0)

    @property
    def identity(self) -> Mapping[str, Any]:
        """What decides them, as plain data."""
        with self.path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return {"list_sha256": digest, "fixed": dict(self.fixed)}

    @property
    def _is_parquet(self) -> bool:
        return self.path.suffix.lower() == ".parquet"

    def _reader(self) -> tuple[list[str], Any]:
        """Names of the columns, and an iterator of record batches."""
        if self._is_parquet:
            import pyarrow.parquet as pq

            file = pq.ParquetFile(self.path)
            return file.schema_arrow.names, file.iter_batches()
        import pyarrow as pa
        from pyarrow import csv

        types = csv.ConvertOptions(column_types=dict.fromkeys(HEADER, pa.float64()))
        reader = csv.open_csv(self.path, convert_options=types)
        return reader.schema.names, reader

    def chunks(self, size: int) -> Iterator[FloatArray]:
        """Arrays (size, 6); the last may be shorter."""
        held: list[FloatArray] = []
        try:
            for batch in self._reader()[1]:
                held.append(self._poses(batch))
                while sum(map(len, held)) >= size:
                    joined = np.concatenate(held)
                    yield joined[:size]
                    held = [joined[size:]]
        except (OSError, ValueError) as error:
            raise DloError(f"--list {self.path}: {error}") from None
        rest = np.concatenate(held) if held else np.zeros((0, len(COLUMNS)))
        if len(rest):
            yield rest

    def _poses(self, batch: Any) -> FloatArray:
        poses = _fixed(batch.num_rows, self.fixed)
        for k, name in enumerate(HEADER):
            if name in batch.schema.names:
                column = batch.column(batch.schema.names.index(name))
                poses[:, k] = column.cast("float64").to_numpy(zero_copy_only=False)
        return poses


def _fixed(count: int, fixed: Mapping[str, float]) -> FloatArray:
    return np.tile([float(fixed.get(name, 0.0)) for name in COLUMNS], (count, 1))
