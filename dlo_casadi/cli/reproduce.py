"""`dlo reproduce`: the comparison with the paper."""

from __future__ import annotations

from collections.abc import Sequence

from dlo_casadi.cli.checkout import run_script
from dlo_casadi.cli.options import command

EXAMPLES = """\
dlo reproduce
dlo reproduce -- --help                         options of the script, which follow --"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo reproduce [-- OPTION ...]`."""
    parser = command(
        "reproduce",
        "Compare with the paper of Quartaro et al.; runs scripts/reproduce_paper.py of a checkout.",
        EXAMPLES,
        "others are the script's own",
    )
    parser.add_argument("option", nargs="*", help="passed on to the script")
    chosen = parser.parse_args(argv)
    return run_script("reproduce_paper", chosen.option)
