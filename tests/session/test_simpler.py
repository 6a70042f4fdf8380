"""The simpler fits that a batch estimate stands beside."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtri

from dlo_casadi.config import load_config
from dlo_casadi.estimation.constrained import Interval
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.stiffness import StiffnessFit, fit_stiffness
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import declared_model, simpler_fits, straight
from dlo_casadi.session.measure import measured_poses, read_inputs
from dlo_casadi.session.stages import stiffness_stage

BENCH = Path(__file__).parents[1] / "data" / "bench"


@pytest.fixture(scope="module")
def session():
    config = load_config(BENCH / "short_clean" / "session.yaml")
    measured = measured_poses(config, read_inputs(config))
    few = [item for item in measured if not item.held_out][:3]
    return config.estimation, declared_model(config).model, few


def test_a_reading_of_a_sensor_leaves_the_papers_loop_its_lines(session):
    options, model, measured = session
    first = measured[0].with_readings({"end_force": (0.1, -1.0)})
    found = simpler_fits(options, model, [first, *measured[1:]], 10)
    stages = found.stages(measured, 10)
    assert [stage.name for stage in stages] == ["initial", "stiffness_only", "algorithm1"]
    assert found.loop is not None
    assert found.missing == ""


@pytest.mark.parametrize("factor", [1.0, 2.0, 30.0])
def test_the_stiffness_alone_is_found_from_any_guess(session, factor):
    """Also from the exact one, about which all other stiffnesses are many times worse."""
    _, model, measured = session
    model = straight(model).with_mesh(10)
    poses = [item.pose for item in measured]
    shapes = predict_poses(model, model.nominal, np.zeros(model.chain.n_rests), poses)
    exact = [
        MeasuredPose.of_points(pose, shape.curve.nodes[1:-1])
        for pose, shape in zip(poses, shapes, strict=True)
    ]
    true = model.cable.bending_stiffness
    guess = replace(model, cable=replace(model.cable, bending_stiffness=factor * true))
    assert pytest.approx(true, rel=2e-3) == fit_stiffness(guess, exact).EI


def test_the_std_of_the_stiffness_alone_is_that_of_every_coordinate_of_a_marker(session):
    """To first order noise / |d x / d log EI| over both coordinates of all markers."""
    _, model, measured = session
    model, noise = straight(model).with_mesh(10), 3e-4
    poses, s = [item.pose for item in measured], np.linspace(0.05, 0.95, 60) * model.cable.length

    def places(log_ratio):
        p = model.nominal * np.exp(log_ratio)
        shapes = predict_poses(model, p, np.zeros(model.chain.n_rests), poses)
        return np.array([shape.curve.at(s) for shape in shapes])

    seen = places(0.0) + np.random.default_rng(0).normal(scale=noise, size=(len(poses), 60, 2))
    marked = [MeasuredPose.of_points(*one, s=s) for one in zip(poses, seen, strict=True)]
    slope = np.linalg.norm(places(1e-3) - places(-1e-3)) / 2e-3
    # 360 squares tell the noise to a twentieth.
    assert fit_stiffness(model, marked).log_std == pytest.approx(noise / slope, rel=0.15)


@pytest.mark.parametrize(("log_std", "known"), [(0.58, True), (0.6, False)])
def test_the_interval_of_the_stiffness_alone_spans_a_factor_of_ten_at_most(session, log_std, known):
    """exp(2 x 1.96 x 0.5874) is ten."""
    _, model, measured = session
    found = StiffnessFit(0.02, log_std)
    stage = stiffness_stage(straight(model).with_mesh(10), measured[:1], found)
    estimate = stage.parameters["bending_stiffness"]
    assert (estimate.value, estimate.std) == (0.02, pytest.approx(0.02 * log_std))
    assert estimate.identifiable is known
    assert Interval(0.02, 0.19 if known else 0.21).identifiable is known
    ends = 0.02 * np.exp(np.array([-1, 1]) * ndtri(0.975) * log_std)
    assert estimate.interval_95 == (pytest.approx(ends, rel=1e-6) if known else (None, None))


def test_markers_do_not(session):
    options, model, measured = session
    points = measured[0].points[[20, 60, 100]]
    marked = MeasuredPose.of_points(measured[0].pose, points, s=[0.1, 0.3, 0.5])
    found = simpler_fits(options, model, [marked, *measured[1:]], 10)
    assert found.loop is None
    assert "single markers" in found.stages(measured, 10)[-1].note


def test_stages_of_a_finer_mesh_are_of_the_same_fits(session):
    options, model, measured = session
    found = simpler_fits(options, model, measured, 10)
    for coarse, fine in zip(*(found.stages(measured, n) for n in (10, 20)), strict=True):
        assert coarse.parameters == fine.parameters
        assert coarse.rmse_fit == pytest.approx(fine.rmse_fit, rel=1e-2)
