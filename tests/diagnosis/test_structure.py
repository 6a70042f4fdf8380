"""Tests of a residual that is known: slow waves across lines in space."""

import numpy as np
import pytest
from scipy.special import ndtri
from scipy.stats import chi2, spearmanr

from dlo_casadi.diagnosis.structure import _rank_score, structure_of
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose

STD, POINTS = 3e-4, 60
ALONG_X = (0.0, 0.0, 0.0, 1.0)
# Ends at one level distance from the start, and above it, in an order that is not theirs.
HEIGHTS = (0.3, 0.0, 0.45, 0.15, 0.4)


@pytest.fixture(scope="module")
def structure():
    """Five lines off by opposite waves along two normals, more so where the ends are far apart."""
    cable = CableData(0.8, 0.05, 0.008, 0.02, torsional_stiffness=0.015)
    model = CableModel(cable, 8, start="clamped", end="clamped", gravity=(0.0, 0.0, -9.81))
    poses = [
        HeldPose((0.0, 0.0, 0.0), (0.5, 0.0, z), None, None, ALONG_X, ALONG_X, name=f"pose_{k}")
        for k, z in enumerate(HEIGHTS)
    ]
    rng, s = np.random.default_rng(0), np.linspace(0.02, 0.98, POINTS) * cable.length
    measured = []
    for pose, found in zip(
        poses,
        predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), poses),
        strict=True,
    ):
        wave = 2 ** (10 * pose.end[2]) * STD * np.sin(6 * np.pi * s / cable.length)
        away = np.stack([wave, -wave], axis=1) + 0.1 * STD * rng.normal(size=(POINTS, 2))
        points = found.curve.at(s) + np.einsum("kn,knd->kd", away, found.curve.normals(s))
        measured.append(MeasuredPose.of_points(pose, points))
    return structure_of(fit_model(model, measured, Tolerances(), STD), np.inf)


def test_waves_along_two_normals_are_long_runs(structure):
    """Six runs a component, of 60 points 30 are expected: opposite signs side by side are none."""
    # sqrt(10) components of 24.5 runs less than expected each, 3.8 their standard deviation.
    assert structure.runs_z == pytest.approx(-10 * 25 / np.sqrt(10 * 14.7), rel=0.15)


def test_ties_share_their_rank():
    """Repeats of two poses: the order in which they were taken does not matter."""
    energies, spans = np.arange(9.0), np.repeat([1.0, 2.0], [8, 1])
    there, back = _rank_score(energies, spans), _rank_score(energies[::-1], spans[::-1])
    assert there == pytest.approx(back)
    assert there == pytest.approx(spearmanr(energies, spans).statistic * np.sqrt(8))


def test_the_distance_of_the_ends_is_that_in_space(structure):
    """Level, all ends are equally far apart; the energy of the waves grows with the distance."""
    assert structure.span_z == pytest.approx(np.sqrt(len(HEIGHTS) - 1))
    # In the order of the poses the ranks are 3, 1, 5, 2, 4: Spearman's correlation is 0.3.
    assert structure.order_z == pytest.approx(0.3 * np.sqrt(len(HEIGHTS) - 1))


def test_a_lens_is_seen_as_least_squares_with_its_terms_see_it():
    """Chi-square falls by the score if ten terms of first and second degree are fitted, too."""
    cable = CableData(0.8, 0.05, 0.008, 0.02)
    model, rng = CableModel(cable, 8, n_rest=0), np.random.default_rng(0)
    poses = [HeldPose((0.0, 0.0), end) for end in ((0.6, 0.0), (0.4, -0.3), (0.5, 0.2))]
    s, measured = np.linspace(0.02, 0.98, 30) * cable.length, []
    shapes = predict_poses(model, model.nominal, np.zeros(8), poses)
    for pose, shape in zip(poses, shapes, strict=True):
        x, y = shape.curve.at(s).T
        lens = 7 * STD * np.column_stack([x * y, y**2]) / cable.length**2
        points = shape.curve.at(s) + lens + rng.normal(scale=STD, size=(len(s), 2))
        measured.append(MeasuredPose.of_points(pose, points))
    fit = fit_model(model, measured, Tolerances(), STD)
    # Rows of each pose: its points, then the scatter of its own ends; at last what is known of EI.
    problem, lin, std = fit.problem, fit.linearization, fit.problem.deviation_std
    fields, others, target = [], [], []
    for k, (item, seen) in enumerate(zip(measured, problem.observed(fit.point), strict=True)):
        x, y = item.points.T
        terms = np.column_stack([x, y, x**2, x * y, y**2])
        normals = seen.curve.normals(fit.point.projections[k])[:, 0]
        moved = problem.whitening[k] @ np.hstack([normals[:, [i]] * terms for i in (0, 1)])
        fields += [moved, np.zeros((len(std), 10))]
        own = np.zeros((len(s) + len(std), 3, len(std)))
        own[:, k] = np.vstack([lin.by_deviation[k], np.diag(1 / std)])
        by_theta = np.pad(lin.by_theta[k], ((0, len(std)), (0, 0)))
        others.append(np.hstack([by_theta, own.reshape((len(own), -1))]))
        target += [lin.residuals[k], fit.own_deviations[k] / std]
    prior = np.sqrt(problem.precision[0, 0])
    fields = np.vstack([*fields, np.zeros((1, 10))])
    others = np.vstack([*others, prior * np.eye(1, others[0].shape[1])])
    target = np.concatenate([*target, prior * (fit.point.theta - problem.mean)])
    without, beside = (
        np.linalg.lstsq(columns, target, rcond=None)[1][0]
        for columns in (others, np.hstack([others, fields]))
    )
    expected = -ndtri(chi2.sf(without - beside, 10))
    found = structure_of(fit, np.inf).position_z
    assert 3 < found < 6
    assert found == pytest.approx(expected, rel=1e-3)
