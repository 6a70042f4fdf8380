"""One pose taken several times, each time a little different for reasons that nobody knows."""

from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.diagnosis.crossval import CrossValidation
from dlo_casadi.diagnosis.refits import Confirmed
from dlo_casadi.diagnosis.selection import choose
from dlo_casadi.diagnosis.structure import limiting_spread
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose

MODEL = CableModel(CableData(0.8, 0.03, 0.006, 0.02), 12, start="clamped", end="clamped", n_rest=5)
NOISE = 3e-4


def hung_again(seed: int, scatter: float, count: int = 5) -> list[MeasuredPose]:
    """Repeats of one pose whose rest shape differs from one to the next [1/m]."""
    rng = np.random.default_rng(seed)
    pose = HeldPose((0.0, 0.0), (0.45, -0.05), start_heading=-0.6, end_heading=0.5)
    s = np.linspace(0.02, 0.98, 40) * MODEL.cable.length
    out = []
    for _ in range(count):
        rest = MODEL.rest_basis @ (0.5 + rng.normal(scale=scatter, size=5))
        (shape,) = predict_poses(MODEL, np.array([0.02]), rest, [pose])
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2))
        out.append(MeasuredPose.of_points(pose, points))
    return out


@pytest.mark.parametrize(("scatter", "limited"), [(0.3, True), (0.0, False)])
def test_hangings_that_differ_by_more_than_the_noise_limit_every_prediction(scatter, limited):
    """Rest curvatures 0.3 1/m apart move the shapes across by several times the noise."""
    fit = fit_model(MODEL, hung_again(0, scatter), Tolerances(), NOISE)
    spread = limiting_spread(fit)
    assert (spread is not None and spread > 2.5 * NOISE) if limited else spread is None


@pytest.mark.parametrize(
    ("gains", "doubt", "kept"),
    [
        ([20.0, 0.0, 10.0, -10.0, 30.0], None, True),  # worth it, were the points independent
        ([20.0, 0.0, 10.0, -10.0, 30.0], 0.005, False),  # but two of five repeats are no better
        ([70.0, 60.0, 70.0, 50.0, 60.0], 0.005, True),  # all are
    ],
)
def test_only_a_clear_gain_counts_where_poses_do_not_repeat(gains, doubt, kept):
    """Gains in log density of each left-out repeat."""
    counts = np.full(5, 40.0)
    before = CrossValidation(counts, counts, 1.0, densities=np.zeros(5))
    added = SimpleNamespace(candidate=SimpleNamespace(name="effect"))
    after = CrossValidation(counts, counts, 1.0, densities=np.array(gains))
    tried = Confirmed(added, SimpleNamespace(log_evidence=100.0), after, 100.0)
    base = SimpleNamespace(log_evidence=0.0, model=SimpleNamespace(priors={}))
    chosen, _ = choose([tried], base, before, doubt)
    assert chosen == ([tried] if kept else [])
