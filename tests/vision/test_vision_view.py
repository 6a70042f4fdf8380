"""Pixels to metres and back, against projections worked out with numpy alone."""

from functools import cache

import cv2
import numpy as np
import pytest

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import Board, Camera, View, from_reference, locate_board

SHAPE = (480, 640)
MATRIX = np.array([[620.0, 0.0, 322.0], [0.0, 618.0, 236.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.08, 0.03, 0.001, -0.0005, 0.0])
# k1, k2, p1, p2, k3, then rational, thin prism, tilted sensor: 30 px in a corner.
LENS = [1.2, 0.5, 1e-3, -5e-4, 0.05, 1.5, 0.8, 0.1, 1e-3, 2e-3, -1e-3, 5e-4, 0.02, -0.03]
CENTERS = {0: (-0.1, 0.2), 1: (0.5, 0.2), 2: (0.5, -0.25), 3: (-0.1, -0.25)}
POINTS = np.array([[0.0, 0.0], [0.3, 0.1], [0.15, -0.2], [0.45, -0.1]])


def pose():
    """Rotation and shift of the board, tilted both ways, 0.95 m from the camera."""
    tilt, pan = 0.25, -0.15
    x_turn = np.array(
        [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    )
    y_turn = np.array([[np.cos(pan), 0, np.sin(pan)], [0, 1, 0], [-np.sin(pan), 0, np.cos(pan)]])
    facing = np.diag([1.0, -1.0, -1.0])  # board y up, z to the camera; camera y down, z ahead
    return x_turn @ y_turn @ facing, np.array([-0.18, -0.03, 0.95])


def bend(a, b, distortion):
    """Brown's model of a lens and its extensions, written out from OpenCV's manual."""
    full = np.pad(distortion, (0, 14 - len(distortion)))
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, x_tilt, y_tilt = full
    r2 = a * a + b * b
    g = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    bent_a = a * g + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + s1 * r2 + s2 * r2**2
    bent_b = b * g + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + s3 * r2 + s4 * r2**2
    (cx, sx), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in (x_tilt, y_tilt))
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ about_x
    sensor = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    u, v, w = sensor @ turn @ np.stack([bent_a, bent_b, np.ones_like(a)])
    return u / w, v / w


def project(points, height, distortion=DISTORTION):
    """Pixels of board points at a height in front of the board."""
    turn, shift = pose()
    seen = np.column_stack([points, np.full(len(points), height)]) @ turn.T + shift
    bent = bend(*(seen[:, :2] / seen[:, 2:]).T, distortion)
    return np.column_stack([*bent, np.ones(len(points))]) @ MATRIX[:2].T


FINE = 3  # sub-pixels along each side of a pixel


@cache
def places_seen(distortion):
    """Places (K, 2) [m] on the board that all sub-pixels see, by following their rays."""
    v, u = (np.mgrid[: SHAPE[0] * FINE, : SHAPE[1] * FINE] + 0.5) / FINE - 0.5
    target = (u.ravel() - MATRIX[0, 2]) / MATRIX[0, 0], (v.ravel() - MATRIX[1, 2]) / MATRIX[1, 1]
    a, b = target
    for _ in range(6 if any(distortion) else 0):  # contracts tenfold a step
        bent_a, bent_b = bend(a, b, distortion)
        a, b = a + target[0] - bent_a, b + target[1] - bent_b
    turn, shift = pose()
    plane = np.linalg.inv(np.column_stack([turn[:, :2], shift]))
    mapped = plane @ np.stack([a, b, np.ones_like(a)])
    return (mapped[:2] / mapped[2]).T


def photograph(numbers=CENTERS, distortion=DISTORTION):
    """Picture of the markers."""
    board = places_seen(tuple(distortion))
    grey = np.full(len(board), 170.0)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number in numbers:
        cells = np.pad(cv2.aruco.generateImageMarker(dictionary, number, 6), 1, constant_values=255)
        local = (board - CENTERS[number]) / 0.08 * [1, -1] * 6 + 4  # eight cells with the margin
        inside = np.all((local >= 0) & (local < 8), axis=1)
        column, row = local[inside].astype(int).T
        grey[inside] = cells[row, column]
    picture = grey.reshape(SHAPE[0], FINE, SHAPE[1], FINE).mean(axis=(1, 3))
    return np.repeat(np.round(picture).astype(np.uint8)[..., None], 3, axis=2)


def a_board(**changes):
    return Board(
        **{
            "dictionary": "DICT_4X4_50",
            "marker_size": 0.08,
            "standoff": 0.02,
            "marker_centers": CENTERS,
            **changes,
        }
    )


CAMERA = Camera(MATRIX, DISTORTION)


@pytest.fixture(scope="module")
def picture():
    return photograph()


def test_board_and_camera_give_the_plane_in_front_of_the_board(picture):
    view = locate_board(picture, a_board(), CAMERA)
    # the drawing is sharp to a third of a pixel; sixteen corners average to below a tenth
    assert view.to_pixels(POINTS) == pytest.approx(project(POINTS, 0.02), abs=0.1)
    assert view.to_board(project(POINTS, 0.02)) == pytest.approx(POINTS, abs=1.5e-4)
    assert view.reprojection_error < 0.15
    assert len(view.markers) == 4


def test_round_trip_is_exact_to_rounding(picture):
    view = locate_board(picture, a_board(), CAMERA)
    assert view.to_board(view.to_pixels(POINTS)) == pytest.approx(POINTS, abs=1e-9)


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_every_coefficient_of_a_lens_counts_both_ways(count):
    """To the corners of the picture; to the fixed point's own tolerance of 1e-10 focal lengths."""
    view = View(homography=np.eye(3), shape=SHAPE, camera=Camera(MATRIX, LENS[:count]))
    a, b = (axis.ravel() for axis in np.meshgrid([-0.45, 0.0, 0.2, 0.5], [-0.35, -0.1, 0.0, 0.35]))
    seen = np.stack([*bend(a, b, LENS[:count]), np.ones_like(a)], axis=1) @ MATRIX[:2].T
    rays = np.stack([a, b], axis=1)
    assert view.to_pixels(rays) == pytest.approx(seen, abs=1e-9)
    assert view.to_board(seen) == pytest.approx(rays, abs=1e-9)


def test_a_rational_lens_is_the_same_for_the_board_and_the_cable():
    picture = photograph(distortion=LENS[:8])
    view = locate_board(picture, a_board(), Camera(MATRIX, LENS[:8]))
    assert view.to_pixels(POINTS) == pytest.approx(project(POINTS, 0.02, LENS[:8]), abs=0.1)


def test_the_camera_stands_where_it_stood(picture):
    """Corners of 1/10 px: 0.1 / 620 of the distance of 0.95 m across, some times that along."""
    turn, shift = pose()
    view = locate_board(picture, a_board(), CAMERA)
    stood = -turn.T @ shift - [0.0, 0.0, 0.02]
    assert view.camera_center == pytest.approx(stood, abs=1e-3)
    assert locate_board(picture, a_board(standoff=0.0)).camera_center is None


def test_standoff_moves_points_the_right_way(picture):
    near = locate_board(picture, a_board(standoff=0.02), CAMERA)
    flat = locate_board(picture, a_board(standoff=0.0), CAMERA)
    shift = project(POINTS, 0.02) - project(POINTS, 0.0)
    assert near.to_pixels(POINTS) - flat.to_pixels(POINTS) == pytest.approx(shift, abs=0.02)


def test_one_marker_is_not_enough():
    with pytest.raises(VisionError, match=r"needs 2 markers of the board, and only \[2\] of"):
        locate_board(photograph([2]), a_board(), CAMERA)


@pytest.mark.parametrize("numbers", [(0, 1, 2, 3), (0, 1, 2), (1, 3), (0, 3)])
def test_gamma_and_blur_do_not_tilt_the_board(numbers):
    """They make the squares smaller, which would be 3 to 4 mm of tilt with two markers.

    The rest, 0.1 px of a corner as with a sharp picture, is 0.3 mm beside two markers.
    """
    light = cv2.GaussianBlur(photograph(numbers).astype(float), (0, 0), 0.7)
    picture = np.round(255 * (light / 255) ** (1 / 2.2)).astype(np.uint8)
    view = locate_board(picture, a_board(), CAMERA)
    assert view.reprojection_error < 0.15
    assert view.to_board(project(POINTS, 0.02)) == pytest.approx(POINTS, abs=5e-4)


def test_without_camera_the_board_itself_is_measured():
    straight = np.zeros(5)
    view = locate_board(photograph(distortion=straight), a_board(standoff=0.0))
    assert view.to_pixels(POINTS) == pytest.approx(
        project(POINTS, 0.0, distortion=straight), abs=0.15
    )
    step = np.array([[0.15, 0.0], [0.151, 0.0]])
    per_metre = np.linalg.norm(np.diff(view.to_pixels(step), axis=0)) / 1e-3
    assert view.scale == pytest.approx(per_metre, rel=0.05)  # it varies over a tilted board


def test_a_standoff_without_camera_is_refused(picture):
    with pytest.raises(VisionError, match=r"standoff of 0\.02 m needs a camera"):
        locate_board(picture, a_board())


def test_a_missing_board_names_what_was_found(picture):
    with pytest.raises(VisionError, match="no marker at all of DICT_4X4_50"):
        locate_board(np.full((*SHAPE, 3), 170, np.uint8), a_board(), CAMERA)
    other = a_board(marker_centers={7: (0.0, 0.0)})
    with pytest.raises(
        VisionError, match=r"only markers \[0, 1, 2, 3\] of DICT_4X4_50 .* has \[7\]"
    ):
        locate_board(picture, other, CAMERA)
    with pytest.raises(VisionError, match="unknown ArUco dictionary 'DICT_4X4'"):
        locate_board(picture, a_board(dictionary="DICT_4X4"), CAMERA)


def test_markers_at_other_places_than_declared_are_refused(picture):
    swapped = a_board(marker_centers={**CENTERS, 0: CENTERS[2], 2: CENTERS[0]})
    with pytest.raises(VisionError, match=r"off .* With 0 at the place of 2, 2 at the place of 0"):
        locate_board(picture, swapped, CAMERA)
    cycled = a_board(marker_centers={n: CENTERS[(n + 1) % 4] for n in CENTERS})
    with pytest.raises(VisionError, match=r"With 0 at the place of 3, .* 3 at the place of 2 in"):
        locate_board(picture, cycled, CAMERA)
    with pytest.raises(VisionError, match=r"With a marker_size of about 0\.08 m they fit"):
        locate_board(picture, a_board(marker_size=0.1), CAMERA)


def test_a_matrix_of_pictures_of_twice_the_size_is_recognised(picture):
    """By its principal point alone it would be 1.99 times the size."""
    twice = Camera(np.diag([2, 2, 1]) @ MATRIX, DISTORTION)
    message = r"but 0\.\d+ px with the matrix divided by 2\. Try"
    with pytest.raises(VisionError, match=message):
        locate_board(picture, a_board(), twice)


def test_one_displaced_marker_of_four_is_left_out(picture):
    moved = a_board(marker_centers={**CENTERS, 1: (0.55, 0.2)})
    view = locate_board(picture, moved, CAMERA)
    assert len(view.markers) == 3
    assert view.to_pixels(POINTS) == pytest.approx(project(POINTS, 0.02), abs=0.3)


def test_two_points_give_a_similarity_with_y_up():
    """With q = u - i v = A z + B, A = 1000 px/m turned by 0.3 rad."""
    factor, offset = 1000 * np.exp(0.3j), 200 - 150j
    z = POINTS[:, 0] + 1j * POINTS[:, 1]
    pixels = np.column_stack([(factor * z + offset).real, -(factor * z + offset).imag])
    view = from_reference(pixels[:2], POINTS[:2], (300, 400, 3))
    assert view.to_pixels(POINTS) == pytest.approx(pixels, abs=1e-9)
    assert view.to_board(pixels) == pytest.approx(POINTS, abs=1e-12)
    assert view.scale == pytest.approx(1000.0)


def test_two_equal_reference_points_are_refused():
    with pytest.raises(VisionError, match="too close for a scale"):
        from_reference(np.zeros((2, 2)), [[0, 0], [1, 0]], (10, 10))
