"""Noise of poses that were taken more than once, and what a fit makes of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dlo_casadi.config import load_config
from dlo_casadi.effects import CableData, RestCurvatureDrift
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import Repeats, spread_across
from dlo_casadi.estimation import repeats
from dlo_casadi.estimation.prediction import (
    measured_branches,
    predict_poses,
    rms_distance,
    uncertainty_of,
)
from dlo_casadi.estimation.repeats import (
    different_poses,
    repeat_std,
    repeatability,
    with_repeats,
)
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.report.documents import fit_dict
from dlo_casadi.rod.obstacles import Plane
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.session.fitting import declared_model, fit_declared
from dlo_casadi.session.measure import measured_poses, read_inputs

ROOT = Path(__file__).resolve().parents[2]
LENGTH, STD = 1.0, 5e-4
MODEL = CableModel(CableData(LENGTH, 0.1, 0.01, 0.05), 20)
DECLARED = NoiseModel(STD, source="declared")


def lines(noise: NoiseModel, count: int, pose: HeldPose) -> list[MeasuredPose]:
    """Repeats of a straight line whose points are off across it."""
    rng = np.random.default_rng(0)
    s = np.linspace(0.03, 0.97, 60) * LENGTH
    factor = np.linalg.cholesky(noise.covariance(s, np.ones(60)))
    return [
        MeasuredPose.of_points(pose, np.stack([s, factor @ rng.normal(size=60)], axis=1))
        for _ in range(count)
    ]


def test_repeats_tell_size_and_correlation():
    """Sixteen lines; the distances from their mean lose one degree of freedom."""
    truth = NoiseModel(3e-3, share=0.9, length=0.05, kernel="gaussian")
    measured = lines(truth, 16, HeldPose((0.0, 0.0), (LENGTH, 0.0)))
    found = with_repeats(DECLARED, measured, MODEL)
    assert found.source == "repeats"
    assert found.known
    # 16 lines of some 8 correlation lengths: 10 % of a standard deviation, three of them.
    assert found.std == pytest.approx(truth.std, rel=0.3)
    assert found.length == pytest.approx(truth.length, rel=0.3)
    # From the mean of the others: sqrt(1 + 1 / 15).
    assert repeatability(measured, MODEL) == pytest.approx(truth.std * 1.033, rel=0.3)
    # Nothing differs along the line, nor beyond the noise.
    assert repeat_std(measured, MODEL, 0.0) == pytest.approx(truth.std * 1.033, rel=0.3)
    assert repeat_std(measured, MODEL, truth.std) < truth.std / 2

    # The same elsewhere, and nearly the same: ends 0.5 mm apart, of a cable of 1 m.
    moved = []
    for k, item in enumerate(measured):
        away = np.array([0.3 * k, -0.1])
        end = item.pose.end + away + [0.0, 5e-4 * (k % 2)]
        pose = replace(item.pose, start=tuple(away), end=tuple(end))
        moved.append(MeasuredPose.of_points(pose, item.points + away))
    assert different_poses(moved, MODEL) == 1
    again = with_repeats(DECLARED, moved, MODEL)
    assert again.std == pytest.approx(found.std, rel=0.01)
    turned = replace(moved[0], pose=replace(moved[0].pose, start_heading=0.002))
    assert different_poses([turned, *moved], MODEL) == 2


def test_of_pairs_the_mean_takes_half_of_the_degrees_of_freedom(monkeypatch):
    """Five poses, each taken twice: either is sqrt(2) times the noise off the other."""
    truth, pose = NoiseModel(3e-3), HeldPose((0.0, 0.0), (LENGTH, 0.0))
    measured = [
        replace(item, pose=replace(pose, end=(LENGTH, 0.01 * (k // 2))))
        for k, item in enumerate(lines(truth, 10, pose))
    ]
    assert different_poses(measured, MODEL) == 5
    # 300 degrees of freedom: three times 4 %.
    assert repeatability(measured, MODEL) == pytest.approx(np.sqrt(2) * truth.std, rel=0.12)
    found = with_repeats(DECLARED, measured, MODEL)
    assert found.std == pytest.approx(truth.std, rel=0.12)
    assert repeat_std(measured, MODEL, truth.std) < truth.std / 2
    # Of the 600 distances from the means 300 are independent.
    all_of_them = NoiseModel(truth.std, slow_dof=600.0)
    monkeypatch.setattr(repeats, "estimate_noise", lambda *_: all_of_them)
    assert with_repeats(DECLARED, measured, MODEL).slow_dof == pytest.approx(300.0)


def test_poses_that_hold_a_cable_in_different_ways_are_no_repeats():
    pose = HeldPose((0.0, 0.0), (LENGTH, 0.0))
    item = lines(DECLARED, 1, pose)[0]
    clip = HeldClip("pinned", (0.5, 0.1), 0.5)
    others = [
        replace(pose, branch="ccw"),
        replace(pose, branch="cw"),
        replace(pose, over=True),
        replace(pose, clips=(clip,)),
        replace(pose, clips=(replace(clip, place=(0.5, 0.2)),)),
        replace(pose, clips=(replace(clip, at=0.6),)),
        replace(pose, clips=(replace(clip, kind="clamped", heading=0.1),)),
        replace(pose, clips=(replace(clip, kind="clamped", heading=0.2),)),
    ]
    held = [replace(item, pose=one) for one in (pose, *others, *others)]
    assert different_poses(held, MODEL) == 1 + len(others)
    later, elsewhere = replace(pose, branch="previous"), replace(pose, end=(0.9 * LENGTH, 0.1))
    assert different_poses([replace(item, pose=one) for one in (pose, later)], MODEL) == 1
    # It may have reached another equilibrium on the way.
    around = (pose, elsewhere, later, later)
    assert different_poses([replace(item, pose=one) for one in around], MODEL) == 3
    # Beside a table it matters where they stand.
    raised = replace(pose, start=(0.0, 0.1), end=(LENGTH, 0.1))
    two = [item, replace(item, pose=raised)]
    assert different_poses(two, MODEL) == 1
    table = Plane((0.0, -0.3), (0.0, 1.0), name="table")
    assert different_poses(two, replace(MODEL, obstacles=(table,))) == 2


def test_poses_that_repeat_to_the_noise_or_are_taken_once_leave_it_as_declared():
    pose = HeldPose((0.0, 0.0), (LENGTH, 0.0))
    assert with_repeats(DECLARED, lines(DECLARED, 5, pose), MODEL) is DECLARED
    far_off = lines(NoiseModel(3e-3), 2, pose)
    once = [far_off[0], replace(far_off[1], pose=replace(pose, end=(LENGTH, 0.01)))]
    assert with_repeats(DECLARED, once, MODEL) is DECLARED
    held_out = [far_off[0], replace(far_off[1], held_out=True)]
    assert with_repeats(DECLARED, held_out, MODEL) is DECLARED


def test_repeats_are_compared_where_all_of_them_were_measured():
    """Arcs of one shape: a line that ends early, and few markers beside a line."""
    radius, turn = 0.4, LENGTH / 0.4
    pose = HeldPose((0.0, 0.0), (radius * np.sin(turn), radius * (1 - np.cos(turn))))
    noise = np.random.default_rng(0).normal(scale=STD, size=(3, 97, 2))

    def seen(k, s, known=None):
        arc = radius * np.stack([np.sin(s / radius), 1 - np.cos(s / radius)], axis=1)
        return MeasuredPose.of_points(pose, arc + noise[k, : len(s)], s=known)

    s, few = np.linspace(0.01, 0.99, 97) * LENGTH, np.linspace(0.1, 0.8, 8) * LENGTH
    cut, markers = seen(1, s[s < 0.93 * LENGTH]), seen(2, few, few)
    for group in ([seen(0, s), cut], [seen(0, s), markers]):
        # The difference of two: sqrt(2) of the noise across the cable.
        assert repeatability(group, MODEL) < 1.3 * np.sqrt(2) * STD
        assert with_repeats(DECLARED, group, MODEL) is DECLARED


def test_poses_of_a_cable_that_takes_a_set_are_no_repeats():
    """The first of two poses that hold it alike has changed its shape in the second one."""
    taken = MODEL.with_effect(RestCurvatureDrift())
    measured = lines(NoiseModel(3e-3), 5, HeldPose((0.0, 0.0), (LENGTH, 0.0)))
    assert different_poses(measured, taken) == 5
    assert with_repeats(DECLARED, measured, taken) is DECLARED


@pytest.mark.parametrize("left_out", [0, 1])
def test_a_wire_that_does_not_repeat_gets_no_rest_shape_that_snaps(left_out):
    """Real: repeats of the black wire, clicked to 1 mm, differ by 7 to 23 mm from the last one.

    Taken at 1 mm, four repeats ask for EI of 0.03 N m^2 and a rest shape bent the other way, whose
    lowest equilibrium is 280 mm away from all of them. Its makers found 1.2e-3 N m^2.
    """
    config = load_config(ROOT / "configs" / "black_wire.yaml").changed(model={"n": 20})
    measured = [
        replace(item, held_out=k == left_out)
        for k, item in enumerate(measured_poses(config, read_inputs(config)))
    ]
    fit = fit_declared(config, declared_model(config, None, None), measured)
    assert 6e-4 < fit.p[0] < 2.4e-3  # a factor of two
    poses = [item.pose for item in measured]
    predictions = predict_poses(fit.model, fit.p, fit.rest, poses)
    others = measured_branches(fit.model, fit.p, fit.rest, measured, predictions)
    assert others == [None] * 5
    floor = repeatability([replace(item, held_out=False) for item in measured], fit.model)
    assert rms_distance(predictions, measured, held_out=True) < 1.5 * floor
    # The band is as wide as the fitted repeats differ across the cable.
    uncertainty = uncertainty_of(fit)
    assert uncertainty.repeat_std == pytest.approx(repeatability(measured, fit.model), rel=0.02)
    at = np.array([0.4, 0.7])
    curve, moved = Repeats(predictions[left_out], uncertainty).displacements(at)
    assert np.all(spread_across(curve, at, moved) > uncertainty.repeat_std)
    assert fit_dict(fit)["scatter"]["hanging"] == uncertainty.repeat_std
    # Noise that repeats tell is no declared one.
    assert np.isfinite(fit.variance_degrees("bending_stiffness"))


def test_repeats_of_three_markers_each_tell_the_noise():
    """The first and the last point that was measured count, too."""
    pose, s = HeldPose((0.0, 0.0), (LENGTH, 0.0)), np.array([0.3, 0.5, 0.7]) * LENGTH
    rng = np.random.default_rng(0)
    measured = [
        MeasuredPose.of_points(pose, np.stack([s, 0 * s], 1) + rng.normal(0, 3e-3, (3, 2)), s=s)
        for _ in range(20)
    ]
    found = with_repeats(DECLARED, measured, MODEL)
    assert found.source == "repeats"
    assert found.std == pytest.approx(3e-3, rel=0.3)


def test_repeats_of_a_point_each_tell_of_no_noise():
    pose = HeldPose((0.0, 0.0), (LENGTH, 0.0))
    points = [MeasuredPose.of_points(pose, np.array([[0.5, y]])) for y in (-0.01, 0.01)]
    assert with_repeats(DECLARED, points, MODEL) is DECLARED
