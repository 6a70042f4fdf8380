"""What no measurement tells is as uncertain as its bounds leave it."""

import numpy as np
import pytest

from dlo_casadi.effects import CableData, LumpedMass
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import Repeats, Uncertainty, spread_across
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses, uncertainty_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.report.documents import finite
from dlo_casadi.report.tables import describe
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.stages import fitted_parameters

NOISE, LENGTH = 3e-4, 0.5
PLAIN = CableModel(CableData(LENGTH, 0.03, 0.006, 0.01, straight=True), 12)
MASS, PLACE = "lumped_mass.mass", "lumped_mass.position"


@pytest.fixture(scope="module", params=[0.0, 0.01])
def fitted(request):
    """Fit with a weight, and whether there was one."""
    model = PLAIN.with_effect(LumpedMass())
    poses = [HeldPose((0.0, 0.0), end) for end in ((0.3, 0.0), (0.2, -0.2), (0.35, 0.1))]
    # Lighter than nothing where there is none, in the middle, where no weight nearer to an end does
    # the same: the fit ends at the bound of 0.
    p = np.array([0.01, request.param, 0.2] if request.param else [0.01, -6e-3, 0.25])
    s, rng = np.linspace(0.02, 0.98, 30) * LENGTH, np.random.default_rng(0)
    shapes = predict_poses(model, p, np.zeros(12), poses)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(30, 2)))
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    near = np.array([0.01, 0.005, 0.25]) if request.param else model.nominal
    fit = fit_model(model, measured, Tolerances(), NOISE, values=near)
    return fit, request.param > 0


def test_the_place_of_no_weight_is_anywhere(fitted):
    fit, weighs = fitted
    assert fit.is_determined(MASS)
    assert fit.is_determined(PLACE) is weighs
    assert fit.is_determined("lumped_mass.colour") is None
    if weighs:
        assert abs(fit.value(PLACE) - 0.2) < 3 * fit.std(PLACE) < 0.05
    else:
        assert fit.value(MASS) == 0.0
        # Whatever exceeds the noise: bounds do not grow with it.
        assert fit.inflation > 1.05
        assert fit.std(PLACE) == pytest.approx(LENGTH / np.sqrt(12), rel=1e-9)
    # Where the bounds tell nothing beside the data the covariance is the Hessian's inverse.
    known = [k for k, name in enumerate(fit.problem.unknowns.names) if name != PLACE or weighs]
    inverse = np.linalg.inv(fit.normal.hessian[np.ix_(known, known)])
    stds = np.sqrt(np.diag(fit.covariance)[known])
    np.testing.assert_allclose(stds, np.sqrt(np.diag(inverse)), rtol=0.01)


def test_what_it_is_told_as(fitted):
    fit, weighs = fitted
    estimate = fitted_parameters(fit, {}, (MASS, PLACE))[PLACE]
    assert estimate.identifiable is weighs
    assert ("not identifiable" in describe(estimate)[2]) is not weighs
    assert finite({"std": estimate.std}) == {"std": estimate.std}


def test_an_unknown_place_widens_no_band(fitted):
    """Of a weight of zero it moves nothing; a covariance is one whatever is in it."""
    fit, weighs = fitted
    names, covariance = fit.named_covariance
    assert np.linalg.eigvalsh(covariance).min() > -1e-12 * covariance.max()
    pose = fit.problem.measured[0].pose
    (shape,) = predict_poses(fit.model, fit.p, fit.rest, [pose])
    s = np.linspace(0.0, LENGTH, 11)

    def band(uncertainty):
        curve, moved = Repeats(shape, uncertainty).displacements(s)
        return spread_across(curve, s, moved)

    whole = uncertainty_of(fit)
    without = covariance.copy()
    k = names.index(PLACE)
    without[k], without[:, k] = 0.0, 0.0
    other = Uncertainty(names, without, whole.scatter, whole.pose_scatter, whole.repeat_std)
    found = band(whole)
    assert np.all(np.isfinite(found))
    assert np.allclose(found, band(other), rtol=1e-6) is not weighs
