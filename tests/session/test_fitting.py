"""The mesh that is asked for, and weights that land on the points they are meant for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dlo_casadi.config import load_config
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel, Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session import run_session
from dlo_casadi.session.fitting import reweighted

BENCH = Path(__file__).resolve().parents[1] / "data" / "bench"
NOISE = 3e-4


def test_a_declared_mesh_is_kept_and_its_error_told():
    config = load_config(BENCH / "short_clean" / "session.yaml")
    coarse = config.model.model_copy(update={"n": 6})
    estimation = config.estimation.model_copy(update={"algorithm1": False})
    diagnosis = config.diagnosis.model_copy(update={"enabled": False})
    config = config.model_copy(
        update={"model": coarse, "estimation": estimation, "diagnosis": diagnosis}
    )
    outcome = run_session(config)
    assert outcome.fit.model.n == 6
    (warning,) = [text for text in outcome.warnings if "mesh" in text]
    assert f"{1e3 * outcome.mesh_error:.3g} mm" in warning
    assert "the mesh of 6 elements" in warning


def test_the_points_that_weigh_less_are_the_outlying_ones():
    """The first pose is held out, and no two poses have the same number of points."""
    model = CableModel(CableData(0.8, 0.03, 0.006, 0.02), 12, n_rest=5)
    rng = np.random.default_rng(0)
    poses = [HeldPose((0.0, 0.0), (0.45, y)) for y in (-0.1, 0.0, 0.1, 0.2)]
    shapes = predict_poses(model, model.nominal, np.ones(model.chain.n_cells), poses)
    measured = []
    for k, (pose, shape) in enumerate(zip(poses, shapes, strict=True)):
        s = np.linspace(0.02, 0.98, 40 + k) * model.cable.length
        points = shape.curve.at(s) + rng.normal(scale=NOISE, size=(len(s), 2))
        points[20, 1] += 30 * NOISE * (k == 2)
        measured.append(MeasuredPose.of_points(pose, points, held_out=k == 0))

    found = reweighted(fit_model(model, measured, Tolerances(), NOISE))

    assert [item.pose for item in found] == poses
    assert found[0] is measured[0]
    assert [len(item.relative_std) for item in found[1:]] == [41, 42, 43]
    # A point of d standard deviations weighs as one of noise sqrt(d / 1.5): 4.5 for 30, and 1.7
    # for the 4.5 that one of a hundred thousand has.
    assert np.flatnonzero(np.concatenate([item.relative_std for item in found[1:]]) > 2) == 41 + 20
