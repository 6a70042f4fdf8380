"""Solve a fitted cable in very many poses (a grid or a list), in chunks, into one file."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dlo_casadi import __version__
from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen import STATUSES, CompiledSolver
from dlo_casadi.codegen.generate import solver_hash
from dlo_casadi.codegen.shapes import Branch, records_of
from dlo_casadi.errors import DloError, counted
from dlo_casadi.fleet import parquet_library
from dlo_casadi.io.files import LOCK, only_run, write_file
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.runtime.parallel import Tally, map_as_completed

if TYPE_CHECKING:
    import pyarrow

# Columns of a pose, as the compiled solver takes them [m, m, m, m, rad, rad].
COLUMNS = ("start_x", "start_y", "end_x", "end_y", "start_heading", "end_heading")
# Names of the same columns in the header of a list.
HEADER = tuple(f"{name}_rad" if name.endswith("heading") else f"{name}_m" for name in COLUMNS)


@dataclass(frozen=True)
class Grid:
    """End positions on a grid, x fastest.

    Parameters
    ----------
    x, y : (float, float, float) [m, m, -]
        First place, last place, number of places.
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
        """Plain data that identify the poses."""
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
        Required columns.
    fixed : dict
        Start [m] and headings [rad] of all poses, by COLUMNS; columns of the file take precedence.

    Raises
    ------
    DloError
        If the file cannot be read, a column is missing or unknown.
    """

    path: Path
    needed: tuple[str, ...] = ("end_x_m", "end_y_m")
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with self._explained():
            names = self._data.schema.names
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
        """Number of poses; without any, there is no table."""
        with self._explained():
            rows = int(self._data.count_rows())
        if not rows:
            raise DloError(
                f"--list {self.path}: no poses: the file names its columns and has no rows.\n"
                "  Try: one row per pose"
            )
        return rows

    @property
    def identity(self) -> Mapping[str, Any]:
        """Plain data that identify the poses."""
        with self._explained(), self.path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return {"list_sha256": digest, "fixed": dict(self.fixed)}

    @property
    def _data(self) -> Any:
        from pyarrow import csv, dataset, float64

        types = csv.ConvertOptions(column_types=dict.fromkeys(HEADER, float64()))
        comma = dataset.CsvFileFormat(convert_options=types)
        is_parquet = self.path.suffix.lower() == ".parquet"
        return dataset.dataset(self.path, format="parquet" if is_parquet else comma)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Say what is wrong with the file."""
        pyarrow, _ = parquet_library()
        try:
            yield
        except (OSError, UnicodeDecodeError, pyarrow.ArrowException) as error:
            why = "no such file" if isinstance(error, FileNotFoundError) else error
            text = f"--list {self.path}: {why}.\n  Try: a CSV or Parquet file of numbers"
            raise DloError(text) from None

    def chunks(self, size: int) -> Iterator[FloatArray]:
        """Arrays (size, 6); the last may be shorter."""
        held = np.zeros((0, len(COLUMNS)))
        with self._explained():
            for batch in self._data.to_batches():
                poses = _fixed(batch.num_rows, self.fixed)
                for name in batch.schema.names:
                    column = batch.column(name).cast("float64")
                    poses[:, HEADER.index(name)] = column.to_numpy(zero_copy_only=False)
                held = np.concatenate([held, poses])
                while len(held) >= size:
                    yield held[:size]
                    held = held[size:]
        if len(held):
            yield held


def _fixed(count: int, fixed: Mapping[str, float]) -> FloatArray:
    return np.tile([float(fixed.get(name, 0.0)) for name in COLUMNS], (count, 1))


SCHEMA = "dlo-shapes/1"
# Size of a chunk's shapes [bytes]; each process holds one chunk at a time.
CHUNK_BYTES = 12_000_000
# Part of a column's name -> its unit; otherwise [m].
_UNITS = {"force": "N", "moment": "N m", "energy": "J", "heading": "rad"}
_ORDER = "x and y of the nodes in turn, from start to end"


@dataclass(frozen=True)
class Plan:
    """Inputs of the computation that all poses share.

    Parameters
    ----------
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
    branch : "ccw", "cw" or None
    output : Path
        The Parquet file, absolute.
    """

    model: CableModel
    p: FloatArray
    rest: FloatArray
    branch: Branch | None
    output: Path

    @property
    def parts(self) -> Path:
        """Folder of the finished chunks."""
        return self.output.with_name(f"{self.output.name}.parts")

    @property
    def digest(self) -> str:
        """SHA-256 of everything that determines the shapes, as in the C header."""
        return solver_hash(self.model, self.p, self.rest)

    @property
    def chunk(self) -> int:
        """Number of poses in a chunk."""
        n, k = self.model.n, self.model.chain.n_nodes
        return max(1, CHUNK_BYTES // (8 * (2 * (n + 1) + k + 12)))

    def part(self, index: int) -> Path:
        """File of a finished chunk."""
        return self.parts / f"{index:08d}.arrow"


@dataclass(frozen=True)
class Chunk:
    """Some of the poses, (m, 6) [m, rad]."""

    index: int
    poses: FloatArray

    def __repr__(self) -> str:
        return f"chunk {self.index} of {counted(len(self.poses), 'pose')}"


def shape_table(
    plan: Plan,
    poses: Grid | PoseList,
    executor: Executor,
    *,
    metadata: dict[str, Any] | None = None,
    restart: bool = False,
    progress: Callable[[Tally], None] | None = None,
) -> dict[str, int]:
    """Solve all poses and write them to a Parquet file, in their order: equal input, equal bytes.

    Finished chunks stay in `plan.parts` until the file is complete, so that an interrupted run can
    continue. No process holds more than one chunk of shapes (`CHUNK_BYTES`) and a few copies.

    Parameters
    ----------
    metadata : dict, optional
        Additional plain data for the file.
    restart : bool
        Discard existing output and parts.
    progress : callable, optional
        Called with the progress of the chunks.

    Returns
    -------
    dict
        Number of poses by status; empty if the file was already complete.

    Raises
    ------
    DloError
        If the file or the parts are of another table, or cannot be written.
    """
    _, pq = parquet_library()
    identity = json.dumps(
        {
            "schema": SCHEMA,
            "solver_hash": plan.digest,
            "branch": plan.branch,
            "dlo_casadi": __version__,
            **poses.identity,
        },
        sort_keys=True,
    )
    if os.path.exists(plan.output) and not restart:
        if _identity_of(plan.output) == identity:
            return {}
        raise DloError(
            f"{plan.output} is there already and holds something else.\n"
            "  Try: another --output, or --restart to replace it."
        )
    schema = _schema(plan.model, {"identity": identity, **(metadata or {})})
    counts = np.zeros(len(STATUSES), int)
    with only_run(plan.parts):
        for path in plan.parts.iterdir() if restart else ():
            if path.name != LOCK:
                path.unlink()
        mark = plan.parts / "identity.json"
        if not mark.exists():
            write_file(mark, identity)
        elif mark.read_text(encoding="utf-8") != identity:
            raise DloError(
                f"{plan.parts} holds parts of another table: other poses, another model or "
                "version.\n  Try: another --output, or --restart to throw them away."
            )

        def fill(stream: BinaryIO) -> None:
            with pq.ParquetWriter(
                stream,
                schema,
                use_dictionary=["status"],
                # Otherwise the digits of neighbouring points would not compress.
                use_byte_stream_split=["points.list.element"],
                compression="zstd",
                compression_level=1,
            ) as writer:
                for path in _parts_in_order(plan, poses, executor, progress):
                    part = _read_part(path, schema)
                    codes = part["status"].chunk(0).indices
                    counts[:] += np.bincount(codes, minlength=len(STATUSES))
                    writer.write_table(part)

        write_file(plan.output, fill, plan.parts / "draft.parquet")
        shutil.rmtree(plan.parts, ignore_errors=True)
    return {name: int(n) for name, n in zip(STATUSES, counts, strict=True) if n}


def _identity_of(path: Path) -> str | None:
    """Identity of a table; None for any other file."""
    pa, pq = parquet_library()
    try:
        found = (pq.read_schema(path).metadata or {}).get(b"identity")
    except (OSError, pa.ArrowInvalid):
        return None
    return None if found is None else found.decode()


def _parts_in_order(
    plan: Plan,
    poses: Grid | PoseList,
    executor: Executor,
    progress: Callable[[Tally], None] | None,
) -> Iterator[Path]:
    """Compute missing chunks; yield each chunk as soon as all before it are finished."""
    total = -(-poses.count // plan.chunk)
    there = {k for k in range(total) if plan.part(k).exists()}
    chunks = (Chunk(k, chunk) for k, chunk in enumerate(poses.chunks(plan.chunk)) if k not in there)
    left, solve = total - len(there), partial(solve_chunk, plan)
    tasks = map_as_completed(executor, solve, chunks, total=left, progress=progress)
    for index in range(total):
        while index not in there:
            done = next(tasks)
            _ = done.value  # a failed chunk ends the run; finished ones are kept
            there.add(done.item.index)
        yield plan.part(index)


def _read_part(path: Path, schema: pyarrow.Schema) -> pyarrow.Table:
    import pyarrow as pa

    with path.open("rb") as stream:
        part = pa.ipc.open_file(stream).read_all()
    if not part.schema.equals(schema):
        raise DloError(f"{path} is no part of this table.\n  Try: --restart")
    return part


_solvers: dict[str, CompiledSolver] = {}


def solve_chunk(plan: Plan, chunk: Chunk) -> None:
    """Solve a chunk on a worker and store it durably; each worker compiles the solver once."""
    import pyarrow as pa

    digest = plan.digest
    if digest not in _solvers:
        _solvers.clear()
        _solvers[digest] = CompiledSolver(plan.model, plan.p, plan.rest)
    found = _solvers[digest].solve_many(chunk.poses, branch=plan.branch)
    part = table_of(plan.model, chunk.poses, *found)

    def fill(stream: BinaryIO) -> None:
        with pa.ipc.new_file(stream, part.schema) as writer:
            writer.write_table(part)

    write_file(plan.part(chunk.index), fill)


def table_of(
    model: CableModel, poses: FloatArray, records: NDArray[np.void], statuses: NDArray[np.intc]
) -> pyarrow.Table:
    """Table of poses and shapes; shapes are null where there is none.

    Points are in single precision: 0.1 um or better below a metre.
    """
    import pyarrow as pa

    lost, ends = statuses != 0, ("start", "end")
    clamped = [side for side in ends if getattr(model, side).direction]
    turned = functions_of(model).moment_ends  # clamps, and pins with springs
    known = {
        *("start_x", "start_y", *(["end_x", "end_y"] if model.end.place else [])),
        *(f"{side}_heading" for side in clamped),
    }
    results = {
        "energy": records["energy"],
        **{
            f"force_on_{side}_{axis}": records[f"{side}_force"][:, k]
            for side in ends
            for k, axis in enumerate("xy")
        },
        **{f"moment_on_{side}": records["moments"][:, ends.index(side), 0] for side in turned},
        "min_bend_radius": records["min_bend_radius"],
    }
    points = pa.array(records["points"].astype(np.float32).ravel())
    columns = {
        **{name: pa.array(poses[:, k]) for k, name in enumerate(COLUMNS) if name in known},
        "status": pa.DictionaryArray.from_arrays(statuses.astype(np.int8), list(STATUSES)),
        **{name: pa.array(np.ascontiguousarray(x), mask=lost) for name, x in results.items()},
        "points": pa.FixedSizeListArray.from_arrays(points, 2 * (model.n + 1), mask=pa.array(lost)),
    }

    def field(name: str, column: pyarrow.Array) -> pyarrow.Field:
        unit = next((unit for part, unit in _UNITS.items() if part in name), "m")
        said = {"status": {}, "points": {"unit": unit, "order": _ORDER}}.get(name, {"unit": unit})
        return pa.field(name, column.type, metadata=said or None)

    schema = pa.schema([field(*item) for item in columns.items()])
    return pa.table(columns, schema=schema)


def _schema(model: CableModel, metadata: dict[str, Any]) -> pyarrow.Schema:
    """Types and units of the columns, and the file's metadata on the cable."""
    none = np.zeros((0, len(COLUMNS))), np.zeros(0, records_of(model).shape), np.zeros(0, np.intc)
    said = {
        "cable": model.cable.name,
        "length_m": model.cable.length,
        "n": model.n,
        "element": model.element,
        "boundary": [str(model.start), str(model.end)],
        **metadata,
    }
    texts = {key: item if isinstance(item, str) else json.dumps(item) for key, item in said.items()}
    return table_of(model, *none).schema.with_metadata(texts)
