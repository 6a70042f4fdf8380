"""Rendered photographs of a session in space against their true curves."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from dlo_casadi.vision import Board, Camera, KnownCable, calibrate_camera, measure_views, read_image

DATA = Path(__file__).parents[1] / "data"
SESSION = DATA / "space/space_photos"
DOCUMENT = yaml.safe_load((SESSION / "session.yaml").read_text())
DECLARED = DOCUMENT["experiment"]["measurement"]
POSES = DOCUMENT["experiment"]["poses"]
BOARD = Board(**DECLARED["board"], standoff=0.0)
CAMERA = Camera(**DECLARED["camera"])


def photographs(number):
    return {name: read_image(SESSION / name) for name in POSES[number - 1]["files"]}


def measured(pictures, number):
    pose, cable = POSES[number - 1], DOCUMENT["cable"]
    return measure_views(
        pictures,
        BOARD,
        CAMERA,
        KnownCable(pose["start"], pose["end"], cable["diameter"], cable["length"]),
    )


def truth(number):
    points = np.load(DATA / "space_truth/space_photos/truth_shapes.npz")[f"pose_{number:02d}"]
    return CubicSpline(np.linspace(0, 1, len(points)), points)(np.linspace(0, 1, 4001))


# 1: three views; 2: a bend seen from its side, two views; 6: it covers itself along a third of its
# length, which crosses there; 9: it crosses itself
@pytest.mark.parametrize("number", [1, 2, 6, 9])
def test_the_line_in_space(number):
    views = measured(photographs(number), number)
    assert not views.problems
    away = cKDTree(truth(number)).query(views.line.points)[0]
    assert np.sqrt(np.mean(away**2)) < 0.5e-3
    assert np.mean(cKDTree(views.line.points).query(truth(number))[0] < 2.5e-3) > 0.95
    assert np.sqrt(np.mean((away / views.line.std) ** 2)) < 2.0


def test_swapped_photographs_are_named():
    """Of three one is left out and the others used; of two both are asked for."""
    three = photographs(1)
    three["pose_01_b.jpg"] = photographs(7)["pose_07_b.jpg"]
    views = measured(three, 1)
    assert list(views.problems) == ["pose_01_b.jpg"]
    away = cKDTree(truth(1)).query(views.line.points)[0]
    assert np.sqrt(np.mean(away**2)) < 0.5e-3
    two = photographs(3)
    two["pose_03_b.jpg"] = photographs(5)["pose_05_b.jpg"]
    views = measured(two, 3)
    assert views.line is None
    assert list(views.problems) == ["pose_03_b.jpg"]
    assert "Try: are both of this pose?" in views.problems["pose_03_b.jpg"]


def test_the_camera_from_its_own_photographs():
    every = {name: read_image(SESSION / name) for pose in POSES for name in pose["files"]}
    found = calibrate_camera(every, BOARD)
    declared = CAMERA.matrix[[0, 1], [0, 1]]
    assert found.camera.matrix[[0, 1], [0, 1]] == pytest.approx(declared, rel=0.005)
    assert np.all(np.abs(found.camera.matrix[[0, 1], [0, 1]] - declared) < 4 * found.matrix_std[:2])
    assert not found.advice
