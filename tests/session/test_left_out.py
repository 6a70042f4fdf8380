"""Poses that cannot be used are left out of a fit, and named with the reason."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.points import read_points, write_points
from dlo_casadi.report.sections import print_summary, report_dict
from dlo_casadi.session import run_session
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.plausibility import without_implausible
from dlo_casadi.session.remarks import reading_warnings

SOURCE = Path(__file__).parents[1] / "data/bench/short_clean/session.yaml"


@pytest.fixture
def session(tmp_path):
    """A copy of a session whose poses a test may change, with absolute files."""
    data = read_yaml(SOURCE)
    data |= {"model": {"n": 8}, "estimation": {"algorithm1": False}}
    data["diagnosis"] = {"enabled": False}
    for pose in data["experiment"]["poses"]:
        pose["file"] = str(SOURCE.parent / pose["file"])

    def load(change):
        change(data["experiment"]["poses"])
        path = tmp_path / "rope.yaml"
        path.write_text(dump_yaml(data))
        return load_config(path)

    return load


def summary_text(outcome):
    """What the terminal says, spaces collapsed."""
    console = Console(width=120, file=io.StringIO())
    print_summary(console, outcome)
    return " ".join(console.file.getvalue().split())


def left_out(config):
    """What a fit says of the poses that it leaves out."""
    inputs, odd = without_implausible(config, read_inputs(config))
    assert not odd
    return reading_warnings(inputs, config.skipped), inputs


def test_an_end_out_of_reach_is_told(session):
    def change(poses):
        poses[1]["end"] = [0.6, 0.1]

    config = session(change)
    assert "pose_02" not in [pose.name for pose in config.experiment.poses]
    assert reading_warnings(read_inputs(config), config.skipped) == [
        "pose_02 is left out: end (0.6, 0.1) m is 0.6083 m from the start; the cable is 0.55 m "
        "long. Are end and cable.length in metres?"
    ]


def test_a_missing_file_is_told_once(session):
    def change(poses):
        poses[1]["file"] = "nothing.csv"

    config = session(change)
    (line,) = reading_warnings(read_inputs(config), config.skipped)
    assert line.startswith("nothing is left out: ")
    assert "nothing.csv does not exist" in line


def test_held_out_poses_that_no_error_counts_are_told(session):
    """One cannot be reached, the file of another is gone; a third is as it was."""

    def change(poses):
        del poses[6:]
        for k, pose in enumerate(poses):
            pose["role"] = "held_out" if k in (1, 2, 3) else "fit"
        poses[1]["end"] = [0.6, 0.1]
        poses[2]["file"] = "nothing.csv"

    outcome = run_session(session(change))

    held_out = outcome.held_out(outcome.stage("batch"))
    assert (held_out.predicted, held_out.declared) == (1, 3)
    assert set(held_out.missing) == {"pose_02", "nothing"}
    (said,) = [line for line in outcome.warnings if line.startswith("held out and in no error")]
    assert "pose_02" in said
    assert said.endswith("2 of 3 held-out poses")
    assert "1 of 3 held out" in summary_text(outcome)
    assert "mm (1 of 3)" in summary_text(outcome)
    report = report_dict(outcome)["stages"][-1]["held_out"]
    assert (report["predicted"], report["declared"]) == (1, 3)


def changed_line(tmp_path, name, change):
    """The file of a pose with other points."""

    def apply(poses):
        points = read_points(SOURCE.parent / f"{name}.csv", (0, 0)).points
        write_points(tmp_path / f"{name}.csv", change(points))
        next(pose for pose in poses if Path(pose["file"]).stem == name)["file"] = f"{name}.csv"

    return apply


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda points: points[:, ::-1], "pose_02 is left out: its line runs from"),
        (
            lambda points: np.random.default_rng(0).permutation(points),
            "pose_02 is left out: from point to point its line is",
        ),
        (lambda points: [points[0], points[0] + [0.01, 0.0]], "pose_02 is left out: its line runs"),
    ],
    ids=["x and y exchanged", "shuffled rows", "a centimetre"],
)
def test_one_bad_pose_is_left_out_of_the_fit(session, tmp_path, change, words):
    (line,), inputs = left_out(session(changed_line(tmp_path, "pose_02", change)))
    assert line.startswith(words)
    assert [item.name for item in inputs if not len(item.points)] == ["pose_02"]


def test_a_fit_is_that_without_the_bad_pose(session, tmp_path):
    """Two routes: a pose with x and y exchanged, and no such pose."""
    exchange = changed_line(tmp_path, "pose_02", lambda points: points[:, ::-1])

    def with_it(poses):
        del poses[5:]
        exchange(poses)

    def without(poses):
        del poses[1]

    bad, good = (run_session(session(change)) for change in (with_it, without))
    assert [line for line in bad.warnings if line.startswith("pose_02 is left out: its line")]
    EI, exact = (outcome.fit.value("bending_stiffness") for outcome in (bad, good))
    # Both stop when the objective changes by 1e-4, which is 0.01 standard deviations.
    assert abs(EI - exact) < 0.05 * good.fit.std("bending_stiffness")


def test_mostly_bad_poses_are_refused(session):
    def change(poses):
        for k, pose in enumerate(poses):
            if k % 4:
                pose["start"] = [0.1 * np.sin(7 * k) - 0.1, 0.1 * np.cos(5 * k) + 0.2]

    with pytest.raises(
        MeasurementError,
        match=r"the configuration is contradicted by 4 of 7 poses:\n  pose_\d+: its line runs from",
    ):
        left_out(session(change))
