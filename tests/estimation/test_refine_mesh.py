"""From one mesh to the next: a fit that gets stuck on the finer one starts again."""

import numpy as np
import pytest

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.estimation import fit as fitting
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose

MODEL = CableModel(CableData(0.5, 0.1, 0.006, 0.02), 10, n_rest=0)
NOISE = 3e-4


def test_a_fit_that_gets_stuck_on_a_finer_mesh_starts_again(monkeypatch):
    """Where a pose loses its stability on the way no step leads on, however much is left.

    Stuck here: at twice the stiffness, with nothing that descends from there.
    """
    poses = [
        HeldPose((0.0, 0.0), end, name=f"{k}") for k, end in enumerate([(0.4, 0.0), (0.3, -0.1)])
    ]
    shapes = predict_poses(MODEL, MODEL.nominal, np.zeros(MODEL.chain.n_rests), poses)
    rng, s = np.random.default_rng(0), np.linspace(0.01, 0.49, 40)
    measured = [
        MeasuredPose.of_points(pose, shape.curve.at(s) + rng.normal(scale=NOISE, size=(40, 2)))
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    fit = fitting.fit_model(MODEL, measured, Tolerances(), NOISE)

    def stuck(start, model):
        twice = {"bending_stiffness": 2 * start.value("bending_stiffness")}
        return refit(start, model, free=[], values=twice, steps=0)

    monkeypatch.setattr(fitting, "refit", stuck)
    monkeypatch.setattr(fitting, "refine", lambda near, **_: near)
    finer = fitting.refine_mesh(fit, 20)

    assert finer.model.n == 20
    # The two meshes differ by less than the noise: so do the fits.
    assert finer.chi2_per_dof < 1.2 * fit.chi2_per_dof


def test_the_error_of_a_mesh_is_the_distance_from_a_much_finer_one():
    """Of links, whose error falls with the square of their length; nothing holds the other end."""
    model = CableModel(CableData(0.5, 0.03, 0.006, 0.01), 10, "link", end="free", n_rest=3)
    pose, rest = HeldPose((0.0, 0.0)), model.rest_basis @ np.array([4.0, 5.0, 2.0])
    (shape,) = predict_poses(model, model.nominal, rest, [pose])
    seen = [MeasuredPose.of_points(pose, shape.curve.at(np.linspace(0.01, 0.49, 40)))]
    fit = fitting.fit_model(model, seen, Tolerances(), NOISE, refined=False)
    fine = model.with_mesh(160)
    (true,) = predict_poses(fine, fit.p, fine.rest_basis @ fit.coefficients, [pose])
    places = np.linspace(0.0, 0.5, 101)
    gap = true.curve.at(places) - fit.problem.observed(fit.point)[0].curve.at(places)
    apart = np.sqrt((gap**2).sum(axis=1).mean())
    assert apart > 1e-4
    # Between nodes, chords of both meshes differ otherwise than nodes do.
    assert fitting.mesh_error(fit) == pytest.approx(apart, rel=0.1)
