"""Pixels of a photograph as a sensor, against a curve that is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_casadi.equilibrium.curve import NodeCurve, Observed, ObservedChange
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.sensing.pixels import Pixels, ViewInput, pixel_std, pixels_of
from dlo_casadi.sensing.sensors import line_or_markers
from dlo_casadi.vision import Camera, CameraPose, ImageCurve
from dlo_casadi.vision.camera import project_outline

LENGTH, DIAMETER = 0.9, 0.008
CAMERA = Camera(
    np.array([[1000.0, 0, 640], [0, 1000.0, 480], [0, 0, 1]]), np.array([-0.1, 0.05, 0, 0, 0])
)
S = np.linspace(0.03, 0.87, 40)


def viewpoint(angle):
    """A camera 1.2 m away, turned by an angle about the board's y axis."""
    turn = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
    at = np.array([0.4 - 1.2 * np.sin(angle), 0.0, 1.2 * np.cos(angle)])
    return CameraPose(
        shape=(960, 1280),
        camera=CAMERA,
        rotation=turn,
        translation=-turn @ at,
        covariance=1e-8 * np.eye(6),
        reprojection_error=0.1,
    )


def curve(bend=2.0):
    """An arc of 20 elements in front of the board, leaving its plane."""
    s = np.linspace(0.0, LENGTH, 21)
    tangent = np.column_stack(
        [np.cos(bend * s - 0.9) * 0.9, np.sin(bend * s - 0.9) * 0.9, np.full(21, np.sqrt(0.19))]
    )
    angle = bend * s - 0.9
    nodes = np.column_stack(
        [0.9 / bend * np.sin(angle), -0.9 / bend * np.cos(angle), np.sqrt(0.19) * s]
    )
    return NodeCurve(LENGTH, nodes - nodes[0], tangent)


def sensor(angle, shown, together=0.0):
    """What a camera sees of a curve, without an error."""
    camera = viewpoint(angle)
    pixels, _, _ = project_outline(camera, shown.at(S), shown.at(S, 1), DIAMETER)
    shared = together * np.ones((len(S), 6))
    return Pixels(camera, pixels, DIAMETER, shown.at(S), np.ones(len(S)), 1.2e-3, shared)


def test_a_curve_is_where_it_is_seen():
    """No residual at its own pixels, also from places half an element off."""
    seen = Observed(curve(), np.zeros(0))
    pixels = sensor(0.4, curve())
    places = pixels.located(seen, S + 0.02)
    np.testing.assert_allclose(places, S, atol=1e-4)  # the middle is not quite the axis
    np.testing.assert_allclose(pixels.residual(seen, places), 0.0, atol=1e-6)
    np.testing.assert_allclose(pixels.nearest(curve()), S, atol=1e-4)


@pytest.mark.parametrize(("bend", "off"), [(2.0, 1e-3), (2.02, 0.05)])
def test_derivatives_are_those_of_the_residual(bend, off):
    """To first order; the middle of the outline follows the axis to a part in 1e-4."""
    pixels, now = sensor(0.4, curve()), curve(bend)
    table = now.numbers
    places = pixels.located(Observed(now, np.zeros(0)), S)
    step = np.random.default_rng(0).normal(size=(*table.shape, 1))
    residual, change = pixels.linearized(
        Observed(now, np.zeros(0)), places, ObservedChange(step, np.zeros((0, 1)))
    )
    np.testing.assert_array_equal(residual, pixels.residual(Observed(now, np.zeros(0)), places))
    ahead, behind = (
        pixels.residual(
            Observed(NodeCurve.of(LENGTH, table + h * step[..., 0]), np.zeros(0)), places
        )
        for h in (1e-6, -1e-6)
    )
    found = (ahead - behind) / 2e-6
    # beside it the tangent turns the normal, which a residual of some millimetres feels
    np.testing.assert_allclose(change[:, 0], found, atol=off * np.abs(found).max())


def test_displaced_points_change_the_residual_as_their_images_do():
    pixels, shown, way = (
        sensor(0.4, curve()),
        curve(),
        np.random.default_rng(0).normal(size=(40, 3)),
    )

    def residual(step):
        seen = project_outline(viewpoint(0.4), shown.at(S) + step * way, shown.at(S, 1), DIAMETER)
        return replace(pixels, pixels=seen[0]).residual(Observed(shown, np.zeros(0)), S)

    found = (residual(1e-6) - residual(-1e-6)) / 2e-6
    change = pixels.components(shown, S, way[..., None])[:, 0]
    np.testing.assert_allclose(change, found, atol=1e-3 * np.abs(found).max())


def test_errors_of_the_cameras_place_are_part_of_the_covariance():
    pixels = sensor(0.4, curve(), together=1e-3)
    white = pixels.whitening(NoiseModel(1e-4), S)
    covariance = 1e-8 * np.eye(len(S)) + 6e-6
    np.testing.assert_allclose(white @ covariance @ white.T, np.eye(len(S)), atol=1e-9)


def test_errors_are_correlated_over_the_average_along_the_cable():
    """All of what is not correlated otherwise: pixels two lengths apart share exp(-2) of it."""
    pixels = replace(sensor(0.4, curve()), correlation_length=0.02)
    places = np.array([0.1, 0.14, 0.5])
    noise, together = NoiseModel(1e-4, 0.5, 0.01, "exponential"), np.zeros((3, 6))
    pixels = replace(pixels, weight=np.ones(3), by_camera=together)
    white = pixels.whitening(noise, places)
    inverse = np.linalg.inv(white.T @ white) / 1e-8
    assert inverse[0, 1] == pytest.approx(0.5 * (np.exp(-2) + np.exp(-4)), rel=1e-6)
    assert inverse[0, 2] == pytest.approx(0.0, abs=1e-9)


def test_pixels_near_the_ends_and_beside_each_other_are_left_out():
    """Of a straight line of 1 px steps averaged over 4 px: one of every 8, none near an end."""
    camera, count = viewpoint(0.0), 301
    pixels = np.column_stack([np.arange(count) + 400.0, np.full(count, 500.0)])
    places = np.column_stack([np.linspace(0.2, 0.6, count), np.zeros(count), np.zeros(count)])
    curve = ImageCurve(
        camera, pixels, np.full(count, 0.05), np.ones(count, bool), 6.0, 0.1, DIAMETER, 1.2,
        4.0 * np.sqrt(np.pi), 1.0, (), np.zeros(3), 1.0,
    )  # fmt: skip
    view = ViewInput("a", Path("a.jpg"), curve, places)
    assert pixel_std([view]) == pytest.approx(0.05 * 1.2 / 1000)
    found = pixels_of(view, pixel_std([view]))
    u = found.pixels[:, 0] - 400.0
    assert u.min() > 16.0
    assert u.max() < count - 17.0
    np.testing.assert_allclose(np.diff(u), 8.0)
    np.testing.assert_allclose(found.weight, 1.0)
    assert found.correlation_length == pytest.approx(np.sqrt(2) * 4.0 * 1.2 / 1000)


def test_errors_of_the_cameras_pose_move_all_pixels_as_it_does():
    """Rows of pixels along u are compared in v; the covariance is J C J^T, J by differences."""
    count, root = 301, 1e-3 * np.random.default_rng(0).normal(size=(6, 6))
    camera = replace(viewpoint(0.3), covariance=root @ root.T)
    pixels = np.column_stack([np.arange(count) + 400.0, np.full(count, 500.0)])
    places = np.linspace([0.2, -0.1, 0.1], [0.6, 0.2, 0.0], count)
    curve = ImageCurve(
        camera, pixels, np.full(count, 0.05), np.ones(count, bool), 6.0, 0.1, DIAMETER, 1.2,
        4.0 * np.sqrt(np.pi), 1.0, (), np.zeros(3), 1.0,
    )  # fmt: skip
    found = pixels_of(ViewInput("a", Path("a.jpg"), curve, places), 1e-4)
    ahead, behind = (
        np.array([camera.moved(way).to_pixels(found.points)[:, 1] for way in step * np.eye(6)])
        for step in (1e-6, -1e-6)
    )
    slopes = found.size * (ahead - behind).T / 2e-6
    expected = slopes @ camera.covariance @ slopes.T
    shared = found.by_camera @ found.by_camera.T
    np.testing.assert_allclose(shared, expected, rtol=0, atol=1e-6 * expected.max())


@pytest.mark.parametrize("line", [True, False])
def test_a_pose_of_photographs(line):
    """Its distances are those of its line; of one photograph those across the line of sight."""
    shown = curve()
    points = shown.at(S) if line else np.zeros((0, 3))
    item = MeasuredPose(
        HeldPose((0.0, 0.0, 0.0)),
        (sensor(0.4, shown), sensor(-0.4, shown)),
        line=line_or_markers(points),
    )
    assert item.has_line is line
    assert len(item.distances(shown)) == (len(S) if line else 2 * len(S))
    np.testing.assert_allclose(item.distances(shown), 0.0, atol=1e-6)
    moved = NodeCurve(LENGTH, shown.nodes + np.array([0.0, 0.0, 1e-3]), shown.slopes)
    assert 0.3e-3 < np.sqrt(np.mean(item.distances(moved) ** 2)) < 1e-3
    np.testing.assert_array_equal(item.traced.points, points if line else item.points)
