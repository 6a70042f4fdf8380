"""Recordings of each format beside the session they are rendered from.

    python scripts/check_import.py [FORMAT ...] [clouds] [moving]

For each format: poses found, offset of clocks found, and EI and GJ of the imported session from
those of the CSV session, in its standard deviations. RENDERED, not real: a take of
configs/markers_in_space.yaml at 100 Hz, led from pose to pose, with noise in every frame and a
clock of the grippers that is 80 ms ahead.

Clouds: ten poses of tests/data/space/space_photos, cast with 2 mm of noise in depth and 30 % of the
cable hidden: distance of the lines from the true ones, and EI and GJ beside the true values.
Moving: a simulated cable that is carried from pose to pose, imported with its motions: EI, GJ and
the damping time beside the true values. All of it takes three minutes of processor time. Exit
code 1 if anything is not as it should be.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from harness import options, run
from recorded.clouds import CABLE, depth_cloud, write_ply
from recorded.moved import CABLE as MOVED
from recorded.moved import DAMPING, STIFFNESS, TORSION, moved
from recorded.takes import OFFSET, WRITERS, led, rendered, write_grippers
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

import dlo_casadi as dlo
from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.cli import main as command
from dlo_casadi.config import load_config
from dlo_casadi.io.points import read_points

ROOT = Path(__file__).parents[1]
SESSION = ROOT / "configs" / "markers_in_space.yaml"
PHOTOS = ROOT / "tests" / "data" / "space" / "space_photos" / "session.yaml"
TRUTH = ROOT / "tests" / "data" / "space_truth" / "space_photos"
PLACE, UP = np.array([0.25, -0.1, 1.3]), np.array([0.0, 1.0, 0.0])  # m, of the depth camera
MOST_RMS = 1.5e-3  # m
KNOWN = ["--mass", "0.03", "--diameter", "0.004", "--bending-stiffness", "0.0197"]
STIFFNESSES = ("bending_stiffness", "torsional_stiffness")
MOST_STD, MOST_OFFSET = 0.3, 0.005  # standard deviations; s, half a frame


def fitted(path: Path) -> list[Estimate]:
    """EI and GJ of a session, without a diagnosis."""
    session = dlo.Session.load(path)
    quick = session.diagnosis.changed(enabled=False)
    result = session.changed(diagnosis=quick).fit()
    return [result.params[name] for name in STIFFNESSES]


def imported(kind: str, folder: Path) -> Path:
    """The session of a take in one format."""
    files, options = WRITERS[kind](rendered(SESSION), folder)
    target = folder / "loom"
    arguments = ["import", *map(str, files), "--output", str(target), *options, *KNOWN, "--quiet"]
    if command(arguments):
        raise SystemExit(f"{kind}: not imported")
    return target / "session.yaml"


def clouds(folder: Path) -> bool:
    """Print lines and stiffnesses from rendered clouds beside the truth; whether all is right."""
    config, random = load_config(PHOTOS), np.random.default_rng(0)
    shapes, cable = np.load(TRUTH / "truth_shapes.npz"), config.cable
    poses = config.experiment.poses
    for pose in poses:
        seen = depth_cloud(shapes[pose.name], 0.5 * cable.diameter, PLACE, UP, random)
        write_ply(folder / f"{pose.name}.ply", *seen)
    write_grippers(led(poses, np.zeros((len(poses), 0, 3))), folder / "grippers.csv")
    options = ["--up", "y", "--camera", *map(str, PLACE), "--color", *map(str, CABLE), "--quiet"]
    for key in ("length", "diameter", "mass", "bending_stiffness"):
        options += [f"--{key.replace('_', '-')}", str(getattr(cable, key))]
    files = map(str, [*sorted(folder.glob("*.ply")), folder / "grippers.csv"])
    if command(["import", *files, "--output", str(folder / "loom"), *options]):
        return False
    path = folder / "loom" / "session.yaml"
    print("\nclouds: pose, RMS distance of the line from the true one [mm], points")
    right = True
    for pose, true in zip(load_config(path).experiment.poses, poses, strict=True):
        line = read_points(pose.paths[0], pose.start, pose.end).points
        fine = CubicSpline(np.linspace(0, 1, 101), shapes[true.name])(np.linspace(0, 1, 9001))
        away = cKDTree(fine).query(line[:, [0, 2, 1]] * [1.0, 1.0, -1.0])[0]
        rms = float(np.sqrt((away**2).mean()))
        print(f"  {true.name}  {1e3 * rms:.2f}  {len(line)}")
        right &= rms <= MOST_RMS
    truth = yaml.safe_load((TRUTH / "truth.yaml").read_text())
    for name, own in zip(STIFFNESSES, fitted(path), strict=True):
        low, high = own.interval_95 or (np.nan, np.nan)
        print(f"  {name} {own.value:.5f}, 95 % {low:.5f} to {high:.5f}, true {truth[name]} N m^2")
        right &= bool(low <= truth[name] <= high)
    return right


def moving(folder: Path) -> bool:
    """Print stiffnesses and damping from a simulated take with motions; whether all is right."""
    files, options = WRITERS["c3d"](moved(), folder)
    for key, value in (*MOVED.items(), ("bending_stiffness", 0.01)):
        options += [f"--{key.replace('_', '-')}", str(value)]
    target = folder / "loom"
    options += ["--motions", "3", "--quiet"]
    if command(["import", *map(str, files), "--output", str(target), *options]):
        return False
    result, right = dlo.fit(target / "session.yaml", diagnosis=False), True
    true = dict(zip((*STIFFNESSES, "damping_time"), (STIFFNESS, TORSION, DAMPING), strict=True))
    print("\nmoving:")
    for name, value in true.items():
        own = result.params[name]
        low, high = own.interval_95 or (np.nan, np.nan)
        print(f"  {name} {own.value:.5f}, 95 % {low:.5f} to {high:.5f}, true {value}")
        right &= bool(low <= value <= high)
    return right


def main() -> int:
    """Print the table; 1 if anything is off."""
    parser = options(__doc__, jobs=True)
    parser.add_argument("kinds", nargs="*", help=f"{', '.join(WRITERS)}, clouds, moving")
    chosen = parser.parse_args()
    kinds = chosen.kinds
    right = True
    if not kinds or "clouds" in kinds:
        with tempfile.TemporaryDirectory() as folder:
            right = clouds(Path(folder))
    if not kinds or "moving" in kinds:
        with tempfile.TemporaryDirectory() as folder:
            right &= moving(Path(folder))
    kinds = [kind for kind in kinds or WRITERS if kind not in ("clouds", "moving")]
    if not kinds:
        return not right
    own = fitted(SESSION)
    print(
        f"CSV session: EI {own[0].value:.5f} +- {own[0].std:.5f}, GJ {own[1].value:.5f} +- "
        f"{own[1].std:.5f} N m^2\n"
    )
    print("format    poses  offset ms  EI std  GJ std")
    for poses, offset, off in run(partial(compared, own=own), kinds, chosen, text_of):
        right &= poses == 10 and abs(offset - OFFSET) <= MOST_OFFSET
        right &= max(map(abs, off)) <= MOST_STD
    return not right


def compared(kind: str, own: list[Estimate]) -> tuple[int, float, list[float]]:
    """Poses and offset of the clock [s] in a format, and both stiffnesses off `own` [std]."""
    with tempfile.TemporaryDirectory() as folder:
        path = imported(kind, Path(folder))
        text = path.read_text()
        found = re.search(r"is (\d+) ms\s+ahead", text.replace("\n#", ""))
        off = [(a.value - b.value) / b.std for a, b in zip(fitted(path), own, strict=True)]
    return text.count("- {file:"), int(found[1]) / 1e3 if found else float("nan"), off


def text_of(kind: str, row: tuple[int, float, list[float]], _: float) -> str:
    """A line of the table."""
    poses, offset, off = row
    return f"{kind:8}  {poses:5}  {1e3 * offset:9.0f}  {off[0]:+6.2f}  {off[1]:+6.2f}"


if __name__ == "__main__":
    sys.exit(main())
