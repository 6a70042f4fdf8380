"""A camera found from photographs of the board, against the one that drew them."""

import cv2
import numpy as np
import pytest
from scene import BOARD, CAMERA, PLACES, SHAPE, background
from scipy.spatial.transform import Rotation

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import calibrate_camera, calibration
from dlo_casadi.vision.board import CORNERS_THAT_SHARE, detect_markers
from dlo_casadi.vision.calibration import _LENSES


@pytest.fixture(scope="module")
def pictures():
    return {
        where: np.repeat(np.round(background(where)).astype(np.uint8)[..., None], 3, axis=2)
        for where in PLACES
    }


def test_the_camera_is_found_from_three_photographs(pictures):
    """The scene's lens has 14 numbers, of which five do duty here for the rest."""
    found = calibrate_camera(pictures, BOARD)
    truth = np.array([CAMERA.matrix[0, 0], CAMERA.matrix[1, 1]])
    focal = np.array([found.camera.matrix[0, 0], found.camera.matrix[1, 1]])
    assert focal == pytest.approx(truth, rel=0.02)
    assert found.reprojection_error < 0.5
    assert set(found.errors) == set(PLACES)
    assert not found.problems


def test_what_would_make_it_better_is_told(pictures):
    close = {"a": pictures["ahead"], "b": pictures["ahead"], "c": np.roll(pictures["ahead"], 4, 0)}
    found = calibrate_camera(close, BOARD)
    advice = " ".join(found.advice)
    assert found.focal_uncertainty > 0.02  # from three sides 0.0007
    assert "within" in advice
    assert "degrees" in advice


def test_photographs_from_straight_ahead_tell_no_focal_length():
    size, scale = 60, 1000.0
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    images = {}
    for name, (left, top) in {"a": (500, 450), "b": (540, 430), "c": (520, 470)}.items():
        images[name] = np.full((900, 1200, 3), 255, np.uint8)
        for n, (x, y) in BOARD.marker_centers.items():
            u, v = int(left + scale * x - size / 2), int(top - scale * y - size / 2)
            marker = cv2.aruco.generateImageMarker(words, n, size)
            images[name][v : v + size, u : u + size] = marker[..., None]
    with pytest.raises(VisionError, match="all face the board alike"):
        calibrate_camera(images, BOARD)


def test_how_well_the_matrix_is_known_is_as_opencv_has_it(pictures, monkeypatch):
    """Of markers in their places, and photographs from different sides, OpenCV's are right."""
    monkeypatch.setattr(calibration, "_PLACED", 0.0)
    monkeypatch.setattr(calibration, "_ROUNDS", 0)
    known = [
        np.vstack([np.column_stack([BOARD.corners(n), np.zeros(4)]) for n in seen])
        for seen in (detect_markers(image, BOARD)[0] for image in pictures.values())
    ]
    seen = [
        np.vstack(list(detect_markers(image, BOARD)[0].values())) for image in pictures.values()
    ]
    solid, flat = ([a.astype(np.float32) for a in arrays] for arrays in (known, seen))
    found = calibrate_camera(pictures, BOARD)
    stds = [
        cv2.calibrateCameraExtended(solid, flat, SHAPE[::-1], None, None, flags=flags)[5][:4, 0]
        for flags in _LENSES.values()
    ]
    misfit = [
        np.abs(found.matrix_std / np.sqrt(CORNERS_THAT_SHARE) / std - 1).max() for std in stds
    ]
    assert min(misfit) < 1e-3


def corners(rng, cone, misplaced=1e-3, smaller=0.0):
    """Corners in three photographs from within some degrees about the board's normal.

    Drawn, with 0.1 px of noise; the markers are 1 mm off their places, the same in each photograph,
    and all sides of their squares are some pixels further inwards.
    """
    off = {n: misplaced * rng.standard_normal(2) for n in BOARD.marker_centers}
    middle = np.append(np.mean(list(BOARD.marker_centers.values()), axis=0), 0.0)
    seen = []
    for turn in rng.uniform(0, 2 * np.pi) + np.array([0.0, 2.1, 4.2]):
        tilt = np.radians(cone) / 2 * np.array([np.cos(turn), np.sin(turn), 0.0])
        # The board's x to the right and y up; pictures count downwards.
        turned = Rotation.from_rotvec(tilt).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        at = np.array([0.0, 0.0, 1.6]) - turned @ middle
        seen.append({})
        for n, shift in off.items():
            places = np.column_stack([BOARD.corners(n) + shift, np.zeros(4)])
            rotation = cv2.Rodrigues(turned)[0]
            drawn = cv2.projectPoints(places, rotation, at, CAMERA.matrix, None)[0][:, 0]
            toward = drawn.mean(axis=0) - drawn
            drawn += smaller * np.sqrt(2) * toward / np.linalg.norm(toward, axis=1, keepdims=True)
            seen[-1][n] = drawn + 0.1 * rng.standard_normal((4, 2))
    return seen


@pytest.mark.parametrize("cone", [12, 40])
def test_markers_that_are_a_millimetre_off_are_counted(cone, monkeypatch):
    """From nearly one direction they turn into focal length, and no residual shows it."""
    rng, ratios, known = np.random.default_rng(0), [], []
    for _ in range(12):
        seen = corners(rng, cone)
        found_in = iter(seen)
        monkeypatch.setattr(calibration, "detect_markers", lambda *_, i=found_in: (next(i), None))
        views = {f"{k}": np.zeros((*SHAPE, 3), np.uint8) for k in range(3)}
        found = calibrate_camera(views, BOARD)
        errors = found.camera.matrix[[0, 1], [0, 1]] - CAMERA.matrix[[0, 1], [0, 1]]
        ratios.append(np.abs(errors / found.matrix_std[:2]).max())
        known.append(found.focal_uncertainty)
    assert np.median(ratios) < 1.5
    assert max(ratios) < 4.0
    assert (np.median(known) > 0.02) == (cone < 20)
    assert found.spread == pytest.approx(cone * np.sin(np.pi / 3), rel=0.2)


def test_gamma_and_blur_of_the_markers_are_not_focal_length(monkeypatch):
    """Squares that are smaller by 1 px on each side made the focal lengths 1.4 to 1.8 % smaller.

    An eighth of the shift is left, 0.2 %, and noise: corners of 0.1 px give 0.4 %.
    """
    rng = np.random.default_rng(0)
    for _ in range(4):
        found_in = iter(corners(rng, 60, 0.0, 1.0))
        monkeypatch.setattr(calibration, "detect_markers", lambda *_, i=found_in: (next(i), None))
        views = {f"{k}": np.zeros((*SHAPE, 3), np.uint8) for k in range(3)}
        found = calibrate_camera(views, BOARD)
        errors = found.camera.matrix[[0, 1], [0, 1]] / CAMERA.matrix[[0, 1], [0, 1]] - 1
        assert np.abs(errors).max() < 1e-2
        assert found.reprojection_error < 0.25


def test_photographs_that_do_not_serve_are_named(pictures):
    covered = pictures["left"].copy()
    covered[:, :330] = 150
    with pytest.raises(VisionError, match="needs 3 photographs") as raised:
        calibrate_camera({**pictures, "left": covered}, BOARD)
    assert "left: only the markers" in raised.value.message
    found = calibrate_camera({**pictures, "mirrored": pictures["left"][:, ::-1].copy()}, BOARD)
    assert "The picture is mirrored" in found.problems["mirrored"]


def test_photographs_of_another_size_are_refused(pictures):
    small = cv2.resize(pictures["left"], (SHAPE[1] // 2, SHAPE[0] // 2))
    with pytest.raises(VisionError, match="left is 480 x 360 px, most photographs are 960 x 720"):
        calibrate_camera({**pictures, "left": small}, BOARD)
