"""One Pose and one Obstacle for all that finds shapes."""

import casadi as ca
import numpy as np
import pytest

import dlo_casadi as dlo

ROPE = {"length": 0.6, "mass": 0.06, "diameter": 0.008, "bending_stiffness": 0.01}
TURNED = (0.0, 0.0, np.sin(0.2), np.cos(0.2))
IN_SPACE = pytest.mark.parametrize("in_space", [False, True], ids=["plane", "space"])


def cable_and_pose(in_space):
    if in_space:
        rope, gravity = dlo.Cable(**ROPE, torsional_stiffness=0.008), (0, 0, -9.81)
        frames = {"start_orientation": (0, 0, 0, 1), "end_orientation": TURNED}
        pose = dlo.Pose((0.1, 0.0, 0.0), (0.4, 0.1, 0.05), **frames)
    else:
        rope, gravity = dlo.Cable(**ROPE), (0, -9.81)
        pose = dlo.Pose((0.1, 0.0), (0.4, 0.1), start_heading=-0.4, end_heading=0.3)
    known = {"gravity": gravity, "boundary": ("clamped", "clamped"), "model": {"n": 6}}
    return dlo.known_cable(rope, **known), pose


@IN_SPACE
def test_one_pose_serves_them_all(in_space):
    cable, pose = cable_and_pose(in_space)
    points = cable.solve(pose).equilibrium.points
    assert pose.vector().shape == ((15,) if in_space else (6,))
    np.testing.assert_allclose(np.array(cable.function()(pose.vector())[0]).T, points, atol=1e-9)
    np.testing.assert_allclose(cable.initial(pose).x, cable.initial(pose.vector()).x)
    compiled = cable.compile(flags=("-O0",))
    np.testing.assert_allclose(compiled.solve(pose).points, points, atol=1e-8)
    np.testing.assert_array_equal(compiled.solve_many(pose.vector()[None])[1], [0])
    opti = ca.Opti()
    (shape,) = cable.transcribe(opti, [pose])
    np.testing.assert_allclose(opti.debug.value(shape.points, opti.initial()).T, points, atol=1e-9)


def test_the_branch_of_a_pose_is_that_of_its_first_guess():
    rope = dlo.known_cable(
        dlo.Cable(**ROPE), gravity=(0, -9.81), boundary=("pinned", "pinned"), model={"n": 6}
    )
    for branch, sign in (("ccw", 1), ("cw", -1)):
        x = rope.initial(dlo.Pose((0, 0), (0.4, 0.0), branch=branch)).x
        assert sign * (x[0, -1] - x[0, 0]) > 0


def test_one_obstacle_serves_both():
    rope = dlo.known_cable(
        dlo.Cable(**ROPE), gravity=(0, -9.81), boundary=("pinned", "pinned"), model={"n": 10}
    )
    pose = dlo.Pose((0, 0), (0.3, 0.0))
    table = dlo.Obstacle(kind="plane", point=(0, -0.15), normal=(0, 2))
    points = rope.solve(pose, obstacles=[table]).equilibrium.points
    assert points[:, 1].min() > -0.15
    compiled = rope.compile(flags=("-O0",), obstacles=1)
    found = compiled.solve(pose, obstacles=[table]).points
    assert found[:, 1].min() == pytest.approx(points[:, 1].min(), abs=2e-3)
    with pytest.raises(dlo.DloError, match="obstacle_1: a plane needs normal"):
        compiled.solve(pose, obstacles=[dlo.Obstacle(kind="plane", point=(0, -0.15))])


def test_a_pose_stands_alone():
    cable, pose = cable_and_pose(False)
    with pytest.raises(dlo.DloError, match=r"solve\(pose\) beside start_heading: a Pose has them"):
        cable.solve(pose, start_heading=0.0)
