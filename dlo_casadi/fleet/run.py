"""Fit all sessions that are not fitted yet, and fold what is done into table and page."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import astuple, dataclass
from pathlib import Path

from dlo_casadi.fleet.columns import Row, empty_row
from dlo_casadi.fleet.discover import Session, digest_of
from dlo_casadi.fleet.one import Job, Options, fit_one
from dlo_casadi.fleet.overview import overview_html
from dlo_casadi.fleet.store import parquet_library, read_row, write_row, write_table
from dlo_casadi.io.files import make_folder, only_run, write_file
from dlo_casadi.runtime.parallel import Tally, map_as_completed

PAGE = "index.html"
# The table is folded anew after so many seconds, and at most for this share of the time.
FOLD_AFTER = 10.0
FOLD_SHARE = 0.02


@dataclass(frozen=True)
class FleetResult:
    """What a run has led to.

    Parameters
    ----------
    rows : tuple of dict
        One per session, in the order of their keys.
    taken_over : int
        Rows of an earlier run.
    output : Path
    """

    rows: tuple[Row, ...]
    taken_over: int
    output: Path

    @property
    def failed(self) -> tuple[Row, ...]:
        """Rows without results."""
        return tuple(row for row in self.rows if row["status"] != "done")


def fit_fleet(
    sessions: Sequence[Session],
    output: Path,
    executor: Executor,
    options: Options | None = None,
    *,
    retry_failed: bool = False,
    begin: Callable[[int, int], None] = lambda taken_over, left: None,
    progress: Callable[[Tally], None] | None = None,
) -> FleetResult:
    """Fit many sessions; what an earlier run has finished is taken over.

    Writes `table.parquet`, `index.html`, `rows/` (one durable file per session, as it finishes),
    `sessions/` (the results of each) and, with an executor that logs, `logs/`. A session counts
    as finished if neither its configuration nor its data, the options or the package's version
    have changed.

    Parameters
    ----------
    sessions : sequence of Session
    output : Path
        On a file system that all workers see.
    executor : Executor
    options : Options, optional
    retry_failed : bool
        Whether sessions that failed are tried again. Those lost always are: with a killed worker,
        or because their results could not be written.
    begin : callable
        Told how many rows are taken over and how many sessions are left.
    progress : callable, optional
        Told how far the run has come, after each session.

    Raises
    ------
    DloError
        If pyarrow is missing, the output cannot be written, or another run is writing there.
    """
    parquet_library()
    options = options or Options()
    output = output.resolve()
    with only_run(output):
        make_folder(output / "rows")
        digests = {session.key: digest_of(session, astuple(options)) for session in sessions}
        rows: dict[str, Row] = {}
        for session in sessions:
            row = read_row(output, session.key, digests[session.key])
            if row is None or row["status"] == "lost":
                continue
            if row["status"] == "done" or not retry_failed:
                rows[session.key] = row
        jobs = [
            Job(session, digests[session.key], output, options)
            for session in sessions
            if session.key not in rows
        ]
        for job in jobs:
            make_folder(job.folder.parent)
        taken_over = len(rows)
        begin(taken_over, len(jobs))
        folding = _Folding(output)
        try:
            for done in map_as_completed(executor, fit_one, jobs, progress=progress):
                job = done.item
                if done.result is None:
                    row = empty_row(job.session.key, job.digest, "lost", str(done.error), 0.0)
                    write_row(output, row)
                else:
                    row = done.result
                rows[job.session.key] = row
                folding.maybe(rows)
        finally:
            folding.now(rows)
    ordered = tuple(rows[key] for key in sorted(rows))
    return FleetResult(ordered, taken_over, output)


class _Folding:
    """Writes table and page from time to time, for a small share of it."""

    def __init__(self, output: Path) -> None:
        self._output = output
        self._next = time.perf_counter() + FOLD_AFTER

    def maybe(self, rows: dict[str, Row]) -> None:
        """Fold if it is time."""
        if time.perf_counter() > self._next:
            self.now(rows)

    def now(self, rows: dict[str, Row]) -> None:
        """Fold."""
        begin = time.perf_counter()
        write_table(self._output, rows.values())
        write_file(self._output / PAGE, overview_html(list(rows.values()), self._output))
        end = time.perf_counter()
        self._next = end + max(FOLD_AFTER, (end - begin) / FOLD_SHARE)
