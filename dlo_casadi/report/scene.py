"""Map a cable and its surroundings to a drawing: on its board, or in a room.

A scene maps points of the world [m] to its own coordinates, in which the page and the figures draw
the same marks. A board uses metres in its plane. A room uses millimetres from the middle of a pose;
its third axis points up, against gravity.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.cable.picture import outlines, touching
from dlo_casadi.config import Config
from dlo_casadi.config.sections import Pose
from dlo_casadi.rod.obstacles import Obstacle
from dlo_casadi.session.outcome import Outcome, PoseInput, Stage
from dlo_casadi.session.pose_shape import PoseShape
from dlo_casadi.show.style import arrow

# Views of a room: name, azimuth and elevation [degrees]; the first is the default.
VIEWS = (
    ("a corner", -60.0, 24.0),
    ("the front", -90.0, 0.0),
    ("the side", 0.0, 0.0),
    ("above", -90.0, 90.0),
)
_MM = 1e3
# Longest arrow relative to the cable's length: in a room, at an end and along a planar cable.
_IN_ROOM, _AT_END, _PULLING = 0.15, 1 / 5, 0.25
# More shares of the length: an axis of a frame, the height above the floor, half of a cross.
_AXIS, _AIR, _CROSS = 0.09, 0.06, 0.05
# Approximate number of points of a measured line that are drawn in addition to others.
_POINTS = 60


# ---- marks -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mark:
    """A line (K, d) in a scene, or a word at a point of it."""

    kind: str  # how it is drawn
    points: FloatArray
    label: str = ""  # the word, if it is one


def beside(pose: PoseInput, shape: PoseShape, factor: float = 1.0) -> FloatArray:
    """Points (K, d) [m] of the prediction beside the measured ones, deviations times `factor`."""
    return np.asarray(pose.points - factor * shape.gap)


# ---- scenes ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plane:
    """The plane of a cable."""

    length: float  # of the cable [m]
    newton: float  # how long a force is drawn [m/N]
    markers: FloatArray | tuple[()] = ()  # outlines (K, 5, 2) [m] of the squares printed on it

    def points(self, points: FloatArray) -> FloatArray:
        """Points (K, 2) [m], or a single one, unchanged."""
        return points.reshape(-1, 2)

    def force(self, at: FloatArray, force: FloatArray, kind: str = "force") -> Mark:
        """A force (2,) [N] as an arrow from a place (2,) [m]."""
        return Mark(kind, arrow(at, self.newton * force))

    def ground(self) -> list[Mark]:
        """The markers."""
        return [Mark("marker", outline) for outline in self.markers]


@dataclass(frozen=True)
class Room:
    """The surroundings of one pose in space."""

    upright: FloatArray  # rows (3, 3): two level directions of the world, and the one up
    center: FloatArray  # its middle (3,) [mm], in those directions from the world's origin
    radius: float  # of a ball [mm] that holds the cable and the arrows in every pose
    floor: float  # height of the floor [mm]
    length: float  # of the cable [mm]
    newton: float  # how long a force is drawn [mm/N]

    @property
    def square(self) -> float:
        """Side of the floor's squares [mm]: 1, 2 or 5 times a power of ten."""
        wanted = self.length / 5 * (1 + 1e-9)  # log10 of a number just below a power rounds up
        tens = 10.0 ** np.floor(np.log10(wanted))
        return float(tens * max(step for step in (1, 2, 5) if step * tens <= wanted))

    @property
    def window(self) -> FloatArray:
        """Width and height [mm] of a picture; only vertical arrows may leave it."""
        return np.array([2.0, 1.7]) * self.radius

    def points(self, points: FloatArray) -> FloatArray:
        """Points (K, 3) [m] of the world, as they stand in the room [mm]."""
        return np.asarray(_MM * points.reshape(-1, 3) @ self.upright.T - self.center)

    def force(self, at: FloatArray, force: FloatArray, kind: str = "force") -> Mark:
        """A force (3,) [N] as an arrow from a point (3,) [mm]."""
        return Mark(kind, arrow(at, self.newton * self.upright @ force))

    def ground(self) -> list[Mark]:
        """The floor with its squares, the world's axes and gravity."""
        # The floor's corners, with their letters, stay in every view's window: sqrt(2) 0.68 < 1.
        reach = self.square * np.floor(0.68 * self.radius / self.square)
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
        foot = np.array([reach, reach, self.floor])
        rise = np.array([0.0, 0.0, size])
        top = foot + 2.5 * rise
        marks.append(Mark("weight", arrow(top, foot - top)))
        marks.append(Mark("letter", (top + 0.5 * rise)[None], "g"))
        return marks

    def shadow(self, points: FloatArray) -> list[Mark]:
        """Shadow of a line (K, 3) [mm] on the floor, and vertical lines from its ends."""
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


Scene = Plane | Room


def seen(points: FloatArray, view: tuple[str, float, float] = VIEWS[0]) -> FloatArray:
    """Project points (..., 3) of a room from far away: (..., 2) to the right and up.

    right = (-sin a, cos a, 0), up = (-sin e cos a, -sin e sin a, cos e)
    with azimuth a and elevation e of the eye. Points (..., 2) of a board are seen as they are.
    """
    if points.shape[-1] == 2:
        return points
    a, e = radians(view[1]), radians(view[2])
    axes = np.array([[-sin(a), cos(a), 0.0], [-sin(e) * cos(a), -sin(e) * sin(a), cos(e)]])
    return np.asarray(points @ axes.T)


def upright(gravity: Sequence[float]) -> FloatArray:
    """Rows (3, 3): two horizontal directions, the first along the world's x if possible, and up."""
    g = np.asarray(gravity, dtype=float)
    size = float(np.linalg.norm(g))
    up = -g / size if size > 0 else np.array([0.0, 0.0, 1.0])
    level = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    level = level - (level @ up) * up
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(up, level), up])


def scenes_of(
    config: Config, poses: Sequence[PoseInput], stages: Sequence[Stage]
) -> tuple[Sequence[Scene], list[tuple[list[Mark], list[Mark]]]]:
    """Make a scene for each pose, all on one scale, and the marks `around` its cable.

    Forces are those of the last stage.
    """
    last, length = stages[-1].shapes if stages else {}, config.cable.length
    declared = {pose.name: pose for pose in config.experiment.poses}
    shapes = last.values()
    pressed = [np.array(one["force"]) for shape in shapes for one in shape.contacts]
    scenes: Sequence[Scene]
    if config.experiment.in_space:
        drawn = [
            [pose.points, held_places(declared[pose.name])]
            + [stage.shapes[pose.name].curve for stage in stages if pose.name in stage.shapes]
            for pose in poses
        ]
        ends = [force for shape in shapes for force in shape.forces]
        clips = [np.array(one["force"]) for shape in shapes for one in shape.clips]
        scenes = _rooms(config, drawn, [*ends, *clips, *pressed])
    else:
        pairs = [pair for shape in shapes for pair in _forces_read(shape).values()]
        known = [force for pair in pairs for force in pair]
        scenes = [Plane(length, _scale(_AT_END * length, [*known, *pressed]))] * len(poses)
    surfaces = stages[-1].surfaces if stages else config.experiment.surfaces
    marks = []
    for pose, scene in zip(poses, scenes, strict=True):
        shape, own = last.get(pose.name), declared[pose.name]
        under, over = around(scene, own, pose.points, shape)
        beside = [held_places(own), pose.points if shape is None else shape.curve]
        under += obstacle_marks(scene, surfaces, np.concatenate(beside), length)
        marks.append((under, over + ([] if shape is None else contact_marks(scene, shape, length))))
    return scenes, marks


def held_places(pose: Pose) -> FloatArray:
    """Points (1 or 2, d) [m] at which the ends of a pose are held."""
    return np.array([place for place in (pose.start, pose.end) if place is not None])


def _rooms(
    config: Config, drawn: Sequence[Sequence[FloatArray]], forces: Iterable[FloatArray]
) -> list[Room]:
    """Rooms of one size around lines (K, 3) [m], with space for forces (3,) [N]."""
    length = _MM * config.cable.length
    directions = upright(config.experiment.gravity)
    standing = [_MM * np.concatenate(lines) @ directions.T for lines in drawn]
    middles = [(points.min(axis=0) + points.max(axis=0)) / 2 for points in standing]
    about = [points - middle for points, middle in zip(standing, middles, strict=True)]
    radius = float(max(np.linalg.norm(x, axis=1).max() for x in about)) + _IN_ROOM * length
    newton = _scale(_IN_ROOM * length, forces)
    return [
        Room(directions, middle, radius, float(x[:, 2].min()) - _AIR * length, length, newton)
        for middle, x in zip(middles, about, strict=True)
    ]


def _scale(longest: float, forces: Iterable[FloatArray]) -> float:
    """Length per newton that gives the largest of all forces the `longest` arrow."""
    largest = max((float(np.linalg.norm(force)) for force in forces), default=0.0)
    return longest / largest if largest > 0 else 0.0


# ---- what stands around one pose ---------------------------------------------------------------


def _forces_read(shape: PoseShape) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Measured and predicted forces by what measured them: start, end, clip_1, ..."""
    forces = (name for name in shape.readings if name.endswith("_force"))
    return {name.removesuffix("_force"): shape.readings[name] for name in forces}


def _spot(scene: Scene, at: FloatArray, what: str) -> list[Mark]:
    """Mark where a cable is held; a line of zero length would not be drawn."""
    spot = np.stack([at, at + 1e-4 * scene.length])
    return [Mark(f"{kind} {what}", spot) for kind in ("fixture-casing", "fixture")]


def around(
    scene: Scene, declared: Pose, measured: FloatArray, shape: PoseShape | None
) -> tuple[list[Mark], list[Mark]]:
    """Marks behind and in front of a cable: ground and shadow; clamps, clips and forces.

    On a board: clips, and measured forces, each followed by the predicted one as a sensor would
    show it.

    Parameters
    ----------
    declared : Pose
        How the ends are held, and where clips are.
    measured : (K, d) [m]
    shape : PoseShape or None
        The prediction; without it the measured points cast the shadow.
    """
    read = {} if shape is None else _forces_read(shape)
    line = scene.points(measured if shape is None else shape.curve)
    between = [scene.points(np.array(clip.place))[0] for clip in declared.clips]
    clips = [mark for at in between for mark in _spot(scene, at, "clip")]
    if isinstance(scene, Plane):
        holders = {f"clip_{k}": at for k, at in enumerate(between, start=1)}
        holders |= {"start": line[0], "end": line[-1]} if read else {}
        arrows = [
            scene.force(holders[side], force, kind)
            for side, (known, model) in read.items()
            for kind, force in (("force", model), ("force-read", known))
        ]
        return [], [*clips, *arrows]
    under, over = scene.ground(), []
    if len(line):
        under += scene.shadow(line)
    for k, side in ((0, "start"), (-1, "end")):
        held = getattr(declared, side)
        if held is None:
            continue
        at = scene.points(np.array(held))[0] if shape is None else line[k]
        orientation = getattr(declared, f"{side}_orientation")
        if orientation is not None:
            over += scene.clamp(at, orientation)
        if shape is not None:
            over.append(scene.force(at, shape.forces[k]))
        if side in read:
            over.append(scene.force(at, read[side][0], "force-read"))
        over += _spot(scene, at, side)
    for k, (at, clip) in enumerate(zip(between, declared.clips, strict=True)):
        if clip.orientation is not None:
            over += scene.clamp(at, clip.orientation)
        if shape is not None and shape.clips:
            over.append(scene.force(at, np.array(shape.clips[k]["force"])))
        if f"clip_{k + 1}" in read:
            over.append(scene.force(at, read[f"clip_{k + 1}"][0], "force-read"))
    return under, over + clips


def obstacle_marks(
    scene: Scene, surfaces: Iterable[Obstacle], points: FloatArray, length: float
) -> list[Mark]:
    """Obstacles near points (K, d) [m] of a cable of the given length [m]."""
    lines = (line for one in surfaces for line in outlines(one, points, length))
    return [Mark("obstacle", scene.points(line)) for line in lines]


def contact_marks(scene: Scene, shape: PoseShape, length: float) -> list[Mark]:
    """The parts of a predicted cable that touch something, each with its force."""
    places = np.linspace(0.0, length, len(shape.curve))
    marks = []
    for one in shape.contacts:
        s = touching(one["from"], one["to"], length)
        points = scene.points(np.stack([np.interp(s, places, x) for x in shape.curve.T], axis=1))
        marks.append(Mark("contact", points))
        marks.append(scene.force(points[10], np.array(one["force"])))
    return marks


# ---- all poses of a session in one scene -------------------------------------------------------


def scene_of(outcome: Outcome) -> tuple[Scene, list[Mark]]:
    """A scene for all poses, with its ground and the measured lines."""
    config, proposal = outcome.config, outcome.next_pose
    pulls = [] if outcome.unexplained is None else list(outcome.unexplained.force_per_pose)
    measured = [pose.points for pose in outcome.poses if len(pose.points)]
    scene: Scene
    if config.experiment.in_space:
        held = [held_places(pose) for pose in config.experiment.poses]
        ends = [] if proposal is None else [np.array([proposal.end])]
        (scene,) = _rooms(config, [[*measured, *held, *ends]], pulls)
    else:
        printed = getattr(config.experiment.measurement, "board", None)
        scene = Plane(config.cable.length, _scale(_PULLING * config.cable.length, pulls))
        if printed is not None:
            centers = np.array(list(printed.marker_centers.values()))
            square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2
            outlines = centers[:, None] + printed.marker_size * square
            scene = Plane(scene.length, scene.newton, outlines)
    lines = [scene.points(points[:: max(1, len(points) // _POINTS)]) for points in measured]
    return scene, scene.ground() + [Mark("taken", line) for line in lines]


def pull_marks(outcome: Outcome, scene: Scene) -> list[Mark]:
    """Where the unexplained force acts on the cable (95 %), and the force in each fit pose."""
    load = outcome.unexplained
    assert load is not None
    pulled = np.array([*np.linspace(*load.interval, 9), load.position])
    measured = {pose.name: pose.points for pose in outcome.poses}
    declared = {pose.name: pose for pose in outcome.config.experiment.poses}
    marks = []
    for name, force in zip(load.poses, load.force_per_pose, strict=True):
        if not len(measured[name]):
            continue
        start, *end = held_places(declared[name])
        points = np.concatenate([[start], measured[name], *([place] for place in end)])
        places = chord_lengths(points)
        if end:
            places *= outcome.config.cable.length / places[-1]
        part = scene.points(np.column_stack([np.interp(pulled, places, x) for x in points.T]))
        marks += [Mark("pulled", part[:-1]), scene.force(part[-1], force, "pull")]
    return marks


def next_marks(outcome: Outcome, scene: Scene) -> list[Mark]:
    """The ends of the poses that were taken, and the proposed end of the next one."""
    assert outcome.next_pose is not None
    marks = []
    for pose in outcome.config.experiment.poses:
        for kind, place in zip(("start", "end"), held_places(pose), strict=False):
            at = scene.points(place)
            marks.append(Mark(f"fixture {kind}", np.concatenate([at, at + 1e-3 * scene.length])))
    at = scene.points(np.array(outcome.next_pose.end))
    size, axes = _CROSS * scene.length, np.eye(at.shape[1])
    arms = size * np.concatenate([[sign * axis, 0 * axis] for axis in axes for sign in (1, -1)])
    return [
        *marks,
        Mark("next", at + arms),
        Mark("next-letter", at + 2 * size * axes[-1], "next end"),
    ]
