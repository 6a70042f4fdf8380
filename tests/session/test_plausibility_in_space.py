"""Mistakes of sessions in space: each is made in a rendered session, and named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from dlo_casadi.config import load_config
from dlo_casadi.session.measure import read_inputs
from dlo_casadi.session.plausibility import find_suspicions
from dlo_casadi.session.pull import load_over_stiffness

ROOT = Path(__file__).parents[2]
TIP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up -> y up
AWAY = np.array([0.3, 0.1, -0.2])


@pytest.fixture(scope="module", params=["markers", "lines"])
def session(request):
    """Markers of the repository, and lines through them that nobody has arc lengths of."""
    config = load_config(ROOT / "configs/markers_in_space.yaml")
    inputs = read_inputs(config)
    if request.param == "lines":
        length = config.cable.length
        ends = [(pose.start, pose.end) for pose in config.experiment.poses]
        inputs = [
            replace(
                item,
                points=CubicSpline([0.0, *item.s, length], np.vstack([start, item.points, end]))(
                    np.linspace(0.01, 0.99, 150) * length
                ),
                s=None,
            )
            for item, (start, end) in zip(inputs, ends, strict=True)
        ]
    return config, inputs


def posed(config, change):
    """The configuration with poses changed: change(pose) -> new values."""
    poses = tuple(pose.changed(**change(pose)) for pose in config.experiment.poses)
    experiment = config.experiment.changed(poses=poses)
    return config.changed(experiment=experiment)


def oriented(config, change, sides=("start", "end")):
    keys = [f"{side}_orientation" for side in sides]
    return posed(config, lambda pose: {key: tuple(change(getattr(pose, key))) for key in keys})


def moved(inputs, change):
    return [replace(item, points=change(item.points)) for item in inputs]


def turned(vector):
    turn = Rotation.from_rotvec(vector)
    return lambda q: (Rotation.from_quat(q) * turn).as_quat()


def test_a_sound_session_raises_no_suspicion(session):
    assert find_suspicions(*session) == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda q: (q[3], *q[:3]), "here w seems to stand first"),
        (lambda q: (-q[0], -q[1], -q[2], q[3]), "here it seems to be the world's in the clamp"),
        (turned([0, 0, np.pi]), "here it points backwards, or start and end are exchanged"),
        (turned([0, np.pi / 2, 0]), "here the clamp's z axis does"),
        (turned([0, 0, -np.pi / 2]), "here the clamp's y axis does"),
    ],
)
def test_orientations_are_told_by_what_they_may_mean(session, change, said):
    config, inputs = session
    (found,) = find_suspicions(oriented(config, change), inputs)
    assert said in found.message
    assert found.certain


def test_one_side_and_one_pose(session):
    config, inputs = session
    back = turned([0, 0, np.pi])
    (found,) = find_suspicions(oriented(config, back, ("end",)), inputs)
    assert found.certain
    assert found.message.startswith("end_orientation contradicts 10 of 10 lines")
    first = config.experiment.poses[0].name

    def change(pose):
        if pose.name != first:
            return {}
        return {"end_orientation": tuple(back(pose.end_orientation))}

    (found,) = find_suspicions(posed(config, change), inputs)
    assert (found.pose, found.certain) == (first, False)
    assert "points backwards" in found.message


@pytest.mark.parametrize("askew", [[0, 0.9, 0], [0, 0, -0.9], [1.5, 0, 0]])
def test_a_clamp_that_is_askew_or_rolled_is_no_mistake(session, askew):
    config, inputs = session
    assert find_suspicions(oriented(config, turned(askew), ("start",)), inputs) == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: 1e3 * x, "the points look like millimetres"),
        (lambda x: x @ TIP, "x, y, z = x, -z, y (y up in one, z up in the other?)"),
        (lambda x: x * [1, -1, 1], "x, y, z = x, -y, z, mirrored (a left-handed frame)"),
        (lambda x: x[:, [1, 0, 2]], "x, y, z = y, x, z, mirrored (a left-handed frame)"),
        (
            lambda x: Rotation.from_rotvec([0.3, -0.4, 0.5]).apply(x) + AWAY,
            "with the points turned by 4",
        ),
        (lambda x: x + AWAY, "all lines lie (0.3"),
    ],
)
def test_frames_and_units_of_the_points(session, change, said):
    config, inputs = session
    (found,) = find_suspicions(config, moved(inputs, change))
    assert said in found.message
    assert found.certain


def test_a_frame_a_little_off_is_a_doubt(session):
    config, inputs = session
    turn = Rotation.from_rotvec([0.0, 0.07, 0.04])
    (found,) = find_suspicions(config, moved(inputs, turn.apply))
    assert not found.certain
    assert "turned by 4." in found.message
    slight = Rotation.from_rotvec([0.0, 0.02, 0.01])
    assert find_suspicions(config, moved(inputs, slight.apply)) == ()


def test_files_out_of_step(session):
    config, inputs = session
    shifted = [
        replace(item, points=other.points, s=other.s)
        for item, other in zip(inputs, [*inputs[1:], inputs[0]], strict=True)
    ]
    (found,) = find_suspicions(config, shifted)
    assert "10 of 10 files belong to other entries" in found.message


@pytest.mark.parametrize(
    ("session", "gravity"),
    [
        ("markers", (9.81, 0.0, 0.0)),
        ("lines", (0.0, 0.0, 9.81)),
    ],
    indirect=["session"],
)
@pytest.mark.long
def test_gravity_is_held_against_the_load_that_the_shapes_show(session, gravity):
    config, inputs = session[0], session[1][::3]
    experiment = config.experiment.changed(gravity=gravity)
    (found,) = find_suspicions(config.changed(experiment=experiment), inputs)
    assert "does not hang along gravity" in found.message
    assert "with gravity (0, 0, -9.81) m/s^2" in found.message


def test_the_load_over_the_stiffness_is_that_of_the_cable(session):
    """The truth is 0.03 kg on 0.6 m and 0.015 N m^2 along -z; rest curvature adds a quarter."""
    load = load_over_stiffness([(item.points, item.s) for item in session[1]])
    truth = 0.03 * 9.81 / 0.6 / 0.015
    assert np.linalg.norm(load - [0.0, 0.0, -truth]) < truth / 2


def markers():
    config = load_config(ROOT / "configs/markers_in_space.yaml")
    return config, read_inputs(config)


def test_markers_counted_from_the_end():
    config, inputs = markers()
    length = config.cable.length
    counted = [replace(item, points=item.points[::-1], s=length - item.s[::-1]) for item in inputs]
    exchanged = posed(config, lambda pose: {"start": pose.end, "end": pose.start})
    for found in (find_suspicions(config, counted), find_suspicions(exchanged, inputs)):
        (one,) = found
        assert one.certain
        assert "once they are counted from the other end" in one.message


def test_arc_lengths_shorter_than_chords():
    config, inputs = markers()
    (found,) = find_suspicions(config, [replace(item, s=0.7 * item.s) for item in inputs])
    assert found.certain
    assert "s_m contradicts the points of 10 of 10 poses" in found.message
    one = [replace(inputs[0], s=np.delete(np.append(0.0, inputs[0].s), 5)), *inputs[1:]]
    (found,) = find_suspicions(config, one)
    assert (found.pose, found.certain) == ("pose_01", False)
