"""Centre-lines of a few points, as somebody clicks them: the noise is still estimated."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, t
from test_problem import CABLE, STD, measured_from

from dlo_casadi.diagnosis.selection import p_under_new_noise, with_new_noise
from dlo_casadi.diagnosis.structure import noise_degrees, structure_of
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.constrained import threshold
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import _white_noise, contradicted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.pose_scatter import PoseScatter
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fit_remarks import fit_warnings
from dlo_casadi.session.fitting import nuisances

EI = 0.09  # N m^2


@cache
def fitted(points, poses=8, std=None):
    """Fit of poses, with what lies within the tolerances as nuisances."""
    truth = CableModel(CABLE, 16, n_rest=5)
    measured = measured_from(
        truth, np.array([EI]), np.array([0.5, 1.0, 1.5, 0.8, 0.4]), poses, STD, points
    )
    return fit_model(nuisances(truth, Tolerances()), measured, Tolerances(), std)


@pytest.mark.parametrize("points", [12, pytest.param(9, marks=pytest.mark.long), 5])
def test_noise_of_few_points(points):
    """Five points leave some twenty degrees of freedom in all, good to a factor of two."""
    fit = fitted(points)
    assert STD / 2 < fit.noise.std < 2 * STD
    assert fit.noise.source == "estimated"
    assert 3 <= fit.noise.slow_dof < 8 * points
    assert abs(fit.value("bending_stiffness") - EI) < 3 * fit.std("bending_stiffness")
    # Nothing is missing, so that it is uniform: one seed in two hundred falls below.
    assert structure_of(fit, noise_degrees(fit)).p_value > 0.005


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 0.005, 1.0), (1 / 1.4, 0.0, 1e-2)])
def test_the_residual_of_a_declared_noise_is_tested_against_chi_square(factor, low, high):
    """Of noise 1.4 times the declared one the statistic is twice the degrees of freedom."""
    fit = fitted(12, std=factor * STD)
    found = structure_of(fit, noise_degrees(fit))
    assert low < found.p_value < high
    assert found.p_value == pytest.approx(chi2.sf(found.statistic, found.dof))
    # Mean of chi-square, and three of its standard deviations, sqrt(2 / dof) each.
    assert factor**2 * found.statistic / found.dof == pytest.approx(
        1, abs=3 * (2 / found.dof) ** 0.5
    )


@pytest.mark.parametrize(("points", "source"), [(24, "estimated"), (5, "declared")])
def test_a_declared_noise_that_the_points_contradict(points, source):
    """Three times too small; five points a pose leave too little to tell."""
    fit = fitted(points, std=STD / 3)
    assert fit.noise.source == source
    said = [line for line in fit_warnings(fit, 0.0, STD / 3) if "measurement.std" in line]
    assert len(said) == (source == "estimated")
    if said:
        assert fit.noise.std == pytest.approx(STD, rel=0.3)
        assert "measurement.std declares, 0.1 mm" in said[0]
        assert fitted(points, std=STD).noise.source == "declared"


def test_errors_that_are_smooth_along_the_cable_contradict_no_declared_noise():
    """As a missing effect leaves them: waves of three times the noise, four along the cable."""
    fit, rng, waved = fitted(24, std=STD), np.random.default_rng(0), []
    seen = fit.problem.observed(fit.point)
    for item, s, one in zip(fit.problem.history, fit.point.projections, seen, strict=True):
        wave = 3 * STD * np.sin(8 * np.pi * s / CABLE.length + rng.uniform(0, 2 * np.pi))
        points = item.points + wave[:, None] * one.curve.normals(s)[:, 0]
        waved.append(MeasuredPose.of_points(item.pose, points))
    problem = replace(fit.problem, history=tuple(waved))
    assert not contradicted(Fit(problem, problem.evaluate(fit.point)))
    assert contradicted(fit.reweighed(replace(fit.noise, std=STD / 3)))


def test_how_well_the_variance_of_a_parameter_is_known():
    """Satterthwaite: shares are the slopes of the log of the variance, by differences."""
    fit = fitted(9)

    def like(noise=1.0, rest=1.0, rest_dof=7.0):
        errors = replace(fit.noise, std=np.sqrt(noise) * fit.noise.std, slow_dof=30.0)
        scatter = PoseScatter(np.sqrt(rest) * 0.2, 0.25, rest_dof)
        return fit.reweighed(errors, replace(fit.problem.priors, pose_scatter=scatter))

    def slope(name):
        more, less = (like(**{name: factor}).covariance[0, 0] for factor in (1.01, 0.99))
        return np.log(more / less) / np.log(1.01 / 0.99)

    shares = [slope("noise"), slope("rest")]
    assert min(shares) > 0.05
    expected = 1 / (shares[0] ** 2 / 30 + shares[1] ** 2 / 7)
    assert like().variance_degrees("bending_stiffness") == pytest.approx(expected, rel=1e-3)
    declared = fitted(9, std=STD)
    assert declared.variance_degrees("bending_stiffness") == np.inf
    wider, own = (x.marginal_covariance[0, 0] / x.covariance[0, 0] for x in (fit, declared))
    assert wider > fit.inflation**2
    assert threshold(fit) == threshold(fit, systematic=True)
    assert threshold(fit) == pytest.approx(
        threshold_of_t(fit.variance_degrees("bending_stiffness")) * wider
    )
    # A twentieth of a white noise in each of 8 x 9 distances.
    allowance = 0.05 * np.sqrt(72)
    assert threshold(declared) == pytest.approx(threshold_of_t(np.inf) * own)
    assert np.sqrt(threshold(declared, systematic=True) / own) == pytest.approx(
        t.ppf(0.975, np.inf) + allowance
    )


def threshold_of_t(degrees):
    """Square of the quantile that 95 % are within."""
    return t.ppf(0.975, degrees) ** 2


def test_fewer_points_than_unknowns():
    with pytest.raises(
        EstimationError,
        match=r"the 4 distances of 4 fit poses determine \d+\.\d unknowns .* "
        r"3 are needed.\n  Try: more points on each line, more poses, the noise as "
        r"measurement.std, or rest_shape: straight.",
    ):
        fitted(1, poses=4)


def test_noise_of_three_points_each_of_a_cable_whose_ends_have_no_tolerance():
    """It hangs from a pin: nothing but the unknowns of all poses may change a curve."""
    model, pose = CableModel(CABLE, 8, end="free", n_rest=3), HeldPose((0.0, 0.0))
    assert model.deviations == ()
    (shape,) = predict_poses(model, model.nominal, model.rest_basis @ np.array([4, 5, 2]), [pose])
    seen = shape.curve.at(np.array([0.3, 0.6, 0.9]) * CABLE.length)
    noise = np.random.default_rng(0).normal(scale=STD, size=(4, *seen.shape))
    fit = fit_model(model, [MeasuredPose.of_points(pose, seen + e) for e in noise], Tolerances())
    assert STD / 2 < fit.noise.std < 2 * STD


def test_as_many_points_as_are_needed_are_enough():
    """Weak priors took a ten-thousandth: "3.0 degrees of freedom are left, 3 are needed"."""
    straight = replace(CABLE, straight=True)
    model, pose = CableModel(straight, 8, start="clamped", end="free"), HeldPose((0, 0), None, 0.0)
    (shape,) = predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), [pose])
    s = np.array([0.4, 0.8]) * CABLE.length
    seen = shape.curve.at(s) + np.random.default_rng(1).normal(scale=STD, size=(2, 2))
    fit = fit_model(model, [MeasuredPose.of_points(pose, seen, s=s)], Tolerances())
    assert fit.noise.slow_dof == pytest.approx(3, abs=0.05)


def test_an_effect_that_leaves_no_point_over_is_not_significant():
    fit = fitted(1, poses=4, std=STD)
    noise = replace(fit.noise, source="estimated")
    fit = replace(fit, problem=replace(fit.problem, noise=noise))
    assert p_under_new_noise(None, fit, fit, tried=1) == 1.0
    each = [SimpleNamespace(candidate=SimpleNamespace(name="x"))]
    winner = SimpleNamespace(fit=fit, each=each, settled=False)
    current = replace(fit, converged=not fit.converged)
    closed, p_value = with_new_noise(winner, current, {"x": 0.001}, from_shapes=False)
    assert closed is current
    assert p_value == 1.0


def test_noise_of_few_points_beside_readings():
    """Forces on the end are no points: they do not count among those the noise is told by."""
    truth = CableModel(CABLE, 16, n_rest=5)
    rest = np.array([0.5, 1.0, 1.5, 0.8, 0.4])
    measured = measured_from(truth, np.array([EI]), rest, 8, STD, 5)
    heard = [
        x.with_readings({"end_force": [0.0, 0.0]}) if k < 2 else x for k, x in enumerate(measured)
    ]
    fit = fit_model(truth, heard, Tolerances())
    assert fit.noise.source == "estimated"
    assert STD / 2 < fit.noise.std < 2 * STD
    # Degrees of freedom of the 40 distances alone.
    points = np.concatenate([item.on_points for item in heard])
    raw, taken = np.concatenate(fit.linearization.raw), np.concatenate(fit.leverages)
    assert points.sum() == 40
    degrees = 40 - taken[points].sum()
    white = _white_noise(fit)
    assert white.slow_dof == pytest.approx(degrees, rel=1e-3)
    assert white.std == pytest.approx(np.sqrt((raw[points] ** 2).sum() / degrees), rel=1e-3)
