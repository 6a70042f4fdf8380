"""`dlo fit`, `dlo diagnose`, `dlo fit-many`: from configurations to results."""

import argparse
import multiprocessing
import os
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path

from dlo_casadi.cli import BAD_INPUT, OK
from dlo_casadi.cli.common import CONFIG, SCHEDULER, Counter, Page, Watch, command, jobs, option
from dlo_casadi.errors import counted, well_formed
from dlo_casadi.io.files import make_folder, write_file
from dlo_casadi.runtime.executors import ended_first
from dlo_casadi.runtime.parallel import begin, open_executor

# Keys of report.json that a diagnosis prints.
DIAGNOSIS = ("config", "verdict", "effects", "candidates", "unexplained", "next_pose", "warnings")


# Default number of processes of a single session: two if there are two processors (a third saves
# little); one if other processes cannot be started.
PROCESSORS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
SESSION_JOBS = jobs(1 if multiprocessing.current_process().daemon else min(2, PROCESSORS))
VERBOSE = option(
    "--verbose", action="store_true", help="also print what took how long, in steps of the fits"
)
NO_DIAGNOSIS = option(
    "--no-diagnosis", action="store_true", help="do not search for missing effects"
)


@command(
    CONFIG,
    option(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder of the results; default results/<config name>/",
    ),
    SESSION_JOBS,
    NO_DIAGNOSIS,
    VERBOSE,
    codes="on 2 and 130 earlier results are kept",
    json="print report.json instead of tables",
)
def fit(chosen: argparse.Namespace) -> None:
    """Fit a cable to its photographs or centre-lines and report what was found.

    dlo fit configs/cable.yaml                       writes results/cable/
    dlo fit rope.yaml --output results/monday        to a folder of your choice
    dlo fit rope.yaml --no-diagnosis                 only the declared model: much faster
    dlo fit rope.yaml --jobs 1                       in one process: slower, and lighter
    dlo fit rope.yaml --quiet --json > rope.json     report.json to a program
    """
    chosen.output = chosen.output or Path("results") / chosen.config.name
    if chosen.no_diagnosis:
        chosen.config = chosen.config.changed(diagnosis={"enabled": False})
    _fit_and_show(chosen)


@command(
    CONFIG,
    option("--output", type=Path, metavar="DIR", help="write the results there"),
    SESSION_JOBS,
    VERBOSE,
)
def diagnose(chosen: argparse.Namespace) -> None:
    """Fit a cable and search for what the declared model lacks, whether or not the
    configuration asks for it; print every effect that was tried, ranked.

    dlo diagnose configs/cable.yaml                  prints; writes nothing
    dlo diagnose rope.yaml --output results/rope     writes the results of a fit, too
    dlo diagnose rope.yaml --quiet --json            effects, candidates, verdict and next pose
    """
    chosen.config = chosen.config.changed(diagnosis={"enabled": True})
    _fit_and_show(chosen, DIAGNOSIS)


def _fit_and_show(chosen: argparse.Namespace, keys: Sequence[str] = ()) -> None:
    """Fit a session here and in `--jobs` - 1 processes; write to the output, if given; print.

    With `keys`, `--json` prints only these of report.json, and text lists all effects tried.
    """
    config, output = chosen.config, chosen.output
    libraries = ("dlo_casadi.session", "dlo_casadi.report.writer")
    with open_executor(chosen.jobs, here=True, libraries=libraries) as executor:
        begin(executor, os.getpid)
        # These imports take as long as those of the other process, which run in parallel.
        from dlo_casadi.report.sections import print_summary, report_dict
        from dlo_casadi.report.terminal import candidate_table, work_table
        from dlo_casadi.report.writer import ResultsFolder
        from dlo_casadi.session import run_session

        results = nullcontext() if output is None else ResultsFolder(output, config)
        with results as folder, Watch(quiet=chosen.quiet) as watch, ended_first(executor):
            watch.warn(config.warnings)
            if folder is not None and folder.of_another:
                said = f"{output} holds results of {folder.of_another}, which this run replaces"
                watch.warn([f"{said}. Try: --output DIR"])
            outcome = run_session(config, watch, executor)
            if folder is not None:
                watch.step("write the results", 0, 1)
                folder.write(outcome, executor)
                watch.step("write the results", 1, 1)
    page, report = Page(chosen), report_dict(outcome)
    page.data({key: report[key] for key in keys or report})
    print_summary(page, outcome)
    if keys:
        page.print(candidate_table(outcome))
    if chosen.verbose:
        page.print(work_table(outcome))
    if output is not None:
        page.say(f"Results: {output}")


@command(
    option("where", metavar="FOLDER", help="folder, or a pattern in quotes"),
    jobs(),
    SCHEDULER,
    option(
        "--output", type=Path, metavar="DIR", help="default results/fleet-<name of the folder>/"
    ),
    NO_DIAGNOSIS,
    option("--no-reports", action="store_true", help="no folder of results for each session"),
    option("--retry-failed", action="store_true", help="try sessions again that have failed"),
    codes="2 is also a session without results: it is a row with its message, the others are done",
    json="print the rows as JSON",
)
def fit_many(chosen: argparse.Namespace) -> int:
    """Fit many sessions: a table (table.parquet) with one row each, a page (index.html) that
    shows the odd ones first, and the results of each. The same command goes on after an
    interruption; what is finished and unchanged is not repeated.

    dlo fit-many cables/                                  all configurations in it and below
    dlo fit-many 'cables/*/session.yaml' --jobs 8         on eight cores
    dlo fit-many cables/ --scheduler tcp://10.0.0.5:8786  on a Dask cluster
    dlo fit-many cables/ --no-diagnosis --no-reports      the table alone, fast
    """
    from dlo_casadi.fleet.rows import judge
    from dlo_casadi.fleet.run import Options, find_sessions, fit_fleet

    base, sessions = find_sessions(chosen.where)
    output = chosen.output or Path("results") / f"fleet-{base.name}"
    logs, source = output / "logs", output / "source.txt"
    make_folder(logs)
    counter = Counter(quiet=chosen.quiet, noun="session")

    def begin(taken_over: int, left: int) -> None:
        before = f", {taken_over} of them finished before" if taken_over else ""
        counter.message(f"{counted(len(sessions), 'session')}{before}; results in {output}")
        own = earlier = well_formed(str(base))
        with suppress(OSError):
            earlier = source.read_text(encoding="utf-8", errors="replace")
        if earlier != own:
            said = f"{output} holds results of {earlier}, which this run replaces"
            counter.message(f"warning: {said}. Try: --output DIR")
        write_file(source, own)

    try:
        with counter, open_executor(chosen.jobs, chosen.scheduler, logs) as executor:
            rows = fit_fleet(
                sessions,
                output,
                executor,
                Options(diagnosis=not chosen.no_diagnosis, reports=not chosen.no_reports),
                retry_failed=chosen.retry_failed,
                begin=begin,
                progress=counter.show,
            )
    except KeyboardInterrupt:
        counter.message("What is finished is kept: the same command goes on.")
        raise
    page = Page(chosen)
    page.data(rows)
    odd = [item for item in judge(rows) if item.reasons]
    for item in odd[:10]:
        message = str(item.row["message"]).replace("\n", "\n  ")
        page.say(": ".join(filter(None, [item.row["session"], ", ".join(item.reasons), message])))
    if len(odd) > 10:
        page.say(f"and {len(odd) - 10} more")
    failed = sum(row["status"] != "done" for row in rows)
    page.say(
        f"{counted(len(rows), 'session')}, {failed} without results: "
        f"{output / 'index.html'}, {output / 'table.parquet'}"
    )
    return BAD_INPUT if failed else OK
