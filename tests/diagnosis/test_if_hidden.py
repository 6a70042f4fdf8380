"""What one effect that is too small to show would do to a stiffness."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from dlo_casadi.diagnosis.candidates import _like_stiffness, candidates, equivalents, setup_of
from dlo_casadi.diagnosis.if_hidden import if_hidden
from dlo_casadi.diagnosis.screening import Screen
from dlo_casadi.diagnosis.widened import Widened
from dlo_casadi.effects import EFFECTS, CableData, LumpedMass, PointForce
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.thresholds import NORMAL_95

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


def hidden_in(fit):
    """What one effect could do to the stiffness of a fit."""
    listed = candidates(fit.model, setup_of(fit.model, n_poses=10))
    return if_hidden(fit, Screen(fit, listed).gram(np.inf))["bending_stiffness"]


def test_a_weight_that_fits_as_well_as_none_widens_the_interval_of_the_stiffness():
    """Two markers a pose, 6 mm off: without the weight EI is half of what it is."""
    fit = fitted(6e-3, 2, MASS)
    assert fit.chi2_per_dof < 1.5
    assert fit.value("bending_stiffness") + 3 * fit.std("bending_stiffness") < EI
    found = hidden_in(fit)
    low, high = found.interval
    assert low < EI < high
    assert found.effect in ("lumped_mass", "point_force", "tether")
    told = found.telling
    assert told.reading.name.startswith("start_"), "the tip is free"
    assert told.difference < fit.expected_error, "another pose would not tell"
    assert found.motion is None
    motion = found.with_motion().motion
    assert motion.at == pytest.approx(0.65), "it is let go from its tip"
    assert set(motion.rivals) == {found.effect}
    assert motion.rivals[found.effect].separation > NORMAL_95

    force = next(c for c in candidates(MODEL, setup_of(MODEL)) if c.name == "point_force")
    model = force.add_to(MODEL)
    values = {"point_force.fy": 2.0, "point_force.position": 0.3}
    free = [name for name in model.names if name != "point_force.position"]
    lifted = refit(fit, model, values=values, free=free)
    # Whatever the data have decided on: nothing lifts a cable with a free tip.
    assert equivalents(lifted, force, tuple(EFFECTS)) == ("lumped_mass", "bending_stiffness")


def test_the_stiffness_beside_an_unknown_force_is_known_as_well_as_scipy_finds_it():
    """Least squares of EI, rest curvature and a force by SciPy, without errors of fixtures."""
    fit = fitted(2e-3, 4, 0.0)
    weight = next(c for c in candidates(fit.model, setup_of(fit.model)) if c.name == "point_force")
    (row,) = Screen(fit, [weight]).gram(np.inf).widened("bending_stiffness")
    place, pulled = row.scan["point_force.position"], fit.model.with_effect(PointForce())
    measured, s = fit.problem.measured, np.linspace(0.65 / 4, 0.65, 4)
    poses = [one.pose for one in measured]

    def whitened(x):
        p = np.array([np.exp(x[0]), *x[1:3], place])
        each = predict_poses(pulled, p, fit.model.rest_basis @ x[3:], poses)
        pairs = zip(each, measured, strict=True)
        return np.ravel([seen.curve.at(s) - own.points for seen, own in pairs]) / 2e-3

    start = np.concatenate([[np.log(fit.value("bending_stiffness")), 0.0, 0.0], fit.coefficients])
    scales = fit.problem.unknowns.scales[-MODEL.n_rest :]
    sizes = np.array([0.01, 0.01, 0.01, *scales])
    slopes = least_squares(whitened, start, "3-point", x_scale=sizes, max_nfev=1).jac
    prior = np.zeros((len(start), len(start)))
    own = fit.problem.precision[-MODEL.n_rest :, -MODEL.n_rest :]
    prior[3:, 3:] = own / np.outer(scales, scales)
    std = np.sqrt(np.linalg.inv(slopes.T @ slopes + prior)[0, 0])
    low, high = row.ends("bending_stiffness", 1.0)
    assert (high - low) / (2 * NORMAL_95) == pytest.approx(std, rel=0.05)


@pytest.mark.parametrize("bounded", [None, 1])
def test_an_interval_beside_a_parameter_with_a_bound_is_that_of_the_draws_within_it(bounded):
    mean, covariance = np.array([0.1, -0.4]), np.array([[0.5, 0.35], [0.35, 0.6]])
    row = Widened(None, {}, ("EI", "mass"), mean, covariance, bounded)
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, 400_000)
    kept = draws[draws[:, 1] > 0] if bounded else draws
    assert row.ends("EI", 1.0) == pytest.approx(np.quantile(kept[:, 0], (0.025, 0.975)), abs=0.02)


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


def test_what_would_show_does_nothing():
    """Sixty points a pose to 0.1 mm leave no room for anything that would move EI by 3 %."""
    fit = fitted(1e-4, 60, 0.0)
    low, high = hidden_in(fit).interval
    assert low < fit.value("bending_stiffness") < high < 1.06 * low
