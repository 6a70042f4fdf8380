"""Recordings with wrong times, lost markers and unusual text: read whole, or refused by name."""

import re
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded.takes import HOLD, MOVE, rendered, write_c3d, write_motive, write_vicon
from scipy.spatial.transform import Rotation

from dlo_casadi.cli import main
from dlo_casadi.errors import DloError, MeasurementError
from dlo_casadi.recordings import (
    CloudView,
    Recording,
    Stream,
    Wishes,
    make_session,
    mocap,
    read_recording,
)
from dlo_casadi.recordings.stills import Offset, Still, _still, align_clocks, find_stills

SESSION = Path(__file__).parents[1] / "configs" / "markers_in_space.yaml"


@pytest.fixture(scope="module")
def take():
    return rendered(SESSION, poses=4, rate=25.0)


@pytest.fixture(scope="module")
def sources(take, tmp_path_factory):
    """Text of a take's files with its markers, by program."""
    folder = tmp_path_factory.mktemp("take")
    return {
        "motive": write_motive(take, folder)[0][0].read_text(),
        "vicon": write_vicon(take, folder)[0][0].read_text(),
    }


def recording_of(take):
    """The recording of a take, without files."""
    kinds = (("marker", take.markers), ("body", take.bodies))
    return Recording(
        tuple(
            Stream(name, kind, take.t, x, "take", file="take")
            for kind, items in kinds
            for name, x in items.items()
        )
    )


def with_cell(text, row, column, value):
    """Text with another value in a cell of a line, counted from 1."""
    lines = text.splitlines()
    cells = lines[row - 1].split(",")
    cells[column] = value
    lines[row - 1] = ",".join(cells)
    return "\n".join(lines) + "\n"


def exchanged(text, first, second):
    lines = text.splitlines()
    lines[first - 1], lines[second - 1] = lines[second - 1], lines[first - 1]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("program", "change", "said"),
    [
        ("motive", lambda x: with_cell(x, 101, 1, ""), "line 101 has no time"),
        ("motive", lambda x: with_cell(x, 8, 1, "-1700000000.0"), r"line 9 .* after -17\d+\.0+ s"),
        ("motive", lambda x: exchanged(x, 50, 90), "line 51 has the time .* in line 50"),
        ("vicon", lambda x: with_cell(x, 60, 0, ""), "line 60 has no time"),
        ("vicon", lambda x: exchanged(x, 50, 90), "line 51 has the time .* in line 50"),
        ("vicon", lambda x: with_cell(x, 2, 0, "0"), "line 2: the rate is '0' "),
        ("vicon", lambda x: with_cell(x, 2, 0, ""), "line 2: the rate is '' "),
    ],
    ids=["empty", "absurd", "order", "no frame", "order of frames", "rate 0", "no rate"],
)
def test_wrong_times_are_refused_with_their_line(program, change, said, sources, tmp_path):
    file = tmp_path / "cable.csv"
    file.write_text(change(sources[program]))
    with pytest.raises(MeasurementError, match=rf"^cable\.csv: {said}(.|\n)*\n  Try: "):
        read_recording([file])


def test_clocks_that_do_not_agree_need_no_memory(take):
    first, *others = recording_of(take).streams
    streams = (replace(first, t=first.t + 1.7e9), *others)
    with pytest.raises(MeasurementError, match=r"(?s)times run from .* frames .*Try: "):
        make_session("loom", Recording(streams), Wishes())


def test_a_fast_force_sensor_makes_no_recording_too_long(take):
    """Speeds are compared at the rate of what moves."""
    t = np.arange(0.0, 1e-3, 1e-6)
    sensor = Stream("ft", "wrench", t, np.zeros((len(t), 6)), "take", file="take")
    recording = recording_of(take)
    moved, _ = align_clocks(replace(recording, streams=(*recording.streams, sensor)))
    exact, _ = align_clocks(recording)
    assert moved.streams[0].t == pytest.approx(exact.streams[0].t)


def test_a_blank_line_ends_no_section(sources, tmp_path):
    """Frames follow it; a section that is not read, below another blank line, is skipped."""
    lines = sources["vicon"].splitlines()
    file = tmp_path / "cable.csv"
    file.write_text("\n".join([*lines[:50], "", *lines[50:], "Devices", "1000", "volts", "1"]))
    found = read_recording([file]).of("marker").values()
    assert {len(stream.t) for stream in found} == {len(lines) - 6}


def test_a_row_of_a_long_vicon_file_is_judged_without_a_copy_of_all_rows():
    """Which made the time to read a file grow with the square of its length."""
    rows = [["Trajectories"], ["100"], *[["1", "0", "0.5"]] * 100_000]
    tracemalloc.start()
    opened = [mocap._opens_section(rows, k) for k in (0, 1, 50_000, len(rows) - 1)]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert opened == [True, False, False, False]
    assert peak < 100_000  # bytes; the pointers to all rows take 800 kB


def in_pose(take, k):
    """Frames from before pose k until it ends."""
    begin = k * (HOLD + MOVE) - 0.5 * MOVE
    return (take.t > begin) & (take.t < begin + HOLD + MOVE)


@pytest.mark.parametrize("how", ["zero", "held"])
def test_a_marker_that_tracking_lost_costs_no_pose(how, take, tmp_path):
    """Zeros, or its last position: for a quarter of the time it counts as not seen, and is told."""
    lost = in_pose(take, 2)
    x = take.markers["m07"].copy()
    x[lost] = 0.0 if how == "zero" else x[np.flatnonzero(lost)[0] - 1]
    files, _ = write_motive(replace(take, markers={**take.markers, "m07": x}), tmp_path)
    session = make_session("loom", read_recording(files), Wishes())
    assert [len(points) for points, _ in session.points.values()] == [12, 12, 11, 12]
    (told,) = (text for text in session.remarks if "m07 is" in text)
    count = int(re.search(r"in (\d+) of", told)[1])
    assert count == pytest.approx(lost.sum(), abs=1)


def test_without_noise_a_marker_may_be_constant(take):
    """Simulated: all markers are constant in each pose, and one beside the fixture throughout."""
    at = np.clip(take.t - 3.0, 0.0, 1.0)[:, None] * [0.0, 0.1, 0.0]
    exact = {f"m{k}": (k > 0) * at + [0.1 * k, 0.2, 0.3] for k in range(4)}
    recording = recording_of(replace(take, markers=exact))
    assert recording.without_held().assumptions == ()


def test_a_gripper_whose_last_pose_is_held_costs_no_other_pose(take):
    lost, bodies = in_pose(take, 2), {name: x.copy() for name, x in take.bodies.items()}
    bodies["end"][lost] = bodies["end"][np.flatnonzero(lost)[0] - 1]
    assert len(find_stills(recording_of(replace(take, bodies=bodies)), 0.5)) == 4


def test_a_still_tells_how_far_a_marker_moves_from_its_first_half_to_its_second():
    """One creeps at 2 mm a second for 4 s, another one at half of that."""
    t = np.arange(400) / 100
    creep = 2e-3 * t[:, None] * [0.6, 0.0, 0.8]
    streams = [Stream(f"m{k}", "marker", t, creep / k) for k in (1, 2)]
    still = _still(streams, 0.0, 4.0)
    assert still.drift == pytest.approx(4e-3)
    assert still.scatter == pytest.approx(2e-3 * 4 / 6 * np.sqrt((1 + 1 / 4) / 2), rel=1e-3)


def test_spikes_are_no_motion(take):
    """Two in a hundred frames of each marker are 0.1 m off."""
    random = np.random.default_rng(1)
    markers = {
        name: x + (random.random((len(x), 1)) < 0.02) * random.normal(0.0, 0.1, x.shape)
        for name, x in take.markers.items()
    }
    exact = find_stills(recording_of(take), 0.5)
    found = find_stills(recording_of(replace(take, markers=markers)), 0.5)
    assert len(found) == len(exact) == 4
    for one, other in zip(found, exact, strict=True):
        for name in take.markers:
            key = "marker", name
            assert one.values[key] == pytest.approx(other.values[key], abs=1.5e-4)


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"held_out": 1}, "--held-out 1: .* 2 or more"),
        ({"hold": 0.0}, "--hold 0: "),
        ({"known": {"bending_stiffness": -1.0}}, "--bending-stiffness -1: "),
        ({"known": {"length": np.nan}}, "--length nan: "),
        ({"start_offset": (10.0, 0.0, 0.0)}, "--start-offset 10 0 0: .* 1 m at most"),
        ({"at": (0.1, 0.1)}, "--at 0.1 0.1: .* each larger"),
        ({"at": (0.1, 5.5), "known": {"length": 0.6}}, "--at 0.1 5.5: .* --length 0.6"),
        ({"at": (0.1, np.inf)}, "--at 0.1 inf: "),
        ({"end": "start"}, "--end start: .* another body"),
        ({"end": "free", "end_offset": (0.0, 0.0, 0.1)}, "--end-offset 0 0 0.1: .* --end free"),
    ],
)
def test_impossible_options_are_refused_by_name(wishes, said):
    with pytest.raises(DloError, match=said):
        Wishes(**wishes)


@pytest.mark.parametrize(
    ("view", "said"),
    [
        ({"camera": (np.nan, 0.0, 0.0)}, "--camera nan 0 0: "),
        ({"camera": (0.2, 0.1, 1300.0)}, "--camera 0.2 0.1 1300: .* metres, up to 100 m"),
        ({"color": (1000.0, -5.0, 20.0)}, "--color 1000 -5 20: .* 0 to 255"),
        ({"box": (np.inf, *[0.0] * 5)}, "--box inf "),
    ],
)
def test_impossible_views_are_refused_by_name(view, said):
    with pytest.raises(DloError, match=said):
        CloudView(**view)


def test_options_of_what_a_recording_does_not_have_are_refused(take, tmp_path):
    files, _ = write_motive(take, tmp_path)
    with pytest.raises(MeasurementError, match=r"--color and --box tell of clouds, .* has none"):
        read_recording(files, view=CloudView(color=(230, 110, 20), box=(0,) * 6))
    recording = recording_of(replace(take, bodies={}))
    with pytest.raises(
        MeasurementError, match=r"--start-offset .* has none\.\n  Try: --start O,X,Y"
    ):
        make_session("loom", recording, Wishes(start_offset=(0.0, 0.0, 0.1)))


def test_a_contradiction_that_only_the_recording_shows_cites_no_file(take, tmp_path, capsys):
    files, _ = write_motive(take, tmp_path)
    arguments = ["import", *map(str, files), "--output", str(tmp_path / "loom")]
    assert main([*arguments, "--mass", "30", "--diameter", "0.004"]) == 2
    told = capsys.readouterr().err
    assert "nothing is written: cable.mass: 30 kg" in told
    assert "check.yaml" not in told


def test_arc_lengths_beyond_the_cable_are_refused(take):
    at = np.linspace(0.02, 5.5, len(take.markers))
    with pytest.raises(MeasurementError, match=r"--at ends at 5\.5 m, but the cable is 0\.6"):
        make_session("loom", recording_of(take), Wishes(at=at.tolist()))


def few(take, count):
    """A take with markers evenly along the cable."""
    exact = make_session("loom", recording_of(take), Wishes())
    (text,) = (text for text in exact.remarks if text.startswith("markers by arc length"))
    order = text[text.index("(") + 1 : text.index(")")].split(", ")
    kept = [order[k] for k in np.linspace(1, 10, count).round().astype(int)]
    return replace(take, markers={name: take.markers[name] for name in kept})


def test_two_markers_are_too_few_for_arc_lengths(take):
    two = recording_of(few(take, 2))
    with pytest.raises(MeasurementError, match=r"2 markers are too few .*\n  Try: .*--at"):
        make_session("loom", two, Wishes())
    assert make_session("loom", two, Wishes(at=(0.075, 0.52), known={"length": 0.6})).length == 0.6


def test_the_scatter_of_the_length_is_its_tolerance(take, tmp_path):
    """Four markers: told, and written; none of that where the arc lengths are known."""
    four = recording_of(few(take, 4))
    session = make_session("loom", four, Wishes())
    assert session.tolerances["length"] > 2e-3
    (doubt,) = session.doubts
    assert "Try: --length and --at" in doubt
    assert f"tolerances: {{length: {session.tolerances['length']:.2g}}}" in session.text()
    at = tuple(float(x) for x in (0.075, 0.225, 0.375, 0.52))
    known = make_session("loom", four, Wishes(at=at, known={"length": 0.6}))
    assert not known.doubts
    assert not known.tolerances


def test_a_marker_at_the_place_of_a_gripper_moves_no_other(take):
    """Exactly there at the end, and 1 mm across the cable at the start."""
    exact = make_session("loom", recording_of(take), Wishes())
    beside = {"m_start": take.bodies["start"][:, :3] + [0.0, 0.0, 1e-3]}
    beside["m_end"] = take.bodies["end"][:, :3]
    found = make_session(
        "loom", recording_of(replace(take, markers={**take.markers, **beside})), Wishes()
    )
    assert found.length == pytest.approx(exact.length, abs=1e-5)
    for (_, s), (_, known) in zip(found.points.values(), exact.points.values(), strict=True):
        assert s[1:-1] == pytest.approx(known, abs=1e-5)
        assert s[[0, -1]] == pytest.approx([1e-3, found.length], abs=1e-4)


@pytest.mark.parametrize("way", [1, -1])
def test_a_gripper_at_the_end_alone_tells_the_order(way, take):
    """In whatever order the markers are listed."""
    place, q = np.split(take.bodies["end"], [3], axis=1)
    axes = 0.05 * np.swapaxes(Rotation.from_quat(q).as_matrix(), 1, 2)
    trio = {"o": place, "x": place + axes[:, 0], "y": place + axes[:, 1]}
    markers = dict([*take.markers.items()][::way]) | trio
    alone = recording_of(replace(take, markers=markers, bodies={}))
    session = make_session("loom", alone, Wishes(end="o,x,y"))
    whole = make_session("loom", recording_of(take), Wishes())
    for (points, s), (known, at) in zip(
        session.points.values(), whole.points.values(), strict=True
    ):
        assert points == pytest.approx(known)
        assert s - s[0] == pytest.approx(at - at[0], abs=2e-3)


@pytest.mark.parametrize("third", ["y", "x"])
def test_markers_of_a_gripper_in_one_line_are_refused(third, take):
    """Their noise would turn it about that line; a marker that is named twice is in it, too."""
    place = take.bodies["start"][:, :3]
    ways = {"o": [0.0, 0.0, 0.0], "x": [0.05, 0.0, 0.0], "y": [0.1, 1e-4, 0.0]}
    markers = take.markers | {name: place + np.array(way) for name, way in ways.items()}
    recording = recording_of(replace(take, markers=markers))
    with pytest.raises(
        MeasurementError, match=rf"markers o,x,{third} at the start are in one line"
    ):
        make_session("loom", recording, Wishes(start=f"o,x,{third}"))


def test_exchanged_labels_name_their_pose(take):
    there, markers = in_pose(take, 2), {name: x.copy() for name, x in take.markers.items()}
    for one, other in (("m02", "m07"), ("m07", "m02")):
        markers[one][there] = take.markers[other][there]
    with pytest.raises(MeasurementError, match="labels of m02 and m07 are exchanged in pose 3 "):
        make_session("loom", recording_of(replace(take, markers=markers)), Wishes())


def test_a_screen_axis_that_is_not_read_is_not_said_to_be_followed(take, tmp_path):
    pytest.importorskip("ezc3d", reason="the extra `recordings` is not installed")
    file = write_c3d(take, tmp_path)[0][0]
    file.write_bytes(file.read_bytes().replace(b"+Y", b"-Y"))
    (told,) = (text for text in read_recording([file]).assumptions if "--up" in text)
    assert told == "z is up, in most C3D files; POINT:Y_SCREEN is -Y; or --up"


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_text_that_is_not_utf_8(encoding, sources, tmp_path):
    file = tmp_path / "cable.csv"
    file.write_bytes(sources["motive"].replace("cable:m07", "Pr\u00fcfling").encode(encoding))
    recording = read_recording([file])
    assert "Pr\u00fcfling" in recording.of("marker")
    told = [text for text in recording.assumptions if "is not UTF-8" in text]
    assert len(told) == (encoding == "latin-1")


@pytest.mark.parametrize(("unit", "size"), [("Degrees", 90.0), ("radians", np.pi / 2)])
def test_units_of_angle(unit, size, tmp_path):
    names, axes = ",,hand" + "," * 5, "Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ"
    frame = f"1,0,0,0,{size:.9f},1,2,3"
    text = "\n".join(["Objects", "100", names, axes, f",,{','.join([unit] * 3)},m,m,m", frame])
    file = tmp_path / "hand.csv"
    file.write_text(text)
    (hand,) = read_recording([file]).streams
    assert hand.values[0, 3:] == pytest.approx([0.0, 0.0, 0.5**0.5, 0.5**0.5])
    file.write_text(text.replace(unit, "gon"))
    with pytest.raises(MeasurementError, match=r"unit of angle is 'gon'.\n  Try: "):
        read_recording([file])


def test_quaternions_of_a_vicon_body_at_the_origin(tmp_path):
    """A body that never leaves the origin is there; markers would count as not seen."""
    axes = "Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ"
    frames = [f"{k},0,0,0,0.6,0.8,0,0,0" for k in (1, 2)]
    text = ["Objects", "100", ",,hand" + "," * 6, axes, ",,,,,,mm,mm,mm", *frames]
    (tmp_path / "hand.csv").write_text("\n".join(text))
    (hand,) = read_recording([tmp_path / "hand.csv"]).streams
    assert hand.values == pytest.approx(np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.6, 0.8], (2, 1)))


@pytest.mark.parametrize("holder", ["body", "markers"])
def test_an_offset_of_a_gripper_is_in_its_own_axes(holder, take):
    """A body, or three markers at its origin and along its x and y axes."""
    place, q = np.split(take.bodies["start"], [3], axis=1)
    axes = 0.05 * np.swapaxes(Rotation.from_quat(q).as_matrix(), 1, 2)
    trio = {"o": place, "x": place + axes[:, 0], "y": place + axes[:, 1]}
    recording = recording_of(replace(take, markers=take.markers | trio))
    offset, name = (0.01, 0.02, -0.03), {"body": "start", "markers": "o,x,y"}[holder]
    places = []
    for own in ((), offset):
        session = make_session("loom", recording, Wishes(start=name, cable="m", start_offset=own))
        places.append(
            [np.array(pose["start"].strip("[]").split(","), float) for pose in session.poses]
        )
    own = Rotation.from_quat(q[len(q) // 2])  # the gripper at the start does not move
    for before, after in zip(*places, strict=True):
        assert own.inv().apply(after - before) == pytest.approx(offset, abs=1e-4)


def test_what_is_told_of_clocks_and_of_poses():
    ahead = Offset("robot", "cameras", 0.08, 0.931, 0.5)
    assert ahead.told.startswith("robot is 80 ms ahead of cameras and was moved there")
    assert "correlate by 0.93" in ahead.told
    assert "it would move the fastest pose by 40 mm" in ahead.told
    behind = replace(ahead, seconds=-0.001)
    assert behind.told.startswith("robot is 1 ms behind cameras")
    assert "it does not matter at these speeds" in behind.told
    still = Still(1.0, 2.5, {}, 2.4e-4, 1.3e-3)
    assert still.told == "still from 1.00 to 2.50 s: scatter 0.24 mm, drift 1.30 mm"


def test_few_markers_whose_bends_look_like_another_pull_are_no_mistake(tmp_path, capsys):
    """Ten of twelve markers show a pull 59 degrees off gravity; fits tell that it is none."""
    take = rendered(SESSION, poses=6, rate=25.0)
    few = {name: x for name, x in take.markers.items() if name not in ("m10", "m11")}
    files, _ = write_motive(replace(take, markers=few), tmp_path)
    arguments = ["import", *map(str, files), "--output", str(tmp_path / "loom")]
    assert main([*arguments, "--mass", "0.03", "--diameter", "0.004"]) == 0
    assert "warning" not in capsys.readouterr().out
    assert (tmp_path / "loom" / "session.yaml").exists()
