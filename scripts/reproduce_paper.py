"""Every table and figure of the paper that can be had without its raw data, on one page.

    python scripts/reproduce_paper.py [--output DIR] [--only PART ...] [--jobs N] [--quiet]
                                      [--monte-carlo N] [--scale]

Writes index.html, paper.json and figures/ to results/paper/. Parts that are not run keep their
earlier results: `--only --scale` runs nothing but the scale.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from paper import energies, equations, monte_carlo, page, scale, tables, timing
from paper.content import Part

from dlo_casadi.runtime.parallel import open_executor

ORDER = ("table4", "replica", "equations", "speed")
LONG = ("monte_carlo", "scale")


def main() -> int:
    """Run the parts, print what they found, write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("results/paper"))
    parser.add_argument("--only", nargs="*", choices=ORDER, help="of these parts, run no others")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--monte-carlo", type=int, default=0, metavar="N", help="simulated sets")
    parser.add_argument("--scale", action="store_true", help="up to 1000 poses")
    parser.add_argument("--quiet", action="store_true", help="print only what was missed")
    args = parser.parse_args()

    def tell(text: str) -> None:
        if not args.quiet:
            print(text, flush=True)

    parts = []
    with open_executor(args.jobs) as executor:
        runs: dict[str, Callable[[], Part]] = {
            "table4": energies.run,
            "replica": lambda: tables.run(executor),
            "equations": lambda: equations.run(executor),
            "speed": timing.run,
            "monte_carlo": lambda: monte_carlo.run(executor, args.monte_carlo, tell),
            "scale": lambda: scale.run(tell),
        }
        chosen = list(ORDER if args.only is None else args.only)
        chosen += ["monte_carlo"] if args.monte_carlo else []
        chosen += ["scale"] if args.scale else []
        for name in chosen:
            begin = perf_counter()
            part = runs[name]()
            part.seconds = perf_counter() - begin
            parts.append(part)
            tell(f"{name}: {part.seconds:.1f} s")
    result = page.write(args.output, parts, (*ORDER, *LONG))
    report(result, args.quiet)
    print(args.output / "index.html")
    return 0


def report(result: dict[str, Any], quiet: bool) -> None:
    """Print claims and targets."""
    parts = result["parts"].values()
    if not quiet:
        for claim in (claim for part in parts for claim in part["claims"]):
            print(f"{claim['where']}: {claim['says']}\n    {claim['verdict']}: {claim['found']}")
    for target in (target for part in parts for target in part["targets"]):
        if not (quiet and target["met"]):
            word = "met" if target["met"] else "MISSED"
            print(f"{word}: {target['name']}: {target['value']} (must be {target['limit']})")


if __name__ == "__main__":
    sys.exit(main())
