"""The sessions of a folder: those not fitted yet are fitted, a table and a page show all."""

import glob
import hashlib
import os
import re
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from dlo_casadi import __version__
from dlo_casadi.config import load_config, read_yaml
from dlo_casadi.errors import DloError, OutputError, well_formed
from dlo_casadi.fleet import parquet_library
from dlo_casadi.fleet.rows import (
    Row,
    empty_row,
    overview_html,
    read_row,
    row_of,
    write_row,
    write_table,
)
from dlo_casadi.io.files import make_folder, only_run, write_file
from dlo_casadi.report.documents import report_dict
from dlo_casadi.runtime.executors import worker_log
from dlo_casadi.runtime.parallel import Tally, map_as_completed
from dlo_casadi.session import run_session

ENDINGS = (".yaml", ".yml")
# A line that makes a YAML file a configuration, even one with mistakes.
_SECTION = re.compile(rb"^(cable|experiment)\s*:", re.MULTILINE)


@dataclass(frozen=True, order=True)
class SessionFile:
    """One configuration of many.

    Parameters
    ----------
    key : str
        Its path below the common folder of all, with `/`: unique.
    path : Path
        The YAML file, absolute.
    """

    key: str
    path: Path


def find_sessions(where: str | Path) -> tuple[Path, tuple[SessionFile, ...]]:
    """Find all configurations in a folder and below, or of a pattern.

    In a folder a YAML file counts if it has a `cable:` or an `experiment:` and is no result of a
    fit; hidden folders are left out. All files that match a pattern count; `**` stands for any
    folders.

    Returns
    -------
    Path, tuple of SessionFile
        The common folder, and the sessions in the order of their keys.

    Raises
    ------
    DloError
        If there is none.
    """
    text = str(where)
    folder = Path(text)
    if os.path.isdir(folder):
        base = folder.resolve()
        found = []
        for inner, folders, names in os.walk(base):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            paths = [Path(inner, name) for name in names if name.lower().endswith(ENDINGS)]
            found += [path for path in paths if _is_session(path)]
    else:
        named = {Path(name).resolve() for name in glob.glob(text, recursive=True)}
        found = [path for path in named if path.is_file()]
        base = Path(os.path.commonpath([path.parent for path in found])) if found else folder
    if not found:
        raise DloError(
            f"no configuration in {text}: a YAML file with cable: and experiment: is looked for.\n"
            "  Try: a folder, or a pattern in quotes, such as 'cables/*/session.yaml'."
        )
    keys = [well_formed(path.relative_to(base).as_posix()) for path in found]
    sessions = sorted(map(SessionFile, keys, found))
    return base, tuple(sessions)


def _is_session(path: Path) -> bool:
    """Whether a YAML file is intended as a configuration."""
    try:
        content = path.read_bytes()
    except OSError:
        return True  # its row will say why
    return bool(_SECTION.search(content)) and not re.search(rb"^schema\s*:", content, re.MULTILINE)


def digest_of(session: SessionFile, options: tuple[Any, ...]) -> str:
    """SHA-256 of all that determines a session's results.

    The package's version, the options of the run, the configuration's bytes, and the name and
    bytes of each file that its poses name; an unreadable file enters as such.
    """
    digest = hashlib.sha256()

    def add(content: bytes) -> None:
        digest.update(len(content).to_bytes(8, "big"))
        digest.update(content)

    add(repr((__version__, options)).encode())
    try:
        poses = read_yaml(session.path)["experiment"]["poses"]
        named = [name for pose in poses for name in (pose.get("file"), *(pose.get("files") or ()))]
        names = [str(name) for name in named if name is not None]
    except (DloError, KeyError, TypeError, AttributeError):
        names = []  # a configuration that cannot be read
    add(_content(session.path))
    for name in names:
        add(well_formed(name).encode())
        add(_content(session.path.parent / name))
    return digest.hexdigest()


def _content(path: Path) -> bytes:
    """SHA-256 of a file's bytes; empty if it cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").digest()
    except (OSError, ValueError):  # a name that no file can have is a ValueError
        return b""


PAGE = "index.html"
# Shortest time between two updates of the table [s], and largest share of the time spent on them.
FOLD_AFTER = 10.0
FOLD_SHARE = 0.02


@dataclass(frozen=True)
class Options:
    """Options for each session.

    Parameters
    ----------
    diagnosis : bool
        Whether missing effects are searched for, where the configuration does not forbid it.
    reports : bool
        Whether each session gets its folder of results.
    """

    diagnosis: bool = True
    reports: bool = True


@dataclass(frozen=True)
class FleetResult:
    """Result of a run.

    Parameters
    ----------
    rows : tuple of dict
        One per session, in the order of their keys.
    """

    rows: tuple[Row, ...]

    @property
    def failed(self) -> tuple[Row, ...]:
        """Rows without results."""
        return tuple(row for row in self.rows if row["status"] != "done")


def fit_fleet(
    sessions: Sequence[SessionFile],
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
    output : Path
        On a file system that all workers see.
    retry_failed : bool
        Whether failed sessions are tried again. Lost ones always are: with a killed worker, or
        because their results could not be written.
    begin : callable
        Called with the numbers of rows taken over and of sessions left.
    progress : callable, optional
        Called with the progress after each session.

    Raises
    ------
    DloError
        If pyarrow is missing, the output cannot be written, or another run is writing there.
    """
    parquet_library()
    options = options or Options()
    output = output.resolve()
    kept = ("done",) if retry_failed else ("done", "failed")
    rows: dict[str, Row] = {}
    jobs = []
    next_fold = time.perf_counter() + FOLD_AFTER

    def fold() -> None:
        """Write table and page from time to time, see FOLD_AFTER and FOLD_SHARE."""
        nonlocal next_fold
        begun = time.perf_counter()
        write_table(output, rows.values())
        write_file(output / PAGE, overview_html(list(rows.values()), output))
        end = time.perf_counter()
        next_fold = end + max(FOLD_AFTER, (end - begun) / FOLD_SHARE)

    with only_run(output):
        make_folder(output / "rows")
        for session in sessions:
            job = Job(session, digest_of(session, astuple(options)), output, options)
            row = read_row(output, session.key, job.digest)
            if row is not None and row["status"] in kept:
                rows[session.key] = row
            else:
                jobs.append(job)
                make_folder(job.folder.parent)
        begin(len(rows), len(jobs))
        try:
            for done in map_as_completed(executor, fit_one, jobs, progress=progress):
                key, row = done.item.session.key, done.result
                if row is None:
                    row = empty_row(key, done.item.digest, "lost", str(done.error), 0.0)
                    write_row(output, row)
                rows[key] = row
                if time.perf_counter() > next_fold:
                    fold()
        finally:
            fold()
    return FleetResult(tuple(rows[key] for key in sorted(rows)))


@dataclass(frozen=True)
class Job:
    """One session to fit, complete for a worker."""

    session: SessionFile
    digest: str  # of what decides the results
    output: Path  # folder of all results, absolute
    options: Options

    @property
    def folder(self) -> Path:
        """Folder of the session's results: named after its file, and so unique."""
        return self.output / "sessions" / self.session.key

    def __repr__(self) -> str:
        return self.session.key


def fit_one(job: Job) -> Row:
    """Fit a session, write its results and then its row; a failure is a row with a message.

    Raises OutputError if the results or the row cannot be written: that is no property of the
    session.
    """
    begin, key = time.perf_counter(), job.session.key
    try:
        row = _fitted(job, begin)
    except OutputError:
        raise
    except Exception as error:
        message = str(error)
        if not isinstance(error, DloError):
            worker_log(None).error("bug in %s:\n%s", key, traceback.format_exc())
            message = f"a bug: {type(error).__name__}: {error}; see the worker's log"
        row = empty_row(key, job.digest, "failed", message, time.perf_counter() - begin)
    write_row(job.output, row)
    return row


def _fitted(job: Job, begin: float) -> Row:
    config = load_config(job.session.path)
    if not job.options.diagnosis:
        config = config.changed(diagnosis={"enabled": False})
    if job.options.reports:
        # It imports the drawing libraries; without figures a worker starts in half the time.
        from dlo_casadi.report.writer import ResultsFolder

        with ResultsFolder(job.folder, config) as folder:
            outcome = run_session(config)
            folder.write(outcome)
    else:
        outcome = run_session(config)
    seconds = time.perf_counter() - begin
    return row_of(job.session.key, job.digest, config.cable.name, report_dict(outcome), seconds)
