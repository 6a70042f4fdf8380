"""Sensors against curves that are known: a helix in space, a circle in the plane."""

import numpy as np
import pytest

from dlo_casadi.equilibrium.curve import NodeCurve, Observed, ObservedChange
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.sensing.sensors import Centerline, Markers

LENGTH, RADIUS, RISE = 0.9, 0.1, 0.6  # m, m, advance along the axis per arc length


def helix(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and tangents (K, 3) of a helix about z."""
    slope = np.sqrt(1 - RISE**2)
    angle = slope * s / RADIUS
    points = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), RISE * s], axis=1)
    tangents = np.stack([-slope * np.sin(angle), slope * np.cos(angle), RISE + 0 * s], axis=1)
    return points, tangents


def seen(n: int = 60) -> Observed:
    s = np.linspace(0.0, LENGTH, n + 1)
    return Observed(NodeCurve(LENGTH, *helix(s)), np.zeros(0))


def test_normals_in_space_are_carried_along_without_twist():
    """They are orthonormal to the tangent and turn from point to point by the smallest rotation.

    Its axis is normal to both tangents: the pair of normals has no antisymmetric product.
    """
    s = np.linspace(0.05, 0.85, 401)
    curve = seen(200).curve
    normals, t = curve.normals(s), curve.at(s, 1)
    frames = np.concatenate(
        [t[:, None] / np.linalg.norm(t, axis=1)[:, None, None], normals], axis=1
    )
    np.testing.assert_allclose(
        np.einsum("kai,kbi->kab", frames, frames),
        np.broadcast_to(np.eye(3), (401, 3, 3)),
        atol=1e-12,
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-12)
    product = np.einsum("kai,kbi->kab", normals[1:], normals[:-1])
    np.testing.assert_allclose(product[:, 0, 1], product[:, 1, 0], atol=1e-12)


def test_a_line_in_space_is_compared_across_its_tangent():
    """Points moved across by known vectors: their components; moved along: nothing."""
    s = np.linspace(0.1, 0.8, 12)
    now = seen()
    offset = np.random.default_rng(0).normal(scale=1e-3, size=(12, 3))
    t = now.curve.at(s, 1)
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    offset -= (offset * t).sum(axis=1, keepdims=True) * t
    line = Centerline(now.curve.at(s) + offset, np.ones(12))
    places = line.located(now, s + 0.003)
    np.testing.assert_allclose(places, s, atol=1e-8)
    residual = line.residual(now, places).reshape(12, 2)
    np.testing.assert_allclose(
        np.einsum("kn,knd->kd", residual, line.normals(now.curve, places)), offset, atol=1e-9
    )
    along = line.components(now.curve, s, t[..., None])
    np.testing.assert_allclose(along, 0.0, atol=1e-9)


def test_residuals_of_a_line_in_space_hardly_roll_with_the_curve():
    """Against differences; normals carried along the curve itself roll: 12 % of the change."""
    s, nodes = np.linspace(0.05, 0.85, 60), np.linspace(0.0, LENGTH, 101)
    now, line = seen(100), Centerline(helix(s)[0] + 0.01 * np.sin(5 * s)[:, None], np.ones(60))
    wave = 0.1 * np.stack([nodes * np.sin(6 * nodes), nodes**2, np.cos(9 * nodes)], axis=1)

    def residual(share: float) -> np.ndarray:
        curve = NodeCurve(LENGTH, now.curve.nodes + share * wave, None)
        moved = Observed(curve, np.zeros(0))
        return line.residual(moved, line.located(moved, s))

    flat = Observed(NodeCurve(LENGTH, now.curve.nodes, None), np.zeros(0))
    along = ObservedChange(wave[:, :, None], np.zeros((0, 1)))
    change = line.linearized(flat, line.located(flat, s), along)[1][:, 0]
    difference = (residual(1e-4) - residual(-1e-4)) / 2e-4
    assert np.linalg.norm(change - difference) < 0.005 * np.linalg.norm(change)


def test_markers_are_compared_in_all_directions_at_their_arc_lengths():
    """Also where another place of the curve is nearer; the derivative is minus the curve's."""
    s = np.array([0.2, 0.5, 0.9])
    now = seen()
    offset = np.array([[0.0, 0.0, 0.05], [0.01, 0.0, 0.0], [0.0, -0.02, 0.0]])
    item = MeasuredPose.of_points(HeldPose((0.0, 0.0)), now.curve.at(s) + offset, s=s)
    places = item.located(now, item.places(LENGTH))
    np.testing.assert_array_equal(places, s)
    np.testing.assert_allclose(item.residual(now, places), offset.ravel(), atol=1e-12)
    np.testing.assert_allclose(item.distances(now.curve), [0.05, 0.01, 0.02], atol=1e-12)
    table = now.curve.numbers
    step = 1e-3 * np.random.default_rng(1).normal(size=table.shape)
    ahead = Observed(NodeCurve.of(LENGTH, table + step), now.readings)
    along = ObservedChange(step[..., None], np.zeros((0, 1)))
    residual, change = item.linearized(now, places, along)
    moved = item.residual(ahead, places) - residual
    np.testing.assert_allclose(change[:, 0], moved, atol=1e-15)  # linear in the curve's numbers


def test_sensors_of_a_pose_follow_one_another():
    """A line and markers: residuals, directions and whitening are those of both."""
    s = np.array([0.2, 0.4, 0.7])
    now = seen()
    points = now.curve.at(s) + 1e-3
    line, markers = Centerline(points, np.ones(3)), Markers(points, np.array([1.0, 2.0, 1.0]), s)
    item = MeasuredPose(HeldPose((0.0, 0.0)), (line, markers))
    places = np.concatenate([line.located(now, s), s])
    both = [line.residual(now, places[:3]), markers.residual(now, s)]
    np.testing.assert_array_equal(item.residual(now, places), np.concatenate(both))
    np.testing.assert_array_equal(item.point_of, [0, 0, 1, 1, 2, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5])
    noise = NoiseModel(2e-3)
    white = np.diag(1 / (2e-3 * np.array([1] * 9 + [2] * 3 + [1] * 3)))
    np.testing.assert_allclose(item.whitening(noise, places), white)
    assert [(x.start, x.stop) for _, x, _ in item.slices] == [(0, 3), (3, 6)]
    assert [(x.start, x.stop) for _, _, x in item.slices] == [(0, 6), (6, 15)]


def test_distance_that_noise_alone_gives():
    """In space sqrt(2) times the noise for a line, sqrt(3) for markers; RMS over the points."""
    pose, points = HeldPose((0.0, 0.0, 0.0)), np.zeros((2, 3))
    line = MeasuredPose.of_points(pose, points, weight=np.array([1.0, 3.0]))
    marked = MeasuredPose.of_points(pose, points, s=np.array([0.1, 0.2]))
    assert noise_distance([line], 2e-3) == pytest.approx(2e-3 * np.sqrt(2 * 5))
    assert noise_distance([marked], 2e-3) == pytest.approx(2e-3 * np.sqrt(3))
