"""Cables in a gripper with a free tip: of two ways to fall, which one, and what is said of it."""

import re
from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import continued, solve_equilibrium
from dlo_casadi.equilibrium.spread import Repeats, SolvedCable, Uncertainty, tipping
from dlo_casadi.errors import ConfigError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.stiffness import fit_stiffness
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.remarks import branch_warnings, doubts_of
from dlo_casadi.session.stages import fit_stage

EI, STD = 0.028, 1e-3
MODEL = CableModel(CableData(0.5, 0.3, 0.012, EI), 12, start="clamped", end="free", n_rest=5)
STRAIGHT = np.zeros(MODEL.chain.n_cells)
UP = np.pi / 2


def held(beyond, branch=None):
    """A pose whose gripper points so far beyond straight up [rad]."""
    return HeldPose((0.0, 0.0), None, UP + beyond, branch=branch, name=f"{beyond:+.2f}")


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
    assert tipping(MODEL, lowest, lowest.other_side) == pytest.approx(beyond, rel=0.01)
    assert lowest.other_side.energy == pytest.approx(other.energy, rel=1e-9)
    assert other.other_side is None  # the pose tells its branch
    assert fallen(held(1.5)).other_side is None


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


def test_clips_move_with_the_ends_while_a_cable_is_followed():
    moves = ((-0.2, 0.4, 0.2), (0.3, 0.48, 0.4))
    clips = [(HeldClip("clamped", (0.3, y), at, heading=a),) for y, at, a in moves]
    before, after = (HeldPose((0.0, 0.0), start_heading=0.0, clips=x) for x in clips)
    way = after.on_the_way(before, 0.4)
    assert way.clips[0].place == pytest.approx((0.3, 0.0))
    assert way.clips[0].heading == pytest.approx(0.28)
    assert way.clips[0].at == pytest.approx(0.432)
    assert after.on_the_way(before, 1.0).clips == after.clips


def judged(measured):
    """The stage of a fit, and what is said of it: doubts and warnings."""
    fit = fit_model(MODEL, measured, Tolerances(), STD)
    stage = fit_stage("batch", fit, measured, {})
    shown = [
        PoseInput(item.pose.name, "held_out" if item.held_out else "fit", item.points)
        for item in measured
    ]
    return stage, [*doubts_of([stage], shown, fit), *branch_warnings([stage])]


def test_a_fit_pose_on_the_other_side_is_compared_there_and_named():
    stage, (said,) = judged(turned_over())
    assert {name: side.branch for name, side in stage.measured_side.items()} == {"-0.30": "ccw"}
    # Simulated as the cable turned over on the side where it is higher.
    assert re.search(
        r"^declared model, fitted: -0.30: .* equilibrium than predicted, with an energy "
        r"[\d.e-]+ J higher;",
        said,
    )
    assert said.endswith("needs `branch: ccw`")
    assert stage.rmse_fit == stage.rmse_fit_measured_branch < 2 * STD

    told, said = judged(turned_over(branch="previous"))
    assert told.measured_side == {}
    assert said == []
    assert told.rmse_fit < 2 * STD


def test_held_out_poses_on_either_side_are_told_with_both_errors():
    """Both are fallen counter-clockwise, -0.30 from before; the lower side is the other one."""
    held_out = ("+0.10", "-0.30")
    measured = [replace(item, held_out=item.pose.name in held_out) for item in turned_over()]
    stage, said = judged(measured)
    assert said == []
    usual, other = (stage.shapes[name].either_side for name in held_out)
    assert (usual.predicted.branch, usual.other.branch) == ("ccw", "cw")
    assert (other.predicted.branch, other.other.branch) == ("cw", "ccw")
    assert other.other.rmse < 2 * STD < 0.1 < other.predicted.rmse
    assert other.told
    # The clamp is known to a hundredth of a radian, the cable at rest to a few.
    assert usual.tipping.std < 0.04
    assert not usual.told


def test_a_cable_that_does_not_repeat_may_fall_to_either_side():
    """Heavy ones differ by 0.3 1/m from repeat to repeat: over 0.5 m, by 0.15 rad at most."""
    pose = held(0.08)
    eq = fallen(pose)

    def near(std):
        known = Uncertainty((), np.zeros((0, 0)), {}, PoseScatter(std))
        repeats = Repeats(SolvedCable(MODEL, MODEL.nominal, STRAIGHT, pose, eq), known)
        return repeats.tipping(eq.other_side)

    assert near(0.3).std == pytest.approx(10 * near(0.03).std, rel=1e-6)
    assert near(0.3).std < 0.15
    assert near(0.3).either
    assert not near(0.1).either


@pytest.mark.parametrize("factor", [pytest.param(0.25, marks=pytest.mark.long), 10])
def test_a_pose_on_the_other_side_does_not_count_against_the_fit(factor):
    """Predicted, it is 200 mm away; 30 points to 1 mm tell EI to a tenth of a per cent."""
    prior = replace(MODEL, cable=replace(MODEL.cable, bending_stiffness=factor * EI))
    measured = turned_over()
    alone = fit_stiffness(prior, measured)
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
    with pytest.raises(ConfigError, match="branch: previous needs a pose before this one"):
        load_config(tmp_path / "c.yaml")


def test_in_space_a_cable_is_followed_too():
    """In a vertical plane, gravity along -z and the gripper turned about y; twist has no part."""
    cable = replace(MODEL.cable, torsional_stiffness=0.02)
    model = CableModel(cable, 12, start="clamped", end="free", gravity=(0.0, 0.0, -9.81))
    rest = np.zeros(model.chain.n_rests)

    def gripper(beyond):
        half = -(UP + beyond) / 2  # counter-clockwise against y
        return HeldPose((0.0,) * 3, start_orientation=(0.0, np.sin(half), 0.0, np.cos(half)))

    before, after = gripper(1.2), gripper(0.3)
    x = solve_equilibrium(model, model.nominal, rest, before).x
    moved = continued(model, model.nominal, rest, after, before, x)
    assert moved.stable
    # On twelve elements of another kind: both errors are below a hundredth of the length.
    planar = fallen(held(0.3))
    assert moved.points[-1] == pytest.approx(
        [planar.points[-1, 0], 0, planar.points[-1, 1]], abs=5e-3
    )


def test_in_space_a_cable_gives_way_to_one_side_of_two():
    """Bent upwards at rest, on a gripper that points down: both sides are as low."""
    cable = replace(MODEL.cable, torsional_stiffness=0.02)
    model = CableModel(cable, 12, start="clamped", end="free", gravity=(0.0, 0.0, -9.81))
    rest = np.zeros(model.chain.n_rests)
    rest[model.chain.n_cells : 2 * model.chain.n_cells] = 6.0
    half = -(UP + 1.0) / 2
    held = HeldPose((0.0,) * 3, start_orientation=(0.0, np.sin(half), 0.0, np.cos(half)))
    found = solve_equilibrium(model, model.nominal, rest, held)
    assert found.stable
    assert abs(found.points[-1, 1]) > 0.2
