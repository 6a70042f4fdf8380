"""Poses to solve, a grid or a list, in chunks that fit into memory."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import DloError
from dlo_casadi.fleet import parquet_library

# Columns of a pose, as the compiled solver takes them [m, m, m, m, rad, rad].
COLUMNS = ("start_x", "start_y", "end_x", "end_y", "start_heading", "end_heading")
# The same in the header of a list.
HEADER = tuple(f"{name}_rad" if name.endswith("heading") else f"{name}_m" for name in COLUMNS)


@dataclass(frozen=True)
class Grid:
    """End positions on a grid, x fastest.

    Parameters
    ----------
    x, y : (float, float, float) [m, m, -]
        First and last place, and the number of places.
    fixed : dict
        Start [m] and headings [rad] of all poses, by COLUMNS.
    """

    x: tuple[float, float, float]
    y: tuple[float, float, float]
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, (first, last, number) in (("X", self.x), ("Y", self.y)):
            if number < 1 or number % 1 or not np.isfinite([first, last]).all():
                raise DloError(
                    f"--grid: {name}0 {name}1 N{name} are two finite numbers [m] and a whole "
                    f"number of places, found {first:g} {last:g} {number:g}"
                )

    @property
    def _axes(self) -> list[tuple[float, float, int]]:
        return [(first, last, int(number)) for first, last, number in (self.x, self.y)]

    @property
    def count(self) -> int:
        """Number of poses."""
        return int(self.x[2]) * int(self.y[2])

    @property
    def identity(self) -> Mapping[str, Any]:
        """Plain data that determine the poses."""
        x, y = self._axes
        return {"grid_x": x, "grid_y": y, "fixed": dict(self.fixed)}

    def chunks(self, size: int) -> Iterator[FloatArray]:
        """Arrays (size, 6); the last may be shorter."""
        x, y = (np.linspace(*axis) for axis in self._axes)
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
            names = self._data.schema.names
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
        """Number of poses."""
        return int(self._data.count_rows())

    @property
    def identity(self) -> Mapping[str, Any]:
        """Plain data that determine the poses."""
        with self.path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return {"list_sha256": digest, "fixed": dict(self.fixed)}

    @property
    def _data(self) -> Any:
        parquet_library()
        from pyarrow import csv, dataset, float64

        types = csv.ConvertOptions(column_types=dict.fromkeys(HEADER, float64()))
        comma = dataset.CsvFileFormat(convert_options=types)
        is_parquet = self.path.suffix.lower() == ".parquet"
        return dataset.dataset(self.path, format="parquet" if is_parquet else comma)

    def chunks(self, size: int) -> Iterator[FloatArray]:
        """Arrays (size, 6); the last may be shorter."""
        held = np.zeros((0, len(COLUMNS)))
        try:
            for batch in self._data.to_batches():
                poses = _fixed(batch.num_rows, self.fixed)
                for name in batch.schema.names:
                    column = batch.column(name).cast("float64")
                    poses[:, HEADER.index(name)] = column.to_numpy(zero_copy_only=False)
                held = np.concatenate([held, poses])
                while len(held) >= size:
                    yield held[:size]
                    held = held[size:]
        except (OSError, ValueError) as error:
            raise DloError(f"--list {self.path}: {error}") from None
        if len(held):
            yield held


def _fixed(count: int, fixed: Mapping[str, float]) -> FloatArray:
    return np.tile([float(fixed.get(name, 0.0)) for name in COLUMNS], (count, 1))
