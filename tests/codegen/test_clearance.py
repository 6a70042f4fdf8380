"""Distances of the whole cable from obstacles, in a plane and in space."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from solvers import QUICK, moved

from dlo_casadi.codegen import Capsule, CompiledSolver, Plane
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")

POSE = HeldPose(
    (0.0, 0.0, 0.0),
    (0.4, 0.1, 0.1),
    start_orientation=(0.0, 0.0, 0.0, 1.0),
    end_orientation=(0.2, 0.0, 0.0, 0.98),
)
BALL = Capsule((0.2, 0.3, -0.1), (0.2, 0.3, -0.1), 0.05)
ROD = Capsule((0.1, -0.2, -0.2), (0.3, -0.2, 0.2), 0.02)
FLOOR = Plane((0.0, 0.0, -0.3), (0.0, 0.0, 2.0))


@pytest.fixture(scope="module")
def space():
    cable = CableData(0.6, 0.03, 0.004, 0.015, torsional_stiffness=0.011)
    model = CableModel(cable, 12, "quadratic", "clamped", "clamped", gravity=(0.0, 0.0, -9.81))
    return CompiledSolver(model, model.nominal, np.zeros(model.chain.n_rests), flags=QUICK)


def fine(shape):
    """Points of the axis, dense, from places and tangents at the nodes."""
    from scipy.interpolate import CubicHermiteSpline

    s = np.linspace(0.0, 0.6, len(shape.points))
    tangents = Rotation.from_quat(shape.x).apply([1.0, 0.0, 0.0])
    return CubicHermiteSpline(s, shape.points, tangents)(np.linspace(0.0, 0.6, 20001))


@pytest.mark.parametrize("obstacle", [BALL, ROD, FLOOR], ids=["ball", "rod", "floor"])
def test_distance_is_that_of_many_points_and_its_gradient_central_differences(space, obstacle):
    shape = space.solve(POSE)
    gap = space.clearance(shape, [obstacle], space.sensitivity(shape, POSE))
    points = fine(shape)
    if isinstance(obstacle, Plane):
        away = points[:, 2] + 0.3
    else:
        a, b = np.array(obstacle.a), np.array(obstacle.b)
        u = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0.0, 1.0)
        away = np.linalg.norm(points - a - u[:, None] * (b - a), axis=1) - obstacle.radius
    assert gap.distance == pytest.approx(away.min() - 0.002, abs=1e-8)
    assert gap.place == pytest.approx(away.argmin() / 20000, abs=1e-4)
    assert gap.point == pytest.approx(points[away.argmin()], abs=1e-4)
    assert np.linalg.norm(gap.normal) == pytest.approx(1.0)
    step = 1e-5
    for column in range(12):
        ahead = []
        for sign in (1, -1):
            there = space.solve(moved(POSE, column, sign * step), warm=shape)
            ahead.append(space.clearance(there, [obstacle]).distance)
        expected = (ahead[0] - ahead[1]) / (2 * step)
        assert gap.gradient[column] == pytest.approx(expected, abs=1e-6)


def test_the_nearest_of_many_obstacles_is_told_and_a_cut_is_negative(space):
    shape = space.solve(POSE)
    far = [space.clearance(shape, [one]).distance for one in (BALL, ROD, FLOOR)]
    gap = space.clearance(shape, [BALL, ROD, FLOOR])
    assert gap.obstacle == int(np.argmin(far))
    assert np.isnan(gap.gradient).all()  # no slope is given
    assert repr(space).startswith("<CompiledSolver ")
    assert gap.distance == min(far)
    inside = Capsule(tuple(shape.points[6]), tuple(shape.points[6]), 0.05)
    assert space.clearance(shape, [inside]).distance == pytest.approx(-0.052, abs=1e-7)
    with pytest.raises(DloError, match="0 obstacles"):
        space.clearance(shape, [])
    with pytest.raises(DloError, match="not_finite"):
        space.clearance(shape, [replace(BALL, radius=np.nan)])
    with pytest.raises(DloError, match="an Obstacle belongs here, found 1"):
        space.clearance(shape, [1])
    with pytest.raises(DloError, match="a CompiledShape of this solver belongs here, found None"):
        space.clearance(None, [BALL])
    with pytest.raises(DloError, match="must have 3 numbers"):
        space.clearance(shape, [replace(BALL, a=(0.2, 0.3))])


@pytest.mark.parametrize("element", ["link", "arc", "quadratic"])
def test_in_a_plane(element):
    model = CableModel(CableData(0.8, 0.2, 0.01, 0.1), 12, element, "clamped", "pinned")
    solver = CompiledSolver(model, model.nominal, np.zeros(model.chain.n_cells), flags=QUICK)
    pose = np.array([0.5, 0.1, 0.4])

    def posed(at):
        return HeldPose((0.0, 0.0), tuple(at[:2]), start_heading=at[2])

    def solved(at, warm=None):
        return solver.solve(posed(at), warm=warm)

    shape = solved(pose)
    slope = solver.sensitivity(shape, posed(pose))
    ball, floor = Capsule((0.3, 0.4), (0.3, 0.4), 0.05), Plane((0.0, -0.5), (0.0, 1.0))
    for obstacle in (ball, floor):
        gap = solver.clearance(shape, [obstacle], slope)
        # Links are straight; a node is a place of the cable, but seldom the nearest one.
        near = obstacle.near(shape.points).distance
        assert gap.distance <= near.min() - 0.005 + 1e-12
        assert gap.distance > near.min() - 0.005 - 0.01
        for column in range(3):
            by = 1e-6 * np.eye(3)[column]
            ahead, behind = (
                solver.clearance(solved(pose + sign * by, shape), [obstacle]).distance
                for sign in (1, -1)
            )
            assert gap.gradient[column] == pytest.approx((ahead - behind) / 2e-6, abs=1e-5)
