"""`dlo diagnose`: a fit with the search for missing effects printed in full."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dlo_casadi.cli.fit import fit_session
from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import (
    add_config,
    add_jobs,
    command,
    configuration,
    parsed,
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
    add_config(parser)
    parser.add_argument("--output", type=Path, metavar="DIR", help="write the results there")
    add_jobs(parser, session_jobs())
    chosen = parsed(parser, argv)

    config = configuration(chosen.config)
    options = config.diagnosis.model_copy(update={"enabled": True})
    config = replace(config, diagnosis=options)
    fit_session(chosen, config, chosen.output, keys=KEYS, candidates=True)
    return OK
