"""Photographs from several places on their way through a session."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dlo_casadi.cli import main
from dlo_casadi.config import DeclaredCamera, dump_yaml, load_config, read_yaml
from dlo_casadi.errors import DloError
from dlo_casadi.report.documents import check_dict
from dlo_casadi.report.page import failure_page
from dlo_casadi.report.page_pictures import view_pictures
from dlo_casadi.session.measure import draw_steps, measured_poses, read_inputs
from dlo_casadi.session.outcome import Stage
from dlo_casadi.session.pose_shape import PoseShape

SESSION = Path(__file__).parents[1] / "data/space/space_photos"
TRUTH = SESSION.parents[1] / "space_truth/space_photos/truth_shapes.npz"


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Pose 1 with a photograph that is overexposed; pose 2 with one photograph; markers of 3."""
    folder = tmp_path_factory.mktemp("photos")
    data = read_yaml(SESSION / "session.yaml")
    one, two, three = data["experiment"]["poses"][:3]
    bright = np.full_like(cv2.imread(str(SESSION / one["files"][2])), 255)
    cv2.imwrite(str(folder / "pose_01_c.jpg"), bright)
    one["files"] = [str(SESSION / name) for name in one["files"][:2]] + ["pose_01_c.jpg"]
    two["files"] = [str(SESSION / two["files"][0])]
    three["file"] = "pose_03.csv"
    del three["files"]
    shown = np.load(TRUTH)["pose_03"][::10]
    table = np.column_stack([np.linspace(0, 0.9, len(shown)), shown])
    np.savetxt(folder / "pose_03.csv", table, delimiter=",", header="s_m,x_m,y_m,z_m", comments="")
    data["experiment"]["poses"] = [one, two, three]
    (folder / "photos.yaml").write_text(dump_yaml(data))
    return load_config(folder / "photos.yaml")


@pytest.fixture(scope="module")
def inputs(config):
    return read_inputs(config)


def test_a_session_of_views_one_view_and_markers(config, inputs):
    """Two photographs give a line, one its pixels; the third is named and the others used."""
    first, second, third = inputs
    assert [len(item.views) for item in inputs] == [2, 1, 0]
    assert len(first.points) > 100
    assert len(second.points) == 0
    assert third.s is not None
    assert all(item.readable and not item.problem for item in inputs)
    assert any(text.startswith("pose_01_c: ") and "overexposed" in text for text in first.messages)
    assert any("pose_02_a: one photograph alone gives no line" in text for text in second.messages)
    poses = measured_poses(config, inputs)
    assert [len(item.sensors) for item in poses] == [2, 1, 1]
    assert [item.has_line for item in poses] == [True, False, True]
    assert not check_dict(config, inputs, ())["warnings"]
    (warning,) = check_dict(config, inputs[1:2], ())["warnings"]
    assert warning.startswith("no pose has a line in space")
    noise = np.concatenate([sensor.weight for item in poses[:2] for sensor in item.sensors])
    assert np.median(noise) == pytest.approx(1.0, rel=0.1)


def test_the_true_curve_projected_into_the_photographs(inputs):
    """It lies on what is seen, to a pixel; a page of a failed run shows that without it."""
    curve = np.load(TRUTH)["pose_01"]
    none = np.zeros(0)
    shape = PoseShape(curve, 0.0, none, none, none, 0.0, True, np.zeros((2, 3)))
    stage = Stage("batch", 0.0, None, None, {}, None, {"pose_01": shape})
    one, other = view_pictures(inputs[:1], [("after", "the truth", stage)])
    assert one.name == "pose_01_a"
    assert one.behind.photograph.startswith("data:image/jpeg")
    for picture in (one, other):
        assert [line.kind for line in picture.lines] == ["after", "measured"]
        (_, label, text), _ = picture.facts
        assert label == "the truth"
        assert float(text.split()[0]) < 1.0  # px


def test_a_failed_run_shows_its_photographs(config, inputs):
    page = failure_page(config, DloError("what happened"), inputs)
    assert page.count("data:image/jpeg") == 3
    assert "pose_02_a" in page


def test_the_steps_of_the_camera_in_every_photograph(config):
    pose = config.experiment.poses[1]
    assert list(draw_steps(config, pose)) == [
        f"pose_02_a_{name}" for name in ("1_workplane", "2_contrast", "3_strands", "4_centerline")
    ]
    assert draw_steps(config, config.experiment.poses[2]) == {}
    board = config.experiment.poses[0]
    only = board.changed(files=board.files[2:])
    assert list(draw_steps(config, only)) == ["pose_01_c_4_centerline"]  # no board is found in it


def test_a_camera_of_another_picture_size_is_told(config):
    """A matrix for half the width and height: named, with what to multiply."""
    pose = config.experiment.poses[0]
    only = pose.changed(files=pose.files[1:2])
    camera = DeclaredCamera(matrix=((540.0, 0.0, 321.0), (0.0, 540.0, 237.0), (0.0, 0.0, 1.0)))
    measurement = config.experiment.measurement.changed(camera=camera)
    experiment = config.experiment.changed(poses=(only,), measurement=measurement)
    (item,) = read_inputs(config.changed(experiment=experiment))
    assert "pose_01_b: camera.matrix, with its principal point at (321, 237)" in item.problem
    assert "is not that of this picture of 1280 x 960 px" in item.problem
    assert not item.readable


def test_the_command(config, tmp_path, capsys):
    """`dlo check --show`: pictures of all photographs but the markers' pose."""
    assert main(["check", str(config.path), "--json", "--quiet", "--show", str(tmp_path)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["points"] > 0 for row in told["poses"]] == [True, False, True]
    names = {Path(path).name for path in told["pictures"]}
    assert {"pose_01_a_4_centerline.jpg", "pose_01_b_4_centerline.jpg"} < names
    assert not any("pose_03" in name for name in names)
