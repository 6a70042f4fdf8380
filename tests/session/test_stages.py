"""Errors of a stage: on which branch, over which poses, in which unit."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.diagnosis.crossval import cross_validate
from dlo_casadi.effects import CableData, ContactPlane
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.estimation.constrained import as_measured
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import (
    measured_branches,
    predict_poses,
)
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session import stages as stages_module
from dlo_casadi.session.fitting import nearest_to_poses, not_worse
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.pose_shape import PoseShape
from dlo_casadi.session.remarks import branch_warnings, doubts_of, worse_than_simpler
from dlo_casadi.session.stages import fit_stage, initial_stage, pose_shape

# Stiff beside its weight, EI / (w L^3) = 3: its bow is stable upwards, and lower downwards.
MODEL = CableModel(CableData(0.5, 0.02, 0.006, 0.08), 12, n_rest=0)
NOISE = 3e-4
ENDS = ((0.4, 0.0), (0.35, 0.1), (0.3, -0.1))


def measured(*branches, held_out=(), told=False):
    """Poses measured on branches, and whether the session names them."""
    rng = np.random.default_rng(0)
    rest = np.zeros(MODEL.chain.n_cells)
    poses = [
        HeldPose((0.0, 0.0), end, branch=branch, name=f"{k}")
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
    assert said.startswith(
        "declared model, fitted: 0, 2: measured in another equilibrium than predicted"
    )
    assert re.search(r"with an energy up to [\d.]+ J higher: .*`branch: cw` chooses it", said)
    lower = {
        name: replace(shape, measured_branch=replace(shape.measured_branch, above=-0.01))
        for name, shape in stage.shapes.items()
        if name == "0"
    }
    (said,) = branch_warnings([replace(stage, name="batch", shapes=lower)])
    assert "with an energy 0.01 J lower: " in said
    later = replace(stage, name="closed", shapes={})
    assert branch_warnings([replace(stage, name="batch"), later]) == []
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


def test_points_inside_of_a_band_of_ninety_per_cent():
    """In a plane within 1.645 standard deviations; in space the circle of radius sqrt(2 ln 10)."""
    none, length = np.zeros(0), 2.0
    shape = PoseShape(none, None, none, none, none, 0.0, True, none)
    # The band is 3 mm wide at the start and 7 at the end, the noise 4 mm: at 0.5 m 4 sqrt(2) mm.
    s, spread = np.array([0.5, 0.5, 0.5]), np.array([3e-3, 7e-3])
    off = 4e-3 * np.sqrt(2) * np.array([-1.64, 1.65, 0.0])
    flat = replace(shape, s=s, residual=off, spread=spread)
    assert flat.inside_band(length, 4e-3).tolist() == [True, False, True]
    way, edge = np.array([[0.6, 0.8], [-0.8, 0.6], [1.0, 0.0]]), np.sqrt(2 * np.log(10))
    away = 4e-3 * np.sqrt(2) * edge * np.array([[0.99], [1.01], [0.99]]) * way
    spatial = replace(shape, s=s, residual=away, spread=np.stack([spread, spread], axis=1))
    assert spatial.inside_band(length, 4e-3).tolist() == [True, False, True]


def test_a_held_out_pose_without_a_prediction_is_named():
    poses = measured("ccw", "ccw", "ccw", held_out=(1, 2))
    poses[2] = replace(poses[2], pose=replace(poses[2].pose, end=(0.6, 0.0)))  # longer than L
    stage = initial_stage(MODEL, poses)

    assert stage.unpredicted == ("2",)
    assert stage.rmse_held_out is None
    assert "No equilibrium for 2." in stage.note
    assert stage.rmse_fit < 2 * NOISE


def judged(poses, fit):
    stage = fit_stage("batch", fit, poses, {})
    shown = [
        PoseInput(item.pose.name, "held_out" if item.held_out else "fit", item.points)
        for item in poses
    ]
    return stage, doubts_of([stage], shown, fit)


@pytest.mark.parametrize("held_out", [(), (0,)])
def test_a_pose_predicted_on_another_equilibrium_is_in_doubt(held_out):
    """Fitted on the branch where it was measured, it leaves nothing in the residual."""
    poses = measured("cw", "ccw", "ccw", held_out=held_out)
    fit = fit_model(MODEL, poses, Tolerances(), NOISE)
    stage, (doubt,) = judged(poses, fit)

    assert fit.chi2_per_dof < 1.5
    assert f"{'held-out' if held_out else 'fit'} poses are predicted" in doubt
    worst = np.sqrt(np.mean(stage.shapes["0"].missed ** 2))
    assert f": 0, at worst {1e3 * worst:.3g} mm instead of 0." in doubt
    assert "predicted equilibrium in 0 is another one than the measured one" in doubt
    assert "`branch: cw` chooses it" in doubt
    if not held_out:
        assert cross_validate(fit).rmse < 2 * NOISE

    poses = measured("cw", "ccw", "ccw", held_out=held_out, told=True)
    assert judged(poses, fit_model(MODEL, poses, Tolerances(), NOISE))[1] == ()


@pytest.mark.parametrize(("scatter", "undecided"), [(0.48, False), (0.51, True)])
def test_scatter_alone_may_leave_an_equilibrium_undecided(scatter, undecided, monkeypatch):
    """A gap of 1 J is decided from two standard deviations on: 2 sqrt(0.1^2 + 0.49^2)."""
    gap = SimpleNamespace(value=1.0, std=0.1)
    monkeypatch.setattr(stages_module.EnergyGap, "between", lambda *_: gap)
    monkeypatch.setattr(stages_module.Repeats, "gap_std", lambda *_: scatter)
    uncertainty = Uncertainty((), np.zeros((0, 0)), {}, PoseScatter(0.3))
    repeats = stages_module.Repeats(SimpleNamespace(model=MODEL), uncertainty)
    assert stages_module._undecided(repeats, None) is undecided


@pytest.mark.parametrize(("nearer", "doubted"), [(0.5, True), (2.0, False)])
def test_where_no_pose_is_predicted_a_simpler_model_may_do_better(nearer, doubted):
    poses = measured("cw", "cw", "cw")
    fit = fit_model(MODEL, poses, Tolerances(), NOISE)
    stage, _ = judged(poses, fit)
    assert set(stage.other_branch) == {"0", "1", "2"}
    simpler = replace(initial_stage(MODEL, poses), rmse_fit=nearer * stage.rmse_fit)
    doubts = doubts_of([simpler, stage], [], fit)
    assert len(doubts) == doubted
    for text in doubts:
        assert text.startswith("no pose is predicted from its ends: in all 3 the predicted")
        assert f'{1e3 * stage.rmse_fit:.3g} mm RMS off, and "initial guess" comes nearer' in text


def test_a_fit_is_no_worse_than_the_stiffness_alone():
    """One that was stopped far off starts again from the simpler one."""
    poses = measured("ccw", "ccw", "ccw")
    fit = fit_model(MODEL, poses, Tolerances(), NOISE)
    stages = [initial_stage(MODEL, poses), fit_stage("batch", fit, poses, {})]
    assert not_worse(fit, stages) is fit
    assert worse_than_simpler(stages) == []

    problem, far = fit.problem, fit.point.theta - np.log(10) * np.eye(fit.problem.unknowns.size)[0]
    point = problem.balanced(replace(fit.point, theta=far))
    stopped = replace(fit, point=point, converged=False)
    stage, doubts = judged(poses, stopped)
    assert "has not converged" in doubts[0]
    (said,) = worse_than_simpler([stages[0], stage])
    assert said.startswith(
        '"initial guess" comes nearer to the fit poses than "declared model, fitted"'
    )
    again = not_worse(stopped, [stages[0], stage])
    assert again.point.objective < 1.01 * fit.point.objective
    assert again.converged


def test_a_fit_that_lacks_something_predicts_no_worse_than_a_straight_cable():
    """On a table that is not declared: fitted to 0.3 mm, rest shape and clamps bend to it."""
    held = {"start": "clamped", "end": "clamped"}
    model = CableModel(CableData(0.8, 0.08, 0.006, bending_stiffness=0.06), 12, n_rest=4, **held)
    table = model.with_effect(ContactPlane())
    p = table.nominal.copy()
    p[table.names.index("contact_plane.height")] = -0.2
    rng, s = np.random.default_rng(4), np.linspace(0.02, 0.98, 12) * model.cable.length
    poses = []
    for _ in range(5):
        way, span = rng.uniform(-0.5, 0.5), rng.uniform(0.5, 0.65)
        first, last = rng.uniform(-0.6, 0.6, 2)
        ends = (0.0, 0.0), (span * np.cos(way), span * np.sin(way))
        pose = HeldPose(*ends, start_heading=first, end_heading=last, name=f"{len(poses)}")
        (shape,) = predict_poses(table, p, np.zeros(table.chain.n_rests), [pose])
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(len(s), 2))
        poses.append(MeasuredPose.of_points(pose, points, s=s))
    fit = fit_model(model, poses, Tolerances(), NOISE)
    stages = [initial_stage(model, poses), fit_stage("batch", fit, poses, {})]
    assert stages[0].rmse_fit_measured_branch < stages[1].rmse_fit_measured_branch

    def staged(found):
        return fit_stage("batch", found, poses, {})

    nearest, stage = nearest_to_poses(fit, stages, staged, diagnosed=True)
    assert nearest.noise.source == "misfit"
    assert stage.rmse_fit_measured_branch < stages[0].rmse_fit_measured_branch
    again = [stages[0], stage]
    assert nearest_to_poses(nearest, again, staged, diagnosed=True) == (nearest, stage)


def test_a_cable_twisted_the_other_way_round_is_told_by_its_turns():
    """Its end clamp is rolled by nearly half a turn."""
    cable = CableData(1.0, 0.1, 0.01, bending_stiffness=0.05, torsional_stiffness=0.04)
    held = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
    model = CableModel(cable, 10, "quadratic", **held)
    ahead, rolled = (0.0, 0.0, 0.0, 1.0), (np.sin(1.45), 0.0, 0.0, np.cos(1.45))
    pose = HeldPose((0, 0, 0), (0.9, 0.1, 0), start_orientation=ahead, end_orientation=rolled)
    flat = np.zeros(model.chain.n_rests)
    poses = [pose, *(replace(pose, turns=turns) for turns in (0.5, -0.5))]
    predicted, *either = predict_poses(model, model.nominal, flat, poses)
    (turns, other) = max(
        zip((0.5, -0.5), either, strict=True), key=lambda way: way[1].equilibrium.energy
    )
    item = MeasuredPose.of_points(pose, other.curve.at(np.linspace(0.05, 0.95, 20)))
    (found,) = measured_branches(model, model.nominal, flat, [item], [predicted])
    assert (found.branch, found.turns) == (None, turns)
    shape = pose_shape(predicted, item, found).measured_branch
    assert shape.chosen_by == f"turns: {turns}"
    assert shape.rmse < 1e-4


def test_a_gap_that_no_unknown_changes_is_not_refitted():
    """With the weight known and all at rest straight, EI is all there is to fit."""
    fit = fit_model(MODEL, measured("cw", "cw", "cw"), Tolerances(), NOISE)
    assert as_measured(fit) is fit


def test_a_whole_turn_of_twist_is_named_before_a_pose_is_to_be_taken_again():
    """Rolled by half a radian and twisted by a turn more: half a turn either way is less."""
    cable = CableData(1.0, 0.1, 0.01, bending_stiffness=0.05, torsional_stiffness=0.04)
    held = {"start": "clamped", "end": "clamped", "gravity": (0.0, 0.0, -9.81)}
    model = CableModel(cable, 10, "quadratic", **held)
    ahead, rolled = (0.0, 0.0, 0.0, 1.0), (np.sin(0.25), 0.0, 0.0, np.cos(0.25))
    pose = HeldPose((0, 0, 0), (0.95, 0.1, 0), start_orientation=ahead, end_orientation=rolled)
    flat = np.zeros(model.chain.n_rests)
    poses = [replace(pose, name="a"), replace(pose, turns=1.0)]
    predicted, other = predict_poses(model, model.nominal, flat, poses)
    item = MeasuredPose.of_points(poses[0], other.curve.at(np.linspace(0.05, 0.95, 20)))
    nodes = {"a": other.equilibrium.x}
    (found,) = measured_branches(model, model.nominal, flat, [item], [predicted], nodes)
    assert (found.branch, found.turns) == (None, 1.0)
    shape = pose_shape(predicted, item, found).measured_branch
    apart = other.equilibrium.energy - predicted.equilibrium.energy
    assert shape.above == pytest.approx(apart, rel=1e-6)


@pytest.mark.parametrize(("value", "bound"), [(0.0, True), (1e-6, False), (1.0, True)])
def test_a_parameter_is_at_its_bound_only_if_it_has_stopped_there(value, bound):
    quantity = SimpleNamespace(lower=0.0, upper=1.0, scale=0.1)
    model = SimpleNamespace(parameters=(quantity,), names=("one",))
    fit = SimpleNamespace(model=model, value=lambda _: value)
    assert stages_module._at_bound(fit, "one") is bound
