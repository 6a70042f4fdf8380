"""Lines in space from photographs, beside the true curves: a table of every pose of a session.

    python scripts/check_views.py SESSION.yaml [TRUTH_SHAPES.npz]

For each pose: RMS and largest distance of the line in space from the true curve, the share of the
curve that has a point of the line within 2.5 mm, the largest std that is told, the RMS ratio of
distance to told std, and the processor time of a photograph. Then the camera as calibrated from
the same photographs, beside the declared one.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from harness import options
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from dlo_casadi import vision

_NEAR = 2.5e-3  # m: the spacing of the points of a line


def compare(line: vision.SpaceLine, truth: np.ndarray) -> str:
    """Cells of a line against points (M, 3) [m] along the true curve."""
    dense = CubicSpline(np.linspace(0.0, 1.0, len(truth)), truth)(np.linspace(0.0, 1.0, 4001))
    away = cKDTree(dense).query(line.points)[0]
    share = np.mean(cKDTree(line.points).query(dense)[0] < _NEAR)
    ratio = np.sqrt(np.mean((away / line.std) ** 2))
    return (
        f"{1e3 * np.sqrt(np.mean(away**2)):8.2f} {1e3 * away.max():8.2f} {100 * share:8.1f} "
        f"{1e3 * line.std.max():8.2f} {ratio:8.2f}"
    )


def main() -> None:
    """Print the table."""
    parser = options(__doc__)
    parser.add_argument("session", type=Path, help="a session.yaml with photographs")
    parser.add_argument("truth", type=Path, nargs="?", help="points along the true curves, .npz")
    given = parser.parse_args()
    path, truth = given.session, np.load(given.truth) if given.truth else {}
    document = yaml.safe_load(path.read_text())
    cable, experiment = document["cable"], document["experiment"]
    declared = experiment["measurement"]
    board = vision.Board(**{"standoff": 0.0, **declared["board"]})
    every = {}
    camera = None
    if "camera" in declared:
        camera = vision.Camera(**{"distortion": [], **declared["camera"]})
    for pose in experiment["poses"]:
        for name in pose["files"]:
            every[name] = vision.read_image(path.parent / name)
    began = time.process_time()
    found = vision.calibrate_camera(every, board)
    spent = time.process_time() - began
    print("pose     rms_mm   max_mm  share_%   std_mm   ratio  s/photograph")
    for number, pose in enumerate(experiment["poses"], 1):
        began = time.process_time()
        views = vision.measure_views(
            {name: every[name] for name in pose["files"]},
            board,
            camera or found.camera,
            vision.KnownCable(pose["start"], pose.get("end"), cable["diameter"], cable["length"]),
        )
        each = (time.process_time() - began) / len(pose["files"])
        key = f"pose_{number:02d}"
        cells = "no line in space" if views.line is None else f"{len(views.line.points)} points"
        if views.line is not None and key in truth:
            cells = compare(views.line, truth[key])
        print(f"{key}  {cells} {each:8.2f}")
        for text in (*views.problems.values(), *views.messages):
            print(f"    {text}")
    matrix, std = found.camera.matrix, found.matrix_std
    print(
        f"calibration in {spent:.1f} s: fx {matrix[0, 0]:.2f} +- {std[0]:.2f}, "
        f"fy {matrix[1, 1]:.2f} +- {std[1]:.2f}, cx {matrix[0, 2]:.2f}, cy {matrix[1, 2]:.2f} px, "
        f"error {found.reprojection_error:.3f} px"
    )
    if camera is not None:
        off = 100 * (matrix[[0, 1], [0, 1]] / camera.matrix[[0, 1], [0, 1]] - 1.0)
        print(f"    focal lengths off the declared ones by {off[0]:+.3f} and {off[1]:+.3f} %")
    for text in (*found.problems.values(), *found.advice):
        print(f"    {text}")


if __name__ == "__main__":
    main()
