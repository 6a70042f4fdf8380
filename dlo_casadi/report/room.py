"""A cable in space on a flat page: what stands around it, and how it is seen from somewhere.

Everything is lines in the room of a pose: millimetres about its middle, the third one up, against
gravity. The page and the figures draw them from the same places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.config import Config
from dlo_casadi.config.sections import Pose
from dlo_casadi.report.arrows import arrow
from dlo_casadi.session.outcome import PoseInput, Stage
from dlo_casadi.session.pose_shape import PoseShape

FloatArray = NDArray[np.floating]

# From where a room is seen: name, azimuth and elevation [degrees]. The first one is shown at first.
VIEWS = (
    ("a corner", -60.0, 24.0),
    ("the front", -90.0, 0.0),
    ("the side", 0.0, 0.0),
    ("above", -90.0, 90.0),
)
_MM = 1e3
# Shares of the cable's length: the longest arrow, an axis of a frame, the air above the floor.
_ARROW, _AXIS, _AIR = 0.15, 0.09, 0.06


@dataclass(frozen=True)
class Mark:
    """A line in a room, or a word at a place in it.

    Parameters
    ----------
    kind : str
        How it is drawn.
    points : (K, 3) [mm]
    label : str
        The word, if it is one.
    """

    kind: str
    points: FloatArray
    label: str = ""


@dataclass(frozen=True)
class Room:
    """Space about one pose.

    Parameters
    ----------
    upright : (3, 3)
        Rows: two level directions of the world, and the one up.
    center : (3,) [mm]
        Its middle, in those directions from the world's origin.
    radius : float [mm]
        Of a ball that holds the cable and the arrows in every pose.
    floor : float [mm]
        Height of the floor.
    length : float [mm]
        Of the cable.
    newton : float [mm/N]
        How long a force is drawn.
    """

    upright: FloatArray
    center: FloatArray
    radius: float
    floor: float
    length: float
    newton: float = 0.0

    @property
    def square(self) -> float:
        """Side of the floor's squares [mm]: 1, 2 or 5 times a power of ten."""
        wanted = self.length / 5
        tens = 10.0 ** np.floor(np.log10(wanted))
        return float(tens * max(step for step in (1, 2, 5) if step * tens <= wanted))

    @property
    def window(self) -> FloatArray:
        """Width and height [mm] of a picture; only arrows that stand upright may leave it."""
        return np.array([2.0, 1.7]) * self.radius

    def points(self, points: FloatArray) -> FloatArray:
        """Points (K, 3) [m] of the world, as they stand in the room [mm]."""
        return np.asarray(_MM * points.reshape(-1, 3) @ self.upright.T - self.center)

    def ground(self) -> list[Mark]:
        """The floor with its squares, the world's axes and gravity."""
        reach = self.square * np.floor(0.75 * self.radius / self.square)
        across = np.arange(-reach, reach + 0.5 * self.square, self.square)
        lines = np.array(
            [[[x, -reach], [x, reach]][:: 1 if k % 2 else -1] for k, x in enumerate(across)]
        )
        flat = np.concatenate([lines.reshape(-1, 2), lines.reshape(-1, 2)[:, ::-1]])
        marks = [Mark("grid", np.column_stack([flat, np.full(len(flat), self.floor)]))]
        corner = np.array([-reach, -reach, self.floor])
        size = _AXIS * self.length
        for name, axis in zip("xyz", size * self.upright.T, strict=True):
            marks.append(Mark("world", np.stack([corner, corner + axis])))
            marks.append(Mark("letter", (corner + 1.5 * axis)[None], name))
        projection = np.array([reach, reach, self.floor])
        rise = np.array([0.0, 0.0, size])
        top = projection + 2.5 * rise
        marks.append(Mark("weight", arrow(top, projection - top)))
        marks.append(Mark("letter", (top + 0.5 * rise)[None], "g"))
        return marks

    def shadow(self, points: FloatArray) -> list[Mark]:
        """What a line (K, 3) [mm] throws on the floor, and plumb lines from its ends."""
        below = np.column_stack([points[:, :2], np.full(len(points), self.floor)])
        plumb = [Mark("plumb", np.stack([points[k], below[k]])) for k in (0, -1)]
        return [Mark("shadow", below), *plumb]

    def clamp(self, at: FloatArray, orientation: Sequence[float]) -> list[Mark]:
        """The axes of a clamp's frame at a point (3,) [mm]."""
        axes = Rotation.from_quat(orientation).as_matrix().T @ self.upright.T
        return [
            Mark(f"axis-{name}", np.stack([at, at + _AXIS * self.length * axis]))
            for name, axis in zip("xyz", axes, strict=True)
        ]

    def force(self, at: FloatArray, force: FloatArray) -> Mark:
        """A force (3,) [N] as an arrow from a point (3,) [mm]."""
        return Mark("force", arrow(at, self.newton * self.upright @ force))


def around(
    room: Room, declared: Pose, measured: FloatArray, shape: PoseShape | None
) -> tuple[list[Mark], list[Mark]]:
    """What stands behind a cable, and in front of it: ground and shadow; clamps and forces.

    Parameters
    ----------
    declared : Pose
        How the ends are held.
    measured : (K, 3) [m]
    shape : PoseShape or None
        Predicted; without it the measured points throw the shadow.
    """
    under, over = room.ground(), []
    line = room.points(measured if shape is None else shape.curve)
    if len(line):
        under += room.shadow(line)
    for k, side in ((0, "start"), (-1, "end")):
        held = getattr(declared, side)
        if held is None:
            continue
        at = room.points(np.array(held))[0] if shape is None else line[k]
        orientation = getattr(declared, f"{side}_orientation")
        if orientation is not None:
            over += room.clamp(at, orientation)
        if shape is not None:
            over.append(room.force(at, shape.forces[k]))
            if f"{side}_force" in shape.readings:
                measured_force, _ = shape.readings[f"{side}_force"]
                over.append(replace(room.force(at, measured_force), kind="force-read"))
        # A line of no length at all would not be drawn.
        spot = np.stack([at, at + 0.1])
        over += [Mark(f"{kind} {side}", spot) for kind in ("fixture-casing", "fixture")]
    return under, over


def seen(points: FloatArray, view: tuple[str, float, float] = VIEWS[0]) -> FloatArray:
    """Points (..., 3) of a room as they are seen from afar: (..., 2) to the right and up.

    right = (-sin a, cos a, 0), up = (-sin e cos a, -sin e sin a, cos e)
    with azimuth a and elevation e of the eye. Points (..., 2) of a board are seen as they are.
    """
    if points.shape[-1] == 2:
        return points
    a, e = radians(view[1]), radians(view[2])
    axes = np.array([[-sin(a), cos(a), 0.0], [-sin(e) * cos(a), -sin(e) * sin(a), cos(e)]])
    return np.asarray(points @ axes.T)


def upright(gravity: Sequence[float]) -> FloatArray:
    """Rows (3, 3): two level directions, the first along the world's x if it can be, and up."""
    g = np.asarray(gravity, dtype=float)
    size = float(np.linalg.norm(g))
    up = -g / size if size > 0 else np.array([0.0, 0.0, 1.0])
    level = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    level = level - (level @ up) * up
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(up, level), up])


def rooms(config: Config, poses: Sequence[PoseInput], stages: Sequence[Stage]) -> list[Room]:
    """A room for each pose of a session, all of one size; the last stage's forces are drawn."""
    forces = [shape.forces for stage in stages[-1:] for shape in stage.shapes.values()]
    lines = [
        [
            pose.points,
            *(stage.shapes[pose.name].curve for stage in stages if pose.name in stage.shapes),
        ]
        for pose in poses
    ]
    drawn = [
        np.concatenate([*own, _held(config, pose.name)])
        for own, pose in zip(lines, poses, strict=True)
    ]
    return _rooms(config, drawn, np.concatenate([np.zeros((0, 3)), *forces]))


def common_room(
    config: Config, poses: Sequence[PoseInput], places: Sequence[FloatArray], forces: FloatArray
) -> Room:
    """One room about all measured poses and other places (K, 3) [m], for forces (K, 3) [N]."""
    held = [_held(config, pose.name) for pose in config.experiment.poses]
    drawn = np.concatenate([*(pose.points for pose in poses), *held, *places])
    return _rooms(config, [drawn], forces)[0]


def _held(config: Config, name: str) -> FloatArray:
    """Where the ends of a pose are held (1 or 2, 3) [m]."""
    pose = next(pose for pose in config.experiment.poses if pose.name == name)
    return np.array([point for point in (pose.start, pose.end) if point is not None])


def _rooms(config: Config, drawn: Sequence[FloatArray], forces: FloatArray) -> list[Room]:
    """Rooms of one size about points (K, 3) [m], for forces (K, 3) [N]."""
    length = _MM * config.cable.length
    directions = upright(config.experiment.gravity)
    largest = float(np.linalg.norm(forces, axis=1).max(initial=0.0))
    newton = _ARROW * length / largest if largest > 0 else 0.0
    standing = [_MM * points @ directions.T for points in drawn]
    middles = [(points.min(axis=0) + points.max(axis=0)) / 2 for points in standing]
    away = [np.linalg.norm(x - c, axis=1).max() for x, c in zip(standing, middles, strict=True)]
    radius = float(max(away)) + _ARROW * length
    return [
        Room(
            directions,
            middle,
            radius,
            float((points[:, 2] - middle[2]).min()) - _AIR * length,
            length,
            newton,
        )
        for points, middle in zip(standing, middles, strict=True)
    ]
