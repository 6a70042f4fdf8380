"""What messages of ROS carry: places with their names, poses of bodies, wrenches.

A message is read by its structure, not by its package: whatever has a `pose`, a `transform`, a
`position` or a `translation` is a place, and whatever is a list of these is a list of places.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from dlo_casadi.recordings.recording import Kind

Fields = Mapping[str, Any]
"""Definitions of message types, by name, as rosbags holds them."""

# Types of visualization_msgs/Marker whose pose is a place of something: arrow, cube, sphere,
# cylinder, mesh. Lines, lists and texts have their own points or none.
_PLACED = {0, 1, 2, 3, 10}
_BY_INDEX = 1  # id_type of a mocap4r2_msgs/Marker that has no name, but a `marker_index`
# Fields that lead from a message or an item of it to its place.
_INSIDE = ("pose", "transform", "bbox", "center", "results")
_PLACES = ("position", "translation", "point")
_TURNS = ("orientation", "rotation")
# Fields that name an item of a list; of a subject's or namespace's items, the first is the whole.
_NAMES = ("ns", "marker_name", "rigid_body_name", "child_frame_id", "name")
_NUMBERS = ("id", "fiducial_id", "marker_id", "tag_id")
# Lists of names beside lists of poses of equal length.
_LISTS_OF_NAMES = ("name", "names", "joint_names")
# Types with a place that is none of a cable or a gripper: plans, outlines, goals of clicks.
_NO_PLACES = {"Path", "Goals", "Polygon", "PolygonStamped", "PolygonInstance", "GridCells"}
_NO_PLACES |= {"PolygonInstanceStamped", "Mesh", "OccupancyGrid", "MapMetaData", "ImageMarker"}
_NO_PLACES |= {"MultiDOFJointTrajectory", "MultiDOFJointTrajectoryPoint", "JointState"}
_NO_PLACES |= {f"InteractiveMarker{x}" for x in ("", "Init", "Update", "Control", "Feedback")}
# Types of clouds of points.
_CLOUDS = {"PointCloud", "PointCloud2"}
_TYPED = {"TFMessage", "tfMessage", "WrenchStamped", *_CLOUDS}
_DEEPEST = 4  # levels of types below a message: a detection's results hold a pose with covariance


@dataclass(frozen=True)
class Item:
    """A place, pose or wrench in a message."""

    kind: Kind
    name: str
    holder: Any
    """What has the header: the item or the message."""
    row: list[float] | None
    """As in `Stream.values`; None of a thing without a place, such as a line."""
    child: str = ""
    """Of a message with one pose, the frame that it moves: a topic may send those of several."""
    by_order: bool = False
    """Whether its place in a list is all that tells it from others."""


def is_cloud(kind: str) -> bool:
    """Whether messages of this type, without its package, are clouds of points."""
    return kind in _CLOUDS


def carries_places(msgtype: str, known: Fields) -> bool:
    """Whether messages of a type may carry something that is read, by its definition."""
    kind = msgtype.rpartition("/")[2]
    if kind in _TYPED:
        return True
    return kind not in _NO_PLACES and _has_place(msgtype, known, _DEEPEST)


def _has_place(msgtype: str, known: Fields, levels: int) -> bool:
    if levels == 0 or msgtype not in known:
        return False
    names = [name for name, _ in known[msgtype][1]]
    if {*names} & {*_PLACES, "pose", "transform"} or names == ["x", "y", "z"]:
        # A direction, a velocity or an angle has x, y and z as well.
        return not msgtype.endswith("/Vector3")
    return any(
        _has_place(inner, known, levels - 1)
        for _, (_, form) in known[msgtype][1]
        for inner in _named(form)
    )


def _named(form: Any) -> Iterator[str]:
    """Types of messages in the definition of a field."""
    if isinstance(form, str):
        yield form
    elif isinstance(form, tuple):
        for part in form:
            yield from _named(part)


def items_of(message: Any, kind: str, topic: str) -> Iterator[Item]:
    """All places, poses and wrenches in a message of a type, without its package.

    Those that a message deletes, or that were hidden, are left out.
    """
    if kind == "WrenchStamped":
        row = [*_vector(message.wrench.force), *_vector(message.wrench.torque)]
        yield Item("wrench", topic, message, row)
        return
    named = any(getattr(message, key, "") for key in ("ns", "marker_name"))
    if kind == "Marker" or named:
        yield from _listed([message], message, topic, markers=True)
        return
    if place := _pose_of(message):
        child = str(getattr(message, "child_frame_id", "")).strip("/")
        yield Item("body" if len(place) > 3 else "marker", topic, message, place, child)
        return
    for field in fields(message):
        found = getattr(message, field.name)
        if isinstance(found, list) and found and is_dataclass(found[0]):
            names = _names_beside(message, len(found))
            if names is not None:
                for name, item in zip(names, found, strict=True):
                    if place := _pose_of(item):
                        yield Item("body" if len(place) > 3 else "marker", name, message, place)
            else:
                yield from _listed(found, message, topic, field.name == "markers")


def _names_beside(message: Any, count: int) -> list[str] | None:
    """Names in another list of the message, one for each of its items."""
    for key in _LISTS_OF_NAMES:
        names = getattr(message, key, None)
        if isinstance(names, list) and len(names) == count:
            return [str(name) for name in names]
    return None


def _listed(found: Sequence[Any], message: Any, topic: str, markers: bool) -> Iterator[Item]:
    """Items of a list. Those of `markers` and those without a name are points, if they turn or not.

    The full name of a marker of a subject is subject/marker; one without a name has the topic's and
    its place in the list.
    """
    for k, item in enumerate(found):
        if getattr(item, "action", 0) != 0 or getattr(item, "occluded", False):
            continue
        row = _pose_of(item)
        texts = [str(text) for key in _NAMES if (text := getattr(item, key, ""))]
        number = _number_of(item)
        if row is None:
            continue
        body = len(row) > 3 and (texts or number) and not markers
        by_order = not number and not texts
        if by_order:
            by_order = getattr(item, "id_type", 0) != _BY_INDEX
            number = f"{k if by_order else item.marker_index:02d}"
        name = "_".join([*(texts or [topic]), *([number] if number else [])])
        if subject := getattr(item, "subject_name", ""):
            name = f"{subject}/{name}"
        holder = item if hasattr(item, "header") else message
        placed = not hasattr(item, "action") or item.type in _PLACED
        shown = (row if body else row[:3]) if placed else None
        yield Item("body" if body else "marker", name, holder, shown, by_order=by_order)


def _number_of(item: Any) -> str:
    """Number or text that tells an item from others; empty without one."""
    for key in _NUMBERS:
        found = getattr(item, key, "")
        if hasattr(found, "__len__") and not isinstance(found, str):
            found = "_".join(str(x) for x in found)  # a bundle of tags has several
        if str(found) != "":
            return str(found)
    return ""


def _pose_of(item: Any) -> list[float] | None:
    """Place [m] of an item, and its quaternion if it has one; None without a place."""
    for key in _INSIDE:
        inner = getattr(item, key, None)
        if isinstance(inner, list):
            inner = inner[0] if inner else None
        if inner is not None and (found := _pose_of(inner)) is not None:
            return found
    for key in _PLACES:
        place = getattr(item, key, None)
        if place is not None and hasattr(place, "x"):
            turn = next((getattr(item, key) for key in _TURNS if hasattr(item, key)), None)
            return _vector(place) + ([turn.x, turn.y, turn.z, turn.w] if turn is not None else [])
    if {"x", "y", "z"} <= {field.name for field in fields(item)} and not hasattr(item, "w"):
        return None if type(item).__name__.endswith("Vector3") else _vector(item)
    return None


def transform_of(link: Any) -> list[float]:
    """Place and quaternion of a TransformStamped."""
    turn = link.transform.rotation
    return [*_vector(link.transform.translation), turn.x, turn.y, turn.z, turn.w]


def _vector(v: Any) -> list[float]:
    return [v.x, v.y, v.z]
