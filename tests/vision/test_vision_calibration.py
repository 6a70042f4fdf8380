"""A camera found from photographs of the board, against the one that drew them."""

import cv2
import numpy as np
import pytest
from scene import BOARD, CAMERA, PLACES, SHAPE, background

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import calibrate_camera
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


def test_how_well_the_matrix_is_known_is_as_opencv_has_it(pictures):
    """Its standard deviations are right where photographs are taken from different sides."""
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
