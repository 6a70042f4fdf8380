"""Whether sessions still have the results that they had before a change.

    python scripts/check_unchanged.py [SESSION.yaml ...] --output before.json [--jobs N]
    python scripts/check_unchanged.py [SESSION.yaml ...] --before before.json

Run it before the change and after. Verdicts, effects and what cannot be told from them must be
equal, parameters within 0.1 of their standard deviation, errors of held-out poses within 1 %.
Without names it takes the sessions of this repository that differ most from each other; add your
own. Steps of fits and processor time are told beside, they decide nothing.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from harness import options, run

from dlo_casadi.config import load_config
from dlo_casadi.report.sections import report_dict
from dlo_casadi.session import run_session

ROOT = Path(__file__).resolve().parent.parent
BENCH = ("drift", "two_effects", "overhang", "clamped", "held_headings")
GOLDEN = [
    *(ROOT / "configs" / f"{name}.yaml" for name in ("cable", "markers_in_space", "black_wire")),
    ROOT / "configs" / "glass_strip.yaml",
    *(ROOT / "tests" / "data" / "bench" / name / "session.yaml" for name in BENCH),
]
PARAMETERS, HELD_OUT = 0.1, 0.01


def results(path: Path) -> dict[str, Any]:
    """What is compared of one session."""
    started = time.process_time()
    report = report_dict(run_session(load_config(path)))
    last = report["stages"][-1]
    values = {**last["parameters"]}
    values.pop("rest_curvature")
    for effect in report["effects"]:
        own = effect["parameters"].items()
        values |= {f"{effect['name']}.{name}": value for name, value in own}
    return {
        "session": str(path),
        "verdict": report["verdict"],
        "effects": sorted(effect["name"] for effect in report["effects"]),
        "ties": {e["name"]: sorted(e["indistinguishable_from"]) for e in report["effects"]},
        "parameters": {
            name: (value["value"], value["std"])
            for name, value in values.items()
            if isinstance(value, dict) and value.get("std")
        },
        "held_out": last["rmse_held_out"],
        "seconds": time.process_time() - started,
    }


def changes(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What differs by more than is allowed, in words."""
    found = [
        f"{key}: {before[key]} -> {after[key]}"
        for key in ("verdict", "effects", "ties")
        if before[key] != after[key]
    ]
    for name in sorted(before["parameters"].keys() | after["parameters"].keys()):
        old, new = before["parameters"].get(name), after["parameters"].get(name)
        if old is None or new is None:
            found.append(f"{name}: {old} -> {new}")
        elif abs(new[0] - old[0]) > PARAMETERS * old[1]:
            apart = abs(new[0] - old[0]) / old[1]
            found.append(f"{name}: {old[0]:.6g} -> {new[0]:.6g} ({apart:.2f} std)")
    old, new = before["held_out"], after["held_out"]
    if (old is None) != (new is None) or (old and abs(new - old) > HELD_OUT * old):
        found.append(f"held out [m]: {old} -> {new}")
    return found


def main() -> int:
    """Fit the sessions, compare if there is something to compare with."""
    parser = options(__doc__, jobs=True, output=True)
    parser.add_argument("sessions", nargs="*", type=Path, metavar="SESSION.yaml")
    parser.add_argument("--before", type=Path, help="what --output wrote before the change")
    chosen = parser.parse_args()
    known = {}
    if chosen.before is not None:
        known = {name_of(row["session"]): row for row in json.loads(chosen.before.read_text())}

    def line(path: Path, row: dict[str, Any], seconds: float) -> str:
        told = f"{name_of(str(path))}: {row['verdict']} {row['effects']}, {row['seconds']:.1f} s"
        old = known.get(name_of(str(path)))
        if old is None:
            return told + (", not in the file from before" if known else "")
        found = changes(old, row)
        return "\n  ".join((f"{told} ({old['seconds']:.1f} s before)", *(found or ["unchanged"])))

    paths = [path.resolve() for path in chosen.sessions or GOLDEN]
    rows = run(results, paths, chosen, line)
    changed = [
        row for row in rows if (old := known.get(name_of(row["session"]))) and changes(old, row)
    ]
    if known:
        print(f"{len(changed)} of {len(rows)} sessions have changed")
    return 1 if changed else 0


def name_of(path: str) -> str:
    """A session by its folder and file: the same in another checkout."""
    return "/".join(Path(path).parts[-2:])


if __name__ == "__main__":
    raise SystemExit(main())
