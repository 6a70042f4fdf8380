"""Cables whose fixtures move, in MuJoCo beside our own simulation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.export.driven import Driven
from dlo_casadi.export.targets import TARGETS
from dlo_casadi.rod.node import Frame
from dlo_casadi.session.round_trip import motion_round_trip


def smooth(t, duration):
    """From 0 to 1 within the duration, at rest before and after."""
    u = np.clip(t / duration, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


@pytest.fixture(scope="module")
def swung():
    """A rope whose clamp moves and turns."""
    data = dlo.Cable(length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009)
    ends = ("clamped", "free")
    rope = dlo.known_cable(data, gravity=(0, -9.81), boundary=ends, model={"n": 16})
    t = np.linspace(0, 0.9, 226)
    w = smooth(t, 0.6)
    held = {"start": np.stack([0.3 * w, 0.1 * w], 1), "start_heading": -1.2 + 0.4 * w}
    return rope.with_damping(0.02), {"t": t, **held}


def test_a_clamp_that_moves_and_turns_swings_the_cable_alike(swung, tmp_path):
    rope, motion = swung
    (file,) = rope.export("mujoco", tmp_path / "rope.xml", motion=motion)
    apart = motion_round_trip(rope, TARGETS["mujoco"], file, motion, None, {})
    assert apart.largest < 3e-3
    still = {
        **motion,
        "start": motion["start"][0],
        "start_heading": motion["start_heading"] * 1.001,
    }
    assert motion_round_trip(rope, TARGETS["mujoco"], file, still, None, {}).largest > 0.1


def test_both_ends_in_space(tmp_path):
    data = dlo.Cable(
        length=0.6, mass=0.06, diameter=0.008, bending_stiffness=0.009, torsional_stiffness=0.007
    )
    ends = ("clamped", "clamped")
    rope = dlo.known_cable(data, gravity=(0, 0, -9.81), boundary=ends, model={"n": 14})
    t = np.linspace(0, 0.5, 126)
    w = smooth(t, 0.5)
    turns = np.outer(w, [0.3, -0.4, 0.6])
    motion = {
        "t": t,
        "start": np.outer(w, [0.1, 0.0, 0.1]),
        "end": np.array([0.42, 0.05, 0.0]) + np.outer(w, [0.1, 0.05, 0.0]),
        "start_orientation": (
            Rotation.from_euler("y", 0.3) * Rotation.from_rotvec(turns)
        ).as_quat(),
        "end_orientation": (0.0, 0.0, 0.0, 1.0),
    }
    rope = rope.with_damping(0.02)
    (file,) = rope.export("mujoco", tmp_path / "rope.xml", motion=motion, segments=60)
    apart = motion_round_trip(rope, TARGETS["mujoco"], file, motion, 60, {})
    assert apart.largest < 5e-3


def test_turns_about_any_axis_by_a_right_angle_are_followed():
    for axis in range(3):
        for sign in (1, -1):
            turns = np.outer(np.linspace(0, sign * np.pi / 2, 5), np.eye(3)[axis])
            poses = np.zeros((5, 14))
            poses[:, 6:10] = Rotation.from_rotvec(turns).as_quat()
            poses[:, 13] = 1
            driven = Driven.of(Frame, 0.01, poses)
            (carriage,) = driven.carriages.values()
            made = Rotation.from_euler(carriage.axes.upper(), carriage.angles)
            assert np.allclose((made.inv() * Rotation.from_rotvec(turns)).magnitude(), 0)


def test_what_cannot_be_written_is_told(swung, tmp_path):
    rope, motion = swung
    with pytest.raises(dlo.DloError, match="fixtures do not move in its files"):
        rope.export("pyelastica", tmp_path / "a.py", motion=motion)
    with pytest.raises(dlo.DloError, match="start is held, and moves"):
        rope.export("mujoco", tmp_path / "a.xml", motion=motion, start=(0, 0))
    with pytest.raises(dlo.DloError, match="no fixture moves"):
        rope.export(
            "mujoco", tmp_path / "a.xml", motion={"t": [0, 1], "start": (0, 0)}, start_heading=0.0
        )
    with pytest.raises(dlo.DloError, match="arguments of `simulate`"):
        rope.export("mujoco", tmp_path / "a.xml", motion=3)
    assert not list(tmp_path.iterdir())


def test_drag_that_is_lost_is_told(swung):
    rope, _ = swung
    from dlo_casadi.export.rod import Rod

    held = rope.with_damping(air_drag=1.1).solve(start=(0, 0), start_heading=-1.2).held
    assert Rod.of(held).features["damping beside the cable's own"] == ("air_drag",)
