"""How rough a rest curvature may be that the measured shapes hardly tell."""

import numpy as np

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation import variances
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.variances import ALLOWED, settle, with_roughest_rest
from dlo_casadi.model.cable_model import CableModel, Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose


def test_bands_of_a_rest_curvature_that_shapes_hardly_tell_are_wide(monkeypatch):
    """Between pins, twice as stiff as its weight bends, seen as lines with 1 mm of noise."""
    rng = np.random.default_rng(5)
    model = CableModel(CableData(0.56, 0.05, 0.006, bending_stiffness=0.08), 20, n_rest=7)
    s = model.cable.length * np.linspace(0.02, 0.98, 40)
    middle = model.chain.cells.mean(axis=1) / model.cable.length
    rest = -0.7 + 0.8 * np.cos(2 * np.pi * middle)
    poses = []
    for k in range(8):
        way, span = rng.uniform(-0.6, 0.6), rng.uniform(0.35, 0.45)
        pose = HeldPose((0.0, 0.0), (span * np.cos(way), span * np.sin(way)), name=f"{k}")
        (shape,) = predict_poses(model, model.nominal, rest, [pose])
        points = shape.curve.at(s) + rng.normal(scale=1e-3, size=(len(s), 2))
        poses.append(MeasuredPose.of_points(pose, points))
    fit = settle(fit_model(model, poses, Tolerances()))
    rough = with_roughest_rest(fit)

    priors = [item.problem.priors.roughness_std for item in (fit, rough)]
    assert priors[1] > 1.9 * priors[0]
    assert fit.log_evidence - ALLOWED < rough.log_evidence
    places = fit.model.cable.length * np.linspace(0.0, 1.0, 21)
    true = -0.7 + 0.8 * np.cos(2 * np.pi * places / fit.model.cable.length)
    basis, first = fit.model.rest.basis(places), fit.problem.unknowns.n_parameters
    off = []
    for item in (fit, rough):
        scaled = basis * fit.model.cable.curvature_scale
        variance = np.diag(scaled @ item.covariance[first:, first:] @ scaled.T)
        off.append(float((np.abs(basis @ item.coefficients - true) / np.sqrt(variance)).max()))
    assert off[1] < 3 < off[0]

    def at_a_fold(fit):
        raise EstimationError("a pose of the fit has come to a fold of its equilibria")

    monkeypatch.setattr(variances, "descend", at_a_fold)
    assert with_roughest_rest(fit) is fit
