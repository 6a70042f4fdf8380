"""Weights that a cable with a free tip does not tell from its stiffness."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from dlo_casadi.diagnosis.candidates import _like_stiffness, candidates, equivalents, setup_of
from dlo_casadi.diagnosis.next_measurement import hidden_weight
from dlo_casadi.effects import EFFECTS, CableData, LumpedMass
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel, Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.remarks import weight_warning

EI, MASS = 0.06, 0.35
MODEL = CableModel(CableData(0.65, 0.4, 0.015, 0.03), 10, start="clamped", end="free", n_rest=3)


def fitted(std, points, mass, model=MODEL, **options):
    """A cable with a weight near its middle, fitted without it; std of the points [m]."""
    heavy, rng = MODEL.with_effect(LumpedMass()), np.random.default_rng(0)
    p, rest = np.array([EI, mass, 0.3]), np.zeros(MODEL.chain.n_cells)
    poses = [HeldPose((0.0, 0.0), None, h, name=f"{h:.1f}") for h in np.linspace(-3.0, 0.0, 10)]
    s = np.linspace(0.65 / points, 0.65, points)
    measured = [
        MeasuredPose.of_points(
            pose, shape.curve.at(s) + rng.normal(scale=std, size=(points, 2)), s=s
        )
        for pose, shape in zip(poses, predict_poses(heavy, p, rest, poses), strict=True)
    ]
    return fit_model(model, measured, Tolerances(), std, **options)


def test_a_weight_that_fits_as_well_as_none_widens_the_interval_of_the_stiffness():
    """Two markers a pose, 6 mm off: without the weight EI is half of what it is."""
    fit = fitted(6e-3, 2, MASS)
    assert fit.chi2_per_dof < 1.5
    assert fit.value("bending_stiffness") + 3 * fit.std("bending_stiffness") < EI
    weight = hidden_weight(fit)
    low, high = weight.stiffness_95
    assert low < EI < high
    assert weight.mass > MASS
    assert weight.force == pytest.approx(9.81 * weight.mass)
    assert weight.difference < fit.expected_error
    said = weight_warning(weight, fit.expected_error)
    assert "measure the force on the start, which differs by up to" in said
    assert ". No pose would tell: even with start_heading" in said

    force = next(c for c in candidates(MODEL, setup_of(MODEL)) if c.name == "point_force")
    model = force.add_to(MODEL)
    values = {"point_force.fy": 2.0, "point_force.position": 0.3}
    free = [name for name in model.names if name != "point_force.position"]
    lifted = refit(fit, model, values=values, free=free)
    # Whatever the data have decided on: nothing lifts a cable with a free tip.
    assert equivalents(lifted, force, tuple(EFFECTS)) == ("lumped_mass", "bending_stiffness")


def test_the_largest_hidden_weight_is_within_95_percent_of_the_likelihood_ratio():
    """3.84 of chi-square, by SciPy without errors of fixtures: within one trial weight."""
    fit = fitted(2e-3, 4, 0.0)
    weight, heavy = hidden_weight(fit), fit.model.with_effect(LumpedMass())

    measured, s = fit.problem.measured, np.linspace(0.65 / 4, 0.65, 4)
    poses = [item.pose for item in measured]

    def chi2(mass):
        def whitened(x):
            p, rest = np.array([np.exp(x[0]), mass, weight.position]), fit.model.rest_basis @ x[1:]
            each = zip(predict_poses(heavy, p, rest, poses), measured, strict=True)
            return np.ravel([seen.curve.at(s) - own.points for seen, own in each]) / 2e-3

        start = [np.log(EI), *np.zeros(MODEL.n_rest)]
        return 2 * least_squares(whitened, start, x_scale=[1.0, 10.0, 10.0, 10.0]).cost

    least = chi2(0.0)
    assert chi2(weight.mass / 1.6) - least < 3.84 < chi2(1.6 * weight.mass) - least


@pytest.mark.parametrize(
    ("correlations", "alike"), [((0.92,), True), ((0.88,), False), ((0.7, 0.7), True)]
)
def test_a_load_is_like_the_stiffness_that_nearly_all_of_its_uncertainty_moves(correlations, alike):
    """Five times less variance if it were known: 1 - r^2 = 0.19 of uncorrelated parameters."""
    names = ("bending_stiffness", *(f"load.{k}" for k in range(len(correlations))))
    covariance = np.eye(len(names))
    covariance[0, 1:] = covariance[1:, 0] = correlations
    unknowns = SimpleNamespace(names=names)
    fit = SimpleNamespace(problem=SimpleNamespace(unknowns=unknowns), covariance=4.0 * covariance)
    assert _like_stiffness(fit, names[1:]) is alike


def test_a_weight_that_shows_is_not_hidden():
    """Sixty points a pose to 0.1 mm tell a twentieth of the cable's mass."""
    assert hidden_weight(fitted(1e-4, 60, 0.0)) is None
