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
from dlo_casadi.recordings.recording import Cloud, Kind, Recording, Stream

_NANO = 1e-9
# NumPy types of a message's fields, by their numbers in sensor_msgs/PointField.
_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_WANTED = (
    "marker arrays (visualization_msgs/MarkerArray, geometry_msgs/PoseArray, or any message with "
    "`markers`), PoseStamped, TransformStamped, Odometry or TF, WrenchStamped, PointCloud2"
)
_ORIGIN = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
Rows = list[tuple[float, list[float]]]  # times [s] and values
Links = dict[str, tuple[str, Rows]]  # frame -> its parent in TF, and its poses there


def read_bag(path: Path) -> Recording:
    """Read a bag: markers, poses and TF of grippers, wrenches, and clouds of points.

    Times are those of the messages' headers. Markers and clouds share one clock, grippers and force
    sensors another. A body is named after its topic or, in TF, its frame. Markers, bodies and
    clouds are transformed from the frames of their headers to the roots of these in TF; a wrench
    stays in the axes of its sensor. Raises MeasurementError if the bag holds none of these.
    """
    highlevel = library("rosbags.highlevel", "recordings", "reading this file")
    typesys = library("rosbags.typesys", "recordings", "reading this file")
    rows: dict[tuple[Kind, str, str, str], Rows] = {}  # of kind, name, topic, frame
    links: Links = {}
    clouds: list[Any] = []
    store = typesys.get_typestore(typesys.Stores.LATEST)
    with highlevel.AnyReader([path], default_typestore=store) as reader:
        topics = {item.topic: item.msgtype for item in reader.connections}
        for connection, _, raw in reader.messages():
            topic = connection.topic.strip("/")
            kind = connection.msgtype.rsplit("/", 1)[-1]
            if kind not in _HANDLED and "arker" not in kind:
                continue
            message = reader.deserialize(raw, connection.msgtype)
            if kind == "TFMessage":
                for link in message.transforms:
                    _add(link, links, topic.endswith("tf_static"))
            elif kind == "PointCloud2":
                clouds.append(message)
            elif kind in _BODIES:
                of, row = _BODIES[kind]
                key = of, topic, topic, _frame(message)
                rows.setdefault(key, []).append((_time(message), row(message)))
            else:
                for name, sent, place in _markers(message, kind, topic):
                    key = "marker", name, topic, _frame(sent)
                    rows.setdefault(key, []).append((_time(sent), place))
    if not rows and not links and not clouds:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "no topics"
        raise MeasurementError(f"holds {held}.\n  Try: record one or more of {_WANTED}.")
    rows = {key: items for key, items in rows.items() if key[0] != "body" or key[1] not in links}
    for name in links:  # a frame is a body at its own origin, as often as what moves it most often
        times = max((links[below][1] for below in _chain(name, links)[:-1]), key=len)
        rows["body", name, "tf", name] = [(t, _ORIGIN) for t, _ in times]
    streams = [
        _stream(kind, name, frame, items, links) for (kind, name, _, frame), items in rows.items()
    ]
    seen = tuple(_cloud(message, links) for message in clouds)
    roots = {x.frame for x in streams if x.kind != "wrench"} | {x.frame for x in seen}
    roots -= {x.name for x in streams if x.kind == "body"}
    told = tuple(
        replace(x, frame="") if x.kind == "wrench" and x.frame in roots else x for x in streams
    )
    return Recording(told, seen, up_by="as ROS has it (REP 103)")


def _time(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec + _NANO * stamp.nanosec)


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


def _markers(message: Any, kind: str, topic: str) -> Iterator[tuple[str, Any, list[float]]]:
    """Name of each marker in a message, what holds its header, and its position."""
    items = message.poses if kind == "PoseArray" else getattr(message, "markers", [message])
    for k, item in enumerate(items):
        pose = getattr(item, "pose", item)
        place = getattr(pose, "position", None) or getattr(item, "translation", None)
        if place is None:
            continue
        texts = [getattr(item, key, "") for key in ("ns", "marker_name", "name")]
        named = [text for text in texts if text]
        number = getattr(item, "id", "" if named else f"{k:02d}")
        name = "_".join(str(part) for part in (*(named or [topic]), number) if part != "")
        yield name, item if hasattr(item, "header") else message, _vector(place)


def _add(link: Any, links: Links, static: bool) -> None:
    """Add a TransformStamped to TF; of a static one only the last pose is valid."""
    pose = _pose(link.transform.translation, link.transform.rotation)
    itself = link.child_frame_id.strip("/") == _frame(link)
    if itself or not np.isfinite(pose).all() or not any(pose[3:]):
        return
    _, poses = links.setdefault(link.child_frame_id.strip("/"), (_frame(link), []))
    if static:
        poses.clear()
    poses.append((_time(link), pose))


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


def _stream(kind: Kind, name: str, frame: str, items: Rows, links: Links) -> Stream:
    """The record of a topic's marker, body or sensor; all but sensors in the root of its frame."""
    t, values = (np.array(column) for column in zip(*items, strict=True))
    t, first = np.unique(t, return_index=True)
    clock = "markers" if kind == "marker" else "grippers"
    stream = Stream(name, kind, t, values[first], clock, frame)
    if kind == "wrench":
        return stream
    root, place, turn = _in_root(frame, links, t)
    return replace(stream.moved(turn, place), frame=root)


def _cloud(message: Any, links: Links) -> Cloud:
    """Read a sensor_msgs/PointCloud2."""
    order = ">" if message.is_bigendian else "<"
    kind: Any = {
        "names": [f.name for f in message.fields],
        "formats": [order + _FIELDS[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step,
    }
    shape, steps = (message.height, message.width), (message.row_step, message.point_step)
    cloud = cloud_of(np.ndarray(shape, np.dtype(kind), bytes(message.data), 0, steps).ravel())
    t, frame = _time(message), _frame(message)
    root, place, turn = _in_root(frame, links, np.array([t]))
    return Cloud(
        turn[0].apply(cloud.points) + place,
        cloud.colors,
        place[0] if frame in links else None,
        t,
        "markers",
        root,
    )
