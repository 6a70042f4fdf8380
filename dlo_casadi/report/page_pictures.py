"""Pictures of the page: every pose with its measured line and the predictions.

A picture is a reduced photograph, or the board of a centre-line, under lines whose coordinates
are those of the photograph [px] or of the board [mm, y down]. The lines stay sharp at any size
and can be hidden one by one. A cable in space stands in a room: its lines also carry their
coordinates in the room, and the page redraws them when the room is rotated.
"""

import base64
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.config import Config
from dlo_casadi.config.sections import Pose
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.report.scene import (
    Mark,
    Room,
    Scene,
    beside,
    held_places,
    next_marks,
    pull_marks,
    scene_of,
    scenes_of,
    seen,
)
from dlo_casadi.report.words import ON_BRANCH, ComparedStage, compared
from dlo_casadi.sensing.pixels import ViewInput
from dlo_casadi.session.outcome import MeasurementSummary, Outcome, PoseInput
from dlo_casadi.session.pose_shape import PoseShape
from dlo_casadi.show.text import millimetres
from dlo_casadi.vision import nearest_in_order, read_image

Box = tuple[float, float, float, float]  # left, top, width, height

# Sides of the cut-out of a photograph, relative to those of the cable's bounding box.
_ROOM = 1.3
_GRID = 100.0  # mm
_PER_POINT = 4  # points of a predicted curve drawn for each point of the photograph
# Size [bytes] of all photographs of a page; as base64 text they take a third more.
PHOTOGRAPHS = 3_000_000
_WIDEST, _NARROWEST = 1280, 320  # px
_QUALITIES = (82, 70, 55)


@dataclass(frozen=True)
class Line:
    """A line of a picture, or a word in it."""

    kind: str  # "measured", "before", "after", or that of a `scene.Mark`
    points: str  # "u,v u,v ..." as SVG has it
    near: str = ""
    """Of a prediction: its points beside the measured ones, one for one.

    Deviations are enlarged by moving them away from those.
    """
    solid: str = ""  # the points in a room, "x,y,z x,y,z ..."
    near_solid: str = ""  # those of `near` in a room
    label: str = ""  # the word, if it is one


@dataclass(frozen=True)
class Background:
    """What lies below the lines: a photograph [px], the board or a room [mm, y down]."""

    whole: Box  # all there is
    scene: Scene | None
    """Where the pose stands; None of a photograph in space, which has the world's coordinates."""
    place: Callable[[FloatArray], FloatArray] | None
    """Maps points of the scene into it; None where the camera was not located."""
    photograph: str = ""  # as a data URI; empty for the board

    @property
    def room(self) -> Room | None:
        """The room, if it is one."""
        return self.scene if isinstance(self.scene, Room) else None

    @property
    def grid(self) -> tuple[Box, ...]:
        """Lines (x1, y1, x2, y2) of the board, every 100 mm."""
        if self.photograph or self.room is not None:
            return ()
        left, top, width, height = self.whole
        across = np.arange(np.ceil(left / _GRID), np.floor((left + width) / _GRID) + 1) * _GRID
        down = np.arange(np.ceil(top / _GRID), np.floor((top + height) / _GRID) + 1) * _GRID
        return (
            *((float(x), top, float(x), top + height) for x in across),
            *((left, float(y), left + width, float(y)) for y in down),
        )

    def points(self, points: FloatArray) -> FloatArray:
        """Convert points (K, d) [m] of the world to the picture; none if it was not located."""
        if self.place is None or not len(points):
            return np.zeros((0, 2))
        return np.asarray(self.place(points if self.scene is None else self.scene.points(points)))

    def solid(self, points: FloatArray, decimals: int) -> str:
        """Coordinates of points (K, 3) [m] of the world in a room, if it is one."""
        return "" if self.room is None else _text(self.room.points(points), decimals)

    def drawn(self, mark: Mark) -> Line:
        """Convert a mark of the scene to the page's form."""
        at = np.zeros((0, 2)) if self.place is None else self.place(mark.points)
        solid = "" if self.room is None else _text(mark.points, 1)
        return Line(mark.kind, svg(at, 1), solid=solid, label=mark.label)

    def about(self, lines: Sequence[FloatArray]) -> Box:
        """Part of a photograph around all lines, with its aspect ratio; the whole of a board."""
        if not self.photograph:
            return self.whole
        left, top, width, height = self.whole
        drawn = np.concatenate(lines)
        corner, size = np.array([left, top]), np.array([width, height])
        drawn = np.clip(drawn[np.isfinite(drawn).all(axis=1)], corner, corner + size)
        if not len(drawn):
            return self.whole
        low, high = drawn.min(axis=0), drawn.max(axis=0)
        share = min(1.0, max(0.25, _ROOM * float(((high - low) / size).max())))
        at = np.clip((low + high - share * size) / 2, corner, corner + (1 - share) * size)
        x, y, wide, high_ = (round(float(v), 1) for v in (*at, share * width, share * height))
        return x, y, wide, high_


@dataclass(frozen=True)
class Picture:
    """One pose as the page shows it."""

    name: str
    role: str
    alt: str
    behind: Background
    box: Box  # what is shown of `behind` at first: the part with the cable
    lines: tuple[Line, ...] = ()
    start: tuple[float, float] | None = None
    end: tuple[float, float] | None = None
    """Where the cable begins and ends: predicted, or declared where nothing was."""
    facts: tuple[tuple[str, str, str], ...] = ()
    """(kind, name, text); the kind is that of the line that a fact is about."""
    problem: str = ""  # why the pose could not be read
    notes: tuple[str, ...] = ()  # what the camera step noticed
    under: tuple[Line, ...] = ()
    over: tuple[Line, ...] = ()
    """What stands behind the cable and in front of it; in a plane the forces that were read."""


def pictures(outcome: Outcome) -> list[Picture]:
    """A picture of every pose of a run, in the order in which they were taken."""
    return pose_pictures(outcome.config, outcome.poses, compared(outcome), outcome.measurement)


def pose_pictures(
    config: Config,
    poses: Sequence[PoseInput],
    stages: Sequence[ComparedStage] = (),
    measurement: MeasurementSummary | None = None,
) -> list[Picture]:
    """Make a picture of every pose; for a failed run with the measurements made until then.

    `stages`: those whose predictions are drawn.
    """
    scenes, marks = scenes_of(config, poses, [item.stage for item in stages])
    declared = {pose.name: pose for pose in config.experiment.poses}
    lines = [pose.points for pose in poses if len(pose.points)]
    lines += [shape.curve for item in stages for shape in item.stage.shapes.values()]
    lines += [mark.points for _, over in marks for mark in over]
    behind = [_in_room(scene) for scene in scenes if isinstance(scene, Room)]
    if not behind:
        behind = [_board(config, scenes[0], lines)] * len(poses)
    if not config.experiment.in_space and config.experiment.measurement.kind == "images":
        behind = [
            _photographed(declared[pose.name], pose, board, PHOTOGRAPHS // len(poses))
            for pose, board in zip(poses, behind, strict=True)
        ]
    return [
        _picture(pose, declared[pose.name], own, beside_it, stages, measurement)
        for pose, own, beside_it in zip(poses, behind, marks, strict=True)
    ]


def scene_pictures(outcome: Outcome) -> dict[str, Picture]:
    """Pictures of all poses in one room: "pull", "next"; none for a cable in a plane."""
    said = {
        "pull": ("with the pull as an arrow in each pose", outcome.unexplained, pull_marks),
        "next": ("with the proposed end", outcome.next_pose, next_marks),
    }
    room, under = scene_of(outcome)
    if not isinstance(room, Room):
        return {}
    behind = _in_room(room)
    return {
        key: Picture(
            name=key,
            role="fit",
            alt=f"Measured cables in space, {text}",
            behind=behind,
            box=behind.whole,
            under=tuple(map(behind.drawn, [*under, *marks(outcome, room)])),
        )
        for key, (text, found, marks) in said.items()
        if found is not None
    }


def view_pictures(
    poses: Sequence[PoseInput], stages: Sequence[ComparedStage] = ()
) -> list[Picture]:
    """Make a picture of every usable photograph of poses in space, grouped by pose.

    `stages`: those whose predictions are projected into it.
    """
    shown = [(pose, view) for pose in poses for view in pose.views]
    return [_view_picture(pose, view, stages, PHOTOGRAPHS // len(shown)) for pose, view in shown]


# ---- backgrounds -------------------------------------------------------------------------------


def _in_room(room: Room) -> Background:
    """A room in its first view."""
    low, size = -room.window / 2, room.window
    whole = (float(low[0]), float(low[1]), float(size[0]), float(size[1]))
    return Background(whole, room, lambda points: seen(points) * [1.0, -1.0])


def _to_millimetres(points: FloatArray) -> FloatArray:
    return np.asarray(points) * [1e3, -1e3]


def _board(config: Config, scene: Scene, lines: Sequence[FloatArray]) -> Background:
    """The part of the board that contains all lines (K, 2) [m] and all fixtures."""
    held = [held_places(pose) for pose in config.experiment.poses]
    drawn = _to_millimetres(np.concatenate([*held, *lines]))
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    span = float((high - low).max())
    size = np.maximum(high - low + 0.12 * span, 0.45 * span)
    left, top = (low + high - size) / 2
    whole = (float(left), float(top), float(size[0]), float(size[1]))
    return Background(whole, scene, _to_millimetres)


def _photographed(declared: Pose, pose: PoseInput, board: Background, budget: int) -> Background:
    """The photograph of a pose, if it was located and can be read; else the board."""
    located = pose.to_pixels is not None or not len(pose.points)
    photograph = photograph_of(declared.paths[0], budget) if located and declared.paths else None
    if photograph is None:
        return board
    uri, width, height = photograph
    return Background((-0.5, -0.5, float(width), float(height)), board.scene, pose.to_pixels, uri)


def photograph_of(path: Path, budget: int) -> tuple[str, int, int] | None:
    """Read a photograph as a small JPEG in a data URI, with its true width and height [px].

    Parameters
    ----------
    budget : int
        Largest size [bytes] of the JPEG; quality is reduced first, then width.

    None where the file cannot be read.
    """
    try:
        pixels = read_image(path)[..., ::-1]
    except MeasurementError:
        return None
    height, width = pixels.shape[:2]
    whole = Image.fromarray(np.ascontiguousarray(pixels))
    wide = float(min(_WIDEST, width))
    while True:
        size = (round(wide), max(1, round(wide * height / width)))
        small = whole.resize(size, Image.Resampling.LANCZOS, None, 2)
        for quality in _QUALITIES:
            buffer = io.BytesIO()
            small.save(buffer, "JPEG", quality=quality)
            if buffer.tell() <= budget:
                break
        if buffer.tell() <= budget or wide <= _NARROWEST:
            break
        wide = max(_NARROWEST, min(0.8, 0.95 * (budget / buffer.tell()) ** 0.5) * wide)
    text = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f"data:image/jpeg;base64,{text}", width, height


# ---- one picture -------------------------------------------------------------------------------


def _picture(
    pose: PoseInput,
    declared: Pose,
    behind: Background,
    marks: tuple[Sequence[Mark], Sequence[Mark]],
    stages: Sequence[ComparedStage],
    measurement: MeasurementSummary | None,
) -> Picture:
    lines, facts = [], []
    measured = behind.points(pose.points)
    drawn = [measured]
    for kind, label, stage in stages:
        shape = stage.shapes.get(pose.name)
        if shape is None:
            facts.append((kind, label, "no equilibrium"))
            continue
        drawn.append(behind.points(shape.curve))
        near = beside(pose, shape) if len(measured) else measured
        places = svg(drawn[-1], 1), svg(behind.points(near), 2)
        lines.append(Line(kind, *places, behind.solid(shape.curve, 1), behind.solid(near, 2)))
        if shape.rmse is not None:
            facts.append((kind, label, millimetres(shape.rmse)))
        if not shape.stable:
            facts.append((kind, label, "not stable"))
        if shape.measured_branch is not None:
            branch = shape.measured_branch
            said = f"with {branch.chosen_by}" if branch.chosen_by else ON_BRANCH
            facts.append((kind, said, millimetres(branch.rmse)))
    ends = drawn[-1][:1], drawn[-1][-1:]
    if not lines:
        held = behind.points(held_places(declared))
        ends = held[:1], held[1:]
    if len(measured):
        lines.append(Line("measured", svg(measured, 2), solid=behind.solid(pose.points, 2)))
        text = counted(len(pose.points), "point")
        text += "" if pose.coverage is None else f", {pose.coverage:.0%} of the cable"
        facts.append(("measured", "measured", text))
    last = stages[-1].stage.shapes.get(pose.name) if stages else None
    if behind.room is not None and last is not None:
        sizes = ", ".join(f"{np.linalg.norm(force):.3g}" for force in last.forces)
        facts.append(("force", "forces on start, end", f"{sizes} N"))
    for one in () if last is None else last.contacts:
        force = float(np.linalg.norm(one["force"]))
        facts.append(("contact", f"force on {one['obstacle']}", f"{force:.3g} N"))
    if last is not None and measurement is not None:
        facts += _readings(measurement, last)
    what = "Photograph" if behind.photograph else "Drawing of the board"
    what = f"{'Drawing in space' if behind.room else what}, pose {pose.name}"
    if not len(pose.points):
        alt = f"{what}: {'readings alone' if pose.unseen else 'no cable was measured'}."
    elif last is None or last.rmse is None:
        alt = f"{what}, with the measured line."
    else:
        alt = (
            f"{what}, with the measured line and the predicted ones; {stages[-1].label}, they are "
            f"{millimetres(last.rmse)} apart."
        )
    under, over = (tuple(map(behind.drawn, some)) for some in marks)
    arrows = [] if behind.room else [behind.points(mark.points) for mark in marks[1]]
    return Picture(
        name=pose.name,
        role=pose.role,
        alt=alt,
        behind=behind,
        box=behind.about([*drawn, *ends, *arrows]),
        lines=tuple(line for line in lines if line.points),
        start=None if behind.room else _point(ends[0]),
        end=None if behind.room else _point(ends[1]),
        facts=tuple(facts),
        problem=pose.problem,
        notes=pose.messages,
        under=under,
        over=over,
    )


def _readings(measurement: MeasurementSummary, shape: PoseShape) -> Iterator[tuple[str, str, str]]:
    """Each reading by name: difference from the predicted one, in units and relative to noise."""
    for name, (known, model) in shape.readings.items():
        std, unit = measurement.std_of(name)
        off, size = float(np.linalg.norm(known - model)), float(np.linalg.norm(known))
        text = f"{size:.3g} {unit}, off by {off:.2g} {unit} ({off / std:.1f} std)"
        yield "force-read", name.replace("_", " "), text


def _view_picture(
    pose: PoseInput, view: ViewInput, stages: Sequence[ComparedStage], budget: int
) -> Picture:
    viewpoint, pixels = view.seen.viewpoint, view.seen.pixels
    photograph, (height, width) = photograph_of(view.image, budget), viewpoint.shape
    whole = (-0.5, -0.5, float(width), float(height))
    uri = "" if photograph is None else photograph[0]
    behind = Background(whole, None, viewpoint.to_pixels, uri)
    drawn: list[FloatArray] = [pixels]
    lines, facts = [], []
    for kind, label, stage in stages:
        shape = stage.shapes.get(pose.name)
        if shape is None:
            continue
        at = np.arange(len(shape.curve))
        fine = np.linspace(0, at[-1], _PER_POINT * at[-1] + 1)
        curve = behind.points(np.column_stack([np.interp(fine, at, x) for x in shape.curve.T]))
        near = curve[_nearest(pixels, curve)]
        drawn.append(curve)
        lines.append(Line(kind, svg(curve[::_PER_POINT], 1), svg(near, 2)))
        rms = float(np.sqrt(np.mean(np.sum((pixels - near) ** 2, axis=1))))
        facts.append((kind, label, f"{rms:.2g} px"))
    return Picture(
        name=view.name,
        role=pose.role,
        alt=f"Photograph {view.name}, with the line that is seen in it"
        + (" and the predicted ones." if stages else "."),
        behind=behind,
        box=behind.about(drawn),
        lines=(*lines, Line("measured", svg(pixels, 2))),
        start=_point(drawn[-1][:1]),
        end=_point(drawn[-1][-1:]),
        facts=(*facts, ("measured", "measured", counted(len(pixels), "pixel"))),
    )


def _nearest(pixels: FloatArray, curve: FloatArray) -> IntArray:
    """Points (K,) of a projected curve (M, 2) [px] nearest to the pixels (K, 2), in order."""
    away = np.linalg.norm(pixels[:, None] - curve[None], axis=2)
    nearest = away.min(axis=1)
    found = nearest_in_order(away / (1.0 + np.median(nearest)))
    return np.where(found >= 0, found, away.argmin(axis=1))


def _text(points: FloatArray, decimals: int) -> str:
    return " ".join(",".join(f"{x:.{decimals}f}" for x in point) for point in points)


def svg(points: FloatArray, decimals: int) -> str:
    """Points in SVG syntax; empty if the camera cannot see one of them."""
    return _text(points, decimals) if np.isfinite(points).all() else ""


def _point(points: FloatArray) -> tuple[float, float] | None:
    """The point of an array (1, 2), if there is one."""
    if not len(points) or not np.isfinite(points).all():
        return None
    return round(float(points[0, 0]), 1), round(float(points[0, 1]), 1)
