"""Every table and figure of the paper that can be had without its raw data, on one page.

    python scripts/reproduce_paper.py [--output DIR] [--only PART ...] [--jobs N] [--quiet]
                                      [--monte-carlo N] [--scale]

Writes index.html, paper.json and figures/ to results/paper/. Parts that are not run keep their
earlier results.
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

from paper import energies, page
from paper.content import Part

ORDER = ("table4",)


def main() -> int:
    """Run the parts, print what they found, write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("results/paper"))
    parser.add_argument("--only", nargs="+", choices=ORDER, help="parts to run")
    parser.add_argument("--quiet", action="store_true", help="print only what was missed")
    args = parser.parse_args()
    runs: dict[str, Callable[[], Part]] = {"table4": energies.run}
    parts = []
    for name in args.only or runs:
        begin = perf_counter()
        part = runs[name]()
        part.seconds = perf_counter() - begin
        parts.append(part)
        if not args.quiet:
            print(f"{name}: {part.seconds:.1f} s", flush=True)
    result = page.write(args.output, parts, ORDER)
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
