"""Left-out poses where one Gauss-Newton step leads too far."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from dlo_casadi.diagnosis import crossval
from dlo_casadi.diagnosis.crossval import cross_validate, density_of_declared
from dlo_casadi.effects import CableData, RestCurvatureDrift
from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.descent import NEARLY
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.linear_mixed import log_density
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel

CABLE = CableData(length=0.5, mass=0.02, diameter=0.006, bending_stiffness=0.002)
NOISE = 3e-4
ENDS = (0.4, 0.0), (0.35, 0.1), (0.3, -0.1), (0.25, 0.05)


def measured(model: CableModel) -> list[MeasuredPose]:
    rng, s = np.random.default_rng(0), np.linspace(0.02, 0.98, 40) * CABLE.length
    poses = [HeldPose((0.0, 0.0), end, name=f"{k}") for k, end in enumerate(ENDS)]
    shapes = predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), poses)
    return [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2)))
        for pose, shape in zip(poses, shapes, strict=True)
    ]


@pytest.mark.parametrize("effects", [(), (RestCurvatureDrift(),)])
def test_where_a_step_leads_too_far_the_other_poses_are_fitted_again(effects, monkeypatch):
    model = CableModel(CABLE, 12, n_rest=0, effects=effects)
    poses = measured(model)
    fit = fit_model(model, poses, Tolerances(), NOISE)
    expected, densities = cross_validate(fit).squares, cross_validate(fit).densities
    predicted = crossval._predicted

    def astray(fit, thetas):  # a bending stiffness 2.7 times as large
        monkeypatch.setattr(crossval, "_predicted", predicted)
        further = {k: theta + np.eye(len(theta))[0] for k, theta in thetas.items()}
        return predicted(fit, further)

    monkeypatch.setattr(crossval, "_predicted", astray)
    found = cross_validate(fit)
    # The taut cable of the first pose hardly shows its stiffness: it is not fitted again.
    np.testing.assert_allclose(found.squares[1:], expected[1:], rtol=0.02)
    assert found.densities[1:] == pytest.approx(densities[1:], abs=0.1)


@pytest.mark.parametrize("k", range(len(ENDS)))
def test_a_left_out_pose_is_that_of_a_fit_without_it(k):
    model = CableModel(CABLE, 12, n_rest=0)
    poses = measured(model)
    fit = fit_model(model, poses, Tolerances(), NOISE)
    others = [replace(pose, held_out=i == k) for i, pose in enumerate(poses)]
    known = fit_model(model, others, Tolerances(), NOISE)
    (seen,) = predict_poses(model, known.p, known.rest, [poses[k].pose])
    expected = (poses[k].distances(seen.curve) ** 2).sum()
    again = fit.problem.unknowns.p(crossval._fitted_without(fit, k))
    # A decrease of the objective by the tolerance is a step of sqrt(2 x tolerance) std.
    apart = np.sqrt(2 * NEARLY) * known.std("bending_stiffness")
    np.testing.assert_allclose(again, known.p, atol=apart)
    assert cross_validate(fit).squares[k] == pytest.approx(expected, rel=1e-2)


def test_density_of_residuals_is_that_of_their_covariance():
    rng = np.random.default_rng(0)
    white, ways = rng.normal(size=9), rng.normal(size=(9, 4))
    covariance = np.eye(9) + ways @ ways.T
    energy = white @ np.linalg.solve(covariance, white)
    expected = -(energy + np.linalg.slogdet(covariance)[1]) / 2
    assert log_density(white, ways) == pytest.approx(expected, rel=1e-9)


def test_points_of_a_left_out_stretch_do_not_move_what_predicts_it(monkeypatch):
    """Nor through the points beside it, whose noise is correlated with theirs."""
    model = CableModel(CABLE, 12, n_rest=0)
    (pose,) = measured(model)[-1:]
    fit = fit_model(model, [pose], Tolerances(), NOISE, refined=False)
    fit = fit.reweighed(NoiseModel(NOISE, 0.9, 0.05, source="declared"))
    moved = pose.points + np.where(np.arange(40)[:, None] // 8 == 2, 1e-3, 0.0)
    others = replace(fit.problem, history=(MeasuredPose.of_points(pose.pose, moved),))
    thetas, predicted = [], crossval._predicted

    def kept(fit, own):
        thetas.append(own[0])
        return predicted(fit, own)

    monkeypatch.setattr(crossval, "_predicted", kept)
    for one in (fit, Fit(others, fit.point)):
        cross_validate(one)
    before, after = np.split(np.array(thetas), 2)
    assert after[2] == pytest.approx(before[2], rel=1e-9)
    assert np.abs(after - before).max() > 1e-2


def test_a_state_before_a_left_out_pose_moves_with_the_unknowns():
    """To first order as all poses in order do; the third of five poses is held out of the fit."""
    model = CableModel(CABLE, 12, n_rest=0, effects=(RestCurvatureDrift(),))
    p, s = model.nominal.copy(), np.linspace(0.02, 0.98, 40) * CABLE.length
    p[model.names.index("rest_curvature_drift.rate")] = 0.3
    rng, ends = np.random.default_rng(0), (*ENDS, (0.3, 0.12))
    poses = [HeldPose((0.0, 0.0), end, name=f"{k}") for k, end in enumerate(ends)]
    shapes = predict_poses(model, p, np.zeros(model.chain.n_rests), poses)
    points = [shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2)) for shape in shapes]
    measured = [
        MeasuredPose.of_points(pose, some, held_out=k == 2)
        for k, (pose, some) in enumerate(zip(poses, points, strict=True))
    ]
    fit = fit_model(model, measured, Tolerances(), NOISE)
    problem, theta, step = fit.problem, fit.point.theta, 1e-4
    assert problem.used == [0, 1, 3, 4]
    for k, j in enumerate(problem.used):
        off = []
        for x in (theta, theta + step * np.eye(len(theta))[1]):
            seen = crossval._predicted(fit, {k: x})[k]
            off.append(
                problem.whitening[k] @ problem.measured[j].residual(seen, fit.point.projections[k])
            )
        change = (off[1] - off[0]) / step
        expected = fit.linearization.by_theta[k][:, 1]
        assert np.abs(change - expected).max() < 0.02 * np.abs(expected).max() + 1e-6


def test_a_pose_that_newtons_method_loses_counts_for_no_error(monkeypatch):
    """A descent would end in another equilibrium, as one pose in space did, 40 mm off."""
    model = CableModel(CABLE, 12, n_rest=0)
    fit = fit_model(model, measured(model), Tolerances(), NOISE)
    expected, solve = cross_validate(fit), BatchEquilibrium.solve

    def loses_one(self, *arguments, **options):
        shapes, converged = solve(self, *arguments, **options)
        converged[2] = False
        return shapes, converged

    monkeypatch.setattr(BatchEquilibrium, "solve", loses_one)
    monkeypatch.setattr(crossval, "_fitted_without", lambda *_: None)
    found = cross_validate(fit)
    assert np.isinf(found.squares[2])
    assert found.error_of_most < 1.2 * expected.error


@pytest.mark.parametrize("held", [True, False])
def test_a_declared_value_is_left_out_as_a_measurement_is(held):
    """Poses tell v = 3 with a variance of 0.5; declared is 0 with a tolerance of 2, or nothing."""
    told, variance, tolerance, scale = 3.0, 0.5, 2.0, 10.0
    own = 1 / (1 / variance + 1 / tolerance**2) if held else variance
    v = told * own / variance if held else told
    unknowns = SimpleNamespace(names=("other", "v"), scales=np.array([1.0, scale]))
    fit = SimpleNamespace(
        problem=SimpleNamespace(unknowns=unknowns, mean=np.zeros(2)),
        point=SimpleNamespace(theta=np.array([7.0, v / scale])),
        covariance=np.diag([1.0, own / scale**2]),
        model=SimpleNamespace(priors={"v": tolerance} if held else {}),
    )
    width = tolerance if held else scale
    expected = norm(told, np.sqrt(width**2 + variance)).logpdf(0.0)
    constant = norm.logpdf(0.0) - np.log(scale)
    assert density_of_declared(fit, ["v"]) == pytest.approx(expected - constant)
