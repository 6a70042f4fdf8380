"""Recordings as programs of laboratories export them, beyond those of the rendered takes.

Each is read as what it means, or refused with the cause and what to do; and nothing is written.
"""

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from files import tree
from recorded.takes import corners, rendered, write_c3d, write_grippers, write_motive, write_vicon

from dlo_casadi.cli import main
from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings import CloudView, Wishes, make_session, read_recording
from dlo_casadi.recordings.fixtures import full_names

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")
SESSION = Path(__file__).parents[1] / "configs" / "markers_in_space.yaml"
CABLE = ("--mass", "0.03", "--diameter", "0.004")
START = (("start_o", "start_x", "start_y"), ("end_o", "end_x", "end_y"))


@pytest.fixture(scope="module")
def take():
    return rendered(SESSION, poses=4, rate=12.5)


def refused(folder, files, capsys, *options):
    """What `dlo import` says of files that it refuses; nothing is written."""
    before = tree(folder)
    assert main(["import", *map(str, files), "--output", str(folder / "loom"), *options]) == 2
    assert tree(folder) == before
    told = capsys.readouterr().err
    assert "Traceback" not in told
    return told


def imported(folder, files, *options):
    """Remarks of the session that `dlo import` makes of files."""
    out = folder / "loom"
    assert main(["import", *map(str, files), "--output", str(out), *CABLE, *options]) == 0
    return " ".join((out / "session.yaml").read_text().replace("\n#", " ").split())


# ---- bags ----------------------------------------------------------------------------------------

VICON = {
    "vicon_bridge/msg/Markers": "std_msgs/Header header\nvicon_bridge/Marker[] markers",
    "vicon_bridge/msg/Marker": "string marker_name\nstring subject_name\n"
    "geometry_msgs/Point translation\nbool occluded",
}
NAMED = {
    "tracking/msg/NamedPoseArray": "std_msgs/Header header\ntracking/NamedPose[] poses",
    "tracking/msg/NamedPose": "string name\ngeometry_msgs/Pose pose",
}


def store_of(release="ROS2_HUMBLE", **types):
    store = typesys.get_typestore(typesys.Stores[release])
    own = {}
    for name, text in types.get("own", {}).items():
        own |= typesys.get_types_from_msg(text, name)
    store.register(own)
    return store


def header(store, t, frame="world"):
    stamp = store.types["builtin_interfaces/msg/Time"](int(t), round((t % 1.0) * 1e9))
    kind = store.types["std_msgs/msg/Header"]
    return kind(0, stamp, frame) if "seq" in kind.__dataclass_fields__ else kind(stamp, frame)


def point(store, x):
    return store.types["geometry_msgs/msg/Point"](*map(float, x))


def pose(store, x):
    turn = store.types["geometry_msgs/msg/Quaternion"](*map(float, x[3:]))
    return store.types["geometry_msgs/msg/Pose"](point(store, x[:3]), turn)


def bag(folder, store, messages, ros1=False):
    """A bag of (topic, time, message)."""
    path = folder / ("take.bag" if ros1 else "take")
    topics = {}
    made = rosbag1.Writer(path) if ros1 else rosbag2.Writer(path, version=9)
    with made as writer:
        for topic, t, message in messages:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            raw = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(topics[topic], round(1e9 * (t + 1)), raw(message, kind))
    return path


def vicon_bag(folder, take, subjects, scale=1e3):
    """Markers with those of both grippers, in mm; `subjects` gives subject and name of each."""
    store = store_of("ROS1_NOETIC", own=VICON)
    places = {**take.markers, **corners(take)}
    one, array = (store.types[name] for name in reversed(VICON))
    messages = []
    for k, t in enumerate(take.t):
        found = [
            one(subjects(name)[1], subjects(name)[0], point(store, scale * x[k]), False)
            for name, x in places.items()
        ]
        found.append(one("lost", "rope", point(store, np.zeros(3)), True))
        messages.append(("/vicon/markers", t, array(header(store, t), found)))
    return bag(folder, store, messages, ros1=True)


def by_subject(name):
    """A gripper's markers are called o, x and y in a subject of its own."""
    return tuple(name.split("_")) if "_" in name else ("rope", name)


def test_markers_of_subjects_have_their_full_names(take, tmp_path, capsys):
    files = [vicon_bag(tmp_path, take, by_subject)]
    recording = read_recording(files, view=CloudView(units="mm"))
    assert {"start/o", "end/o", "rope/m00"} <= recording.of("marker").keys()
    assert "rope/lost" not in recording.of("marker")  # occluded throughout
    exact = corners(take)["end_o"]
    assert recording.of("marker")["end/o"].values == pytest.approx(exact, abs=1e-9)
    told = refused(tmp_path, files, capsys, "--units", "mm", "--start", "o,x,y", "--end", "free")
    assert "marker 'o' at the start may be start/o or end/o" in told
    assert "Assumed: markers and clouds of take.bag are taken to be in mm" in told
    ends = ("--start", "start/o,start/x,start/y", "--end", "end/o,end/x,end/y")
    assert "(rope/m" in imported(tmp_path, files, "--units", "mm", *ends)


def test_a_unique_last_part_of_a_name_is_enough(take, tmp_path):
    files = [vicon_bag(tmp_path, take, lambda name: (by_subject(name)[0], name))]
    recording = read_recording(files, view=CloudView(units="mm"))
    full = full_names(recording, Wishes(start=",".join(START[0]), end="end_o,end_x,end/end_y"))
    assert full.holders["start"] == [f"start/{name}" for name in START[0]]
    assert full.holders["end"] == [f"end/{name}" for name in START[1]]


def test_two_markers_of_one_name_in_a_message_are_refused(take, tmp_path, capsys):
    files = [vicon_bag(tmp_path, take, lambda name: ("rope", by_subject(name)[1]))]
    told = refused(tmp_path, files, capsys, "--units", "mm")
    assert "two markers are called 'rope/o' in one message of /vicon/markers" in told
    assert "Try: other names" in told


def ros_messages(take, store, markers):
    """Poses of both grippers, and whatever `markers` makes of the cable's places."""
    stamped = store.types["geometry_msgs/msg/PoseStamped"]
    for k, t in enumerate(take.t):
        for side, x in take.bodies.items():
            yield f"/natnet/{side}", t, stamped(header(store, t), pose(store, x[k]))
        yield from markers(k, t)


def custom(take, store, form="/markers"):
    kinds = [store.types[name] for name in NAMED]

    def markers(k, t):
        still = np.array([0.0, 0.0, 0.0, 1.0])
        items = [
            kinds[1](name, pose(store, np.hstack([x[k], still])))
            for name, x in take.markers.items()
        ]
        yield form, t, kinds[0](header(store, t), items)

    return markers


def point_topics(take, store):
    kind = store.types["geometry_msgs/msg/PointStamped"]
    return lambda k, t: [
        (f"/rope/{name}", t, kind(header(store, t), point(store, x[k])))
        for name, x in take.markers.items()
    ]


def without_definitions(path):
    """The bag as ROS 2 Humble records it."""
    with sqlite3.connect(next(path.glob("*.db3"))) as file:
        file.execute("DELETE FROM message_definitions")
    file.close()
    return path


def test_an_unknown_type_says_what_ros_2_needs(take, tmp_path, capsys):
    store = store_of(own=NAMED)
    path = bag(tmp_path, store, ros_messages(take, store, custom(take, store)))
    recording = read_recording([path])
    assert {"m00", "m07"} <= recording.of("body").keys()  # with its definition, it is read
    ends = ("--start", "natnet/start", "--end", "natnet/end")
    told = refused(tmp_path, [without_definitions(path)], capsys, *ends)
    assert "0 markers of the cable" in told
    assert "/markers is left out: its type tracking/msg/NamedPoseArray is unknown" in told
    assert "`ros2 bag convert` to mcap on a computer where the package tracking is" in told
    assert "KeyError" not in told


def test_an_unknown_type_beside_what_is_needed_is_a_remark(take, tmp_path):
    store = store_of(own=NAMED)
    points, unknown = point_topics(take, store), custom(take, store, "/extra")
    text = store.types["std_msgs/msg/String"]

    def both(k, t):
        return [*points(k, t), *unknown(k, t), ("/chatter", t, text("a"))]

    path = without_definitions(bag(tmp_path, store, ros_messages(take, store, both)))
    told = imported(tmp_path, [path], "--start", "natnet/start", "--end", "natnet/end")
    assert "/extra is left out: its type tracking/msg/NamedPoseArray is unknown" in told
    assert "left out, without places or forces: /chatter (std_msgs/msg/String)" in told
    assert "(rope/m" in told  # markers, each a topic of PointStamped


def transforms(store, x, k, t):
    turn = store.types["geometry_msgs/msg/Quaternion"](*map(float, x[k, 3:]))
    kind = store.types["geometry_msgs/msg/Vector3"]
    moved = store.types["geometry_msgs/msg/Transform"](kind(*map(float, x[k, :3])), turn)
    return store.types["geometry_msgs/msg/TransformStamped"](header(store, t), "hand", moved)


def odometry(store, x, k, t):
    of = {
        name: store.types[f"geometry_msgs/msg/{name}WithCovariance"] for name in ("Pose", "Twist")
    }
    still = store.types["geometry_msgs/msg/Twist"](
        *(store.types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0) for _ in range(2))
    )
    none = np.zeros(36)
    at = of["Pose"](pose(store, x[k]), none)
    return store.types["nav_msgs/msg/Odometry"](header(store, t), "", at, of["Twist"](still, none))


def links(store, x, k, t):
    moved = transforms(store, x, k, t).transform
    twist, wrench = [], []
    kind = store.types["sensor_msgs/msg/MultiDOFJointState"]
    return kind(header(store, t), ["hand"], [moved], twist, wrench)


def detections(store, x, k, t):
    kinds = [store.types[name] for name in NAMED]
    return kinds[0](header(store, t), [kinds[1]("hand", pose(store, x[k]))])


BODIES = {
    "TransformStamped": (transforms, "hands"),
    "Odometry": (odometry, "hands"),
    "MultiDOFJointState": (links, "hand"),
    "a list of named poses": (detections, "hand"),
}


@pytest.mark.parametrize("kind", BODIES)
def test_named_poses_are_bodies(kind, take, tmp_path):
    make, name = BODIES[kind]
    store, x = store_of(own=NAMED), take.bodies["end"]
    messages = (("/hands", t, make(store, x, k, t)) for k, t in enumerate(take.t))
    found = read_recording([bag(tmp_path, store, messages)]).of("body")
    assert [*found] == [name]
    assert found[name].values[:, :3] == pytest.approx(x[:, :3], abs=1e-9)


def test_poses_of_several_frames_in_one_topic_are_several_bodies(take, tmp_path):
    store = store_of()
    messages = []
    for k, t in enumerate(take.t):
        for side, x in take.bodies.items():
            message = replace(transforms(store, x, k, t), child_frame_id=side)
            messages.append(("/vicon/transforms", t, message))
    found = read_recording([bag(tmp_path, store, messages)]).of("body")
    assert [*found] == ["vicon/transforms/start", "vicon/transforms/end"]
    for side, stream in zip(take.bodies, found.values(), strict=True):
        assert stream.values[:, :3] == pytest.approx(take.bodies[side][:, :3], abs=1e-9)


def test_a_point_cloud_without_fields_is_a_cloud(tmp_path):
    store = store_of()
    kind, at = (
        store.types[f"{x}"] for x in ("sensor_msgs/msg/PointCloud", "geometry_msgs/msg/Point32")
    )
    cloud = kind(header(store, 1.0), [at(1.0, 2.0, 3.0), at(4.0, 5.0, 6.0)], [])
    (found,) = read_recording([bag(tmp_path, store, [("/cloud", 1.0, cloud)])]).clouds
    assert found.points == pytest.approx(np.arange(1.0, 7.0).reshape(2, 3))


def test_a_topic_whose_messages_are_of_another_type_is_left_out(take, tmp_path):
    """The bytes of one message end too early; the others of this topic are not trusted."""
    store = store_of()
    path = bag(tmp_path, store, ros_messages(take, store, point_topics(take, store)))
    with sqlite3.connect(next(path.glob("*.db3"))) as file:
        ((topic,),) = file.execute("SELECT id FROM topics WHERE name = '/rope/m03'").fetchall()
        row = "SELECT max(id) FROM messages WHERE topic_id = ?"
        file.execute(f"UPDATE messages SET data = x'0001' WHERE id = ({row})", (topic,))
    file.close()
    recording = read_recording([path])
    assert "rope/m03" not in recording.of("marker")
    (told,) = recording.unread
    assert told.startswith(f"/rope/m03 is left out: its message {len(take.t)} is not of the type")


TROUBLES = {
    "no metadata": (
        lambda x: (x / "metadata.yaml").unlink(),
        "no metadata.yaml, .*ros2 bag reindex",
    ),
    "a new version": (
        lambda x: edit(x / "metadata.yaml", "version: 9", "version: 99"),
        "is of a version that is not read.\n  Try: `ros2 bag convert`",
    ),
    "another storage": (
        lambda x: edit(x / "metadata.yaml", "storage_identifier: sqlite3", "storage_identifier: x"),
        "is in a storage that is not read.\n  Try: `ros2 bag convert`",
    ),
    "a file that is missing": (
        lambda x: next(x.glob("*.db3")).unlink(),
        "lacks some of its files.\n  Try: the whole folder",
    ),
    "no database": (
        lambda x: next(x.glob("*.db3")).write_bytes(b"no database at all" * 100),
        "it is damaged, cut short, or of an unknown version.\n  Try: export it again",
    ),
}


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize("what", TROUBLES)
def test_a_bag_that_cannot_be_opened_is_told_in_our_words(what, take, tmp_path, capsys):
    damage, said = TROUBLES[what]
    store = store_of()
    text = store.types["std_msgs/msg/String"]("a")
    path = bag(tmp_path, store, [("/chatter", 1.0, text)])
    damage(path)
    with pytest.raises(MeasurementError, match=f"(?s)^take: .*{said}") as told:
        read_recording([path])
    assert told.value.__cause__ is not None
    told = refused(tmp_path, [path], capsys)
    for foreign in ("report", "please", "issue", "Error:", "Exception"):
        assert foreign not in told.removeprefix("MeasurementError:")


# ---- motion capture ------------------------------------------------------------------------------


def test_a_time_code_is_no_coordinate(take, tmp_path):
    """A third column of Motive, which nobody uses and nobody parses."""
    (file, grippers), _ = write_motive(take, tmp_path)
    lines = file.read_text().splitlines()
    cells = [line.split(",") for line in lines]
    for k, row in enumerate(cells[2:]):
        text = {5 - 1: "TimeCode"}.get(k, "" if k < 5 else f"15:26:46:{k:02d}.00")
        row.insert(2, text)
    file.write_text("\n".join([*lines[:2], *(",".join(row) for row in cells[2:])]) + "\n")
    assert "TimeCode" in file.read_text()
    assert "10 markers" not in imported(tmp_path, [file, grippers])


def test_frames_without_times_have_the_rate_of_the_export(take, tmp_path):
    file = write_motive(take, tmp_path)[0][0]
    exact = read_recording([file]).streams[0]
    lines = [line.split(",") for line in file.read_text().splitlines()]
    lines[6][1] = "Time Code"
    for k, row in enumerate(lines[7:]):
        row[1] = f"00:00:{k:02d}"
    file.write_text("\n".join(",".join(row) for row in lines))
    found = read_recording([file]).streams[0]
    assert found.t == pytest.approx(exact.t, abs=1e-5)
    assert found.values == pytest.approx(exact.values)


def german(text):
    """Saved again by a spreadsheet with decimal commas."""
    return text.replace(",", ";").replace(".", ",")


@pytest.mark.parametrize("program", ["motive", "vicon"])
@pytest.mark.parametrize("how", ["semicolons", "tabs", "quotes"])
def test_exports_that_a_spreadsheet_has_saved_again(program, how, take, tmp_path):
    write = {"motive": write_motive, "vicon": write_vicon}[program]
    file = write(take, tmp_path)[0][0]
    exact = read_recording([file]).of("marker")
    lines = german(file.read_text()).replace("Marker;cable:", "Marker;cable:").splitlines()
    if how == "tabs":
        lines = [line.replace(";", "\t") for line in lines]
    if how == "quotes":
        lines = ['"' + line.replace(";", '","') + '"' for line in lines]
    file.write_text("\n".join(lines), encoding="utf-16")
    found = read_recording([file]).of("marker")
    assert found.keys() == exact.keys()
    for name, stream in found.items():
        assert stream.values == pytest.approx(exact[name].values, nan_ok=True)
        assert stream.t == pytest.approx(exact[name].t)


def test_columns_that_nobody_uses_may_hold_anything(take, tmp_path):
    (_, grippers), _ = write_motive(take, tmp_path)
    edit(grippers, ",0.100000\n", ",lost\n")
    assert "start" in read_recording([grippers]).of("body")


def test_a_coordinate_that_is_no_number_is_named_with_its_line(take, tmp_path, capsys):
    file = write_motive(take, tmp_path)[0][0]
    lines = file.read_text().splitlines()
    lines[20] = ",".join([*lines[20].split(",")[:5], "12..5", *lines[20].split(",")[6:]])
    file.write_text("\n".join(lines))
    told = refused(tmp_path, [file], capsys)
    assert "cable.csv: line 21: '12..5' is not a number of " in told
    assert "Try: export it again" in told


def test_assets_of_one_name_are_told_apart_by_their_parents_or_refused(take, tmp_path):
    """Two ropes, each with a marker of the same name; identifiers and parents tell which."""
    file = write_motive(take, tmp_path)[0][0]
    lines = file.read_text().splitlines()
    names = ["cable:m00" if x == "cable:m01" else x for x in lines[3].split(",")]
    count = len(names) - 2
    parent = ["", "Parent", *(f"P{k // 3 % 2}" for k in range(count))]
    ids = ["", "ID", *(str(k // 3) for k in range(count))]
    file.write_text("\n".join([*lines[:3], ",".join(names), ",".join(ids), *lines[5:]]))
    with pytest.raises(MeasurementError, match=r"two markers are called 'cable:m00' in cable\.csv"):
        read_recording([file])
    file.write_text(
        "\n".join([*lines[:3], ",".join(names), ",".join(ids), ",".join(parent), *lines[5:]])
    )
    assert {"P0:cable:m00", "P1:cable:m00"} <= read_recording([file]).of("marker").keys()


# ---- C3D -----------------------------------------------------------------------------------------


def c3d(take, folder, unit="mm", labels=None, scale=1.0, points=None):
    """Both files of a take as one C3D file with a unit, labels and scaled numbers."""
    ezc3d = pytest.importorskip("ezc3d", reason="the extra `recordings` is not installed")
    file = write_c3d(replace(take, offset=0.0), folder)[0]
    whole = [ezc3d.c3d(str(path)) for path in file]
    content = whole[0]
    group = content["parameters"]["POINT"]
    names = [name for one in whole for name in one["parameters"]["POINT"]["LABELS"]["value"]]
    group["LABELS"]["value"] = labels(names) if labels else names
    group["UNITS"]["value"] = [unit] if unit else []
    group["DESCRIPTIONS"]["value"] = [""] * len(names)
    places = np.concatenate([one["data"]["points"] for one in whole], axis=1)
    places[:3] *= scale
    if points is not None:
        places = points(places, names)
    content["data"]["points"] = places
    content["data"]["meta_points"]["residuals"] = np.zeros((1, *places.shape[1:]))
    content["data"]["meta_points"]["camera_masks"] = np.zeros((7, *places.shape[1:]), bool)
    out = folder / "take.c3d"
    content.write(str(out))
    return [out], ("--start", ",".join(START[0]), "--end", ",".join(START[1]))


def test_an_assumed_unit_is_told_where_it_leads_to_a_mistake(take, tmp_path, capsys):
    files, ends = c3d(take, tmp_path, unit="", scale=1e-3)
    told = refused(tmp_path, files, capsys, *ends, *CABLE)
    assert "cable.length: 0.000" in told
    assert "Assumed: take.c3d names no unit of length: mm is assumed; or --units" in told
    told = imported(tmp_path, files, *ends, "--units", "m")
    assert "take.c3d is taken to be in m, which it does not name" in told


@pytest.mark.parametrize(("unit", "scale"), [("mm", 0.1), ("cm", 0.1), ("inch", 0.1)])
def test_a_unit_that_is_asked_for_is_never_ignored(unit, scale, take, tmp_path):
    """Numbers in cm, whatever the file says of them."""
    files, _ = c3d(take, tmp_path, unit=unit, scale=scale)
    recording = read_recording(files, view=CloudView(units="cm"))
    exact = corners(take)["start_o"]
    assert recording.of("marker")["start_o"].values == pytest.approx(exact, abs=1e-6)
    told = [text for text in recording.assumptions if "is taken to be in cm" in text]
    assert len(told) == (unit != "cm")
    if unit == "inch":
        with pytest.raises(MeasurementError, match=r"unit of length is 'inch'.\n  Try: .*--units"):
            read_recording(files)


def test_a_unit_is_for_the_files_that_name_none(take, tmp_path):
    files, _ = c3d(take, tmp_path, unit="", scale=0.1)
    write_grippers(take.y_up(), tmp_path / "hands.csv")
    recording = read_recording([*files, tmp_path / "hands.csv"], view=CloudView(units="cm"))
    hand = recording.of("body")["start"].values
    assert hand[:, :3] == pytest.approx(take.bodies["start"][:, :3], abs=1e-5)
    assert any("hands.csv is in " in text for text in recording.assumptions)


@pytest.mark.parametrize(
    ("at", "byte", "said"),
    [
        (515, 0x56, r"take\.c3d: has the numbers of SGI .MIPS. computers, .*\n  Try: save it with"),
        (1, 0x51, r"take\.c3d: is no C3D file: it begins with b'.*\n  Try: export"),
    ],
    ids=["processor", "mark"],
)
def test_a_c3d_file_that_is_not_read_is_told_in_our_words(at, byte, said, take, tmp_path):
    files, _ = c3d(take, tmp_path)
    content = bytearray(files[0].read_bytes())
    content[at] = byte
    files[0].write_bytes(content)
    with pytest.raises(MeasurementError, match=f"(?s){said}") as told:
        read_recording(files)
    assert "issue" not in told.value.message


def test_two_equal_labels_are_refused(take, tmp_path, capsys):
    def labels(names):
        return ["m03" if name == "m05" else name for name in names]

    files, ends = c3d(take, tmp_path, labels=labels)
    told = refused(tmp_path, files, capsys, *ends)
    assert "two markers are called 'm03' in take.c3d: they cannot be told apart" in told


def order_of(take):
    """Names of a take's markers along the cable."""
    places = {name: x[0] for name, x in take.markers.items()}
    found = make_session("loom", read_recording_of(take), Wishes())
    (text,) = (x for x in found.remarks if x.startswith("markers by arc length"))
    assert len(places) > 5
    return text[text.index("(") + 1 : text.index(")")].split(", ")


def read_recording_of(take):
    from test_damaged_recordings import recording_of

    return recording_of(take)


@pytest.mark.parametrize("pair", [(0, 1), (2, 4), (3, 4), (1, 9), (5, 11)])
def test_exchanged_labels_of_one_pose_are_named(pair, take, tmp_path, capsys):
    names = sorted(order_of(take)[k] for k in pair)
    begin = 2 * 2.6 - 0.5  # s, between pose 2 and pose 3

    def exchanged(places, labels):
        k = [labels.index(name) for name in names]
        there = (take.t > begin) & (take.t < begin + 2.6)
        places[:, k[0], there], places[:, k[1], there] = (
            places[:, k[1], there].copy(),
            places[:, k[0], there].copy(),
        )
        return places

    files, ends = c3d(take, tmp_path, points=exchanged)
    told = refused(tmp_path, files, capsys, *ends)
    assert f"the labels of {names[0]} and {names[1]} are exchanged in pose 3 (" in told
    assert "Try: exchange the labels there" in told


def test_several_labels_exchanged_in_one_pose_are_all_named(take):
    """Two pairs in pose 2."""
    order = order_of(take)
    markers = {name: x.copy() for name, x in take.markers.items()}
    for pose, i, j in ((2, 1, 3), (2, 6, 10)):
        there = (take.t > 2.6 * (pose - 1) - 0.5) & (take.t < 2.6 * pose - 0.5)
        for one, other in ((order[i], order[j]), (order[j], order[i])):
            markers[one][there] = take.markers[other][there]
    with pytest.raises(MeasurementError) as told:
        make_session("loom", read_recording_of(replace(take, markers=markers)), Wishes())
    for pose, i, j in ((2, 1, 3), (2, 6, 10)):
        one, other = sorted((order[i], order[j]))
        assert f"labels of {one} and {other} are exchanged in pose {pose} " in told.value.message


@pytest.mark.parametrize(
    ("pair", "said"),
    [
        (("end_o", None), "the labels of end_o and m.. are exchanged in pose 2 "),
        (("start_o", "start_x"), "labels of start_o and start_x are exchanged in pose 2 "),
    ],
)
def test_exchanged_labels_of_a_gripper_are_named(pair, said, take, tmp_path):
    names = [name or order_of(take)[-2] for name in pair]
    there = (take.t > 2.1) & (take.t < 4.7)
    every = {**take.markers, **corners(take)}
    for one, other in (names, names[::-1]):
        every[one] = np.where(there[:, None], {**take.markers, **corners(take)}[other], every[one])
    recording = read_recording_of(replace(take, markers=every, bodies={}))
    wishes = Wishes(start=",".join(START[0]), end=",".join(START[1]), cable="")
    with pytest.raises(MeasurementError, match=said):
        make_session("loom", recording, wishes)
