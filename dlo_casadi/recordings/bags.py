"""ROS bags (rosbag2 with SQLite or MCAP, and rosbag1), read by rosbags."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError, library
from dlo_casadi.recordings.clouds import cloud_of
from dlo_casadi.recordings.recording import Cloud, Kind, Recording, Stream, checked_times

_NANO = 1e-9
# NumPy types of a message's fields, by their numbers in sensor_msgs/PointField.
_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_WANTED = (
    "marker arrays (visualization_msgs/MarkerArray, geometry_msgs/PoseArray, or any message with "
    "`markers`), PoseStamped, TransformStamped, Odometry or TF, WrenchStamped, PointCloud2"
)
# Types of visualization_msgs/Marker whose pose is a place of something: arrow, cube, sphere,
# cylinder, mesh. Lines, lists and texts have their own points or none.
_PLACED = {0, 1, 2, 3, 10}
_BY_INDEX = 1  # id_type of a mocap4r2_msgs/Marker that has no name, but a `marker_index`
_SINCE_1970 = 1e6  # s; stamps beyond it are not counted from the start of a simulation
_ORIGIN = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
Rows = list[tuple[float, list[float]]]  # times [s] and values
Sent = list[tuple[float, float, list[float]]]  # times of headers and of receipt [s], and values
Links = dict[str, tuple[str, Rows]]  # frame -> its parent in TF, and its poses there


def read_bag(path: Path, scale: float = 1.0) -> Recording:
    """Read a bag: markers, poses and TF of grippers, wrenches, and clouds of points.

    Times are those of the messages' headers; where these are zero, of their receipt. Markers and
    clouds share one clock, grippers and force sensors another. A body is named after its topic or,
    in TF, its frame. Markers, bodies and clouds are transformed from the frames of their headers to
    the roots of these in TF; a wrench stays in the axes of its sensor. `scale` converts markers and
    clouds to metres; all else is in metres in ROS. Raises MeasurementError if the bag holds none of
    these.
    """
    highlevel = library("rosbags.highlevel", "recordings", "reading this file")
    typesys = library("rosbags.typesys", "recordings", "reading this file")
    sent: dict[tuple[Kind, str, str, str], Sent] = {}  # of kind, name, topic, frame
    moved: dict[str, tuple[str, Sent]] = {}
    torn: set[str] = set()  # frames with several parents
    left_out: set[str] = set()
    clouds: dict[str, Sent] = {}  # of topics; messages in place of values
    store = typesys.get_typestore(typesys.Stores.LATEST)
    with highlevel.AnyReader([path], default_typestore=store) as reader:
        topics = {item.topic: item.msgtype for item in reader.connections}
        for connection, nanoseconds, raw in reader.messages():
            received = _NANO * nanoseconds
            topic = connection.topic.strip("/")
            kind = connection.msgtype.rsplit("/", 1)[-1]
            if kind not in _HANDLED and "arker" not in kind:
                continue
            message = reader.deserialize(raw, connection.msgtype)
            if kind == "TFMessage":
                for link in message.transforms:
                    _add(link, moved, torn, received, topic.endswith("tf_static"))
            elif kind == "PointCloud2":
                clouds.setdefault(topic, []).append((_time(message), received, message))
            elif kind in _BODIES:
                of, row = _BODIES[kind]
                key = of, topic, topic, _frame(message)
                sent.setdefault(key, []).append((_time(message), received, row(message)))
            else:
                for name, holder, place in _markers(message, kind, topic):
                    if place is None:
                        left_out.add(name)
                        continue
                    key = "marker", name, topic, _frame(holder)
                    place = [scale * x for x in place]
                    sent.setdefault(key, []).append((_time(holder), received, place))
    moved = {name: link for name, link in moved.items() if name not in torn}
    unset: set[str] = set()  # topics
    rows = {key: _dated(items, key[2], unset) for key, items in sent.items()}
    links = {name: (parent, _dated(x, "tf", unset)) for name, (parent, x) in moved.items()}
    messages = [row for topic, items in clouds.items() for row in _dated(items, topic, unset)]
    remarks = [f"markers {', '.join(sorted(left_out))} are left out: lines, lists or texts"]
    remarks *= bool(left_out)
    if torn:
        remarks.append(f"frames {', '.join(sorted(torn))} of TF have several parents: left out")
    if unset:
        remarks.append(
            f"header stamps in {', '.join(sorted(unset))} are zero: the times at which the bag "
            "received these messages are taken"
        )
    if not rows and not links and not clouds:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "no topics"
        raise MeasurementError(f"holds {held}.\n  Try: record one or more of {_WANTED}.")
    rows = {key: items for key, items in rows.items() if key[0] != "body" or key[1] not in links}
    for name in links:  # a frame is a body at its own origin, as often as what moves it most often
        times = max((links[below][1] for below in _chain(name, links)[:-1]), key=len)
        rows["body", name, "tf", name] = [(t, _ORIGIN) for t, _ in times]
    sources = [_stream(kind, name, frame, items) for (kind, name, _, frame), items in rows.items()]
    markers = Recording(tuple(x for x in sources if x.kind == "marker")).without_zeros()
    others = [x for x in sources if x.kind != "marker"]
    streams = [_rooted(stream, links) for stream in (*markers.streams, *others)]
    seen = tuple(_cloud(message, t, links, scale) for t, message in messages)
    roots = {x.frame for x in streams if x.kind != "wrench"} | {x.frame for x in seen}
    roots -= {x.name for x in streams if x.kind == "body"}
    told = tuple(
        replace(x, frame="") if x.kind == "wrench" and x.frame in roots else x for x in streams
    )
    remarks += markers.assumptions
    return Recording(told, seen, tuple(remarks), up_by="as ROS has it (REP 103)")


def _time(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec + _NANO * stamp.nanosec)


def _dated(items: Sent, topic: str, unset: set[str]) -> Rows:
    """Rows with the times of their headers; where these are zero, of receipt: `unset` gets topic.

    Among stamps from the start of a simulation a zero is a time like others.
    """
    stamps, received, values = zip(*items, strict=True)
    zero = np.equal(stamps, 0.0)
    if len(items) > 1 and (zero.all() or (zero.any() and np.median(stamps) > _SINCE_1970)):
        unset.add(topic)
        stamps = tuple(np.where(zero, received, stamps).tolist())
    return list(zip(stamps, values, strict=True))


def _frame(message: Any) -> str:
    return str(message.header.frame_id.strip("/"))


def _vector(v: Any) -> list[float]:
    return [v.x, v.y, v.z]


def _pose(place: Any, turn: Any) -> list[float]:
    return [*_vector(place), turn.x, turn.y, turn.z, turn.w]


# Type of a message -> kind of its stream, and function that reads its row.
_BODIES: dict[str, tuple[Kind, Callable[[Any], list[float]]]] = {
    "PoseStamped": ("body", lambda m: _pose(m.pose.position, m.pose.orientation)),
    "PoseWithCovarianceStamped": (
        "body",
        lambda m: _pose(m.pose.pose.position, m.pose.pose.orientation),
    ),
    "Odometry": ("body", lambda m: _pose(m.pose.pose.position, m.pose.pose.orientation)),
    "TransformStamped": ("body", lambda m: _pose(m.transform.translation, m.transform.rotation)),
    "WrenchStamped": ("wrench", lambda m: [*_vector(m.wrench.force), *_vector(m.wrench.torque)]),
}
_HANDLED = {"TFMessage", "PointCloud2", "PoseArray", *_BODIES}


def _markers(message: Any, kind: str, topic: str) -> Iterator[tuple[str, Any, list[float] | None]]:
    """Name of each marker in a message, what holds its header, and its position if it has one.

    Those that a message deletes are left out.
    """
    items = message.poses if kind == "PoseArray" else getattr(message, "markers", [message])
    for k, item in enumerate(items):
        pose = getattr(item, "pose", item)
        place = getattr(pose, "position", None) or getattr(item, "translation", None)
        if place is None or getattr(item, "action", 0) != 0:
            continue
        texts = [getattr(item, key, "") for key in ("ns", "marker_name", "name")]
        named = [text for text in texts if text]
        index = item.marker_index if getattr(item, "id_type", 0) == _BY_INDEX else k
        number = getattr(item, "id", "" if named else f"{index:02d}")
        name = "_".join(str(part) for part in (*(named or [topic]), number) if part != "")
        placed = not hasattr(item, "action") or item.type in _PLACED
        holder = item if hasattr(item, "header") else message
        yield name, holder, _vector(place) if placed else None


def _add(
    link: Any, links: dict[str, tuple[str, Sent]], torn: set[str], received: float, static: bool
) -> None:
    """Add a TransformStamped to TF; of a static one only the last pose is valid.

    A frame that has another parent than before is added to `torn`: its poses cannot be compared.
    """
    pose = _pose(link.transform.translation, link.transform.rotation)
    frame, parent = link.child_frame_id.strip("/"), _frame(link)
    if frame == parent or not np.isfinite(pose).all() or not any(pose[3:]):
        return
    known, poses = links.setdefault(frame, (parent, []))
    if known != parent:
        torn.add(frame)
    if static:
        poses.clear()
    poses.append((_time(link), received, pose))


def _chain(frame: str, links: Links) -> list[str]:
    """A frame and its parents in TF, up to the root."""
    chain = [frame]
    while chain[-1] in links and links[chain[-1]][0] not in chain:
        chain.append(links[chain[-1]][0])
    return chain


def _in_root(frame: str, links: Links, t: FloatArray) -> tuple[str, FloatArray, Rotation]:
    """Root of a frame's tree in TF, and the frame's places (n, 3) and rotations there."""
    *below, root = _chain(frame, links)
    place, turn = np.zeros((len(t), 3)), Rotation.identity(len(t))
    for name in below:
        offset, own = _at(links[name][1], t)
        place, turn = offset + own.apply(place), own * turn
    return root, place, turn


def _at(items: Rows, t: FloatArray) -> tuple[FloatArray, Rotation]:
    """Interpolated places (n, 3) and rotations of a link at other times; static ones stay."""
    times, first = np.unique([time for time, _ in items], return_index=True)
    poses = np.array([items[k][1] for k in first])
    if len(times) == 1:
        poses = np.tile(poses, (len(t), 1))
        return poses[:, :3], Rotation.from_quat(poses[:, 3:])
    inside = np.clip(t, times[0], times[-1])
    place = np.column_stack([np.interp(inside, times, column) for column in poses[:, :3].T])
    return place, Slerp(times, Rotation.from_quat(poses[:, 3:]))(inside)


def _stream(kind: Kind, name: str, frame: str, items: Rows) -> Stream:
    """The record of a topic's marker, body or sensor, in its own frame."""
    t, values = (np.array(column) for column in zip(*items, strict=True))
    t, first = np.unique(t, return_index=True)
    checked_times(t, [f"message {k} of {kind} {name!r}" for k in range(1, len(t) + 1)])
    clock = "markers" if kind == "marker" else "grippers"
    return Stream(name, kind, t, values[first], clock, frame)


def _rooted(stream: Stream, links: Links) -> Stream:
    """The stream in the root of its frame; that of a sensor as it is."""
    if stream.kind == "wrench":
        return stream
    root, place, turn = _in_root(stream.frame, links, stream.t)
    return replace(stream.moved(turn, place), frame=root)


def _cloud(message: Any, t: float, links: Links, scale: float) -> Cloud:
    """Read a sensor_msgs/PointCloud2 of the time t [s]."""
    order = ">" if message.is_bigendian else "<"
    kind: Any = {
        "names": [f.name for f in message.fields],
        "formats": [order + _FIELDS[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step,
    }
    shape, steps = (message.height, message.width), (message.row_step, message.point_step)
    cloud = cloud_of(np.ndarray(shape, np.dtype(kind), bytes(message.data), 0, steps).ravel())
    frame = _frame(message)
    root, place, turn = _in_root(frame, links, np.array([t]))
    camera = np.zeros(3) if frame in links else None
    seen = Cloud(scale * cloud.points, cloud.colors, camera, t, "markers", root)
    return seen.moved(turn[0], place[0])
