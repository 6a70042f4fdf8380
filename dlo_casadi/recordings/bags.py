"""ROS bags (rosbag2 with SQLite or MCAP, and rosbag1), read by rosbags."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError, library
from dlo_casadi.recordings.clouds import cloud_of
from dlo_casadi.recordings.messages import carries_places, is_cloud, items_of, transform_of
from dlo_casadi.recordings.recording import METRES, Cloud, Kind, Recording, Stream, checked_times

_NANO = 1e-9
# NumPy types of a message's fields, by their numbers in sensor_msgs/PointField.
_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_WANTED = (
    "marker arrays (visualization_msgs/MarkerArray, geometry_msgs/PoseArray, or any message with "
    "`markers`), PointStamped, PoseStamped, TransformStamped, Odometry, lists of named poses or "
    "TF, WrenchStamped, PointCloud, PointCloud2"
)
_SINCE_1970 = 1e6  # s; stamps beyond it are not counted from the start of a simulation
_ORIGIN = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
Rows = list[tuple[float, Any]]  # times [s] and values
Sent = list[tuple[float, float, Any]]  # times of headers and of receipt [s], and values
Links = dict[str, tuple[str, Rows]]  # frame -> its parent in TF, and its poses there
Key = tuple[Kind, str, str, str, str]  # kind, name, topic, frame, child frame


def read_bag(path: Path, unit: str | None = None) -> Recording:
    """Read a bag: markers, poses and TF of grippers, wrenches, and clouds of points.

    Times are those of the messages' headers; without one, or where it is zero, of their receipt.
    Markers and clouds share one clock, grippers and force sensors another. A body is named after
    its topic, its own name in a list or, in TF, its frame. Markers, bodies and clouds are
    transformed from the frames of their headers to the roots of these in TF; a wrench stays in the
    axes of its sensor. Markers and clouds are in `unit`, by default metres; all else is in metres
    in ROS. Topics that cannot be read are left out with a remark. Raises MeasurementError if the
    bag holds nothing that can be read, or two markers of one name in one message.
    """
    scale = METRES[unit or "m"]
    bag = _Bag()
    try:
        bag.read(path)
    except MeasurementError:
        raise
    except Exception as error:
        told = _trouble(path, error)
        if told is None:
            raise
        raise MeasurementError(told) from error
    moved = {name: link for name, link in bag.moved.items() if name not in bag.torn}
    unset: set[str] = set()  # topics
    rows = {key: _dated(items, key[2], unset) for key, items in bag.sent.items()}
    links = {name: (parent, _dated(x, "tf", unset)) for name, (parent, x) in moved.items()}
    messages = [row for topic, items in bag.clouds.items() for row in _dated(items, topic, unset)]
    remarks = bag.remarks(unset)
    unread = bag.unread()
    if not rows and not links and not messages:
        held = ", ".join(f"{topic} ({kind})" for topic, kind in bag.topics.items()) or "no topics"
        told = "".join(f"\n  {text}." for text in unread)
        raise MeasurementError(f"holds {held}.{told}\n  Try: record one or more of {_WANTED}.")
    rows = {key: items for key, items in rows.items() if key[0] != "body" or key[1] not in links}
    for name in links:  # a frame is a body at its own origin, as often as what moves it most often
        times = max((links[below][1] for below in _chain(name, links)[:-1]), key=len)
        rows["body", name, "tf", name, ""] = [(t, _ORIGIN) for t, _ in times]
    sources = [
        _stream(kind, shown, frame, items)
        for ((kind, _, _, frame, _), items), shown in zip(rows.items(), _shown(rows), strict=True)
    ]
    at_zero = Recording(tuple(x for x in sources if x.kind == "marker")).without_zeros()
    seen = [replace(x, values=scale * x.values) for x in at_zero.streams]
    others = [x for x in sources if x.kind != "marker"]
    streams = [_rooted(stream, links) for stream in (*seen, *others)]
    clouds = tuple(_cloud(message, t, links, scale) for t, message in messages)
    roots = {x.frame for x in streams if x.kind != "wrench"} | {x.frame for x in clouds}
    roots -= {x.name for x in streams if x.kind == "body"}
    told_in = tuple(
        replace(x, frame="") if x.kind == "wrench" and x.frame in roots else x for x in streams
    )
    if seen or clouds:
        assumed = f"markers and clouds of {path.name} are taken to be in {unit or 'm'}"
        remarks.append(assumed if unit else f"{assumed}, as ROS has it; or --units")
    remarks += at_zero.assumptions
    up_by = "as ROS has it (REP 103)"
    return Recording(told_in, clouds, tuple(remarks), up_by=up_by, unread=tuple(unread))


@dataclass
class _Bag:
    """What has been read of a bag so far."""

    topics: dict[str, str] = field(default_factory=dict)  # types of all topics
    sent: dict[Key, Sent] = field(default_factory=dict)
    moved: dict[str, tuple[str, Sent]] = field(default_factory=dict)
    torn: set[str] = field(default_factory=set)  # frames with several parents
    no_places: set[str] = field(default_factory=set)  # markers without a place
    clouds: dict[str, Sent] = field(default_factory=dict)  # messages in place of values
    undefined: dict[str, str] = field(default_factory=dict)  # types of topics without a definition
    broken: dict[str, int] = field(default_factory=dict)  # first message of a topic that fails
    idle: dict[str, str] = field(default_factory=dict)  # types of topics that hold nothing of use
    counts: dict[str, set[int]] = field(default_factory=dict)  # markers without names in a message

    def read(self, path: Path) -> None:
        highlevel = library("rosbags.highlevel", "recordings", "reading this file")
        typesys = library("rosbags.typesys", "recordings", "reading this file")
        store = typesys.get_typestore(typesys.Stores.LATEST)
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            known = reader.typestore.fielddefs
            self.topics = {item.topic: item.msgtype for item in reader.connections}
            used = []
            for connection in reader.connections:
                topic, msgtype = connection.topic, connection.msgtype
                if msgtype not in known:
                    self.undefined[topic] = msgtype
                elif carries_places(msgtype, known):
                    used.append(connection)
                else:
                    self.idle[topic] = msgtype
            at: dict[str, int] = {}
            for connection, nanoseconds, raw in reader.messages(used) if used else ():
                topic = connection.topic
                if topic in self.broken:
                    continue
                at[topic] = at.get(topic, 0) + 1
                try:
                    message = reader.deserialize(raw, connection.msgtype)
                except Exception:  # what damaged or differently defined messages raise: many kinds
                    self.broken[topic] = at[topic]
                    self._forget(topic.strip("/"))
                    continue
                kind = connection.msgtype.rsplit("/", 1)[-1]
                self._take(message, kind, topic.strip("/"), _NANO * nanoseconds)

    def _forget(self, topic: str) -> None:
        """Leave out what was read of a topic before it turned out to be damaged."""
        self.sent = {key: items for key, items in self.sent.items() if key[2] != topic}
        self.clouds.pop(topic, None)

    def _take(self, message: Any, kind: str, topic: str, received: float) -> None:
        """Add what a message carries."""
        if kind in ("TFMessage", "tfMessage"):
            for link in message.transforms:
                self._add(link, received, topic.endswith("tf_static"))
            return
        if is_cloud(kind):
            self.clouds.setdefault(topic, []).append((_time(message), received, message))
            return
        found = [*items_of(message, kind, topic)]
        names = [(item.kind, item.name) for item in found]
        if len({*names}) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise MeasurementError(
                f"two {twice[0]}s are called {twice[1]!r} in one message of /{topic}: they cannot "
                "be told apart.\n  Try: other names in the program that tracks them."
            )
        if any(item.by_order for item in found):
            self.counts.setdefault(topic, set()).add(len(found))
        for item in found:
            if item.row is None:
                self.no_places.add(item.name)
                continue
            key = item.kind, item.name, topic, _frame(item.holder), item.child
            self.sent.setdefault(key, []).append((_time(item.holder), received, item.row))

    def _add(self, link: Any, received: float, static: bool) -> None:
        """Add a TransformStamped to TF; of a static one only the last pose is valid.

        A frame that has another parent than before is `torn`: its poses cannot be compared.
        """
        pose = transform_of(link)
        frame, parent = link.child_frame_id.strip("/"), _frame(link)
        if frame == parent or not np.isfinite(pose).all() or not any(pose[3:]):
            return
        known, poses = self.moved.setdefault(frame, (parent, []))
        if known != parent:
            self.torn.add(frame)
        if static:
            poses.clear()
        poses.append((_time(link), received, pose))

    def remarks(self, unset: set[str]) -> list[str]:
        """What had to be assumed or left out in reading topics that are used."""
        told = []
        if self.no_places:
            names = ", ".join(sorted(self.no_places))
            told.append(f"markers {names} are left out: lines, lists or texts")
        if self.torn:
            names = ", ".join(sorted(self.torn))
            told.append(f"frames {names} of TF have several parents: left out")
        if unset:
            told.append(
                f"header stamps in {', '.join(sorted(unset))} are zero: the times at which the bag "
                "received these messages are taken"
            )
        for topic, counts in self.counts.items():
            varies = f", {min(counts)} to {max(counts)} of them" * (len(counts) > 1)
            told.append(
                f"markers of /{topic} have no names: their order in each message{varies} is taken "
                "to be the same throughout"
            )
        return told

    def unread(self) -> list[str]:
        """Topics that are left out, and why."""
        told = []
        for topic, msgtype in self.undefined.items():
            package = msgtype.partition("/")[0]
            told.append(
                f"{topic} is left out: its type {msgtype} is unknown, and the bag holds no "
                "definition of it (a .db3 of ROS 2 Humble or older holds none). Try: `ros2 bag "
                f"convert` to mcap on a computer where the package {package} is installed; it "
                "writes the definitions, too"
            )
        for topic, k in self.broken.items():
            told.append(
                f"{topic} is left out: its message {k} is not of the type {self.topics[topic]} as "
                "it is known here. Try: `ros2 bag convert` to mcap where it was recorded"
            )
        if self.idle:
            names = ", ".join(f"{topic} ({kind})" for topic, kind in self.idle.items())
            told.append(f"left out, without places or forces: {names}")
        return told


# What the reader of bags finds wrong -> what that means, and what to try.
_TROUBLES = {
    "not indexed": ("was not closed: it has no index", "`rosbag reindex`"),
    "index looks damaged": ("has a damaged index", "`rosbag reindex`"),
    "encryption": ("is encrypted", "decrypt it with `rosbag decrypt`"),
    "compression": ("is compressed in a way that is not read", "`rosbag decompress`"),
    "serialization": ("is not serialized as CDR", "`ros2 bag convert` to mcap with CDR"),
    "files are missing": ("lacks some of its files", "the whole folder of the bag"),
    "storage": ("is in a storage that is not read", "`ros2 bag convert` to mcap"),
    "version": ("is of a version that is not read", "`ros2 bag convert` to mcap"),
    "hash mismatch": (
        "defines a type of message otherwise than its own digest says",
        "`ros2 bag convert` to mcap where it was recorded",
    ),
}


def _trouble(path: Path, error: Exception) -> str | None:
    """What is wrong with a bag that cannot be opened, in our words; None if that is not known."""
    if path.is_dir() and not (path / "metadata.yaml").exists():
        return (
            f"has no metadata.yaml, which a bag has once it is closed.\n  Try: `ros2 bag reindex "
            f"{path.name}`; the file in it alone; the folder of the bag itself."
        )
    for sign, (what, remedy) in _TROUBLES.items():
        if sign in str(error).lower():
            return f"{what}.\n  Try: {remedy}."
    return None


def _shown(keys: Collection[Key]) -> list[str]:
    """Names of streams; with topics or moved frames where several have the same name."""
    alike: dict[tuple[Kind, str], set[tuple[str, str]]] = {}
    for kind, name, topic, _, child in keys:
        alike.setdefault((kind, name), set()).add((topic, child))
    shown = []
    for kind, name, topic, _, child in keys:
        others = alike[kind, name]
        before = f"{topic}/" * (len({of for of, _ in others}) > 1)
        after = f"/{child}" * (len({moved for _, moved in others}) > 1)
        shown.append(f"{before}{name}{after}")
    return shown


def _time(message: Any) -> float:
    """Time [s] of a header; zero without one."""
    header = getattr(message, "header", None)
    return 0.0 if header is None else float(header.stamp.sec + _NANO * header.stamp.nanosec)


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
    header = getattr(message, "header", None)
    return "" if header is None else str(header.frame_id.strip("/"))


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
    """Read a sensor_msgs/PointCloud2 or PointCloud of the time t [s]."""
    frame = _frame(message)
    root, place, turn = _in_root(frame, links, np.array([t]))
    camera = np.zeros(3) if frame in links else None
    cloud = _points_of(message)
    seen = Cloud(scale * cloud.points, cloud.colors, camera, t, "markers", root)
    return seen.moved(turn[0], place[0])


def _points_of(message: Any) -> Cloud:
    """Points of a cloud in its own axes."""
    if not hasattr(message, "fields"):  # a PointCloud
        return Cloud(np.array([[p.x, p.y, p.z] for p in message.points], float).reshape(-1, 3))
    order = ">" if message.is_bigendian else "<"
    kind: Any = {
        "names": [f.name for f in message.fields],
        "formats": [order + _FIELDS[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step,
    }
    shape, steps = (message.height, message.width), (message.row_step, message.point_step)
    return cloud_of(np.ndarray(shape, np.dtype(kind), bytes(message.data), 0, steps).ravel())
