"""`dlo diagnose`: a fit with the search for missing effects printed in full."""

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
    with session_executor(chosen.jobs) as executor:
        from dlo_casadi.cli.session import fit_and_show  # beside the other process's imports

        fit_and_show(chosen, config, chosen.output, executor, keys=KEYS, candidates=True)
    return OK
