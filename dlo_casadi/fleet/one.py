"""Fit one session of many: what a worker does."""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass, replace
from pathlib import Path

from dlo_casadi.config import load_config
from dlo_casadi.errors import DloError, OutputError
from dlo_casadi.fleet.columns import Row, empty_row, row_of
from dlo_casadi.fleet.discover import Session
from dlo_casadi.fleet.store import write_row
from dlo_casadi.report.json_report import report_dict
from dlo_casadi.runtime.executors import worker_log
from dlo_casadi.session import run_session


@dataclass(frozen=True)
class Options:
    """What is done with each session.

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
class Job:
    """One session to fit, with all that a worker must know.

    Parameters
    ----------
    session : Session
    digest : str
        Of what decides the results.
    output : Path
        Folder of all results, absolute.
    options : Options
    """

    session: Session
    digest: str
    output: Path
    options: Options

    @property
    def folder(self) -> Path:
        """The session's own results: named after its file, so that no two can meet."""
        return self.output / "sessions" / self.session.key

    def __repr__(self) -> str:
        return self.session.key


def fit_one(job: Job) -> Row:
    """Fit a session and write its results, at last its row; a failure is a row with a message.

    Raises
    ------
    OutputError
        If the results or the row cannot be written: that is no property of the session.
    """
    begin = time.perf_counter()
    try:
        row = _fitted(job, begin)
    except OutputError:
        raise
    except DloError as error:
        row = _failed(job, str(error), begin)
    except Exception as error:
        worker_log(None).error("bug in %s:\n%s", job.session.key, traceback.format_exc())
        row = _failed(job, f"a bug: {type(error).__name__}: {error}; see the worker's log", begin)
    write_row(job.output, row)
    return row


def _failed(job: Job, message: str, begin: float) -> Row:
    seconds = time.perf_counter() - begin
    return empty_row(job.session.key, job.digest, "failed", message, seconds)


def _fitted(job: Job, begin: float) -> Row:
    config = load_config(job.session.path)
    if not job.options.diagnosis:
        diagnosis = config.diagnosis.model_copy(update={"enabled": False})
        config = replace(config, diagnosis=diagnosis)
    if job.options.reports:
        # It brings the libraries that draw; without figures a worker starts in half the time.
        from dlo_casadi.report.writer import ResultsFolder

        with ResultsFolder(job.folder, config) as folder:
            outcome = run_session(config)
            folder.write(outcome)
    else:
        outcome = run_session(config)
    seconds = time.perf_counter() - begin
    name = config.cable.name
    return row_of(job.session.key, job.digest, name, report_dict(outcome), seconds)
