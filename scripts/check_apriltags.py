"""What nine shapes of three soft cables, seen as AprilTags in space, tell of their stiffness.

    python scripts/check_apriltags.py TAGS

TAGS is tags.csv of Rojas, github.com/Drojas251/wire_manipulation (MIT): wire, test, pose, tag, x_m,
y_m, z_m; gravity along -z. Mass, free length and clamps are not known, and the stretch between the
outer tags differs from shape to shape: each is fitted alone, between clamps that point along the
outer tags within their scatter. Of each: what a cubic through the tags leaves of them, what the
cable leaves, and the profile interval of EI over weight per length, which any mass leaves alone.
Exit code 1 if an interval is told that the shape cannot bear: here, any.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from harness import options, run
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.config import load_config
from dlo_casadi.session import run_session

FloatArray = NDArray[np.floating]

# Any mass per length will do [kg/m]. Outer diameters [m] as upstream states them.
MASS_PER_LENGTH = 0.2
DIAMETERS = {"wire1": 0.0127, "wire2": 0.0095, "wire3": 0.00635}


def shapes(path: Path) -> dict[tuple[str, str], FloatArray]:
    """Tags (k, 3) [m] of each wire and test, in their order along the cable."""
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    found: dict[tuple[str, str], list[list[float]]] = {}
    for row in table:
        place = [float(row[f"{axis}_m"]) for axis in "xyz"]
        found.setdefault((str(row["wire"]), str(row["test"])), []).append(place)
    return {name: np.array(tags) for name, tags in found.items()}


def session(wire: str, tags: FloatArray) -> tuple[dict[str, Any], float]:
    """Its configuration, and the scatter of the tags about a cubic [m]."""
    chords = np.linalg.norm(np.diff(tags, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(chords)])
    cubic = np.polyfit(at, tags, 3)
    fine = np.vander(np.linspace(0.0, at[-1], 201), 4) @ cubic
    left = tags - np.vander(at, 4) @ cubic
    scatter = float(np.sqrt((left**2).sum() / (3 * (len(tags) - 4))))
    length = float(np.linalg.norm(np.diff(fine, axis=0), axis=1).sum())
    pose: dict[str, Any] = {"file": "tags.csv"}
    for side, place, way in (
        ("start", fine[0], fine[1] - fine[0]),
        ("end", fine[-1], fine[-1] - fine[-2]),
    ):
        frame, _ = Rotation.align_vectors([way], [[1.0, 0.0, 0.0]])
        pose |= {side: place.tolist(), f"{side}_orientation": frame.as_quat().tolist()}
    return {
        "cable": {
            "name": wire,
            "length": length,
            "mass": MASS_PER_LENGTH * length,
            "diameter": DIAMETERS[wire],
            "rest_shape": "straight",
            "bending_stiffness": 0.01,
        },
        "experiment": {
            "gravity": [0.0, 0.0, -9.81],
            "boundary": {"start": "clamped", "end": "clamped"},
            "measurement": {"kind": "centerlines"},
            # Of a direction: the scatter of two tags over their distance.
            "tolerances": {
                "end": scatter,
                "length": 2 * scatter,
                "rotation": float(np.sqrt(2) * scatter / chords.mean()),
            },
            "poses": [pose],
        },
        "diagnosis": {"enabled": False},
    }, scatter


def main() -> int:
    """Fit each shape and print the results."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("tags", type=Path, help="tags.csv")
    chosen = parser.parse_args()
    rows = run(fitted, shapes(chosen.tags).items(), chosen, lambda shape, row, seconds: row[0])
    return int(any(identifiable for _, identifiable in rows))


def fitted(shape: tuple[tuple[str, str], FloatArray]) -> tuple[str, bool]:
    """What a fit says of a shape, and whether it claims to know the stiffness."""
    (wire, test), tags = shape
    document, scatter = session(wire, tags)
    with TemporaryDirectory() as folder:
        header = "x_m,y_m,z_m"
        np.savetxt(Path(folder) / "tags.csv", tags, "%.6f", ",", header=header, comments="")
        (Path(folder) / "session.yaml").write_text(yaml.safe_dump(document))
        outcome = run_session(load_config(Path(folder) / "session.yaml"))
    stage = outcome.stages[-1]
    stiffness = stage.parameters["bending_stiffness"]
    sides = [
        "unbounded" if side is None else f"{side / (9.81 * MASS_PER_LENGTH):.2g}"
        for side in stiffness.interval_95 or (None, None)
    ]
    text = (
        f"{wire} {test}: {len(tags)} tags over {document['cable']['length']:.3f} m; tags about "
        f"a cubic {1e3 * np.sqrt(3) * scatter:.1f} mm, about the cable "
        f"{1e3 * stage.rmse_fit:.1f} mm; EI over weight per length {sides[0]} to {sides[1]} m^3"
        f", {'' if stiffness.identifiable else 'not '}identifiable"
    )
    return text, bool(stiffness.identifiable)


if __name__ == "__main__":
    sys.exit(main())
