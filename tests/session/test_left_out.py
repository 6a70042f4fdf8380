"""Poses that cannot be used are left out of a fit, and named with the reason."""

from pathlib import Path

import pytest

from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.remarks import reading_warnings

SOURCE = Path(__file__).parents[1] / "data/bench/short_clean/session.yaml"


@pytest.fixture
def session(tmp_path):
    """A copy of a session whose poses a test may change, with absolute files."""
    data = read_yaml(SOURCE)
    for pose in data["experiment"]["poses"]:
        pose["file"] = str(SOURCE.parent / pose["file"])

    def load(change):
        change(data["experiment"]["poses"])
        path = tmp_path / "rope.yaml"
        path.write_text(dump_yaml(data))
        return load_config(path)

    return load


def test_an_end_out_of_reach_is_told(session):
    def change(poses):
        poses[1]["end"] = [0.6, 0.1]

    config = session(change)
    assert "pose_02" not in [pose.name for pose in config.experiment.poses]
    assert reading_warnings(read_inputs(config, lambda *_: None), config.skipped) == [
        "pose_02 is left out: end (0.6, 0.1) m is 0.6083 m from the start; the cable is 0.55 m "
        "long. Are end and cable.length in metres?"
    ]


def test_a_missing_file_is_told_once(session):
    def change(poses):
        poses[1]["file"] = "nothing.csv"

    config = session(change)
    (line,) = reading_warnings(read_inputs(config, lambda *_: None), config.skipped)
    assert line.startswith("nothing is left out: ")
    assert "nothing.csv does not exist" in line
