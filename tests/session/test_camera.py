"""The camera of a session from its own photographs."""

import json
from pathlib import Path

import pytest

from dlo_casadi.cli import main
from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.errors import MeasurementError
from dlo_casadi.session.measure import calibrated, needs_camera

SESSION = Path(__file__).parents[1] / "data/space/space_photos"
FOCAL = 1080.0  # px, as rendered


@pytest.fixture
def session(tmp_path):
    """Two poses, five photographs, of which one does not exist; no camera."""
    data = read_yaml(SESSION / "session.yaml")
    poses = data["experiment"]["poses"][:2]
    for pose in poses:
        pose["files"] = [str(SESSION / name) for name in pose["files"]]
    poses[1]["files"].append("gone.jpg")
    data["experiment"]["poses"] = poses
    del data["experiment"]["measurement"]["camera"]
    (tmp_path / "photos.yaml").write_text(dump_yaml(data))
    return tmp_path / "photos.yaml"


def test_a_missing_camera_is_found_in_the_photographs(session, capsys):
    """To half a percent, as the command prints it; the command's text can be pasted."""
    config = load_config(session)
    assert needs_camera(config)
    found = calibrated(config)
    assert not needs_camera(found)
    camera = found.experiment.measurement.camera
    assert camera.matrix[0][0] == pytest.approx(FOCAL, rel=5e-3)
    assert "no camera is declared: focal lengths" in found.warnings[0]
    assert "directions lie within" in found.warnings[0]
    assert main(["calibrate", str(session), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["matrix"][0] == pytest.approx(camera.matrix[0])
    assert len(told["errors_px"]) == 5
    assert main(["calibrate", str(session), "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert main(["calibrate", str(session)]) == 0
    assert "matrix: [[10" in capsys.readouterr().out


def test_photographs_from_one_direction_are_no_calibration(tmp_path, capsys):
    """The focal length that they seem to give is off by a factor of three."""
    source = Path(__file__).parents[2] / "configs/cable.yaml"
    data = read_yaml(source)
    poses = data["experiment"]["poses"] = data["experiment"]["poses"][:4]
    for pose in poses:
        pose["file"] = str(source.parent / pose["file"])
    (tmp_path / "cable.yaml").write_text(dump_yaml(data))
    path = tmp_path / "cable.yaml"
    assert main(["calibrate", str(path)]) == 2
    told = capsys.readouterr()
    assert "focal length is known to" in told.err
    assert "matrix" not in told.out
    config = load_config(path)
    measurement = config.experiment.measurement.changed(camera=None)
    bare = config.experiment.changed(measurement=measurement)
    said = (
        r"camera is missing.* focal length is known to .* % only, .* within \d+ degrees.* Try: .*"
    )
    with pytest.raises(MeasurementError, match=said + "30 to 90 degrees apart, or .*camera"):
        calibrated(config.changed(experiment=bare))


def test_too_few_photographs(session):
    config = load_config(session)
    poses = config.experiment.poses
    few = config.experiment.changed(poses=(poses[1],))
    with pytest.raises(MeasurementError, match=r"camera is missing.* needs 3 photographs .* are 2"):
        calibrated(config.changed(experiment=few))


def test_a_session_without_photographs(capsys):
    bench = Path(__file__).parents[1] / "data/bench/short_clean/session.yaml"
    assert main(["calibrate", str(bench)]) == 2
    assert "photographs of a board of markers, and this session has none" in capsys.readouterr().err
