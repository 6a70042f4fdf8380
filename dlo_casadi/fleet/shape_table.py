"""All chunks, in any order, on any executor, into one file in the order of the poses."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dlo_casadi import __version__
from dlo_casadi.codegen.shapes import STATUSES
from dlo_casadi.errors import DloError
from dlo_casadi.fleet.shape_arrow import table_of, table_schema
from dlo_casadi.fleet.shape_poses import Poses
from dlo_casadi.fleet.shape_solve import Chunk, Plan, part_type, solve_chunk
from dlo_casadi.io.files import only_run, write_file
from dlo_casadi.runtime.parallel import Tally, map_as_completed

SCHEMA = "dlo-shapes/1"


def shape_table(
    plan: Plan,
    poses: Poses,
    output: Path,
    executor: Executor,
    *,
    metadata: dict[str, Any] | None = None,
    restart: bool = False,
    progress: Callable[[Tally], None] | None = None,
) -> dict[str, int]:
    """Solve all poses and write them to a Parquet file, in their order: equal input, equal bytes.

    Finished chunks lie in `plan.parts` until the file is complete, so that an interrupted run
    goes on. No process holds more than one chunk of shapes (`CHUNK_BYTES`) and some copies of it.

    Parameters
    ----------
    plan : Plan
    poses : Poses
    output : Path
        The file.
    executor : Executor
    metadata : dict, optional
        More to be written into the file, as plain data.
    restart : bool
        Throw away what lies there, whatever it is.
    progress : callable, optional
        Told how far the chunks have come.

    Returns
    -------
    dict
        Number of poses by status; empty if the file was complete already.

    Raises
    ------
    DloError
        If the file or the parts belong to something else, or cannot be written.
    """
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
    if os.path.exists(output) and not restart:
        if _identity_of(output) == identity:
            return {}
        raise DloError(
            f"{output} is there already and holds something else.\n"
            "  Try: another --output, or --restart to replace it."
        )
    if restart:
        shutil.rmtree(plan.parts, ignore_errors=True)
    with only_run(plan.parts):
        _claim(plan.parts, identity)
        counts = np.zeros(len(STATUSES), int)
        fill = partial(_fill, plan, poses, executor, identity, metadata or {}, progress, counts)
        write_file(output, fill, plan.parts / "draft.parquet")
        shutil.rmtree(plan.parts, ignore_errors=True)
    return {name: int(n) for name, n in zip(STATUSES, counts, strict=True) if n}


def _identity_of(path: Path) -> str | None:
    """Identity of a table; None of anything else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        found = (pq.read_schema(path).metadata or {}).get(b"identity")
    except (OSError, pa.ArrowInvalid):
        return None
    return None if found is None else found.decode()


def _claim(parts: Path, identity: str) -> None:
    """Say whose parts these are; refuse those of something else."""
    mark = parts / "identity.json"
    if mark.exists():
        if mark.read_text(encoding="utf-8") != identity:
            raise DloError(
                f"{parts} holds parts of another table: other poses, another model or version.\n"
                "  Try: another --output, or --restart to throw them away."
            )
        return
    write_file(mark, identity)


def _fill(
    plan: Plan,
    poses: Poses,
    executor: Executor,
    identity: str,
    metadata: dict[str, Any],
    progress: Callable[[Tally], None] | None,
    counts: NDArray[np.int_],
    stream: BinaryIO,
) -> None:
    """Compute what is missing; append each chunk to the table as soon as those before are in.

    The poses are counted by status into `counts`.
    """
    import pyarrow.parquet as pq

    total = -(-poses.count // plan.chunk)
    there = {k for k in range(total) if plan.part(k).exists()}
    schema = table_schema(plan.model, {"identity": identity, **metadata})
    written = 0

    def missing() -> Iterator[Chunk]:
        for index, chunk in enumerate(poses.chunks(plan.chunk)):
            if index not in there:
                yield Chunk(index, chunk)

    with pq.ParquetWriter(
        stream,
        schema,
        use_dictionary=["status"],
        # Without it the digits of neighbouring points would not compress.
        use_byte_stream_split=["points.list.element"],
        compression="zstd",
        compression_level=1,
    ) as writer:

        def append() -> None:
            nonlocal written
            while written in there:
                part = _read_part(plan, written)
                counts[:] += np.bincount(part["status"], minlength=len(STATUSES))
                writer.write_table(table_of(part, schema, plan.model))
                written += 1

        append()
        tasks = map_as_completed(
            executor,
            partial(solve_chunk, plan),
            missing(),
            total=total - len(there),
            progress=progress,
        )
        for done in tasks:
            _ = done.value  # a chunk that fails ends the run; finished ones are kept
            there.add(done.item.index)
            append()


def _read_part(plan: Plan, index: int) -> NDArray[np.void]:
    part: NDArray[np.void] = np.load(plan.part(index))
    if part.dtype != part_type(plan.model.n):
        raise DloError(f"{plan.part(index)} is no part of this table.\n  Try: --restart")
    return part
