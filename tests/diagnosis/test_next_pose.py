"""How far two predictions are apart, in noise of one measured line."""

from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.diagnosis.next_measurement import (
    _displaced,
    _separations,
    next_reading,
)
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve, Observed
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.node import Heading
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise

LENGTH, POINTS, STD, GAP = 0.5, 40, 2e-4, 3e-4
PLACES, REST = np.linspace(0.0, LENGTH, POINTS), np.zeros(8)


def separation(noise, again=(), kept=()):
    """Of two lines a gap apart in y; `again`, `kept`: common shifts of one std [m] in y."""
    measured = MeasuredPose.of_points(HeldPose((0.0, 0.0), (LENGTH, 0.0)), np.zeros((POINTS, 2)))
    curve = NodeCurve(LENGTH, np.column_stack([PLACES, 0 * PLACES]), None)
    moved = np.zeros((POINTS, 2, 1 + len(again) + len(kept)))
    moved[:, 1] = [GAP, *again, *kept]
    seen = measured.whitening(noise, PLACES) @ measured.components(curve, PLACES, moved)
    return _separations(*np.split(seen, [1, 1 + len(again)], axis=1))


def test_a_line_averages_the_noise_of_its_points():
    """White noise: K equal distances d are d sqrt(K) / std standard deviations off."""
    assert separation(NoiseModel(STD))[0] == pytest.approx(GAP / STD * np.sqrt(POINTS))


def test_repeats_average_what_each_draws_again_not_what_the_fits_leave_open():
    """Shifts of one std, a in each of m lines and b in all: d / sqrt((s^2/K + a^2)/m + b^2)."""
    again, kept = 1e-4, 3e-3
    drawn = np.hypot(STD / np.sqrt(POINTS), again) / np.sqrt(np.arange(1, 21))
    found = separation(NoiseModel(STD), [again], [kept])
    assert found == pytest.approx(GAP / np.hypot(drawn, kept))
    assert separation(NoiseModel(STD), [again]) == pytest.approx(GAP / drawn)


def test_only_parameters_are_the_same_in_all_repeats():
    model, s = CableModel(CableData(LENGTH, 0.05, 0.008, 0.05), 8), np.linspace(0.01, 0.49, POINTS)
    rng = np.random.default_rng(3)
    poses = [HeldPose((0.0, 0.0), (x, y)) for x, y in ((0.4, 0.0), (0.3, 0.1), (0.35, -0.1))]
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=STD, size=(POINTS, 2)))
        for pose, shape in zip(
            poses, predict_poses(model, np.array([0.05]), REST, poses), strict=True
        )
    ]
    fit = fit_model(model, measured, Tolerances(end=1e-3), STD)
    (found,) = predict_poses(fit.model, fit.p, fit.rest, poses[:1])
    kept, again = _displaced(fit, found, np.array([0.0, LENGTH]))
    assert kept.shape == (2, 2, len(fit.named_covariance[0]))
    assert kept[1] == pytest.approx(0.0, abs=1e-9)  # no parameter moves the end
    # The end's x and y, the rest curvature of each repeat, which is none here, and repeats as such.
    assert again.shape == (2, 2, 2 + len(REST) + 2)
    assert again[..., 2:] == pytest.approx(0.0, abs=1e-9)
    ends = np.linalg.norm(again[1, :, :2], axis=0)
    assert ends == pytest.approx(fit.problem.deviation_std, rel=1e-3)


def test_noise_that_is_one_for_the_whole_line_does_not_average():
    alike = NoiseModel(STD, share=0.98, length=100 * LENGTH, kernel="gaussian")

    assert separation(alike)[0] == pytest.approx(GAP / STD, rel=0.02)


@pytest.mark.parametrize(("gap", "times"), [(1.2, 1), (0.4, 3), (0.2, None)])
def test_a_reading_is_repeated_until_noise_and_bias_hide_no_difference(gap, times):
    """Noise of 0.15 N averages, a bias of 0.1 N does not: 3 sqrt(0.15^2 / n + 0.1^2) <= gap."""
    fit = SimpleNamespace(
        problem=SimpleNamespace(priors=SimpleNamespace(tolerances=Tolerances(force_bias=0.1))),
        noise=NoiseModel(STD, readings=ReadingNoise(0.15, 0.1)),
        model=SimpleNamespace(node=Heading, names=()),
    )
    zero = NodeCurve(LENGTH, np.zeros((2, 2)), None)
    one, other = Observed(zero, np.zeros(6)), Observed(zero, np.array([0.0, 0, 0, gap, 0, 0]))
    found = next_reading(fit, one, other)
    assert (found.name, found.times) == ("end_force", times)
    assert found.separation == pytest.approx(gap / np.hypot(0.15, 0.1))
