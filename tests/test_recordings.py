"""Recordings rendered from a session whose truth is known come back as that session."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded.takes import HOLD, WRITERS, rendered
from scipy.spatial.transform import Rotation

from dlo_casadi.cli import main
from dlo_casadi.config import load_config
from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.points import read_points
from dlo_casadi.recordings import FORMATS, Recording, Stream, Wishes, make_session, read_recording
from dlo_casadi.session.motions import read_motions

SESSION = Path(__file__).parents[1] / "configs" / "markers_in_space.yaml"
CABLE = ("--mass", "0.03", "--diameter", "0.004")


@pytest.fixture(scope="module")
def take():
    return rendered(SESSION, poses=4, rate=25.0)


def imported(files, output, *options):
    arguments = ["import", *map(str, files), "--output", str(output), *options]
    return main(arguments)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_take_comes_back_as_the_session(kind, take, tmp_path):
    """All poses, ends, roles and arc lengths; the other clock's 80 ms are named."""
    files, options = WRITERS[kind](take, tmp_path)
    assert imported(files, tmp_path / "loom", *options, *CABLE) == 0

    path = tmp_path / "loom" / "session.yaml"
    own, true = load_config(path), load_config(SESSION)
    poses = list(zip(own.experiment.poses, true.experiment.poses[:4], strict=True))
    for pose, exact in poses:
        assert pose.role == exact.role
        assert pose.start == pytest.approx(exact.start, abs=1e-4)  # 0.1 mm of noise in 100 frames
        assert pose.end == pytest.approx(exact.end, abs=1e-4)
        turns = Rotation.from_quat([pose.end_orientation, exact.end_orientation])
        assert (turns[0].inv() * turns[1]).magnitude() < 3e-4  # rad, of 0.5e-3 in a frame
        seen = [read_points(x.paths[0], x.start, x.end) for x in (pose, exact)]
        assert seen[0].points == pytest.approx(seen[1].points, abs=1.5e-4)
        # The session's own points are 0.3 mm off, the means of four poses 0.15 mm.
        assert seen[0].s == pytest.approx(seen[1].s, abs=4e-4)
    assert own.cable.length == pytest.approx(true.cable.length, abs=4e-4)
    offset = re.search(r"is (\d+) ms ahead of", path.read_text())
    assert int(offset[1]) == pytest.approx(80, abs=5)  # half a frame


def damaged(kind, how, take, folder):
    """Files of a take that are broken in one way."""
    if how == "never seen":
        take = replace(take, markers={name: x * np.nan for name, x in take.markers.items()})
    if how == "no gripper":
        take = replace(take, bodies={name: x * np.nan for name, x in take.bodies.items()})
    files, options = WRITERS[kind](take, folder)
    file = next(files[0].glob("*.db3")) if files[0].is_dir() else files[0]
    if how == "truncated":
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    if how == "empty":
        file.write_bytes(b"")
    if how == "other names":
        options = [*options, "--end", "hand"]
    return files, options


@pytest.mark.parametrize("kind", ["motive", "vicon", "c3d", "mcap"])
@pytest.mark.parametrize("how", ["truncated", "empty", "never seen", "no gripper", "other names"])
def test_broken_files_are_told_and_nothing_is_written(kind, how, take, tmp_path, capsys):
    files, options = damaged(kind, how, take, tmp_path)
    before = sorted(tmp_path.iterdir())
    assert imported(files, tmp_path / "loom", *options, *CABLE) == 2
    told = capsys.readouterr().err
    assert "Try: " in told
    assert "Traceback" not in told
    assert sorted(tmp_path.iterdir()) == before


def swapped(take, axes, signs=(1.0, 1.0, 1.0)):
    """Places in other axes, with quaternions as they were."""
    bodies = {name: np.hstack([x[:, axes] * signs, x[:, 3:]]) for name, x in take.bodies.items()}
    markers = {name: x[:, axes] * signs for name, x in take.markers.items()}
    return replace(take, markers=markers, bodies=bodies)


@pytest.mark.parametrize(
    ("axes", "signs", "told"),
    [
        ([1, 0, 2], (1, 1, 1), "no axis of the body at the end is directed along the cable"),
        pytest.param(
            [0, 2, 1], (1, 1, 1), "warning: pose_04: its end_orientation", marks=pytest.mark.long
        ),
        pytest.param(
            [0, 1, 2], (1, 1, -1), "warning: pose_01: its end_orientation", marks=pytest.mark.long
        ),
    ],
    ids=["x and y", "y and z", "z mirrored"],
)
def test_places_in_other_axes_than_rotations(axes, signs, told, take, tmp_path, capsys):
    files, options = WRITERS["vicon"](swapped(take, axes, signs), tmp_path)
    code = imported(files, tmp_path / "loom", *options, *CABLE)
    said = capsys.readouterr()
    assert told in said.out + said.err
    assert (tmp_path / "loom").exists() == (code == 0)


def test_a_wrong_axis_upwards_is_doubted(take, tmp_path, capsys):
    """A few poses do not prove it: a cable whose shape at rest is curved may look the same."""
    files, options = WRITERS["motive"](take, tmp_path)
    assert imported(files, tmp_path / "loom", *options, "--up", "x", *CABLE) == 0
    told = capsys.readouterr().out
    assert "warning: the cable does not hang along gravity" in told
    assert "warning: Try: --up" in told


def test_one_world_frame_is_assumed_and_said(take, tmp_path, capsys):
    """Of two systems 20 mm apart the length that the markers give scatters from pose to pose."""
    scatter = []
    for shift in (0.0, 0.02):
        bodies = {name: x + shift * np.eye(7)[0] for name, x in take.bodies.items()}
        folder = tmp_path / str(shift)
        folder.mkdir()
        files, options = WRITERS["vicon"](replace(take, bodies=bodies), folder)
        main(["import", *map(str, files), "--output", str(folder / "loom"), *options, *CABLE])
        told = " ".join(capsys.readouterr().out.split())
        assert "come from several files, and nothing here registers them" in told
        scatter.append(float(re.search(r"with a scatter of ([\d.]+) mm", told)[1]))
    assert scatter[0] < 0.5  # 0.3 mm of noise in the session's own markers
    assert scatter[1] > 1.0


def test_any_axis_of_a_body_may_be_the_cables_and_frames_may_be_lost(take, tmp_path):
    """With z along the cable at the ends; a fifth of the frames lost, a marker in two poses."""
    axes = Rotation.from_matrix(np.roll(np.eye(3), 1, axis=0))
    bodies = {
        name: np.hstack([x[:, :3], (Rotation.from_quat(x[:, 3:]) * axes).as_quat()])
        for name, x in take.bodies.items()
    }
    random = np.random.default_rng(0)
    markers = {
        name: np.where(random.random((len(x), 1)) < 0.2, np.nan, x)
        for name, x in take.markers.items()
    }
    markers["m03"][len(take.t) // 2 :] = np.nan
    lost = replace(take, markers=markers, bodies=bodies)
    files, options = WRITERS["vicon"](lost, tmp_path)
    assert imported(files, tmp_path / "loom", *options, *CABLE) == 0
    poses = load_config(tmp_path / "loom" / "session.yaml").experiment.poses
    true = load_config(SESSION).experiment.poses
    for pose, exact in zip(poses, true[:4], strict=True):
        for side in ("start", "end"):
            own, other = (getattr(x, f"{side}_orientation") for x in (pose, exact))
            along = [Rotation.from_quat(q).as_matrix()[:, 0] for q in (own, other)]
            assert along[0] == pytest.approx(along[1], abs=1e-3)
    counts = [len(read_points(x.paths[0], x.start, x.end).points) for x in poses]
    assert counts == [12, 12, 11, 11]


def test_a_bag_of_other_topics(tmp_path, capsys):
    writer = pytest.importorskip("rosbags.rosbag2").Writer(tmp_path / "chat", version=9)
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with writer:
        topic = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        text = store.types["std_msgs/msg/String"]("hello")
        writer.write(topic, 1, store.serialize_cdr(text, topic.msgtype))
    assert imported([tmp_path / "chat"], tmp_path / "loom") == 2
    told = capsys.readouterr().err
    assert "/chatter (std_msgs/msg/String)" in told
    assert "Try: record one or more of marker arrays" in told


def test_values_that_nobody_knows_are_to_be_filled_in(take, tmp_path):
    files, options = WRITERS["motive"](take, tmp_path)
    assert imported(files, tmp_path / "loom", *options) == 0
    text = (tmp_path / "loom" / "session.yaml").read_text()
    for key in ("mass", "diameter", "bending_stiffness"):
        assert f"{key}: FILL_IN" in text


def test_markers_alone_and_a_free_end(take, tmp_path):
    """Nobody knows where the cable is held, or how long it is beyond its last marker."""
    files, _ = WRITERS["vicon"](take, tmp_path)
    assert imported(files[:1], tmp_path / "alone", *CABLE) == 0
    text = (tmp_path / "alone" / "session.yaml").read_text()
    assert "start: FILL_IN, start_orientation: FILL_IN" in text
    assert "length: FILL_IN" in text
    assert imported(files, tmp_path / "free", *CABLE, "--end", "free", "--length", "0.6") == 0
    config = load_config(tmp_path / "free" / "session.yaml")
    assert config.experiment.boundary.end == "free"
    assert config.experiment.poses[0].end is None


def test_a_recording_that_is_never_still(take, tmp_path, capsys):
    wave = np.sin(3.0 * take.t)[:, None] * [0.1, 0.0, 0.0]
    moving = replace(
        take,
        markers={name: x + wave for name, x in take.markers.items()},
        bodies={name: x + np.pad(wave, ((0, 0), (0, 4))) for name, x in take.bodies.items()},
    )
    files, options = WRITERS["motive"](moving, tmp_path)
    assert imported(files, tmp_path / "loom", *options) == 2
    assert "still" in capsys.readouterr().err


def test_a_wrench_is_turned_from_the_frame_of_its_sensor(take, tmp_path):
    files, options = WRITERS["mcap"](replace(take, force=(0.3, -0.2, -0.5)), tmp_path)
    assert imported(files, tmp_path / "loom", *options, *CABLE) == 0
    for pose in load_config(tmp_path / "loom" / "session.yaml").experiment.poses:
        turn = Rotation.from_quat(pose.end_orientation)
        assert turn.inv().apply(pose.end_force) == pytest.approx([0.3, -0.2, -0.5], abs=1e-5)


def test_a_library_that_is_not_installed(take, tmp_path, monkeypatch, capsys):
    files, options = WRITERS["c3d"](take, tmp_path)
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    assert imported(files, tmp_path / "loom", *options) == 2
    assert "pip install 'dlo-casadi[recordings]'" in capsys.readouterr().err


def test_files_of_one_name_have_their_own_clocks(take, tmp_path):
    """The grippers' file is 80 ms ahead; a number in brackets is part of a name."""
    (cable, grippers), _ = WRITERS["vicon"](take, tmp_path)
    pairs = [("one/take.csv", "two/take.csv"), ("take (1).csv", "take (2).csv")]
    for pair in pairs:
        files = [tmp_path / name for name in pair]
        for file, source in zip(files, (cable, grippers), strict=True):
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(source.read_bytes())
        session = make_session("loom", read_recording(files), Wishes())
        told = " ".join(session.remarks)
        assert int(re.search(r"is (\d+) ms ahead of", told)[1]) == pytest.approx(80, abs=5)
        assert "come from several files" in told


def test_a_blank_line_above_a_motive_file_does_not_hide_its_units(take, tmp_path):
    (cable, _), _ = WRITERS["motive"](take, tmp_path)
    before = read_recording([cable]).of("marker")
    cable.write_text("\n" + cable.read_text())
    for name, stream in read_recording([cable]).of("marker").items():
        assert stream.values == pytest.approx(before[name].values)


def test_a_motive_file_in_the_space_of_a_body_is_refused(take, tmp_path):
    (cable, _), _ = WRITERS["motive"](take, tmp_path)
    text = cable.read_text()
    assert "Coordinate Space,Global" in text
    cable.write_text(text.replace("Coordinate Space,Global", "Coordinate Space,Local"))
    with pytest.raises(MeasurementError, match="is in the space 'Local'"):
        read_recording([cable])


VICON = "Segments\n100\n,,hand,,\nFrame,Sub Frame,TX,TY,TZ\n,,mm,mm,mm\n1,0,1,2,3\n\n"


@pytest.mark.parametrize("program", ["motive", "vicon"])
def test_columns_that_are_absent(program, take, tmp_path):
    """Motive's row of types is shorter than the table; Vicon's segment has no rotation."""
    (cable, _), _ = WRITERS["motive"](take, tmp_path)
    lines = cable.read_text().splitlines()
    lines[2] = ",".join(lines[2].split(",")[:5])
    cable.write_text(VICON if program == "vicon" else "\n".join(lines))
    said = "hand has no rotation" if program == "vicon" else "line 3 has 5 of 38 cells"
    with pytest.raises(MeasurementError, match=rf"^cable\.csv: {said}.*\n  Try: "):
        read_recording([cable])


def test_a_mistake_in_a_reader_stays_recognisable(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text("")
    monkeypatch.setitem(FORMATS, ".csv", lambda path, unit: {}["nothing"])
    with pytest.raises(MeasurementError, match="it is damaged, cut short, or of an unk") as told:
        read_recording([tmp_path / "a.csv"])
    assert isinstance(told.value.__cause__, KeyError)


def recorded(take, sensors=(), bodies=("start", "end")):
    """The recording of a take, with force sensors: names, frames and forces."""
    clock = {"clock": "take", "file": "take"}
    values = dict(zip(bodies, take.bodies.values(), strict=True))
    streams = [Stream(name, "marker", take.t, x, **clock) for name, x in take.markers.items()]
    streams += [Stream(name, "body", take.t, x, **clock) for name, x in values.items()]
    for name, frame, force in sensors:
        wrench = np.tile([force, 0.0, 0.0, 0.0, 0.1 * force, 0.0], (len(take.t), 1))
        streams.append(Stream(name, "wrench", take.t, wrench, **clock, frame=frame))
    return Recording(tuple(streams))


def test_forces_go_to_the_fixture_of_their_whole_name(take):
    """By the frame, else by a part of the topic; "hand" is not a part of "hand2"."""
    sensors = (("ft", "hand2", 2.0), ("hand/wrench", "", 1.0))
    wishes = Wishes(start="hand", end="hand2")
    session, turned = make_session("loom", recorded(take, sensors, ("hand", "hand2")), wishes), []
    for pose in session.poses:
        assert pose["start_force"] == "[1.000000, 0.000000, 0.000000]"
        assert pose["start_moment"] == "[0.000000, 0.100000, 0.000000]"
        force, moment = (
            np.array([float(x) for x in pose[f"end_{kind}"].strip("[]").split(",")])
            for kind in ("force", "moment")
        )
        assert np.linalg.norm(force) == pytest.approx(2.0, abs=1e-5)
        assert np.linalg.norm(moment) == pytest.approx(0.2, abs=1e-5)
        turned.append(abs(force[1]))
        assert force @ moment == pytest.approx(0.0, abs=1e-5)
    assert max(turned) > 1e-3
    assert any("means of ft, in axes of hand2;" in text for text in session.remarks)
    assert any("means of hand/wrench, in axes of the world;" in text for text in session.remarks)


@pytest.mark.parametrize(
    ("sensors", "said"),
    [
        ([("start/end/wrench", "", 1.0)], "after both of the fixtures"),
        ([("a", "end", 1.0), ("b", "end", 1.0)], "two force sensors are at the end: a and b"),
    ],
    ids=["both", "two"],
)
def test_forces_whose_fixture_is_not_clear(sensors, said, take):
    with pytest.raises(MeasurementError, match=f"(?s){said}") as told:
        make_session("loom", recorded(take, sensors), Wishes())
    assert "Try: " in told.value.message


@pytest.mark.parametrize("end", ["end", "free"])
@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        (("table", "table", 1.0), "no fixture has the name of its frame or topic"),
        (("start/wrench", "ft_sensor", 1.0), "no TF and no body has its frame"),
    ],
    ids=["of no fixture", "unknown axes"],
)
def test_forces_that_belong_nowhere_are_left_out_with_a_remark(sensor, said, end, take):
    known = {"length": 0.6}
    session = make_session("loom", recorded(take, [sensor]), Wishes(end=end, known=known))
    assert not any("force" in key for pose in session.poses for key in pose)
    assert any(f"force sensor {sensor[0]}" in x and said in x for x in session.remarks)


def test_a_force_sensor_with_another_clock_is_left_out_with_a_remark(take):
    """One that counts from 1970, beside markers that count from the start of the recording."""
    recording = recorded(take, [("start/wrench", "", 1.0)])
    *others, sensor = recording.streams
    late = replace(sensor, t=sensor.t + 1.7e9, clock="forces")
    session = make_session("loom", replace(recording, streams=(*others, late)), Wishes())
    assert not any("start_force" in pose for pose in session.poses)
    (told,) = (text for text in session.remarks if "start/wrench" in text)
    assert "is left out: nothing of it was seen in any pose. Try: " in told


def test_a_pose_without_the_cables_markers_is_named(take):
    """The grippers alone are still in the last one: five markers are fewer than half of all."""
    last = (take.t > take.t[-1] - HOLD - 0.5)[:, None]
    few = {name: np.where(last, np.nan, x) for name, x in [*take.markers.items()][:5]}
    with pytest.raises(MeasurementError, match=r"pose 4 \(.* s\) shows 0 markers .*two\.\n  Try"):
        make_session("loom", recorded(replace(take, markers=few)), Wishes())


def test_markers_that_are_never_seen_together(take):
    early = (take.t < 0.5 * take.t[-1])[:, None]
    first = [*take.markers][:6]
    markers = {
        name: np.where(early if name in first else ~early, x, np.nan)
        for name, x in take.markers.items()
    }
    with pytest.raises(MeasurementError, match=r"no pose shows one of the markers .*\n  Try: fill"):
        make_session("loom", recorded(replace(take, markers=markers)), Wishes())


@pytest.mark.parametrize("kind", ["c3d", "motive", "vicon"])
def test_what_moves_between_poses_is_written_as_motions(kind, tmp_path):
    take = rendered(SESSION, poses=3)
    files, options = WRITERS[kind](take, tmp_path)
    target = tmp_path / "loom"
    known = ["--mass", "0.03", "--diameter", "0.004", "--bending-stiffness", "0.0197"]
    command = ["import", *map(str, files), "--output", str(target), *options, *known, "--quiet"]
    assert main([*command, "--motions", "4"]) == 0
    config = load_config(target / "session.yaml")
    assert config.experiment.tolerances.delay == 0.03
    motions = read_motions(config)
    assert len(motions) == 2
    for motion, pose in zip(motions, config.experiment.poses, strict=False):
        assert motion.at_rest
        assert 1.0 < motion.t[-1] < 2.0
        assert motion.s.shape == (12,)
        assert np.linalg.norm(motion.moving["end"][0] - pose.end) < 4e-4  # noise of 0.2 mm
        turned = np.abs(motion.moving["end_orientation"][0] @ np.array(pose.end_orientation))
        assert turned > 1 - 1e-6
        assert np.linalg.norm(np.ptp(motion.moving["end"], axis=0)) > 0.1
