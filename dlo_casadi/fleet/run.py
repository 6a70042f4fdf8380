"""Fit the sessions of a folder that are not fitted yet, and show all in a table and a page."""

import glob
import hashlib
import os
import re
import time
import traceback
from collections.abc import Callable, Mapping
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
from dlo_casadi.report.sections import report_dict
from dlo_casadi.runtime.executors import worker_log
from dlo_casadi.runtime.parallel import Tally, map_as_completed
from dlo_casadi.session import run_session

ENDINGS = (".yaml", ".yml")
# A line that marks a YAML file as a configuration, even one with mistakes.
_SECTION = re.compile(rb"^(cable|experiment)\s*:", re.MULTILINE)


def find_sessions(where: str | Path) -> tuple[Path, dict[str, Path]]:
    """Find all configurations in and below a folder, or those that match a pattern.

    In a folder a YAML file counts if it has a `cable:` or an `experiment:` and is not a fit's
    result; hidden folders are skipped. Every file that matches a pattern counts; `**` stands for
    any folders.

    Returns
    -------
    Path, dict of Path
        The common folder, and the YAML files, absolute, by their keys and in the order of these: a
        key is the path below the common folder, with `/`.

    Raises
    ------
    DloError
        If there are none.
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
    return base, dict(sorted(zip(keys, found, strict=True)))


def _is_session(path: Path) -> bool:
    try:
        content = path.read_bytes()
    except OSError:
        return True  # its row will give the reason
    return bool(_SECTION.search(content)) and not re.search(rb"^schema\s*:", content, re.MULTILINE)


def digest_of(path: Path, options: tuple[Any, ...]) -> str:
    """SHA-256 of everything that determines a session's results.

    It covers the package's version, the options of the run, the configuration's bytes, and name and
    bytes of each file that its poses name; an unreadable file is included as such.
    """
    digest = hashlib.sha256()

    def add(content: bytes) -> None:
        digest.update(len(content).to_bytes(8, "big"))
        digest.update(content)

    add(repr((__version__, options)).encode())
    try:
        poses = read_yaml(path)["experiment"]["poses"]
        named = [name for pose in poses for name in (pose.get("file"), *(pose.get("files") or ()))]
        names = [str(name) for name in named if name is not None]
    except (DloError, KeyError, TypeError, AttributeError):
        names = []  # an unreadable configuration
    add(_content(path))
    for name in names:
        add(well_formed(name).encode())
        add(_content(path.parent / name))
    return digest.hexdigest()


def _content(path: Path) -> bytes:
    """SHA-256 of a file's bytes; empty if it cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").digest()
    except (OSError, ValueError):  # ValueError: a name that no file can have
        return b""


PAGE = "index.html"
# Shortest interval between updates of the table [s], and their largest share of the time.
FOLD_AFTER = 10.0
FOLD_SHARE = 0.02


@dataclass(frozen=True)
class Options:
    """Options for each session.

    Parameters
    ----------
    diagnosis : bool
        Whether to search for missing effects, unless the configuration forbids it.
    reports : bool
        Whether to write a folder of results for each session.
    """

    diagnosis: bool = True
    reports: bool = True


def fit_fleet(
    sessions: Mapping[str, Path],
    output: Path,
    executor: Executor,
    options: Options | None = None,
    *,
    retry_failed: bool = False,
    begin: Callable[[int, int], None] = lambda taken_over, left: None,
    progress: Callable[[Tally], None] | None = None,
) -> tuple[Row, ...]:
    """Fit many sessions; finished ones of an earlier run are reused.

    Returns one row per session, in the order of their keys.

    Writes `table.parquet`, `index.html`, `rows/` (one durable file per session, as it finishes),
    `sessions/` (the results of each) and, with an executor that logs, `logs/`. A finished session
    is reused if its configuration, its data, the options and the package's version are unchanged.

    Parameters
    ----------
    sessions : mapping of str to Path
        See `find_sessions`.
    output : Path
        On a file system visible to all workers.
    retry_failed : bool
        Whether to retry failed sessions. Lost ones are always retried: those with a killed worker,
        or whose results could not be written.
    begin : callable
        Called with the number of reused rows and of sessions left.
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
        shown = output if options.reports else None
        write_file(output / PAGE, overview_html(list(rows.values()), shown))
        end = time.perf_counter()
        next_fold = end + max(FOLD_AFTER, (end - begun) / FOLD_SHARE)

    with only_run(output):
        make_folder(output / "rows")
        for key, path in sessions.items():
            job = Job(key, path, digest_of(path, astuple(options)), output, options)
            row = read_row(output, key, job.digest)
            if row is not None and row["status"] in kept:
                rows[key] = row
            else:
                jobs.append(job)
                make_folder(job.folder.parent)
        begin(len(rows), len(jobs))
        try:
            for done in map_as_completed(executor, fit_one, jobs, progress=progress):
                key, row = done.item.key, done.result
                if row is None:
                    row = empty_row(key, done.item.digest, "lost", str(done.error), 0.0)
                    write_row(output, row)
                rows[key] = row
                if time.perf_counter() > next_fold:
                    fold()
        finally:
            fold()
    return tuple(rows[key] for key in sorted(rows))


@dataclass(frozen=True)
class Job:
    """One session to fit, with everything that a worker needs."""

    key: str
    path: Path
    digest: str  # of everything that determines the results
    output: Path  # folder of all results, absolute
    options: Options

    @property
    def folder(self) -> Path:
        """Folder of the session's results, named after its file and therefore unique."""
        return self.output / "sessions" / self.key

    def __repr__(self) -> str:
        return self.key


def fit_one(job: Job) -> Row:
    """Fit a session, write its results and then its row; a failure becomes a row with a message.

    Raises OutputError if the results or the row cannot be written: that is not the session's fault.
    """
    begin, key = time.perf_counter(), job.key
    try:
        row = _fitted(job, begin)
    except OutputError:
        raise
    except Exception as error:
        message = str(error)
        if not isinstance(error, DloError):
            log = worker_log(None)
            log.error("bug in %s:\n%s", key, traceback.format_exc())
            where = "; see the worker's log" if log.handlers else ""
            message = f"a bug: {type(error).__name__}: {error}{where}"
        row = empty_row(key, job.digest, "failed", message, time.perf_counter() - begin)
    write_row(job.output, row)
    return row


def _fitted(job: Job, begin: float) -> Row:
    config = load_config(job.path)
    if not job.options.diagnosis:
        config = config.changed(diagnosis={"enabled": False})
    if job.options.reports:
        # It imports drawing libraries; without figures a worker starts in half the time.
        from dlo_casadi.report.writer import ResultsFolder

        with ResultsFolder(job.folder, config) as folder:
            outcome = run_session(config)
            folder.write(outcome)
    else:
        outcome = run_session(config)
    seconds = time.perf_counter() - begin
    return row_of(job.key, job.digest, config.cable.name, report_dict(outcome), seconds)
