"""`dlo diagnose`: a fit with the search for missing effects printed in full."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import (
    add_jobs,
    command,
    configuration,
    console,
    print_json,
    session_executor,
    session_jobs,
)
from dlo_casadi.cli.watch import Watch
from dlo_casadi.report.json_report import report_dict
from dlo_casadi.report.terminal import candidate_table, print_summary
from dlo_casadi.report.writer import ResultsFolder
from dlo_casadi.session import run_session

EXAMPLES = """\
dlo diagnose configs/cable.yaml                  prints; writes nothing
dlo diagnose rope.yaml --output results/rope     writes the results of a fit, too
dlo diagnose rope.yaml --quiet --json            effects, candidates, verdict and next pose"""
KEYS = ("config", "verdict", "effects", "candidates", "unexplained", "next_pose", "warnings")


def main(argv: Sequence[str]) -> int:
    """Run `dlo diagnose CONFIG [...]`."""
    parser = command(
        "diagnose",
        "Fit a cable and search for what the declared model lacks, whether or not the\n"
        "configuration asks for it; print every effect that was tried, ranked.",
        EXAMPLES,
    )
    parser.add_argument("config", type=Path, help="configuration, such as configs/cable.yaml")
    parser.add_argument("--output", type=Path, metavar="DIR", help="write the results there")
    add_jobs(parser, session_jobs())
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    chosen = parser.parse_args(argv)

    config = configuration(chosen.config)
    options = config.diagnosis.model_copy(update={"enabled": True})
    config = replace(config, diagnosis=options)
    results = nullcontext() if chosen.output is None else ResultsFolder(chosen.output, config)
    with (
        results as folder,
        Watch(Console(stderr=True), chosen.quiet) as watch,
        session_executor(chosen.jobs) as executor,
    ):
        watch.warn(config.warnings)
        outcome = run_session(config, watch, executor)
        if folder is not None:
            folder.write(outcome, executor)
    if chosen.json:
        report = report_dict(outcome)
        print_json({key: report[key] for key in KEYS})
        return OK
    page = console(quiet=chosen.quiet)
    print_summary(page, outcome)
    page.print(candidate_table(outcome))
    if chosen.output is not None:
        page.print(f"Results: {chosen.output}", soft_wrap=True)
    return OK
