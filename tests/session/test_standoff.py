"""A cable that stands farther in front of the board than declared, seen by a calibrated camera."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from dlo_casadi.config import load_config
from dlo_casadi.diagnosis.candidates import candidates, setup_of
from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.effects import EFFECTS
from dlo_casadi.errors import ConfigError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import declared_model

DATA = Path(__file__).resolve().parents[1] / "data"
CLEAN = DATA / "bench" / "clean" / "session.yaml"
DISTANCE, STD = 3e-3, 1e-4  # true minus declared standoff; noise of a point [m]
# Photographs by hand: every one from another place, 1.5 to 2 m in front of the board.
CAMERAS = np.random.default_rng(1).uniform([-0.4, -0.8, 1.5], [1.0, 0.4, 2.0], (8, 3))
# Confirming the others would take a minute.
RIVALS = {"standoff_error", "image_scale", "image_distortion", "length_error", "end_offset"}
OTHERS = tuple(set(EFFECTS) - RIVALS)


@pytest.fixture(scope="module")
def config():
    return load_config(CLEAN)


def photographed(config, cameras) -> tuple[MeasuredPose, ...]:
    """True curves, DISTANCE in front of the declared plane z = 0, as their rays meet that plane."""
    rng, shapes = np.random.default_rng(0), np.load(DATA / "bench_truth/clean/truth_shapes.npz")
    measured = []
    for pose, camera in zip(config.experiment.poses, cameras, strict=False):
        curve = shapes[pose.name]
        rays = np.column_stack([curve, np.full(len(curve), DISTANCE)]) - camera
        seen = camera - rays * (camera[2] / rays[:, 2:])
        points = seen[:, :2] + STD * rng.standard_normal(curve.shape)
        ends = replace(pose.held, camera_center=tuple(camera))
        measured.append(MeasuredPose.of_points(ends, points, held_out=pose.role == "held_out"))
    return tuple(measured)


@pytest.mark.parametrize("cameras", [CAMERAS, np.tile(CAMERAS[0], (8, 1))], ids=["moved", "fixed"])
def test_a_wrong_standoff_is_found_and_not_taken_for_a_scale(config, cameras):
    declared = declared_model(config)
    measured = photographed(config, cameras)
    fit = fit_model(declared.model.with_mesh(20), measured, declared.tolerances, STD)
    found = diagnose(fit, exclude=OTHERS)
    assert [item.candidate.name for item in found.added] == ["standoff_error"]
    name = "standoff_error.distance"
    assert abs(found.fit.value(name) - DISTANCE) < 3 * found.fit.std(name)
    assert found.fit.std(name) < 0.2 * DISTANCE  # it would not be found otherwise
    assert "image_scale" not in found.added[0].rivals
    assert found.verdict == "effect_found"


def test_without_a_calibrated_camera_it_is_no_candidate(config):
    model = declared_model(config).model
    setups = [setup_of(model, center=(0, 0), n_poses=8, camera=known) for known in (True, False)]
    named = [{item.name for item in candidates(model, setup)} for setup in setups]
    assert named[0] - named[1] == {"standoff_error"}


def test_a_configuration_that_was_changed_by_hand_is_checked_again(config):
    options = config.diagnosis.changed(exclude=("stand_off",))
    with pytest.raises(ConfigError, match=r"diagnosis\.exclude: no effect is called 'stand_off'"):
        declared_model(config.changed(diagnosis=options))


def test_it_cannot_be_declared_without_a_calibrated_camera(tmp_path):
    document = yaml.safe_load(CLEAN.read_text())
    document["model"] = {"effects": ["standoff_error"]}
    for pose in document["experiment"]["poses"]:
        pose["file"] = str(CLEAN.parent / pose["file"])
    path = tmp_path / "session.yaml"
    path.write_text(yaml.safe_dump(document))
    assert "standoff_error.distance" in declared_model(load_config(path)).model.names
    measurement = document["experiment"]["measurement"]
    measurement["board"]["standoff"] = 0.0
    del measurement["camera"]
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ConfigError, match=r"standoff_error: .* Try: measurement\.camera"):
        load_config(path)
