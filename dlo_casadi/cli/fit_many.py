"""`dlo fit-many`: many sessions on many cores or machines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dlo_casadi.cli.counter import Counter
from dlo_casadi.cli.guard import BAD_INPUT, OK
from dlo_casadi.cli.options import add_jobs, command, console, parsed, print_json
from dlo_casadi.errors import counted
from dlo_casadi.fleet.discover import find_sessions
from dlo_casadi.fleet.overview import judge
from dlo_casadi.fleet.run import FleetResult, Options, fit_fleet
from dlo_casadi.io.files import make_folder
from dlo_casadi.runtime.parallel import open_executor

EXAMPLES = """\
dlo fit-many cables/                                  all configurations in it and below
dlo fit-many 'cables/*/session.yaml' --jobs 8         on eight cores
dlo fit-many cables/ --scheduler tcp://10.0.0.5:8786  on a Dask cluster
dlo fit-many cables/ --no-diagnosis --no-reports      the table alone, fast"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo fit-many FOLDER [...]`."""
    parser = command(
        "fit-many",
        "Fit many sessions: a table (table.parquet) with one row each, a page (index.html) that\n"
        "shows the odd ones first, and the results of each. The same command goes on after an\n"
        "interruption; what is finished and unchanged is not repeated.",
        EXAMPLES,
        "2 is also a session without results: it is a row with its message, the others are done",
    )
    parser.add_argument("where", metavar="FOLDER", help="folder, or a pattern in quotes")
    add_jobs(parser)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, instead")
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="default results/fleet-<name of the folder>/"
    )
    parser.add_argument(
        "--no-diagnosis", action="store_true", help="do not search for missing effects"
    )
    parser.add_argument(
        "--no-reports", action="store_true", help="no folder of results for each session"
    )
    parser.add_argument(
        "--retry-failed", action="store_true", help="try sessions again that have failed"
    )
    chosen = parsed(parser, argv, "print the rows as JSON")

    base, sessions = find_sessions(chosen.where)
    output = chosen.output or Path("results") / f"fleet-{base.name}"
    options = Options(diagnosis=not chosen.no_diagnosis, reports=not chosen.no_reports)
    logs = output / "logs"
    make_folder(logs)
    try:
        with (
            Counter(Console(stderr=True), chosen.quiet, "session") as counter,
            open_executor(chosen.jobs, chosen.scheduler, logs) as executor,
        ):

            def begin(taken_over: int, left: int) -> None:
                before = f", finished of them {taken_over}" if taken_over else ""
                counter.message(f"{counted(len(sessions), 'session')}{before}; results in {output}")

            result = fit_fleet(
                sessions,
                output,
                executor,
                options,
                retry_failed=chosen.retry_failed,
                begin=begin,
                progress=counter.show,
            )
    except KeyboardInterrupt:
        said = Console(stderr=True, quiet=chosen.quiet)
        said.print("What is finished is kept: the same command goes on.")
        raise
    if chosen.json:
        print_json(list(result.rows))
    else:
        _summary(result, output, chosen.quiet)
    return BAD_INPUT if result.failed else OK


def _summary(result: FleetResult, output: Path, quiet: bool) -> None:
    """What to look at first."""
    page = console(quiet)
    odd = [item for item in judge(result.rows) if item.reasons]
    for item in odd[:10]:
        what = str(item.row["message"]).splitlines()[0] if item.row["message"] else ""
        text = f"{item.row['session']}: {', '.join(item.reasons)}{': ' * bool(what)}{what}"
        page.print(text, soft_wrap=True, markup=False)
    if len(odd) > 10:
        page.print(f"and {len(odd) - 10} more", markup=False)
    page.print(
        f"{counted(len(result.rows), 'session')}, {len(result.failed)} without results: "
        f"{output / 'index.html'}, {output / 'table.parquet'}",
        soft_wrap=True,
        markup=False,
    )
