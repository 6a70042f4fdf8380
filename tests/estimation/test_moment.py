"""Moment against curvature without a law, on a cantilever whose law is known."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import BendingSoftening, CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.stiffness import law_of, measured_moment_curve
from dlo_casadi.model.cable_model import CableModel

EI = 8e-4
CABLE = CableData(0.25, 0.0173, 0.001, EI)
WEIGHT = CABLE.mass * 9.81 / CABLE.length
# Torsional stiffness, gravity and a clamp across it.
PLANE = (None, (0.0, -9.81), HeldPose((0.0, 0.0), start_heading=0.0))
SPACE = (4e-4, (3.0, 4.0, -8.4), HeldPose((0.0,) * 3, start_orientation=(0.0, 0.0, 0.6, 0.8)))


@pytest.mark.parametrize("marked", [False, True])
@pytest.mark.parametrize("softness", [0.0, 0.05])
@pytest.mark.parametrize(("torsion", "gravity", "level"), [PLANE, SPACE])
def test_the_law_is_read_off_a_hanging_strip(torsion, gravity, level, softness, marked):
    """M = EI k / (1 + k softness), hanging under its weight, from a line or from markers."""
    cable, soft = replace(CABLE, torsional_stiffness=torsion), (BendingSoftening(),)
    held = {"start": "clamped", "end": "free", "n_rest": 0}
    model = CableModel(cable, 40, gravity=gravity, effects=soft, **held)
    p = np.array([*model.nominal[:-1], softness])
    hung = solve_equilibrium(model, p, np.zeros(model.chain.n_rests), level)
    noise = np.random.default_rng(0).normal(scale=2e-5, size=hung.points.shape)
    # Markers need not reach the tip.
    s, shown = (np.linspace(0, CABLE.length, 41), slice(37)) if marked else (None, slice(None))
    seen = (hung.points + noise)[shown]
    found = measured_moment_curve(
        seen, CABLE.length, WEIGHT, gravity, None if s is None else s[shown]
    )
    k = found.curvature
    exact = EI * k / (1 + k * softness)
    bent = k > 0.3 * k.max()
    ratio = found.moment[bent] / exact[bent]
    # Noise of 20 micrometres leaves some 5 % in the second derivative, less in its mean. Without
    # the weight of the part beyond the last marker 1 to 4 % of the moment would be missing.
    np.testing.assert_allclose(ratio, 1.0, atol=0.07)
    assert ratio.mean() == pytest.approx(1.0, abs=0.012)
    np.testing.assert_allclose(law_of(model, p, k), exact, rtol=5e-3, atol=1e-7)


def test_too_few_points():
    with pytest.raises(EstimationError, match="at least 10 points, got 4"):
        measured_moment_curve(np.zeros((4, 2)), 1.0, 1.0, (0.0, -9.81))


def test_a_hidden_stretch_leaves_no_gap_in_the_curve():
    """Points in two stretches, and not in their order: a curve through all, without nan."""
    s = np.r_[np.linspace(0.0, 0.05, 18), np.linspace(0.22, 0.25, 4)]
    points = np.stack([s, -2.0 * s**2], axis=1)
    found = measured_moment_curve(points, 0.26, WEIGHT, (0.0, -9.81), s)
    assert np.isfinite(found.curvature).all()
    turned = measured_moment_curve(points[::-1], 0.26, WEIGHT, (0.0, -9.81), s[::-1])
    np.testing.assert_array_equal(found.curvature, turned.curvature)
