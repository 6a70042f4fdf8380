"""`dlo fit`: from a configuration to results."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import (
    add_config,
    add_jobs,
    command,
    configuration,
    parsed,
    session_jobs,
)
from dlo_casadi.config import Config
from dlo_casadi.runtime.parallel import begin, open_executor

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
    add_config(parser)
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder of the results; default results/<config name>/",
    )
    add_jobs(parser, session_jobs())
    parser.add_argument(
        "--no-diagnosis", action="store_true", help="do not search for missing effects"
    )
    chosen = parsed(parser, argv, "print report.json instead of tables")

    config = configuration(chosen.config)
    if chosen.no_diagnosis:
        diagnosis = config.diagnosis.model_copy(update={"enabled": False})
        config = replace(config, diagnosis=diagnosis)
    output = chosen.output or Path("results") / config.name
    fit_session(chosen, config, output)
    return OK


def fit_session(
    chosen: argparse.Namespace, config: Config, output: Path | None, **shown: Any
) -> None:
    """Fit and show one session, see `fit_and_show`: here, and in `--jobs` - 1 processes.

    The first of them is begun at once.
    """
    libraries = ("dlo_casadi.session", "dlo_casadi.report.writer")
    with open_executor(chosen.jobs, here=True, libraries=libraries) as executor:
        begin(executor, os.getpid)
        from dlo_casadi.cli.session import fit_and_show  # beside the other process's imports

        fit_and_show(chosen, config, output, executor, **shown)
