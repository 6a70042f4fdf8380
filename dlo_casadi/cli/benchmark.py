"""`dlo benchmark`: the C solver beside other solvers."""

from __future__ import annotations

from collections.abc import Sequence

from dlo_casadi.cli.checkout import run_script
from dlo_casadi.cli.options import command

EXAMPLES = """\
dlo benchmark
dlo benchmark -- --help                         options of the script, which follow --"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo benchmark [-- OPTION ...]`."""
    parser = command(
        "benchmark",
        "Time the C solver beside other solvers: runs scripts/benchmark.py of the checkout.",
        EXAMPLES,
        "others are the script's own",
    )
    parser.add_argument("option", nargs="*", help="passed on to the script")
    chosen = parser.parse_args(argv)
    return run_script("benchmark", chosen.option)
