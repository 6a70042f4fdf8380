"""What the checks share: their options, and cases that run in one or more processes.

    chosen = options(__doc__, seed=0, jobs=True).parse_args()
    rows = run(work, cases, chosen, lambda case, row, seconds: f"{case}: {row}")

Each case's line is printed as it ends; rows are in the order of the cases.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from dlo_casadi.io.files import write_file
from dlo_casadi.runtime.parallel import map_as_completed, open_executor

Case, Row = TypeVar("Case"), TypeVar("Row")
WHERE = ("plane", "space")


def options(
    doc: str | None,
    *,
    count: tuple[int, str] | None = None,
    first: bool = False,
    seed: int | None = None,
    where: bool = False,
    only: str = "",
    jobs: bool = False,
    scheduler: bool = False,
    output: bool = False,
) -> argparse.ArgumentParser:
    """A parser with the options that are asked for.

    Parameters
    ----------
    doc : str
        Of the script; its first line describes it.
    count : (int, str), optional
        Default and help of --count.
    only : str, optional
        Help of --only, which takes the number of a case.
    """
    parser = argparse.ArgumentParser(description=(doc or "").strip().splitlines()[0])
    if count is not None:
        parser.add_argument("--count", type=int, default=count[0], help=count[1])
    if first:
        parser.add_argument("--first", type=int, default=0, help="number of the first case")
    if seed is not None:
        parser.add_argument("--seed", type=int, default=seed)
    if where:
        parser.add_argument("--where", nargs="+", choices=WHERE, default=list(WHERE))
    if only:
        parser.add_argument("--only", type=int, metavar="NUMBER", help=only)
    if jobs:
        parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    if scheduler:
        parser.add_argument("--scheduler", help="address of a Dask scheduler, instead")
    if output:
        parser.add_argument("--output", type=Path, help="all rows as JSON")
    return parser


def run(
    work: Callable[[Case], Row],
    cases: Iterable[Case],
    chosen: argparse.Namespace,
    line: Callable[[Case, Row, float], str],
    *,
    summary: Callable[[Sequence[Row]], str] | None = None,
    every: int = 20,
) -> list[Row]:
    """Rows of all cases.

    Parameters
    ----------
    work : callable
        Of one case; with --jobs it and its row are pickled.
    chosen : argparse.Namespace
        `jobs`, `scheduler` and `output` are read if they are there; the file is written after each
        case, so that an interrupted check leaves what it found.
    line : callable
        Case, row and seconds -> what is printed; nothing if it is empty.
    summary : callable, optional
        Rows so far -> a line that is printed after every so many cases, and at the end.
    """
    rows: dict[int, Row] = {}
    cases = list(cases)
    output = getattr(chosen, "output", None)

    def ordered() -> list[Row]:
        return [rows[k] for k in sorted(rows)]

    with open_executor(getattr(chosen, "jobs", 1), getattr(chosen, "scheduler", None)) as executor:
        for done in map_as_completed(executor, work, cases):
            rows[done.index] = done.value
            if text := line(done.item, done.value, done.seconds):
                print(text, flush=True)
            if summary is not None and (len(rows) % every == 0 or len(rows) == len(cases)):
                print(summary(ordered()), flush=True)
            if output is not None:
                write_file(output, json.dumps([_plain(row) for row in ordered()], default=str))
    return ordered()


def _plain(row: Any) -> Any:
    """A row as JSON takes it."""
    return asdict(row) if is_dataclass(row) and not isinstance(row, type) else row
