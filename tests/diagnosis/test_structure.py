"""Tests of a residual that is known: slow waves across lines in space."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from dlo_casadi.diagnosis.structure import _rank_score, structure_of
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel, Tolerances
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
