"""How rough a rest curvature may be that the measured shapes hardly tell."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.descent import descend
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.problem import FIRST_ROUGHNESS
from dlo_casadi.estimation.result import ROUGHNESSES
from dlo_casadi.estimation.unknowns import REST_TURNS_STD
from dlo_casadi.estimation.variances import settle
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.stages import rest_curvature_of


@pytest.fixture(scope="module")
def fit():
    """Cable between pins, twice as stiff as its weight bends, seen as lines with 1 mm of noise."""
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
    return settle(fit_model(model, poses, Tolerances()))


def test_bands_of_a_rest_curvature_that_shapes_hardly_tell_are_wide(fit):
    places = fit.model.cable.length * np.linspace(0.0, 1.0, 21)
    true = -0.7 + 0.8 * np.cos(2 * np.pi * places / fit.model.cable.length)
    basis, first = fit.model.rest.basis(places), fit.problem.unknowns.n_parameters
    scaled, off = basis * fit.model.cable.curvature_scale, []
    for covariance in (fit.covariance, fit.marginal_covariance):
        variance = np.diag(scaled @ covariance[first:, first:] @ scaled.T)
        off.append(float((np.abs(basis @ fit.coefficients - true) / np.sqrt(variance)).max()))
    assert off[1] < 3 < off[0]
    np.testing.assert_allclose(rest_curvature_of(fit).std[::2], np.sqrt(variance), rtol=1e-9)


def test_the_covariance_is_that_of_refits_at_many_roughnesses(fit):
    """Refits, and their evidence, instead of the normal equations at one roughness."""
    likeliest, logs, covariances = fit.problem.priors.roughness_std, [], []
    for std in likeliest * np.exp(np.linspace(-2.0, 3.0, 11)):
        near = descend(fit.reweighed(priors=replace(fit.problem.priors, roughness_std=std)))
        moved = near.point.theta - fit.point.theta
        logs.append(near.log_evidence + 2 * np.log(std / (1 + (std / FIRST_ROUGHNESS) ** 2)))
        covariances.append(near.covariance + np.outer(moved, moved))
    weights = np.exp(np.array(logs) - max(logs))
    refitted = np.average(covariances, axis=0, weights=weights)
    stds = [np.sqrt(np.diag(x)) for x in (fit.covariance, fit.marginal_covariance, refitted)]
    assert max(stds[2] / stds[0]) > 2
    assert fit.inflation == 1.0
    assert stds[1] == pytest.approx(stds[2], rel=0.05)


def test_a_misfit_widens_the_errors_and_not_how_far_the_estimate_moves(fit):
    """A noise of half the size: all precisions are divided by the excess, which is then 4."""
    priors = replace(fit.problem.priors, roughness_std=2 * fit.problem.priors.roughness_std)
    trusted = fit.reweighed(replace(fit.noise, std=fit.noise.std / 2), priors)
    excess = trusted.inflation**2
    assert excess == pytest.approx(4.0, rel=0.1)
    n, theta = trusted.problem.unknowns.n_parameters, trusted.point.theta
    rough = np.zeros_like(trusted.covariance)
    rough[n:, n:] = trusted.model.roughness.T @ trusted.model.roughness
    hessian, known = np.linalg.inv(trusted.covariance), priors.roughness_std
    plain = np.eye(len(theta) - n) / REST_TURNS_STD**2
    means, logs = [], []
    for std in ROUGHNESSES:
        precision = (hessian + (1 / std**2 - 1 / known**2) * rough) / excess
        way = -(1 / std**2 - 1 / known**2) * rough @ theta / excess
        moved = np.linalg.solve(precision, way)
        left = moved @ precision @ moved
        fixed = (1 / std**2 - 1 / known**2) * theta @ rough @ theta / excess
        prior = np.linalg.slogdet(rough[n:, n:] / std**2 + plain)[1]
        log = (prior - np.linalg.slogdet(precision)[1] - fixed + left) / 2
        logs.append(log + 2 * np.log(std / (1 + (std / FIRST_ROUGHNESS) ** 2)))
        means.append(np.linalg.inv(precision) + np.outer(moved, moved))
    weights = np.exp(np.array(logs) - max(logs))
    assert max(weights[0], weights[-1]) < 0.02 * weights.sum()
    expected = np.average(means, axis=0, weights=weights)
    assert np.diag(trusted.marginal_covariance) == pytest.approx(np.diag(expected), rel=1e-3)
