"""ROS bags (rosbag2 with SQLite or MCAP, and rosbag1), read by rosbags."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError, library
from dlo_casadi.recordings.recording import Cloud, Kind, Recording, Stream

_NANO = 1e-9
# NumPy types of a message's fields, by their numbers in sensor_msgs/PointField.
_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_WANTED = (
    "marker arrays (visualization_msgs/MarkerArray, geometry_msgs/PoseArray, or any message with "
    "`markers`), PoseStamped, TransformStamped, Odometry or TF, WrenchStamped, PointCloud2"
)
Rows = list[tuple[float, list[float]]]  # times [s] and values
Links = dict[str, tuple[str, Rows]]  # frame -> its parent in TF, and its poses there


def read_bag(path: Path) -> Recording:
    """Read a bag: markers, poses and TF of grippers, wrenches, and clouds of points.

    Times are those of the messages' headers. Markers and clouds share one clock, grippers and force
    sensors another. A body is named after its topic or, in TF, its frame, and given in the root of
    its tree. Clouds are also transformed to the root where TF contains the camera's pose. Raises
    MeasurementError if the bag is damaged, or holds none of these.
    """
    anyreader = library("rosbags.highlevel", "recordings", "reading this file")
    typesys = library("rosbags.typesys", "recordings", "reading this file")
    rows: dict[tuple[Kind, str], Rows] = defaultdict(list)
    frames: dict[tuple[Kind, str], str] = {}
    links: Links = {}
    clouds: list[tuple[str, float, Any]] = []
    topics: dict[str, str] = {}
    try:
        store = typesys.get_typestore(typesys.Stores.LATEST)
        with anyreader.AnyReader([path], default_typestore=store) as reader:
            topics = {item.topic: item.msgtype for item in reader.connections}
            for connection, _, raw in reader.messages():
                name = connection.topic.strip("/")
                kind = connection.msgtype.rsplit("/", 1)[-1]
                if kind not in _HANDLED and "arker" not in kind:
                    continue
                message = reader.deserialize(raw, connection.msgtype)
                if kind == "TFMessage":
                    for link in message.transforms:
                        child = link.child_frame_id.strip("/")
                        parent = link.header.frame_id.strip("/")
                        pose = _pose(link.transform.translation, link.transform.rotation)
                        if np.isfinite(pose).all():
                            links.setdefault(child, (parent, []))[1].append((_time(link), pose))
                elif kind == "PointCloud2":
                    clouds.append((name, _time(message), message))
                elif kind in _BODIES:
                    key: tuple[Kind, str] = _BODIES[kind][0], name
                    rows[key].append((_time(message), _BODIES[kind][1](message)))
                    frames[key] = message.header.frame_id.strip("/")
                else:
                    for marker, t, place in _markers(message, kind):
                        rows["marker", marker].append((t, place))
    except MeasurementError:
        raise
    except Exception as error:  # storages raise various errors: sqlite3, struct, YAML, zstd
        raise MeasurementError(
            f"cannot be read: {str(error) or type(error).__name__}.\n  Try: `ros2 bag info`, "
            "`ros2 bag reindex`, or a bag that was closed.",
            pose=path.name,
        ) from None
    for child in links:
        rows["body", child] = _to_root(child, links)
    streams = []
    for (kind, name), items in rows.items():
        times, values = (np.array(column) for column in zip(*items, strict=True))
        order = np.unique(times, return_index=True)[1]
        clock = f"{path.name} ({'markers' if kind == 'marker' else 'grippers'})"
        frame = frames.get((kind, name), "") if kind == "wrench" else ""
        streams.append(Stream(name, kind, times[order], values[order], clock, frame))
    if not streams and not clouds:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "no topics"
        raise MeasurementError(
            f"holds {held}.\n  Try: record one or more of {_WANTED}.", pose=path.name
        )
    seen = tuple(_cloud(item, links, f"{path.name} (markers)") for item in clouds)
    return Recording(tuple(streams), seen, up_by="as ROS has it (REP 103)")


def _time(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec + _NANO * stamp.nanosec)


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


def _markers(message: Any, kind: str) -> Iterator[tuple[str, float, list[float]]]:
    """Name, time and position of each marker in a message."""
    if kind == "PoseArray":
        for k, pose in enumerate(message.poses):
            yield f"{k:02d}", _time(message), _vector(pose.position)
        return
    items = getattr(message, "markers", [message])
    for k, item in enumerate(items):
        pose = getattr(item, "pose", None)
        place = pose.position if pose is not None else getattr(item, "translation", None)
        if place is None:
            continue
        named = [getattr(item, key, "") for key in ("ns", "marker_name", "name", "id")]
        name = "_".join(str(part) for part in named if part != "") or f"{k:02d}"
        yield name, _time(item if hasattr(item, "header") else message), _vector(place)


def _to_root(child: str, links: Links) -> Rows:
    """Poses of a frame in the root of its tree, at the times of its most frequent link."""
    chain, parent = [child], links[child][0]
    while parent in links and parent not in chain:
        chain.append(parent)
        parent = links[parent][0]
    t = max((np.array([time for time, _ in links[name][1]]) for name in chain), key=len)
    place, turn = np.zeros((len(t), 3)), Rotation.from_quat(np.tile([0.0, 0, 0, 1], (len(t), 1)))
    for name in chain:
        offset, own = _at(links[name][1], t)
        place, turn = offset + own.apply(place), own * turn
    values = np.hstack([place, turn.as_quat()])
    return [(float(time), row.tolist()) for time, row in zip(t, values, strict=True)]


def _at(items: Rows, t: FloatArray) -> tuple[FloatArray, Rotation]:
    """Interpolated places (n, 3) and rotations of a link at other times; static ones stay."""
    times, first = np.unique([time for time, _ in items], return_index=True)
    poses = np.array([items[k][1] for k in first])
    if len(times) == 1:
        return np.tile(poses[0, :3], (len(t), 1)), Rotation.from_quat(
            np.tile(poses[0, 3:], (len(t), 1))
        )
    inside = np.clip(t, times[0], times[-1])
    place = np.column_stack([np.interp(inside, times, column) for column in poses[:, :3].T])
    return place, Slerp(times, Rotation.from_quat(poses[:, 3:]))(inside)


def _cloud(item: tuple[str, float, Any], links: Links, clock: str) -> Cloud:
    """Read a sensor_msgs/PointCloud2 into the root of its frame's tree."""
    name, t, message = item
    layout = {
        "names": [f.name for f in message.fields],
        "formats": [_FIELDS[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step,
    }
    data: Any = np.frombuffer(bytes(message.data), np.dtype(layout))  # type: ignore[call-overload]
    points = np.column_stack([data[axis].astype(float) for axis in "xyz"])
    colors = None
    if "rgb" in layout["names"]:
        packed = np.ascontiguousarray(data["rgb"]).view("u4")
        colors = np.column_stack([(packed >> shift) & 255 for shift in (16, 8, 0)]).astype(float)
    frame = message.header.frame_id.strip("/")
    camera = None
    if frame in links:
        stamps, poses = zip(*_to_root(frame, links), strict=True)
        pose = np.array(poses[int(np.argmin(np.abs(np.array(stamps) - t)))])
        points = Rotation.from_quat(pose[3:]).apply(points) + pose[:3]
        camera = pose[:3]
    return Cloud(name, points, colors, camera, t, clock)
