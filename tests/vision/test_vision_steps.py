"""What the steps of an extraction hand out, and what they say of glare, markers and length."""

import cv2
import numpy as np
import pytest
from drawing import SCALE, arc, draw, square_view, to_pixels
from scipy.spatial import cKDTree

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import (
    Board,
    KnownCable,
    Workings,
    draw_steps,
    encoded,
    extract_centerline,
    locate_board,
)

WIDTH_PX, LENGTH = 6.0, 0.6
CABLE = arc(length=LENGTH)
STEPS = ["1_workplane", "2_contrast", "3_strands", "4_centerline"]


def extract(image, workings=None, length=LENGTH):
    return extract_centerline(
        image,
        square_view(image.shape),
        KnownCable(CABLE[0], CABLE[-1], WIDTH_PX / SCALE, length),
        workings,
    )


def blue(picture):
    """Pixels in the colour of the measured line."""
    return np.abs(picture.astype(int) - (178, 114, 0)).sum(axis=2) < 60


def test_the_steps_of_a_cable_that_is_found():
    image, workings = draw(CABLE), Workings()
    extract(image, workings)
    pictures = draw_steps(image, workings)

    assert list(pictures) == STEPS
    assert sum(map(len, workings.chosen)) > 100
    above = (workings.candidate > workings.cut) & workings.plane.reachable
    rows, columns = np.nonzero(above)
    marked = workings.plane.to_board(np.column_stack([columns, rows]))
    off = SCALE * cKDTree(CABLE).query(marked)[0]
    assert off.max() < WIDTH_PX / 2 + 1  # px: the cable and nothing else
    assert len(marked) * workings.plane.pixel**2 > 0.7 * LENGTH * WIDTH_PX / SCALE  # nearly all
    v, u = np.nonzero(blue(pictures["4_centerline"]))
    away = cKDTree(to_pixels(CABLE)).query(np.column_stack([u, v]))[0]
    assert len(away) > 200
    assert away.max() < 2.5  # px: the line is drawn where the cable is
    assert np.array_equal(image, draw(CABLE)), "the photograph itself is left alone"


def test_the_steps_of_a_cable_that_is_not_found():
    image, workings = np.full((420, 560, 3), 185, np.uint8), Workings()
    with pytest.raises(VisionError, match="no cable found"):
        extract(image, workings)
    pictures = draw_steps(image, workings)
    assert "1_workplane" in pictures
    assert not blue(pictures["4_centerline"]).any()
    assert list(draw_steps(image, Workings())) == ["4_centerline"]


def test_a_picture_is_encoded_by_the_ending_of_its_file():
    assert encoded(draw(CABLE), ".png").startswith(b"\x89PNG")
    assert encoded(draw(CABLE), ".jpg").startswith(b"\xff\xd8")


def test_glare_is_told_from_a_card():
    image = draw(CABLE)
    u, v = to_pixels(CABLE)[200].astype(int)
    image[v - 20 : v + 20, u - 20 : u + 20] = 255
    (message,) = extract(image).messages
    assert message.startswith("glare hides 1")
    share, first, last = (float(x) for x in np.array(message.split())[[2, 8, 10]])
    assert share == pytest.approx(100 * (last - first) / LENGTH, abs=2.0)
    assert first < 0.3 < last  # where the white patch is


@pytest.mark.parametrize(("factor", "said"), [(1.05, "4.8 % shorter"), (0.95, "5.3 % longer")])
def test_a_length_that_does_not_fit_is_told(factor, said):
    (message,) = extract(draw(CABLE), length=factor * LENGTH).messages
    assert message.startswith(f"the line found is {said} than declared (0.6")


CENTERS = {0: (0.1, -0.1), 1: (0.9, -0.1), 2: (0.9, -0.6), 3: (0.1, -0.6)}


def board_picture(centers, size_px=60):
    """A board straight ahead, its markers at their centres."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    picture = np.full((520, 720, 3), 255, np.uint8)
    for number, center in centers.items():
        marker = cv2.aruco.generateImageMarker(dictionary, number, size_px)
        u, v = np.round(to_pixels(center)).astype(int) - size_px // 2
        picture[v : v + size_px, u : u + size_px] = marker[..., None]
    return picture


def test_markers_are_told_apart():
    board = Board("DICT_4X4_50", 60 / SCALE, 0.0, CENTERS)
    view = locate_board(board_picture(CENTERS), board)
    assert view.numbers == (0, 1, 2, 3)
    places = view.to_board(view.markers.mean(axis=1))
    assert places == pytest.approx(np.array([CENTERS[n] for n in view.numbers]), abs=2e-3)
    seen = locate_board(board_picture({n: CENTERS[n] for n in (0, 1, 3)}), board)
    assert seen.numbers == (0, 1, 3)
    assert seen.messages == ("marker 2 is not found; 3 of 4 are used",)
    moved = locate_board(board_picture(CENTERS | {2: (0.8, -0.5)}), board)
    assert moved.numbers == (0, 1, 3)
    assert moved.messages == ("marker 2 is not where it is declared; 3 of 4 are used",)
    copied = np.minimum(board_picture(CENTERS), board_picture({2: (0.5, -0.3)}))
    assert locate_board(copied, board).messages == (
        "marker 2 is seen more than once and not used. Try: cover or remove the copy.",
    )


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        (np.diag([1, -1]), "With y pointing up in marker_centers they fit."),
        (np.array([[0, 1], [1, 0]]), "With x and y exchanged in marker_centers they fit."),
        (-np.eye(2), "With both turned by 180 degrees in marker_centers they fit."),
    ],
)
def test_places_of_markers_in_another_frame_are_recognised(axes, said):
    centers = {n: tuple(axes @ center) for n, center in CENTERS.items()}
    with pytest.raises(VisionError, match=said):
        locate_board(board_picture(CENTERS), Board("DICT_4X4_50", 60 / SCALE, 0.0, centers))


def test_a_mirrored_board_is_recognised():
    board = Board("DICT_4X4_50", 60 / SCALE, 0.0, CENTERS)
    with pytest.raises(VisionError, match=r"The picture is mirrored: .* \[0, 1, 2, 3\]"):
        locate_board(np.ascontiguousarray(board_picture(CENTERS)[:, ::-1]), board)
