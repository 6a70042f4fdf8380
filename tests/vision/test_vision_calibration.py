"""A camera found from photographs of the board, against the one that drew them."""

import cv2
import numpy as np
import pytest
from scene import BOARD, CAMERA, PLACES, SHAPE, background

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import calibrate_camera


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
    advice = " ".join(calibrate_camera(close, BOARD).advice)
    assert "within" in advice
    assert "degrees" in advice


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
