"""`dlo fit`: from a configuration to results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import (
    add_jobs,
    command,
    configuration,
    session_executor,
    session_jobs,
)

EXAMPLES = """\
dlo fit configs/cable.yaml                       writes results/cable/
dlo fit rope.yaml --output results/monday        to a folder of your choice
dlo fit rope.yaml --no-diagnosis                 only the declared model: much faster
dlo fit rope.yaml --jobs 1                       in one process: slower, and lighter
dlo fit rope.yaml --quiet --json > rope.json     report.json to a program"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo fit CONFIG [...]`."""
    parser = command(
        "fit",
        "Fit a cable to its photographs or centre-lines and report what was found.",
        EXAMPLES,
        "on 2 and 130 earlier results are kept",
    )
    parser.add_argument("config", type=Path, help="configuration, such as configs/cable.yaml")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder of the results; default results/<config name>/",
    )
    add_jobs(parser, session_jobs())
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--json", action="store_true", help="print report.json instead of tables")
    parser.add_argument(
        "--no-diagnosis", action="store_true", help="do not search for missing effects"
    )
    chosen = parser.parse_args(argv)

    config = configuration(chosen.config)
    if chosen.no_diagnosis:
        diagnosis = config.diagnosis.model_copy(update={"enabled": False})
        config = replace(config, diagnosis=diagnosis)
    output = chosen.output or Path("results") / config.name
    with session_executor(chosen.jobs) as executor:
        from dlo_casadi.cli.session import fit_and_show  # beside the other process's imports

        fit_and_show(chosen, config, output, executor)
    return OK
