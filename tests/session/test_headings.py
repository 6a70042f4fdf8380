"""Headings of clamps against the directions of the lines, on arcs of known ends."""

import numpy as np
import pytest

from dlo_casadi.config import dump_yaml, load_config
from dlo_casadi.equilibrium.measured_line import line_nodes
from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.points import write_points
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.session.clamps import wrong_directions
from dlo_casadi.session.ends import single_poses
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.plausibility import without_implausible
from dlo_casadi.session.read_session import ReadSession

LENGTH = 0.8  # m
BEGINS = (-1.1, -0.6, 0.2)  # rad, where the arcs begin
TURN = 1.4  # rad, by which they turn


def session(folder, change=lambda pose, k: None, turn=TURN, apart=5):
    """Configuration and what was read of circular arcs, both ends clamped, 0.3 mm of noise.

    Points are so many 400th of the cable apart.
    """
    rng = np.random.default_rng(0)
    poses = []
    for k, begin in enumerate(BEGINS):
        heading = begin + turn * np.linspace(0, 1, 400)
        steps = LENGTH / 400 * np.column_stack([np.cos(heading), np.sin(heading)])
        points = np.cumsum(steps, axis=0)
        end = points[-1].tolist()
        noisy = points[::apart] + 3e-4 * rng.standard_normal((len(points[::apart]), 2))
        write_points(folder / f"arc_{k}.csv", noisy)
        pose = {"file": f"arc_{k}.csv", "start": [0, 0], "end": end, "role": "fit"}
        pose |= {"start_heading": begin, "end_heading": begin + turn}
        change(pose, k)
        poses.append(pose)
    data = {
        "cable": {"length": LENGTH, "mass": 0.1, "diameter": 0.01, "bending_stiffness": 0.3},
        "experiment": {
            "gravity": [0, -9.81],
            "boundary": {"start": "clamped", "end": "clamped"},
            "measurement": {"kind": "centerlines"},
            "poses": poses,
        },
    }
    path = folder / "arcs.yaml"
    path.write_text(dump_yaml(data))
    config = load_config(path)
    return config, read_inputs(config)


@pytest.mark.parametrize("turn", [TURN, -5.0, 13.0])
@pytest.mark.parametrize("askew", [-0.8, 0.0, 0.8])
def test_a_clamp_that_is_a_little_askew_is_no_mistake(turn, askew, tmp_path):
    def change(pose, k):
        pose["start_heading"] += askew
        pose["end_heading"] -= askew

    assert wrong_directions(ReadSession(*session(tmp_path, change, turn))) == ()


@pytest.mark.parametrize(
    ("side", "meant", "words"),
    [
        ("start", np.pi + np.array(BEGINS), "along the cable from its start to its end: then -1.1"),
        ("start", [1.1, 0.6, -0.2], "counter-clockwise is positive: then -1.1"),
        ("start", np.pi / 2 - np.array(BEGINS), "clockwise from y, as a compass: then -1.1"),
        ("end", [20.0, 20.0, 20.0], "in degrees? then 0.3491."),
    ],
)
def test_headings_of_most_poses_are_refused(side, meant, words, tmp_path):
    def change(pose, k):
        pose[f"{side}_heading"] = float(meant[k])

    with pytest.raises(
        MeasurementError, match=f"{side}_heading contradicts . of 3 lines"
    ) as caught:
        without_implausible(*session(tmp_path, change))
    assert words in caught.value.message
    assert "rad, the line" in caught.value.message


def test_the_heading_of_a_pinned_side_is_not_used(tmp_path):
    def change(pose, k):
        pose["start_heading"] += 2.0

    config, inputs = session(tmp_path, change)
    assert wrong_directions(ReadSession(config, inputs))
    boundary = config.experiment.boundary.changed(start=SupportKind.PINNED)
    experiment = config.experiment.changed(boundary=boundary)
    assert wrong_directions(ReadSession(config.changed(experiment=experiment), inputs)) == ()


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_behind_a_pinned_start_full_turns_mean_nothing(turns, tmp_path):
    """Neither in what looks like a mistake nor in the first guess along a line."""

    def change(pose, k):
        pose["end_heading"] += 2 * np.pi * turns * (k > 0)

    config, inputs = session(tmp_path, change)
    boundary = config.experiment.boundary.changed(start=SupportKind.PINNED)
    experiment = config.experiment.changed(boundary=boundary)
    bare = config.changed(experiment=experiment)
    assert wrong_directions(ReadSession(bare, inputs)) == ()
    model = declared_model(bare).model
    for pose, item in zip(config.experiment.poses, inputs, strict=True):
        places = np.linspace(0.0, LENGTH, len(item.points))
        nodes = line_nodes(item.points, pose.held, model, places)
        assert abs(nodes[-1, 0] - pose.end_heading) < 0.3


def test_one_wrong_heading_leaves_its_pose_out(tmp_path):
    def change(pose, k):
        pose["end_heading"] += 2.0 * (k == 1)

    inputs, odd = without_implausible(*session(tmp_path, change))
    assert odd == []
    assert [item.name for item in inputs if item.problem] == ["arc_1"]
    assert inputs[1].problem.startswith("its end_heading is 2.8 rad, the line ends at 0.8")


def test_a_full_turn_more_than_the_line_has_is_a_mistake(tmp_path):
    def change(pose, k):
        pose["end_heading"] += 4 * np.pi

    with pytest.raises(MeasurementError, match="end_heading contradicts 3 of 3 lines"):
        without_implausible(*session(tmp_path, change))


@pytest.mark.parametrize("apart", [50, 133, 399])
def test_points_far_apart_do_not_show_the_direction_of_a_clamp(apart, tmp_path):
    """A third of the cable on, arcs have turned by radians."""
    assert wrong_directions(ReadSession(*session(tmp_path, turn=13.0, apart=apart))) == ()
    assert wrong_directions(ReadSession(*session(tmp_path, turn=-6.0, apart=apart))) == ()


@pytest.mark.parametrize("apart", [5, 100, 133])
def test_lines_of_few_points_may_end_before_their_fixtures(apart, tmp_path):
    """But no farther than what they leave of the cable."""
    assert single_poses(ReadSession(*session(tmp_path, apart=apart))) == ()

    def elsewhere(pose, k):
        if k == 1:
            pose["end"] = [0.0, 0.9 * LENGTH]

    (found,) = single_poses(ReadSession(*session(tmp_path, elsewhere, apart=apart)))
    assert found.pose == "arc_1"
