"""One session as a command: fitted, written, printed; what `dlo fit` and `dlo diagnose` share.

Its imports take as long as those of another process, beside which they should be made: import it
once that has been started.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from pathlib import Path

from rich.console import Console

from dlo_casadi.cli.options import console, print_json
from dlo_casadi.cli.watch import Watch
from dlo_casadi.config import Config
from dlo_casadi.report.json_report import report_dict
from dlo_casadi.report.terminal import candidate_table, print_summary
from dlo_casadi.report.writer import ResultsFolder
from dlo_casadi.runtime.executors import ended_first
from dlo_casadi.session import run_session


def fit_and_show(
    chosen: argparse.Namespace,
    config: Config,
    output: Path | None,
    executor: Executor,
    *,
    keys: Sequence[str] | None = None,
    candidates: bool = False,
) -> None:
    """Fit a session, write the results if a folder is given, and print them.

    Parameters
    ----------
    chosen : Namespace
        With `quiet` and `json`.
    keys : sequence of str, optional
        Of report.json, what `--json` prints; all by default.
    candidates : bool
        Whether all effects that were tried are printed, too.
    """
    results = nullcontext() if output is None else ResultsFolder(output, config)
    with (
        results as folder,
        Watch(Console(stderr=True), chosen.quiet) as watch,
        ended_first(executor),
    ):
        watch.warn(config.warnings)
        outcome = run_session(config, watch, executor)
        if folder is not None:
            watch.step("write the results", 0, 1)
            folder.write(outcome, executor)
            watch.step("write the results", 1, 1)
    if chosen.json:
        report = report_dict(outcome)
        print_json(report if keys is None else {key: report[key] for key in keys})
        return
    page = console(quiet=chosen.quiet)
    print_summary(page, outcome)
    if candidates:
        page.print(candidate_table(outcome))
    if output is not None:
        page.print(f"Results: {output}", soft_wrap=True)
