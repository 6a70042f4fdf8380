"""The simpler fits that a batch estimate stands beside."""

from pathlib import Path

import pytest

from dlo_casadi.config import load_config
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import declared_model, simpler_fits
from dlo_casadi.session.measure import measured_poses, read_inputs

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
