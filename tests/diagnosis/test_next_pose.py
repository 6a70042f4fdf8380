"""How far two predictions are apart, in noise of one measured line."""

from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.diagnosis.next_measurement import _separations, next_reading
from dlo_casadi.equilibrium.curve import NodeCurve, Observed
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import Tolerances
from dlo_casadi.rod.node import Heading
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel, ReadingNoise

LENGTH, POINTS, STD, GAP = 0.5, 40, 2e-4, 3e-4


def separation(noise, ways=()):
    """Of two straight lines that lie a gap apart, measured at many points."""
    x = np.linspace(0.0, LENGTH, 11)
    lines = [NodeCurve(LENGTH, np.column_stack([x, 0 * x + y]), None) for y in (0.0, GAP)]
    pose = HeldPose((0.0, 0.0), (LENGTH, 0.0))
    measured = MeasuredPose.of_points(pose, np.zeros((POINTS, 2)))
    fit = SimpleNamespace(
        problem=SimpleNamespace(measured=(measured,), used=(0,)),
        point=SimpleNamespace(projections=(np.linspace(0.0, LENGTH, POINTS),)),
        noise=noise,
    )
    return _separations(fit, np.array([LENGTH, 0.1]), (lines[0], lines[1]), ways)


def test_a_line_averages_the_noise_of_its_points():
    """White noise: K equal distances d are d sqrt(K) / std standard deviations off."""
    assert separation(NoiseModel(STD))[0] == pytest.approx(GAP / STD * np.sqrt(POINTS))


def test_what_the_fits_leave_open_separates_nothing():
    """A common shift of one std, 3 mm, in m lines: d / sqrt(std^2 / (K m) + shift^2)."""
    shift = 3e-3
    open_ways = [lambda s: np.full((len(s), 2, 1), [[0.0], [shift]])]
    expected = GAP / np.hypot(STD / np.sqrt(POINTS * np.arange(1, 21)), shift)
    assert separation(NoiseModel(STD), open_ways) == pytest.approx(expected)


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
