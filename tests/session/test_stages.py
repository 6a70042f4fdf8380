"""Errors of a stage: on which branch, over which poses, in which unit."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import Cable
from dlo_casadi.equilibrium import Pose
from dlo_casadi.estimation.observation import MeasuredPose
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model import CableModel
from dlo_casadi.session.remarks import branch_warnings
from dlo_casadi.session.stages import initial_stage

# Stiff beside its weight, EI / (w L^3) = 3: its bow is stable upwards, and lower downwards.
MODEL = CableModel(Cable(0.5, 0.02, 0.006, 0.08), 12, n_rest=0)
NOISE = 3e-4
ENDS = ((0.4, 0.0), (0.35, 0.1), (0.3, -0.1))


def measured(*branches, held_out=(), told=False):
    """Poses measured on branches, and whether the session names them."""
    rng = np.random.default_rng(0)
    rest = np.zeros(MODEL.chain.n_cells)
    poses = [
        Pose((0.0, 0.0), end, branch=branch, name=f"{k}")
        for k, (end, branch) in enumerate(zip(ENDS, branches, strict=True))
    ]
    s = np.linspace(0.02, 0.98, 40) * MODEL.cable.length
    return [
        MeasuredPose.of_points(
            pose if told else replace(pose, branch=None),
            shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2)),
            held_out=k in held_out,
        )
        for k, (pose, shape) in enumerate(
            zip(poses, predict_poses(MODEL, MODEL.nominal, rest, poses), strict=True)
        )
    ]


def test_a_pose_measured_on_another_branch_is_named_with_its_error_there():
    """A stiff cable may rest as an arch; it is predicted hanging, which is lower."""
    stage = initial_stage(MODEL, measured("cw", "ccw", "cw", held_out=(2,)))

    assert {name: found.branch for name, found in stage.other_branch.items()} == {
        "0": "cw",
        "2": "cw",
    }
    # An arch above, a bow below: apart by more than the height of either, 0.1 m.
    assert stage.shapes["0"].rmse > 0.1
    assert stage.rmse_held_out > 0.1
    # On its branch the noise is left, across the curve: 40 points tell it to a tenth.
    assert stage.shapes["0"].measured_branch.rmse == pytest.approx(NOISE, rel=0.35)
    assert stage.rmse_fit_measured_branch == pytest.approx(NOISE, rel=0.25)
    assert stage.rmse_held_out_measured_branch == pytest.approx(NOISE, rel=0.35)
    (said,) = branch_warnings([replace(stage, name="batch")])
    assert said.startswith("stage batch: 0, 2: the equilibrium of lowest energy")
    assert "`branch: cw` in these poses chooses it" in said
    assert branch_warnings([stage]) == []  # of a first guess nobody expects the branch


@pytest.mark.parametrize(("branches", "told"), [(("cw", "cw", "ccw"), True), (("ccw",) * 3, False)])
def test_on_the_predicted_branch_both_errors_are_one(branches, told):
    stage = initial_stage(MODEL, measured(*branches, held_out=(1,), told=told))

    assert stage.other_branch == {}
    assert stage.rmse_fit_measured_branch == stage.rmse_fit < 2 * NOISE
    assert stage.rmse_held_out_measured_branch == stage.rmse_held_out < 2 * NOISE


def test_residuals_are_distances():
    """In metres, whatever noise a fit has estimated: along a normal no longer than the distance."""
    (shape, *_) = initial_stage(MODEL, measured("ccw", "ccw", "ccw")).shapes.values()

    assert np.sqrt((shape.residual**2).mean()) == pytest.approx(shape.rmse, rel=1e-6)


def test_a_held_out_pose_without_a_prediction_is_named():
    poses = measured("ccw", "ccw", "ccw", held_out=(1, 2))
    poses[2] = replace(poses[2], pose=replace(poses[2].pose, end=(0.6, 0.0)))  # longer than L
    stage = initial_stage(MODEL, poses)

    assert stage.unpredicted == ("2",)
    assert stage.rmse_held_out is None
    assert "No equilibrium for 2." in stage.note
    assert stage.rmse_fit < 2 * NOISE
