"""Wrong inputs by the thousand: each ends in a result or a message, soon, and whole.

    python scripts/check_inputs.py [--count 10000] [--seed 0] [--jobs 2]
    python scripts/check_inputs.py --only 1234 [--keep FOLDER]      one of them, in this process

Right configurations, centre-lines, photographs and parameter files are changed at random, and
handed to `dlo check`, `dlo predict` and, some, `dlo fit`. An input is an offender if it ends in a
traceback, takes more than 10 s of processor time (a fit: 30 s) or 2 GB, kills its process, or
leaves anything half-written. Input number k depends on the seed and k alone. Exit code 1 if there
are offenders.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from harness import options
from inputs import mutations
from inputs.bases import CONFIG, Bases, Session, make_bases
from inputs.watch import MOST_SECONDS, watched

from dlo_casadi.cli import main as dlo
from dlo_casadi.config import dump_yaml
from dlo_casadi.report.writer import FAILURE, OWNED
from dlo_casadi.runtime.parallel import generator_of

# Family -> share of the inputs. A fit takes a hundred times as long as a refusal: some two
# seconds where the input is right, several where its numbers are far off.
SHARES = {
    "structure": 0.32,
    "text": 0.20,
    "values": 0.10,
    "points": 0.14,
    "picture": 0.07,
    "parameters": 0.16,
    "fit": 0.01,
}
# Processor time [s] of families that compute.
SECONDS = {"fit": 30.0}
GOOD = ("ok", "refused")
# Number of offenders that are shown.
_SHOWN = 5
# Number of lines of an offender's output that are shown.
_LINES = 8


@dataclass(frozen=True)
class Case:
    """One input: its files, and the command that reads them."""

    family: str
    files: dict[str, bytes]
    command: list[str] = field(default_factory=list)


def family_of(seed: int, index: int) -> str:
    """Family of input number `index`."""
    until = np.cumsum(list(SHARES.values()))
    return list(SHARES)[int(np.searchsorted(until, generator_of(seed, index).random()))]


def make_case(bases: Bases, seed: int, index: int) -> Case:
    """Make input number `index`."""
    family = family_of(seed, index)
    random = generator_of(seed, index)
    random.random()  # the number that chose the family
    if family == "parameters":
        return _parameters(bases, random)
    every = (*bases.sessions, *bases.photographs)
    chosen: Session = mutations.pick(
        random,
        {"points": bases.sessions, "picture": bases.photographs, "fit": bases.small}.get(
            family, every
        ),
    )
    files, text = dict(chosen.files), dump_yaml(chosen.document).encode()
    if family == "structure":
        text = mutations.changed_structure(chosen.document, random).encode("utf-8", "replace")
    elif family == "text":
        text = mutations.changed_text(text, random)
    elif family == "values" or (family == "fit" and random.random() < 0.7):
        text = mutations.changed_values(chosen.document, random).encode()
    elif family == "picture":
        (name,) = files
        files[name], ending = mutations.changed_picture(files[name], random)
        files = {name.replace(".png", ending): files[name]}
        text = text.replace(b".png", ending.encode())
    else:
        for name in random.permutation(sorted(files))[: int(random.integers(1, 3))]:
            files[name] = mutations.changed_points(files[name], random)
    files[CONFIG] = text
    if family == "fit":
        return Case(family, files, ["fit", CONFIG, "--output", "results", "--quiet", "--jobs", "1"])
    return Case(family, files, ["check", CONFIG, *(["--json"] if random.random() < 0.5 else [])])


def _parameters(bases: Bases, random: np.random.Generator) -> Case:
    document = mutations.pick(random, bases.parameters)
    way = random.random()
    if way < 0.5:
        text = mutations.changed_structure(document, random).encode("utf-8", "replace")
    elif way < 0.8:
        text = mutations.changed_values(document, random).encode()
    else:
        text = mutations.changed_text(dump_yaml(document).encode(), random)
    end = [f"{value:.3f}" for value in random.uniform(-0.5, 0.5, 2)]
    held = document["boundary"]["end"] != "free"
    command = ["predict", "parameters.yaml", *(["--end", *end] if held else [])]
    if document["boundary"]["start"] == "clamped":
        command += ["--start-heading", f"{random.uniform(-3, 3):.3f}"]
    return Case("parameters", {"parameters.yaml": text}, [*command, "--json"])


def run_case(case: Case, folder: Path) -> tuple[str, str]:
    """Run it in this process, in an empty folder; return its outcome and what it said."""
    for name, content in case.files.items():
        (folder / name).write_bytes(content)
    # Strict UTF-8, as a terminal: what cannot be written there is a traceback.
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    before = Path.cwd()
    os.chdir(folder)
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            code = dlo(case.command)
            out.flush()
    except SystemExit as error:
        code = error.code
    except Exception:
        code = 1
        err.write(traceback.format_exc())
    finally:
        os.chdir(before)
    err.flush()
    said = err.buffer.getvalue().decode()
    if code == 1:  # a traceback, which the command has printed
        return ("memory" if "MemoryError" in said else "traceback"), said
    left = left_behind(case, folder, code)
    return ("half-written", f"{left}\n{said}") if left else (GOOD[code == 2], said)


def left_behind(case: Case, folder: Path, code: int | str | None) -> str:
    """Incomplete files and drafts that a run has left."""
    found = {str(path.relative_to(folder)) for path in folder.iterdir()} - set(case.files)
    if case.command[0] != "fit":
        return ", ".join(sorted(found))
    results = {path.name for path in (folder / "results").glob("*")}
    allowed = set(OWNED) if code == 0 else ({FAILURE} if results else set())
    found.discard("results")
    return ", ".join(sorted(found | (results ^ allowed)))


def run_index(bases: Bases, seed: int, index: int) -> tuple[str, str]:
    """Make and run input number `index`."""
    case = make_case(bases, seed, index)
    with tempfile.TemporaryDirectory() as folder:
        return run_case(case, Path(folder))


def check(count: int, seed: int, jobs: int) -> Counter[tuple[str, str]]:
    """Run inputs 0 to count - 1; print the first offenders, and count (family, outcome)."""
    with tempfile.TemporaryDirectory() as folder:
        bases = make_bases(Path(folder))
    counts: Counter[tuple[str, str]] = Counter()
    shown = 0
    begin = time.perf_counter()
    for index, result, said in watched(
        lambda index: run_index(bases, seed, index),
        range(count),
        jobs,
        lambda index: SECONDS.get(family_of(seed, index), MOST_SECONDS),
    ):
        family, outcome = family_of(seed, index), result
        counts[family, outcome] += 1
        if outcome not in GOOD:
            shown += 1
            if shown <= _SHOWN:
                tail = "\n    ".join(said.strip().splitlines()[-_LINES:])
                print(f"{outcome}: --seed {seed} --only {index} ({family})\n    {tail}", flush=True)
        if counts.total() % 1000 == 0:
            print(f"{counts.total()} of {count}, {time.perf_counter() - begin:.0f} s", flush=True)
    return counts


def print_counts(counts: Counter[tuple[str, str]]) -> None:
    """One row for each family."""
    outcomes = [*GOOD, *sorted({outcome for _, outcome in counts} - set(GOOD))]
    print(f"{'':12}" + "".join(f"{outcome:>14}" for outcome in outcomes))
    for family in (*SHARES, "all"):
        row = [
            sum(n for (f, o), n in counts.items() if o == outcome and family in (f, "all"))
            for outcome in outcomes
        ]
        print(f"{family:12}" + "".join(f"{n:14}" for n in row))


def run_only(seed: int, index: int, keep: Path | None) -> int:
    """Run one input in this process, and print its output."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "bases").mkdir()
        case = make_case(make_bases(place / "bases"), seed, index)
        run_in = keep or place / "case"
        run_in.mkdir(exist_ok=True)
        outcome, said = run_case(case, run_in)
    print(f"{case.family}: dlo {' '.join(case.command)}\n{said}\n{outcome}")
    return outcome not in GOOD


def main() -> int:
    """Run and count."""
    parser = options(__doc__, count=(10_000, "inputs"), seed=0, only="run one input, unwatched")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of processes")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where --only writes it")
    args = parser.parse_args()
    if args.only is not None:
        return run_only(args.seed, args.only, args.keep)
    counts = check(args.count, args.seed, args.jobs)
    print_counts(counts)
    offenders = sum(n for (_, outcome), n in counts.items() if outcome not in GOOD)
    print(
        f"{counts.total()} mutated inputs: "
        + (f"{offenders} offenders" if offenders else "every one ends in a result or a message")
    )
    return 1 if offenders else 0


if __name__ == "__main__":
    sys.exit(main())
