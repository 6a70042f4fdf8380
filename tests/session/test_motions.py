"""Recordings of a moving cable are read, or refused with the line and a remedy."""

import re
from pathlib import Path

import numpy as np
import pytest

import dlo_casadi as dlo
from dlo_casadi.config import Config, load_config
from dlo_casadi.io.motions import read_motion
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.session.motions import read_motions
from dlo_casadi.session.still_in_motion import with_still_poses

T = np.arange(60) / 50
S = np.array([0.1, 0.3, 0.6])
SESSION = """
cable: {name: rope, length: 0.6, mass: 0.06, diameter: 0.008, bending_stiffness: 0.009}
experiment:
  gravity: [0.0, -9.81]
  boundary: {start: clamped, end: free}
  measurement: {kind: centerlines, std: 0.0004}
  poses:
  - {points: [[0.0, 0.0], [0.0, -0.3], [0.0, -0.6]], start: [0, 0], start_heading: -1.57}
  motions:
  - MOTION
"""
RESTING = "{file: swing.csv, start: [0.0, 0.0], start_heading: -1.5708}"
CARRIED = "{file: swing.csv, fixtures: ends.csv, begins: at_rest, role: held_out}"


def swing() -> np.ndarray:
    """Rows t, s, x, y of a cable that swings like a pendulum, one marker not seen now and then."""
    angle = 0.3 * np.cos(5 * T)[:, None]
    rows = np.stack(np.broadcast_arrays(T[:, None], S, S * np.sin(angle), -S * np.cos(angle)), -1)
    rows = rows.reshape(-1, 4)
    return np.delete(rows, [7, 30, 31], axis=0)


def carried() -> np.ndarray:
    """Rows t, x, y, heading of a clamp that moves aside while the cable swings."""
    t = np.arange(0, 1.3, 0.004)
    return np.stack([t, 0.02 * (1 - np.cos(t)), 0 * t, -np.pi / 2 + 0 * t], axis=1)


def write(folder: Path, name: str, header: str, rows: np.ndarray) -> None:
    np.savetxt(folder / name, rows, fmt="%.5f", delimiter=",", header=header, comments="")


def read(folder: Path, motion: str = RESTING, points=None, ends=None, header="t_s,s_m,x_m,y_m"):
    """Motions of a session with this motion, its points and its fixtures."""
    write(folder, "swing.csv", header, swing() if points is None else points)
    ends = carried() if ends is None else ends
    write(folder, "ends.csv", "t_s,start_x_m,start_y_m,start_heading_rad", ends)
    (folder / "session.yaml").write_text(SESSION.replace("MOTION", motion))
    return read_motions(load_config(folder / "session.yaml"))


def test_markers_by_instant_with_gaps(tmp_path: Path) -> None:
    (motion,) = read(tmp_path)
    assert motion.points.shape == (60, 3, 2)
    assert motion.name == "swing"
    np.testing.assert_allclose(motion.t, T, atol=1e-5)
    np.testing.assert_allclose(motion.s, S)
    lost = np.isnan(motion.points[..., 0])
    assert lost.sum() == 3
    assert lost[2, 1]
    assert lost[10, 0]
    assert lost[10, 1]
    assert not motion.moving
    assert not motion.at_rest
    assert not motion.held_out
    np.testing.assert_allclose(motion.resting["start_heading"], -1.5708)


def test_lines_are_read(tmp_path: Path) -> None:
    write(tmp_path, "lines.csv", "t_s,x_m,y_m", swing()[:, [0, 2, 3]])
    found = read_motion(tmp_path / "lines.csv", 2, 0.6)
    assert found.s is None
    assert np.isfinite(found.points[2, :2]).all()
    assert np.isnan(found.points[2, 2]).all()
    with pytest.raises(dlo.MeasurementError, match="a line of 5 or more points stands at 0 inst"):
        read(tmp_path, points=swing()[:, [0, 2, 3]], header="t_s,x_m,y_m")


def test_what_does_not_move_yet_is_refused(tmp_path: Path) -> None:
    read(tmp_path)
    config = load_config(tmp_path / "session.yaml")
    table = dlo.Obstacle(kind="plane", point=[0, -0.6], normal=[0, 1])
    with pytest.raises(dlo.ConfigError, match="a session with obstacles has no motions yet"):
        read_motions(config.changed(experiment={"obstacles": (table,)}))
    with pytest.raises(dlo.ConfigError, match="elements of the kind link"):
        read_motions(config.changed(model={"element": "link"}))


def test_fixtures_that_move_and_another_zero_of_time(tmp_path: Path) -> None:
    later = swing() + np.array([1.7e9, 0, 0, 0])
    ends = carried() + np.array([1.7e9, 0, 0, 0])
    (motion,) = read(tmp_path, CARRIED, later, ends)
    assert motion.at_rest
    assert motion.held_out
    assert not motion.resting
    np.testing.assert_allclose(motion.t, T, atol=1e-5)
    np.testing.assert_allclose(motion.fixtures_t, carried()[:, 0], atol=1e-5)
    np.testing.assert_allclose(motion.moving["start"], carried()[:, 1:3], atol=1e-5)


def test_arrays_are_read_as_a_file(tmp_path: Path) -> None:
    (from_file,) = read(tmp_path)
    points = from_file.points
    declared = dlo.Motion(t=T, points=points, at=S, start=(0, 0), start_heading=-1.5708)
    config = load_config(tmp_path / "session.yaml")
    (motion,) = read_motions(config.changed(experiment={"motions": (declared,)}))
    np.testing.assert_array_equal(motion.points, points)
    path = dlo.FixturePath(t=[0, 0.5, 1.2], start=np.zeros((3, 2)), start_heading=[-1.5] * 3)
    moved = dlo.Motion(t=T, points=points, at=S, fixtures=path)
    (motion,) = read_motions(config.changed(experiment={"motions": (moved,)}))
    assert motion.moving["start"].shape == (3, 2)
    assert motion.moving["start_heading"].shape == (3,)


def swapped(rows: np.ndarray) -> np.ndarray:
    """Two markers exchange their labels for some instants."""
    rows = rows.copy()
    at = (rows[:, 0] > 0.5) & (rows[:, 0] < 0.62)
    first, last = at & (rows[:, 1] == 0.3), at & (rows[:, 1] == 0.6)
    rows[first, 2:], rows[last, 2:] = rows[last, 2:], rows[first, 2:]
    return rows


def let_go(rows: np.ndarray, markers: np.ndarray) -> np.ndarray:
    """Some markers swing back from aside within a few instants, each by as much as it is away."""
    rows, t = rows.copy(), rows[:, 0] - rows[0, 0]
    wave = 0.1 * np.exp(-t / 0.012) * np.cos(60 * t)
    rows[:, 2] -= np.where(np.isin(rows[:, 1], markers), wave * rows[:, 1] / markers[-1], 0.0)
    return rows


def test_a_cable_let_go_moves_quickly_as_a_whole_at_first(tmp_path: Path) -> None:
    later = swing()[8:]
    read(tmp_path, points=let_go(later, S))
    with pytest.raises(dlo.MeasurementError, match=r"the marker at 0.3 m is .* wrong label"):
        read(tmp_path, points=let_go(later, S[1:2]))


BROKEN = {
    "backwards": (RESTING, swing()[::-1], None, r"swing.csv: line 5: t_s 1.16 follows 1.18"),
    "gap": (
        RESTING,
        swing()[(swing()[:, 0] < 0.3) | (swing()[:, 0] > 0.95)],
        None,
        r"line \d+: nothing was seen between 0.28 and 0.96 s.*two motions",
    ),
    "milliseconds": (RESTING, swing() * [1e3, 1, 1, 1], None, "in milliseconds"),
    "twice": (
        RESTING,
        np.repeat(swing(), 2, axis=0),
        None,
        "line 3: the marker at 0.1 m stands twice",
    ),
    "labels": (RESTING, swapped(swing()), None, r"line \d+: the marker at .* wrong label"),
    "beyond": (RESTING, swing() * [1, 2, 1, 1], None, "1.2 m is not between 0 and"),
    "few": (RESTING, swing()[:9], None, "holds 4 instants|holds 3 instants"),
    "nothing held": ("{file: swing.csv}", None, None, "a clamped start needs its start"),
    "both": (
        "{file: swing.csv, fixtures: ends.csv, start: [0.0, 0.0]}",
        None,
        None,
        "start rests by the session and moves",
    ),
    "no end": (
        "{file: swing.csv, start: [0, 0], start_heading: 0, end: [0, 1]}",
        None,
        None,
        "a free end has no end",
    ),
    "ends too early": (CARRIED, None, carried()[:150], "ends.csv: the fixtures were recorded"),
    "degrees": (
        CARRIED,
        None,
        carried() * [1, 1, 1, 57.2958],
        r"line 2: .*in degrees\? then -1.57",
    ),
    "far": (CARRIED, None, carried() * [1, 50, 1, 1], "m of cable lie between them"),
    "missing": ("{file: none.csv, start: [0, 0], start_heading: 0}", None, None, "does not exist"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_named(tmp_path: Path, name: str) -> None:
    motion, points, ends, said = BROKEN[name]
    with pytest.raises(dlo.MeasurementError) as error:
        read(tmp_path, motion, points, ends)
    assert re.search(said, error.value.message, re.DOTALL), error.value.message


def test_other_columns_are_explained(tmp_path: Path) -> None:
    with pytest.raises(dlo.MeasurementError, match="time_ms in seconds is called t_s"):
        read(tmp_path, header="time_ms,s_m,x_m,y_m")
    with pytest.raises(dlo.MeasurementError, match="must be t_s,s_m,x_m,y_m of markers"):
        read(tmp_path, header="t_s,s_m,x_mm,y_mm")


def test_shapes_of_arrays_are_checked() -> None:
    with pytest.raises(dlo.ConfigError, match="points \\(T, K, d\\) have times"):
        dlo.Motion(t=T[:5], points=np.zeros((60, 3, 2)), at=S)
    with pytest.raises(dlo.ConfigError, match="one of file and points"):
        dlo.Motion(start=(0, 0))


# ---- sessions without still poses ---------------------------------------------------------------

NO_POSES = re.sub(r"  poses:\n  - .*\n", "", SESSION)


def carried_then_still(folder: Path, begins: str, *, until: float = 0.5) -> Config:
    """A session of one motion: still for 0.2 s, carried aside until `until`, still again."""
    t = np.arange(0, 1.2, 0.02)
    aside = 0.1 * np.clip((t - 0.2) / (until - 0.2), 0, 1)
    rows = [(x, s, a, -s) for x, a in zip(t, aside, strict=True) for s in S]
    write(folder, "swing.csv", "t_s,s_m,x_m,y_m", np.array(rows))
    ends = np.stack([t, aside, 0 * t], axis=1)
    write(folder, "ends.csv", "t_s,start_x_m,start_y_m", ends)
    motion = f"{{file: swing.csv, fixtures: ends.csv, start_heading: -1.57, begins: {begins}}}"
    (folder / "session.yaml").write_text(NO_POSES.replace("MOTION", motion))
    return load_config(folder / "session.yaml")


def test_poses_may_be_left_out_if_a_motion_is_ever_at_rest(tmp_path: Path) -> None:
    config = carried_then_still(tmp_path, "at_rest")
    assert not config.experiment.poses
    motions = read_motions(config)
    found = with_still_poses(config, motions)
    first, last = found.experiment.poses
    assert [first.name, last.name] == ["swing_begins", "swing_ends"]
    np.testing.assert_allclose(first.points, [(0, -s) for s in S], atol=1e-4)
    np.testing.assert_allclose(last.points, [(0.1, -s) for s in S], atol=1e-4)
    np.testing.assert_allclose(last.start, (0.1, 0), atol=1e-4)
    assert first.start_heading == -1.57
    np.testing.assert_allclose(first.at, S)
    assert with_still_poses(found, motions) is found
    (only,) = with_still_poses(
        config, read_motions(carried_then_still(tmp_path, "moving"))
    ).experiment.poses
    assert only.name == "swing_ends"


def test_without_rest_it_is_said_what_to_add(tmp_path: Path) -> None:
    config = carried_then_still(tmp_path, "moving", until=1.2)
    with pytest.raises(dlo.ConfigError, match=r"no motion to fit begins or ends at rest"):
        with_still_poses(config, read_motions(config))
    (tmp_path / "session.yaml").write_text(NO_POSES.split("  motions")[0])
    with pytest.raises(dlo.ConfigError, match="poses"):
        load_config(tmp_path / "session.yaml")


def test_noise_from_frame_to_frame_at_even_and_uneven_times() -> None:
    random = np.random.default_rng(0)
    for t in (np.arange(300) / 60, np.unique(np.round(np.arange(0, 1200, 2.4))) / 240):
        swing = 0.3 * np.sin(2 * np.pi * 3 * t)[:, None, None] + np.zeros((1, 6, 2))
        points = swing + 5e-4 * random.normal(size=swing.shape)
        points[5, 1] = np.nan
        motion = MeasuredMotion(
            "x", t, points, np.arange(6.0), np.zeros(0), {}, {}, at_rest=False, held_out=False
        )
        assert motion.noise == pytest.approx(5e-4, rel=0.06)
