"""Cables in a gripper with a free tip: of two ways to fall, which one, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.effects import Cable
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.equilibrium.solve import continued, solve_equilibrium
from dlo_casadi.errors import ConfigError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.stiffness import fit_stiffness
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.remarks import branch_warnings
from dlo_casadi.session.stages import initial_stage

EI, STD = 0.028, 1e-3
MODEL = CableModel(Cable(0.5, 0.3, 0.012, EI), 12, start="clamped", end="free", n_rest=5)
STRAIGHT = np.zeros(MODEL.chain.n_cells)
UP = np.pi / 2


def held(beyond, branch=None):
    """A pose whose gripper points so far beyond straight up [rad]."""
    return Pose((0.0, 0.0), None, UP + beyond, branch=branch, name=f"{beyond:+.2f}")


def fallen(pose):
    return solve_equilibrium(MODEL, MODEL.nominal, STRAIGHT, pose)


def turned_over(points=30, branch=None, model=MODEL):
    """Poses of a gripper that turns slowly over the top, seen with noise; some name a branch."""
    rng = np.random.default_rng(0)
    poses = [held(b, None if k == 0 else "previous") for k, b in enumerate((1.2, 0.6, 0.1, -0.3))]
    s = np.linspace(0.0, model.cable.length, points)
    return [
        MeasuredPose.of_points(
            replace(pose, branch=pose.branch if branch else None),
            shape.curve.at(s) + STD * rng.normal(size=(points, 2)),
        )
        for pose, shape in zip(
            poses, predict_poses(model, model.nominal, STRAIGHT, poses), strict=True
        )
    ]


@pytest.mark.parametrize("beyond", [0.05, 0.2])
def test_near_a_gripper_that_points_up_a_cable_may_fall_to_either_side(beyond):
    lowest = fallen(held(beyond))
    other = fallen(held(beyond, "cw"))
    mirrored = fallen(held(-beyond, "ccw"))
    assert lowest.turn > 0 > other.turn
    assert other.energy > lowest.energy
    assert other.energy == pytest.approx(mirrored.energy, rel=1e-9)
    # By symmetry both are as low with the gripper straight up; the angle is of first order.
    assert lowest.tipping == pytest.approx(beyond, rel=0.01)
    assert fallen(held(1.5)).tipping is None


def test_a_cable_is_followed_over_the_top_until_it_snaps():
    """The way back snaps where the mirrored one does."""
    before = held(1.0)
    x = fallen(before).x
    stays = continued(MODEL, MODEL.nominal, STRAIGHT, held(-0.9), before, x)
    assert stays.stable
    assert stays.turn > 0 > fallen(held(-0.9)).turn
    snapped = continued(MODEL, MODEL.nominal, STRAIGHT, held(-1.3), before, x)
    assert snapped.phi == pytest.approx(fallen(held(-1.3)).phi, abs=1e-6)
    back = continued(MODEL, MODEL.nominal, STRAIGHT, held(0.9), held(-1.3), snapped.x)
    assert back.energy == pytest.approx(stays.energy, rel=1e-9)


def test_a_pose_on_the_other_side_is_named_with_its_remedy():
    stage = replace(initial_stage(MODEL, turned_over()), name="batch")
    assert {name: found.branch for name, found in stage.other_branch.items()} == {"-0.30": "ccw"}
    other, either = branch_warnings([stage])
    assert "-0.30: the equilibrium of lowest energy" in other
    assert "`branch: ccw` in these poses chooses it" in other
    assert "+0.10: the cable may fall to either side" in either
    assert "with the clamp turned by 0.1 rad" in either

    told = replace(initial_stage(MODEL, turned_over(branch="previous")), name="batch")
    assert told.other_branch == {}
    assert branch_warnings([told]) == []
    assert told.rmse_fit < 2 * STD


@pytest.mark.parametrize("factor", [0.25, 10])
def test_a_pose_on_the_other_side_does_not_count_against_the_fit(factor):
    """Predicted, it is 200 mm away; 30 points to 1 mm tell EI to a tenth of a per cent."""
    prior = replace(MODEL, cable=replace(MODEL.cable, bending_stiffness=factor * EI))
    measured = turned_over()
    alone = fit_stiffness(prior, measured)
    assert alone.rms < 1.2 * STD
    assert abs(np.log(alone.EI / EI)) < 3 * alone.log_std < 0.01
    fit = fit_model(prior, measured, Tolerances(), STD)
    assert abs(np.log(fit.p[0] / EI)) < 3 * np.sqrt(fit.covariance[0, 0])
    assert fit.stable.all()


def test_the_first_pose_continues_none(tmp_path):
    (tmp_path / "a.csv").write_text("x_m,y_m\n0,0\n0,-0.5\n")
    pose = {"file": "a.csv", "start": [0, 0], "start_heading": 0.1, "branch": "previous"}
    data = {
        "cable": {"length": 0.5, "mass": 0.3, "diameter": 0.01, "bending_stiffness": EI},
        "experiment": {
            "gravity": [0, -9.81],
            "boundary": {"start": "clamped", "end": "free"},
            "measurement": {"kind": "centerlines"},
            "poses": [pose],
        },
    }
    (tmp_path / "c.yaml").write_text(dump_yaml(data))
    with pytest.raises(ConfigError, match="the first pose continues none; branch: ccw or cw"):
        load_config(tmp_path / "c.yaml")


def test_in_space_a_cable_is_followed_too():
    """In a vertical plane, gravity along -z and the gripper turned about y; twist has no part."""
    cable = replace(MODEL.cable, torsional_stiffness=0.02)
    model = CableModel(cable, 12, start="clamped", end="free", gravity=(0.0, 0.0, -9.81))
    rest = np.zeros(model.chain.n_rests)

    def gripper(beyond):
        half = -(UP + beyond) / 2  # counter-clockwise against y
        return Pose((0.0,) * 3, start_orientation=(0.0, np.sin(half), 0.0, np.cos(half)))

    before, after = gripper(1.2), gripper(0.3)
    x = solve_equilibrium(model, model.nominal, rest, before).x
    moved = continued(model, model.nominal, rest, after, before, x)
    assert moved.stable
    # On twelve elements of another kind: both errors are below a hundredth of the length.
    planar = fallen(held(0.3))
    assert moved.points[-1] == pytest.approx(
        [planar.points[-1, 0], 0, planar.points[-1, 1]], abs=5e-3
    )
