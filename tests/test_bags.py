"""Bags whose frames, forces and clouds are given in other ways than the rendered takes do it."""

from dataclasses import make_dataclass, replace

import numpy as np
import pytest
from recorded.takes import marker_message
from scipy.spatial.transform import Rotation

from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings import CloudView, Wishes, make_session, read_recording
from dlo_casadi.recordings.fixtures import find_gripper
from dlo_casadi.recordings.messages import items_of
from dlo_casadi.recordings.stills import align_clocks, find_stills

rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")
STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
MSG = {name.rsplit("/", 1)[-1]: kind for name, kind in STORE.types.items()}
T = np.arange(0.0, 8.0, 0.05)  # s
STEP = np.clip(T - 3.5, 0.0, 1.0)[:, None] * [0.0, 0.1, 0.0]  # m: two poses
POINTS = np.array([[0.1, 0.0, 0.0], [0.2, 0.02, 0.0], [0.3, 0.0, 0.0]])  # m
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
MOUNT = np.array([1.0, 2.0, 3.0, *Rotation.from_euler("z", 90, degrees=True).as_quat()])


def header(t, frame):
    stamp = STORE.types["builtin_interfaces/msg/Time"](int(t), round((t - int(t)) * 1e9))
    return MSG["Header"](stamp, frame)


def pose(x):
    return MSG["Pose"](MSG["Point"](*x[:3]), MSG["Quaternion"](*x[3:]))


def tf(t, parent, child, x):
    moved = MSG["Transform"](MSG["Vector3"](*x[:3]), MSG["Quaternion"](*x[3:]))
    return MSG["TFMessage"]([MSG["TransformStamped"](header(t, parent), child, moved)])


def markers(t, frame, places):
    poses = [pose([*x, 0.0, 0.0, 0.0, 1.0]) for x in places]
    return MSG["PoseArray"](header(t, frame), poses)


def wrench(t, frame):
    force = MSG["Wrench"](MSG["Vector3"](1.0, 2.0, 3.0), MSG["Vector3"](0.0, 0.0, 0.0))
    return MSG["WrenchStamped"](header(t, frame), force)


def written(folder, *messages):
    """A bag of (topic, message), or of (topic, message, time of receipt)."""
    topics = {}
    with rosbag2.Writer(folder / "take", version=9) as writer:
        for topic, message, *received in messages:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            at = round(1e9 * sum(received)) or 1
            writer.write(topics[topic], at, STORE.serialize_cdr(message, kind))
    return [folder / "take"]


def cable(frame="world"):
    return [("/a", markers(t, frame, POINTS + x)) for t, x in zip(T, STEP, strict=True)]


def test_markers_and_bodies_go_to_the_root_of_tf(tmp_path):
    hands = [
        ("/hand", MSG["PoseStamped"](header(t, "mocap"), pose([*x, *STILL[3:]])))
        for t, x in zip(T, STEP, strict=True)
    ]
    mount = ("/tf_static", tf(0.0, "world", "mocap", MOUNT))
    recording = read_recording(written(tmp_path, mount, *cable("mocap"), *hands))
    turn = Rotation.from_quat(MOUNT[3:])
    for k, stream in enumerate(recording.of("marker").values()):
        assert stream.values == pytest.approx(turn.apply(POINTS[k] + STEP) + MOUNT[:3])
    hand = recording.of("body")["hand"]
    assert hand.values[:, :3] == pytest.approx(turn.apply(STEP) + MOUNT[:3])
    assert hand.values[:, 3:] == pytest.approx(np.tile(MOUNT[3:], (len(T), 1)))
    assert {stream.frame for stream in recording.streams} == {"world"}


def test_a_frame_that_moves_is_interpolated_between_its_transforms(tmp_path):
    """It turns evenly and is sent half as often as the markers of a lens on it."""
    turn, lens = Rotation.from_rotvec(np.outer(T, [0.0, 0.0, 0.3])), np.array([0.02, 0.01, 0.0])
    at = np.column_stack([0.1 * T, 0.0 * T, 0.0 * T])
    sent = [("/tf_static", tf(0.0, "camera", "lens", [*lens, *STILL[3:]]))]
    sent += [
        ("/tf", tf(T[k], "world", "camera", [*at[k], *turn[k].as_quat()]))
        for k in range(0, len(T), 2)
    ]
    sent += [("/a", markers(t, "lens", POINTS)) for t in T]
    found = read_recording(written(tmp_path, *sent)).of("marker").values()
    for stream, point in zip(found, POINTS, strict=True):
        assert stream.values[:-1] == pytest.approx((turn.apply(point + lens) + at)[:-1], abs=1e-9)


def test_clouds_go_to_the_root_of_tf_and_their_camera_is_there(tmp_path):
    mount = ("/tf_static", tf(0.0, "world", "camera", MOUNT))
    files = written(tmp_path, mount, ("/depth", cloud()))
    (found,) = read_recording(files, view=CloudView(units="mm")).clouds
    turn, points = Rotation.from_quat(MOUNT[3:]), np.arange(12.0).reshape(4, 3)
    assert found.points == pytest.approx(turn.apply(1e-3 * points) + MOUNT[:3])
    assert found.camera == pytest.approx(MOUNT[:3])


def test_markers_of_two_topics_are_not_mixed(tmp_path):
    other = [("/b", markers(t, "world", 2.0 + POINTS)) for t in T]
    found = read_recording(written(tmp_path, *cable(), *other)).of("marker")
    assert [*found] == [f"{topic}_{k:02d}" for topic in "ab" for k in range(3)]
    assert found["b_01"].values == pytest.approx(np.tile(2.0 + POINTS[1], (len(T), 1)))


def test_fixtures_that_never_move_hold_every_pose(tmp_path):
    """Static frames are sent before the first pose; that nothing joins two roots is told."""
    far = np.array([0.4, *STILL[1:]])
    fixed = [
        ("/tf_static", tf(0.0, "base", "start", STILL)),
        ("/tf_static", tf(2.0, "start", "end", 2.0 * far)),
        ("/tf_static", tf(3.0, "start", "end", far)),
    ]
    recording = read_recording(written(tmp_path, *fixed, *cable()))
    aligned, offsets = align_clocks(recording)
    assert not offsets
    stills = find_stills(aligned, 0.5)
    assert len(stills) == 2
    for still in stills:
        assert still.values["body", "start"] == pytest.approx(STILL)
        assert still.values["body", "end"] == pytest.approx(far)
    session = make_session("loom", recording, Wishes(at=(0.1, 0.2, 0.3)))  # it changes its length
    assert any("come from several frames (base, world)" in text for text in session.remarks)


def test_a_wrench_in_axes_of_the_world_is_turned_with_it(tmp_path):
    """With y up in the bag, y becomes z. One in the axes of a sensor keeps them."""
    sent = [("/end/wrench", wrench(t, "world")) for t in T]
    sent += [("/start/wrench", wrench(t, "hand")) for t in T]
    sent += [("/tf", tf(t, "world", "hand", STILL)) for t in T]
    found = read_recording(written(tmp_path, *cable(), *sent), up="y").of("wrench")
    assert found["end/wrench"].values[0, :3] == pytest.approx([1.0, -3.0, 2.0])
    assert found["start/wrench"].values[0, :3] == pytest.approx([1.0, 2.0, 3.0])


def cloud(order="<", names="xyz", lost=0):
    """A PointCloud2 of two rows with two points and four bytes of padding each."""
    table = np.zeros((2, 2), [(name, f"{order}f4") for name in names])
    for k, name in enumerate(names):
        table[name] = [[k, 3 + k], [6 + k, 9 + k]]
    fields = [MSG["PointField"](name, 4 * k, 7, 1) for k, name in enumerate(names)]
    data = b"".join(row.tobytes() + b"\xff" * 4 for row in table)
    raw = np.frombuffer(data[: len(data) - lost], np.uint8)
    width = table.dtype.itemsize
    return MSG["PointCloud2"](
        header(1.0, "camera"), 2, 2, fields, order == ">", width, 2 * width + 4, raw, True
    )


@pytest.mark.parametrize("order", ["<", ">"])
def test_rows_of_a_cloud_may_be_padded_and_of_either_byte_order(order, tmp_path):
    (found,) = read_recording(written(tmp_path, ("/depth", cloud(order)))).clouds
    assert found.points == pytest.approx(np.arange(12.0).reshape(4, 3))


@pytest.mark.parametrize("broken", [cloud(names="xyh"), cloud(lost=8)], ids=["no z", "truncated"])
def test_broken_clouds_of_a_bag(broken, tmp_path):
    with pytest.raises(MeasurementError, match=r"^take: .*\n  Try: "):
        read_recording(written(tmp_path, ("/depth", broken)))


def test_a_transform_without_a_rotation_is_left_out(tmp_path):
    sent = [("/tf", tf(t, "world", "hand", STILL * (k > 0))) for k, t in enumerate(T)]
    hand = read_recording(written(tmp_path, *sent)).of("body")["hand"]
    assert hand.values == pytest.approx(np.tile(STILL, (len(T) - 1, 1)))


NOW = 1.7e9  # s


@pytest.mark.parametrize("unset", ["all", "the first"])
def test_stamps_that_are_not_set_are_replaced_by_the_times_of_receipt(unset, tmp_path):
    """Of all messages, or of one among others with stamps since 1970; both are told."""
    sent = [
        ("/a", markers(NOW + t if unset != "all" and k else 0.0, "world", POINTS + x), NOW + t)
        for k, (t, x) in enumerate(zip(T, STEP, strict=True))
    ]
    recording = read_recording(written(tmp_path, *sent))
    for stream in recording.of("marker").values():
        assert stream.t == pytest.approx(NOW + T, abs=1e-6)
    assert recording.assumptions[0].startswith("header stamps in a are zero: the times at which")


def test_what_is_deleted_or_a_line_is_no_marker(tmp_path):
    def message(t, name, place, **changed):
        found = marker_message(MSG, header(t, "world"), name, pose([*place, *STILL[3:]]))
        for key, value in changed.items():
            setattr(found, key, value)
        return found

    sent = []
    for t, x in zip(T, STEP, strict=True):
        array = [message(t, f"m{k}", p + x) for k, p in enumerate(POINTS)]
        array.insert(0, message(t, "", np.zeros(3), action=3))
        array.append(message(t, "strip", np.zeros(3), type=4))
        sent.append(("/a", MSG["MarkerArray"](array)))
    recording = read_recording(written(tmp_path, *sent))
    assert [*recording.of("marker")] == ["m0_0", "m1_0", "m2_0"]
    assert recording.assumptions[0] == "markers strip_0 are left out: lines, lists or texts"


def test_markers_without_a_name_keep_their_number_when_one_is_lost():
    """As mocap4r2_msgs has them: only those that are seen are in a message."""
    one = make_dataclass("Marker", ["id_type", "marker_index", "marker_name", "translation"])
    array = make_dataclass("Markers", ["markers"])
    names = []
    for seen in ((0, 1, 2), (0, 2)):
        items = [one(1, k, "", MSG["Point"](0.1 * k, 0.0, 0.0)) for k in seen]
        found = items_of(array(items), "Markers", "mocap")
        names.append([(item.name, item.row[0]) for item in found])
    assert names[1] == [names[0][0], names[0][2]]


def test_markers_of_a_bag_may_be_in_millimetres(tmp_path):
    """They are scaled before TF, which is in metres, moves them."""
    mount = ("/tf_static", tf(0.0, "world", "mocap", MOUNT))
    sent = [("/a", markers(t, "mocap", 1e3 * (POINTS + x))) for t, x in zip(T, STEP, strict=True)]
    files = written(tmp_path, mount, *sent)
    with pytest.raises(MeasurementError, match=r"m from the origin.*\n  Try: --units mm"):
        read_recording(files)
    found = read_recording(files, view=CloudView(units="mm")).of("marker")
    place = Rotation.from_quat(MOUNT[3:]).apply(POINTS[1]) + MOUNT[:3]
    assert found["a_01"].values[0] == pytest.approx(place)


def test_clouds_without_a_stamp_have_the_times_of_receipt(tmp_path):
    """Like the gripper beside them."""
    bare = replace(cloud(), header=header(0.0, "world"))
    hand = MSG["PoseStamped"](header(0.0, "world"), pose(STILL))
    sent = [
        (topic, message, t)
        for t in (1.0, 2.0)
        for topic, message in (("/depth", bare), ("/hand", hand))
    ]
    recording = read_recording(written(tmp_path, *sent))
    assert [found.t for found in recording.clouds] == pytest.approx([1.0, 2.0])
    assert recording.of("body")["hand"].t == pytest.approx([1.0, 2.0])
    assert any("header stamps in depth, hand are zero" in text for text in recording.assumptions)


def test_a_cloud_without_the_cable_costs_no_other(tmp_path):
    """Something hid it between two poses; that no cloud of a bag shows it is told."""
    seen, hidden = cloud(), replace(cloud(), data=np.zeros_like(cloud().data))
    bag = written(tmp_path, ("/depth", seen), ("/depth", hidden))
    for box in ((0.0, 1.0, 2.0, 3.0, 4.0, 5.0), (3.0, 1.0, 5.0, 0.0, 4.0, 2.0)):  # any corners
        (found,) = read_recording(bag, view=CloudView(box=box)).clouds
        assert len(found.points) == 2
    with pytest.raises(MeasurementError, match=r"none of its 8 points is finite, inside --box"):
        read_recording(bag, view=CloudView(box=(7.0, 7.0, 7.0, 7.5, 7.5, 7.5)))


def test_a_frame_that_changes_its_parent_is_left_out_with_a_remark(tmp_path):
    """A plug that is taken from a table by a hand: its poses in both do not mix."""
    held = [("/tf_static", tf(0.0, "world", name, MOUNT)) for name in ("table", "hand")]
    moved = [("/tf", tf(t, "table" if t < 4.0 else "hand", "plug", STILL)) for t in T]
    recording = read_recording(written(tmp_path, *held, *moved, *cable()))
    assert set(recording.of("body")) == {"table", "hand"}
    assert "frames plug of TF have several parents: left out" in recording.assumptions
    with pytest.raises(MeasurementError, match="found: table, hand; frames plug of TF have sever"):
        find_gripper("plug", (), "start", [], recording)


def test_a_frame_without_a_name_is_told_as_such(tmp_path):
    fixed = [
        ("/tf_static", tf(0.0, "base", "start", STILL)),
        ("/tf_static", tf(0.0, "base", "end", np.array([0.4, *STILL[1:]]))),
    ]
    recording = read_recording(written(tmp_path, *fixed, *cable("")))
    session = make_session("loom", recording, Wishes(at=(0.1, 0.2, 0.3)))
    told = "come from several frames (base, one without a name)"
    assert any(told in text for text in session.remarks)
