"""A cable in space, photographed from several places, against the curve that was drawn."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scene import (
    BOARD,
    CAMERA,
    DIAMETER,
    PLACES,
    SHAPE,
    bow,
    length_of,
    loop,
    photograph,
    stand,
)
from scipy.spatial import cKDTree

from dlo_casadi.errors import VisionError
from dlo_casadi.vision import (
    Camera,
    KnownCable,
    Workings,
    compare_pixels,
    locate_camera,
    measure_views,
    see_cable,
    space_line,
)
from dlo_casadi.vision.camera import CameraPose, project_outline
from dlo_casadi.vision.image_curve import ImageCurve, loops_either_way, places_along
from dlo_casadi.vision.space_line import _unsure, agreeing_fit

CURVES = {"bow": bow(), "loop": loop()}


@pytest.fixture(scope="module")
def pictures():
    return {
        name: {where: photograph(curve, where) for where in PLACES}
        for name, curve in CURVES.items()
    }


@pytest.fixture(scope="module", autouse=True)
def searched_once():
    """A photograph that several tests use is searched once."""
    found = {}

    def see(image, viewpoint, cable):
        key = (id(image), tuple(cable.start))
        if key not in found:
            found[key] = image, see_cable(image, viewpoint, cable)  # its id stays its own
        return found[key][1]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(space_line, "see_cable", see)
        yield see


def known(curve):
    return KnownCable(curve[0], curve[-1], DIAMETER, length_of(curve))


def measured(photographs, curve):
    return measure_views(photographs, BOARD, CAMERA, known(curve))


def true_pixels(curve, where):
    rotation, translation = PLACES[where]
    at = curve @ rotation.T + translation
    return CAMERA.distort(at[:, :2] / at[:, 2:])


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("where", PLACES)
def test_a_camera_stands_where_it_stood(pictures, where):
    """Corners drawn to a quarter of a pixel, 0.05 px on average; 1 px is 1.2 mm at 1 m."""
    rotation, translation = PLACES[where]
    found = locate_camera(pictures["bow"][where], BOARD, CAMERA)
    assert found.reprojection_error < 0.15
    assert found.center == pytest.approx(-rotation.T @ translation, abs=1e-3)
    turn = found.rotation @ rotation.T
    angles = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    shift = found.translation - turn @ translation
    error = np.concatenate([angles, shift])
    # Of six numbers: 22 in one case of a thousand, 0.2 in one of six thousand.
    assert 0.2 < error @ np.linalg.solve(found.covariance, error) < 22.0


def test_slopes_of_a_projection_are_its_differences(pictures):
    view = locate_camera(pictures["bow"]["left"], BOARD, CAMERA)
    points, step = CURVES["bow"][::200], 1e-6
    _, slopes = view.project(points)
    for axis in range(3):
        moved = step * np.eye(3)[axis]
        differences = (view.to_pixels(points + moved) - view.to_pixels(points - moved)) / (2 * step)
        assert slopes[:, :, axis] == pytest.approx(differences, rel=1e-5, abs=1e-3)


def test_the_middle_of_an_outline_is_that_of_the_cylinders_surface(pictures):
    """A thick cable near the camera: its outline by brute force over its surface.

    Without a lens, which would bend the profile across so wide an outline.
    """
    straight = Camera(np.array([[810.0, 0.0, 470.0], [0.0, 810.0, 366.0], [0.0, 0.0, 1.0]]), [])
    view = replace(locate_camera(pictures["bow"]["right"], BOARD, CAMERA), camera=straight)
    diameter = 0.06
    rng = np.random.default_rng(0)
    for _ in range(5):
        axis = view.center + view.rotation.T @ [*rng.uniform(-0.2, 0.2, 2), 0.5]
        tangent = rng.standard_normal(3)
        tangent /= np.linalg.norm(tangent)
        (middle,), (normal,), _ = project_outline(view, axis, tangent, diameter)
        one = np.cross(tangent, [0.3, 0.5, 0.8])
        one /= np.linalg.norm(one)
        angle, s = np.meshgrid(np.linspace(0, 2 * np.pi, 361), np.linspace(-0.02, 0.02, 801))
        ring = np.multiply.outer(np.cos(angle), one)
        ring += np.multiply.outer(np.sin(angle), np.cross(tangent, one))
        surface = axis + 0.5 * diameter * ring + s[..., None] * tangent
        shape = (*angle.shape, 2)
        off = view.to_pixels(surface.reshape(-1, 3)).reshape(shape) - view.to_pixels(axis)
        across = off @ normal
        profile = across[np.abs(off @ [normal[1], -normal[0]]) < 0.1]
        edges = profile.min(), profile.max()
        assert (middle - view.to_pixels(axis)[0]) @ normal == pytest.approx(
            np.mean(edges), abs=0.03
        )


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("where", PLACES)
def test_the_line_in_a_photograph(pictures, searched_once, name, where):
    """It crosses itself, its shadow and the outline of the board."""
    curve = CURVES[name]
    view = locate_camera(pictures[name][where], BOARD, CAMERA)
    seen = searched_once(pictures[name][where], view, known(curve))
    truth = true_pixels(curve, where)
    away, nearest = cKDTree(truth).query(seen.pixels)
    # the picture's noise leaves 0.1 px; beside the squares of a marker single pixels are far off
    middle, most = np.quantile(away[seen.whole], [0.5, 0.98])
    assert middle < 0.12
    assert most < 0.4
    assert np.mean(cKDTree(seen.pixels).query(truth)[0] < 5.0) > 0.95
    clear = nearest[seen.whole]
    assert np.mean(np.diff(clear) > 0) > 0.97  # from start to end, but for crossings


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize(
    "places",
    [
        ("left", "ahead", "right"),
        ("left", "right"),
        pytest.param(("left", "ahead"), marks=pytest.mark.long),
        pytest.param(("ahead", "right"), marks=pytest.mark.long),
    ],
)
def test_the_line_in_space(pictures, name, places):
    curve = CURVES[name]
    found = measured({where: pictures[name][where] for where in places}, curve)
    assert not found.problems
    away = cKDTree(curve).query(found.line.points)[0]
    assert rms(away) < 0.5e-3
    assert np.mean(cKDTree(found.line.points).query(curve)[0] < 2.5e-3) > 0.95
    assert 0.7 < rms(away / found.line.std) < 2.0
    assert set(found.curves) == set(places)


def test_a_covered_stretch_is_a_gap_of_the_line_that_is_drawn(pictures):
    curve, image = CURVES["bow"], pictures["bow"]["left"].copy()
    middle = true_pixels(curve, "left")[len(curve) // 2].round().astype(int)
    cv2.circle(image, middle.tolist(), 40, (185, 185, 185), -1)
    workings = Workings()
    see_cable(image, locate_camera(image, BOARD, CAMERA), known(curve), workings)

    steps = np.linalg.norm(np.diff(workings.pixels, axis=0), axis=1)
    assert steps.max() > 60
    assert workings.gaps == (int(steps.argmax()),)


def test_pixels_are_compared_with_a_curve_across_it(pictures):
    """Moved by 1 mm, the true curve is where the slopes say that it is seen."""
    curve = CURVES["loop"]
    seen = measured(pictures["loop"], curve).curves["ahead"]
    places = places_along(seen, curve[::5])
    assert np.isfinite(places).mean() > 0.98
    used = np.isfinite(places)
    u = np.linspace(0.0, 1.0, len(curve))

    def compared(moved):
        at = np.stack([np.interp(places[used], u, moved[:, i]) for i in range(3)], axis=1)
        steps = np.gradient(moved, axis=0)
        steps = np.stack([np.interp(places[used], u, steps[:, i]) for i in range(3)], axis=1)
        tangents = steps / np.linalg.norm(steps, axis=1, keepdims=True)
        return compare_pixels(seen.viewpoint, seen.pixels[used], at, tangents, DIAMETER)

    distance, slopes = compared(curve)
    assert rms(distance[seen.whole[used]]) < 0.2
    move = np.array([3e-4, -8e-4, 5e-4])
    assert compared(curve + move)[0] == pytest.approx(distance + slopes @ move, abs=0.01)


def test_one_photograph_is_no_line_but_pixels(pictures):
    curve = CURVES["bow"]
    found = measured({"ahead": pictures["bow"]["ahead"]}, curve)
    assert found.line is None
    assert rms(cKDTree(true_pixels(curve, "ahead")).query(found.curves["ahead"].pixels)[0]) < 0.15
    assert "ahead: one photograph alone gives no line in space" in found.messages[-1]


def test_a_photograph_of_another_pose_is_named_and_left_out(pictures):
    curve = CURVES["bow"]
    mixed = {**pictures["bow"], "ahead": pictures["loop"]["ahead"]}
    found = measured(mixed, curve)
    assert list(found.problems) == ["ahead"]
    assert "of this pose" in found.problems["ahead"]
    assert rms(cKDTree(curve).query(found.line.points)[0]) < 0.5e-3
    pair = {"left": pictures["bow"]["left"], "ahead": pictures["loop"]["ahead"]}
    found = measured(pair, curve)
    assert found.line is None
    assert list(found.curves) == ["left"]
    assert found.problems["ahead"].startswith("ahead: ")


def test_a_camera_whose_place_is_not_known_is_named(pictures):
    """Where its markers tell that to 6 mm; otherwise a part of the line is not seen well."""
    images = {where: pictures["bow"][where] for where in ("left", "ahead")}
    curves = measured(images, CURVES["bow"]).curves
    assert _unsure(curves, images, DIAMETER).startswith("hidden, or seen along their depth")
    vague = replace(curves["left"].viewpoint, covariance=36e-6 * np.eye(6))
    found = _unsure({**curves, "left": replace(curves["left"], viewpoint=vague)}, images, DIAMETER)
    assert "markers in left tell where its camera stands to 6.0 mm" in found


def test_a_loop_that_was_read_the_wrong_way_round_is_turned(pictures, searched_once):
    """Of both orders in one photograph the line in space tells which is likelier."""
    curve = CURVES["loop"]
    images = {where: pictures["loop"][where] for where in ("left", "right")}
    curves = {
        where: searched_once(image, locate_camera(image, BOARD, CAMERA), known(curve))
        for where, image in images.items()
    }
    for where, seen in curves.items():
        for way in loops_either_way(seen)[1:]:
            found = {**curves, where: way}
            fit = agreeing_fit(found, {}, known(curve))
            away = cKDTree(curve).query(fit.curve.position(np.linspace(0.05, 0.95, 200)))[0]
            assert rms(away) < 1e-3


def test_two_photographs_from_one_place_have_no_depth(pictures):
    curve = CURVES["bow"]
    same = {"a": pictures["bow"]["left"], "b": pictures["bow"]["left"]}
    found = measured(same, curve)
    assert found.line is None
    assert "nearly the same place" in found.problems["b"]


def drawn(curve, rotation, translation):
    """What a camera would see of a curve, to a tenth of a pixel."""
    viewpoint = CameraPose(
        camera=CAMERA,
        rotation=rotation,
        translation=translation,
        covariance=1e-8 * np.eye(6),
        shape=SHAPE,
    )
    pixels = viewpoint.to_pixels(curve)
    std, whole = np.full(len(curve), 0.1), np.ones(len(curve), bool)
    width, depth, spread = 6.0, 1.1, 4.0
    return ImageCurve(
        viewpoint, pixels, std, whole, width, 0.1, DIAMETER, depth, spread, 1.0, (), np.ones(3), 0.8
    )


@pytest.mark.parametrize(("apart", "aside"), [(0.4, 0.4), (0.0, 0.2)], ids=["parallel", "turned"])
def test_the_places_of_cameras_give_depth_not_the_way_they_point(apart, aside):
    """Parallel cameras 0.4 m apart, and one that is turned by 10 degrees about itself."""
    curve = bow(401)
    seen, problems = {}, {}
    for side in (-0.5, 0.5):
        center, target = (0.05 + side * apart, 0.0, 1.2), (0.05 + side * aside, 0.0, 0.1)
        seen[f"at {side}"] = drawn(curve, *stand(center, target))
    fit = agreeing_fit(seen, problems, known(curve))
    assert (fit is not None) == (apart > 0.0)
    assert all("nearly the same place" in problem for problem in problems.values())


def test_a_covered_board_is_named(pictures):
    """Of four markers one may be hidden, not two; the other photographs are used."""
    curve = CURVES["bow"]
    covered = pictures["bow"]["left"].copy()
    covered[:, :330] = 150
    found = measured({**pictures["bow"], "left": covered}, curve)
    assert found.problems["left"].startswith("left: the camera's place needs 3 markers")
    assert rms(cKDTree(curve).query(found.line.points)[0]) < 0.5e-3


def test_a_marker_that_is_seen_twice_is_not_used():
    curve = CURVES["bow"]
    twice = photograph(curve, "ahead", twice=((12, (0.05, -0.35)),))
    view = locate_camera(twice, BOARD, CAMERA)
    assert view.numbers == (10, 11, 13)
    assert view.messages == (
        "marker 12 is seen more than once and not used. Try: cover or remove the copy.",
    )


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda image: np.ascontiguousarray(image[:, ::-1]), "The picture is mirrored"),
        (lambda image: np.clip(image * 3.0 + 120, 0, 255).astype(np.uint8), "overexposed"),
        (lambda image: cv2.GaussianBlur(image, (0, 0), 6.0), "blurred"),
        (lambda image: np.full_like(image, 90), "no marker at all"),
    ],
)
def test_a_photograph_that_cannot_be_used_says_why(pictures, spoil, said):
    with pytest.raises(VisionError, match=said):
        locate_camera(spoil(pictures["bow"]["left"]), BOARD, CAMERA)
