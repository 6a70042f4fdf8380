"""Fit sessions from arrays and from their configuration files: both must find the same.

    .venv/bin/python scripts/check_session.py       # configs/ and three of tests/data
    .venv/bin/python scripts/check_session.py configs/cable.yaml --no-diagnosis

Centre-lines are read here and handed on as points, with their arc lengths where they are markers;
photographs are handed on by their paths. report.json must be equal but for names and times.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import dlo_casadi as dlo
from dlo_casadi.config import read_yaml
from dlo_casadi.errors import DloError
from dlo_casadi.report.documents import report_dict

ROOT = Path(__file__).parents[1]
DATA = ("bench/short_clean", "bench/held_headings", "space/space_photos")
# What may differ: the session's name, and times.
NAMES = ("config", "timing_s")


def from_arrays(path: Path) -> dlo.Session:
    """The session of a file as a program would make it."""
    tree = read_yaml(path)
    experiment = tree.pop("experiment")
    measurement = experiment.pop("measurement")
    measurement.pop("kind")
    poses = [pose_of(path.parent, row) for row in experiment.pop("poses")]
    cable = dlo.Cable(**tree.pop("cable"))
    return dlo.Session(cable, poses, **experiment, **measurement, **tree)


def pose_of(folder: Path, row: dict[str, Any]) -> dlo.Pose:
    """A pose with its points as arrays, or with the paths of its photographs."""
    arrays = {
        key: np.array(value, dtype=float) if isinstance(value, list) else value
        for key, value in row.items()
        if key not in ("file", "files")
    }
    if "files" in row:
        return dlo.Pose(**arrays, files=[folder / name for name in row["files"]])
    file = folder / row["file"]
    if file.suffix.lower() != ".csv":
        return dlo.Pose(**arrays, file=file)
    table = np.genfromtxt(file, delimiter=",", names=True)
    columns = {name: table[name] for name in table.dtype.names}
    at = columns.pop("s_m", None)
    points = np.column_stack(list(columns.values()))
    return dlo.Pose(**arrays, points=points, at=at, name=arrays.get("name", file.stem))


def differences(one: Any, other: Any, at: str = "") -> list[str]:
    """Places in which two reports differ."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return [text for key in one for text in differences(one[key], other[key], f"{at}.{key}")]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        return [text for k, (a, b) in pairs for text in differences(a, b, f"{at}[{k}]")]
    return [] if one == other else [f"{at.lstrip('.')}: {one!r} from the file, {other!r}"]


def found_in(session: dlo.Session, diagnosed: bool | None) -> dict[str, Any]:
    """The report without what may differ; the message of a session that fails."""
    try:
        report = report_dict(session.fit(diagnosis=diagnosed))
    except DloError as error:
        return {"error": error.message}
    return {key: value for key, value in report.items() if key not in NAMES}


def main() -> None:
    """Compare the sessions that are named, or all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("sessions", nargs="*", type=Path, help="configurations")
    parser.add_argument("--no-diagnosis", action="store_true", help="fit the declared model alone")
    chosen = parser.parse_args()
    data = [ROOT / "tests/data" / name / "session.yaml" for name in DATA]
    paths = chosen.sessions or [*sorted((ROOT / "configs").rglob("*.yaml")), *data]
    wrong = 0
    for path in paths:
        begin = time.perf_counter()
        diagnosed = False if chosen.no_diagnosis else None
        reports = [found_in(x, diagnosed) for x in (dlo.Session.load(path), from_arrays(path))]
        apart = differences(*reports)
        wrong += bool(apart)
        said = "equal" if not apart else f"{len(apart)} differences"
        print(f"{path}: {said}, {time.perf_counter() - begin:.0f} s", flush=True)
        for text in apart[:8]:
            print(f"  {text}")
    sys.exit(min(wrong, 1))


if __name__ == "__main__":
    main()
