"""Centre-lines of drawn cables, whose shape is known to a small part of a pixel."""

import numpy as np
import pytest
from drawing import SCALE, arc, distance, draw, normal_distance_px, square_view, to_pixels

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import KnownCable, extract_centerline

WIDTH_PX = 6.0
CABLE = arc()


def extract(image, truth, width_px=WIDTH_PX, length=None, **fixtures):
    steps = np.linalg.norm(np.diff(truth, axis=0), axis=1)
    ends = {"start": truth[0], "end": truth[-1], **fixtures}
    length = steps.sum() if length is None else length
    cable = KnownCable(**ends, diameter=width_px / SCALE, length=length)
    return extract_centerline(image, square_view(image.shape), cable)


# RMS [px] allowed: a drawn cable without a trick is found to 0.02 px; noise and shadow cost more
LOOKS = {
    "dark": ({}, 0.05),
    "bright": ({"cable": (230, 230, 230), "board": (50, 50, 50), "shadow": 0.5}, 0.05),
    "red on green of the same luminance": ({"cable": (60, 60, 220), "board": (60, 155, 30)}, 0.05),
    "highlight brighter than the board": ({"highlight": 200}, 0.05),
    "shadow beside it": ({"shadow": 0.4}, 0.3),
    "blurred and noisy": ({"blur": 2.5, "noise": 10}, 0.15),
    "thin": ({"width_px": 3.0}, 0.05),
    "moved while exposed": ({"motion": 9}, 0.05),
    "uneven light": ({"gradient": 0.6}, 0.05),
    "low contrast": ({"cable": (165, 160, 155), "noise": 3}, 0.1),
}


@pytest.mark.parametrize("look", LOOKS)
def test_a_drawn_cable_is_found_whatever_it_looks_like(look):
    style, allowed = LOOKS[look]
    line = extract(draw(CABLE, **style), CABLE, style.get("width_px", WIDTH_PX))
    miss = normal_distance_px(line.points, CABLE)
    assert np.sqrt(np.mean(miss**2)) < allowed
    # Where noise counts the errors are as large as told; else less than the smallest std, 0.06 px.
    told = np.sqrt(np.mean((miss / (SCALE * line.std)) ** 2))
    assert {"blurred and noisy": 0.6, "low contrast": 0.4}.get(look, 0.1) < told < 1.5
    assert miss.max() < 1.0
    assert line.coverage > 0.97
    assert line.gaps == ()
    assert np.all(np.sum(np.diff(line.points, axis=0) * np.diff(CABLE[::3], axis=0)[0], 1)[:5] > 0)


def glossy(strength):
    """Thick yellow cable on dark green, lit from one side, with a wide highlight aside."""
    width_px, steps = 16.0, np.gradient(CABLE, axis=0)
    normal = steps[:, ::-1] * [-1, 1] / np.linalg.norm(steps, axis=1, keepdims=True)
    image = draw(
        CABLE, width_px=width_px, cable=(30, 110, 140), board=(45, 60, 35), shadow=0.5, blur=1.0
    )
    body = distance(CABLE, image.shape[:2], width_px) < width_px / 2 - 1
    aside = distance(CABLE + 0.25 * width_px / SCALE * normal, image.shape[:2], 2 * width_px)
    light = strength * body * np.exp(-((aside / (0.3 * width_px)) ** 2))
    return np.clip(image + light[..., None] * [0.6, 0.9, 1.0], 0, 255).astype(np.uint8)


def test_a_highlight_aside_is_not_taken_for_the_cable():
    """Its level counts in part, a twelfth of the width; as the cable itself it is a quarter."""
    line = extract(glossy(90), CABLE, 16.0)
    assert np.sqrt(np.mean(normal_distance_px(line.points, CABLE) ** 2)) < 16 / 11
    assert line.messages == ()
    with pytest.raises(VisionError, match=r"it is 1\d\.. mm wide .* 32.0 mm.*if it is glossy"):
        extract(glossy(200), CABLE, 16.0)


def test_the_result_is_ordered_spaced_and_consistent():
    line = extract(draw(CABLE), CABLE)
    steps = np.linalg.norm(np.diff(line.points, axis=0), axis=1)
    assert np.linalg.norm(line.points[0] - CABLE[0]) < np.linalg.norm(line.points[0] - CABLE[-1])
    assert steps.max() < 2 * np.median(steps)
    assert 0.0015 < np.median(steps) < 0.0035
    assert len(line.points) <= 401
    assert line.pixels == pytest.approx(to_pixels(line.points), abs=1e-6)
    assert line.std.shape == (len(line.points),)
    assert np.all((line.std > 0) & (line.std < 0.5 / SCALE))
    assert line.messages == ()


def test_reversed_fixtures_reverse_the_points():
    image = draw(CABLE)
    forwards, backwards = extract(image, CABLE), extract(image, CABLE[::-1])
    assert np.linalg.norm(backwards.points[0] - forwards.points[-1]) < 0.005


def test_a_loop_that_crosses_itself_is_followed_straight_on():
    loop = arc(length=1.2, turn=2 * np.pi + 3.0, heading=-0.3, start=(0.15, -0.5))
    line = extract(draw(loop, shape=(500, 560)), loop)
    assert normal_distance_px(line.points, loop).max() < 1.0
    assert line.coverage > 0.97
    s = np.searchsorted(np.linspace(0, 1, len(loop)), np.linspace(0.05, 0.95, len(line.points)))
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line.points, axis=0), axis=1))])
    assert along[-1] == pytest.approx(1.2, abs=0.04)  # no shortcut at the crossing
    assert np.linalg.norm(line.points - loop[s], axis=1).max() < 0.08


@pytest.mark.parametrize("colour", [(40, 60, 200), (45, 45, 45)])
def test_behind_an_occluder_is_a_gap_and_order_survives(colour):
    image = draw(CABLE)
    u, v = to_pixels(CABLE)[200].astype(int)
    image[v - 20 : v + 20, u - 20 : u + 20] = colour
    line = extract(image, CABLE)
    assert len(line.gaps) == 1
    assert normal_distance_px(line.points, CABLE).max() < 1.0
    assert 0.75 < line.coverage < 0.9
    assert "hidden" in line.messages[0]


def test_a_cable_that_leaves_the_picture_and_returns_is_one_cable():
    bow = arc(length=0.8, turn=-2.8, heading=1.4, start=(0.1, -0.3))
    image = draw(bow)
    top = 110  # the bow's highest part lies above this row
    cut = image[top:]
    view = square_view(cut.shape)
    moved = bow + np.array([0.0, top / SCALE])
    cable = KnownCable(moved[0], moved[-1], WIDTH_PX / SCALE, 0.8)
    line = extract_centerline(cut, view, cable)
    assert normal_distance_px(line.points, moved).max() < 1.0
    assert len(line.gaps) == 1
    assert "outside the picture" in line.messages[0]
    inside = np.all(to_pixels(moved) >= 0, axis=1).mean()
    assert line.coverage > 0.88 * inside  # it meets the border at a slant, and two rims are lost


def test_a_holder_of_the_cables_colour_is_not_followed():
    image = draw(CABLE)
    u, v = to_pixels(CABLE)[0].astype(int)
    image[v - 40 : v + 5, u - 40 : u + 40] = (40, 40, 40)
    line = extract(image, CABLE)
    assert normal_distance_px(line.points, CABLE).max() < 1.0
    assert line.coverage > 0.93


def test_a_thinner_line_beside_the_cable_is_ignored():
    image = draw(CABLE, onto=draw(CABLE + np.array([0.0, 0.06]), width_px=2.0))
    line = extract(image, CABLE)
    assert normal_distance_px(line.points, CABLE).max() < 1.0


def test_a_free_end_is_found_without_a_fixture():
    line = extract(draw(CABLE), CABLE, end=None)
    assert line.coverage > 0.97
    assert np.linalg.norm(line.points[-1] - CABLE[-1]) < 0.01


def test_a_tail_beyond_the_fixture_is_not_measured():
    held = CABLE[60:340]
    line = extract(draw(CABLE), held)
    assert np.linalg.norm(line.points[0] - held[0]) < 0.015
    assert np.linalg.norm(line.points[-1] - held[-1]) < 0.015


def test_two_cables_are_refused():
    other = arc(start=(0.25, -0.1))
    with pytest.raises(VisionError, match=r"two cables: .* leave one cable in the picture"):
        extract(draw(CABLE, onto=draw(other)), CABLE)


@pytest.mark.parametrize("look", [{"width_px": 4.0}, {"cable": (190, 70, 20)}])
def test_a_wire_of_another_width_or_colour_is_no_second_cable(look):
    across = np.column_stack([np.linspace(0.05, 1.0, 200), np.linspace(-0.05, -0.5, 200)])
    wire = draw(across, **{"width_px": 5.4, "cable": (150, 60, 20), **look})
    line = extract(draw(CABLE, onto=wire), CABLE)
    assert normal_distance_px(line.points, CABLE).max() < 1.0
    assert line.messages == ()


def test_no_cable_dark_and_overexposed_pictures_say_so():
    empty = np.full((420, 560, 3), 185, np.uint8)
    with pytest.raises(VisionError, match=r"no cable found: the best chain .* background"):
        extract(empty, CABLE)
    with pytest.raises(VisionError, match="too dark"):
        extract(draw(CABLE, cable=(4, 4, 4), board=(6, 6, 6)), CABLE)
    with pytest.raises(VisionError, match="overexposed"):
        extract(np.full((420, 560, 3), 255, np.uint8), CABLE)


def test_wrong_declarations_are_named():
    image = draw(CABLE)
    with pytest.raises(VisionError, match=r"does not reach its end: .* from \(0\.350, -0\.200\) m"):
        extract(image, CABLE, end=(0.35, -0.2), length=0.9)
    with pytest.raises(VisionError, match="almost nothing of the place that it can reach"):
        extract(image, CABLE, start=(5.0, 5.0), end=(5.3, 5.0))
    with pytest.raises(VisionError, match="no cable found"):
        extract(image, CABLE, width_px=30.0)


def test_a_cable_wider_than_the_photograph_is_named():
    """A diameter in the wrong unit: nothing is left of a picture in which it is six pixels wide."""
    with pytest.raises(VisionError, match=r"diameter would be 1000 pixels wide in a photograph"):
        extract(draw(CABLE), CABLE, width_px=1000)
