"""Moment against curvature without a law, on a cantilever whose law is known."""

import numpy as np
import pytest

from dlo_casadi.effects import BendingSoftening, Cable
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.moment import law_of, measured_moment_curve
from dlo_casadi.model.cable_model import CableModel

CABLE = Cable(length=0.25, mass=0.0173, diameter=0.001, bending_stiffness=8e-4)
WEIGHT = CABLE.mass * 9.81 / CABLE.length


@pytest.mark.parametrize("softness", [0.0, 0.05])
def test_the_law_is_read_off_a_hanging_strip(softness):
    """M = EI k / (1 + |k| softness), clamped horizontally, hanging under its weight."""
    model = CableModel(
        CABLE, 40, start="clamped", end="free", effects=(BendingSoftening(),), n_rest=0
    )
    p = np.array([CABLE.bending_stiffness, softness])
    hung = solve_equilibrium(model, p, np.zeros(40), Pose((0.0, 0.0), start_heading=0.0))
    noise = np.random.default_rng(0).normal(scale=2e-5, size=hung.points.shape)
    found = measured_moment_curve(hung.points + noise, CABLE.length, WEIGHT, (0.0, -9.81))
    k = np.abs(found.curvature)
    exact = CABLE.bending_stiffness * k / (1 + k * softness)
    bent = k > 0.3 * k.max()
    # Noise of 20 micrometres leaves some 5 % in the second derivative.
    np.testing.assert_allclose(np.abs(found.moment)[bent], exact[bent], rtol=0.15)
    np.testing.assert_allclose(law_of(model, p, k), exact, rtol=5e-3, atol=1e-7)


def test_too_few_points():
    with pytest.raises(EstimationError, match="at least 10 points, got 4"):
        measured_moment_curve(np.zeros((4, 2)), 1.0, 1.0, (0.0, -9.81))
