"""From one mesh to the next: a fit that gets stuck on the finer one starts again."""

from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation import fit as fitting
from dlo_casadi.estimation.descent import refit
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.model.cable_model import CableModel, Tolerances
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


@pytest.mark.parametrize(
    ("lost", "found"), [(None, (36, True)), ("mesh", (20, True)), ("noise", (10, True))]
)
def test_noise_is_estimated_on_the_last_mesh(lost, found, monkeypatch):
    """Or, if a finer one has no equilibria or no noise can be estimated, on the last possible."""

    def fit(n, known):
        model = SimpleNamespace(n=n, element=MODEL.element)
        noise = SimpleNamespace(source="estimated")
        return SimpleNamespace(model=model, noise=noise, known=known)

    def moved(near, n):
        if lost == "mesh" and n > 20:
            raise EstimationError("no equilibria")
        return fit(n, False)

    def refine(near, **_):
        if lost == "noise":
            raise EstimationError("too few points")
        return fit(near.model.n, True)

    monkeypatch.setattr(fitting, "_moved", moved)
    monkeypatch.setattr(fitting, "refine", refine)
    monkeypatch.setattr(fitting, "mesh_error", lambda near: 1 / near.model.n**2)
    monkeypatch.setattr(fitting, "allowed_mesh_error", lambda near: 1 / 36**2)
    near = fitting.fine_enough(fit(10, True), 10)
    assert (near.model.n, near.known) == found
