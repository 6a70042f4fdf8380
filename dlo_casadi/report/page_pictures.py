"""Pictures of the page: every pose with its measured line and the predictions, as drawings.

A picture is a photograph made smaller, or the board of a centre-line, under lines whose
coordinates are those of the photograph [px] or of the board [mm, y down]. The lines stay sharp
at any size and can be hidden one by one. A cable in space stands in a room: its lines also carry
their places there, and the page draws them anew as the room is turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config
from dlo_casadi.config.sections import Pose
from dlo_casadi.errors import counted
from dlo_casadi.report.arrows import forces_read
from dlo_casadi.report.canvas import Compared, compared, millimetres
from dlo_casadi.report.geometry import beside
from dlo_casadi.report.page_backgrounds import Background, Box, backgrounds, flat, in_room
from dlo_casadi.report.room import Mark, Room, around
from dlo_casadi.report.scene import next_marks, pull_marks, scene_of
from dlo_casadi.report.text_findings import branch_text
from dlo_casadi.session.outcome import MeasurementSummary, Outcome, PoseInput
from dlo_casadi.session.pose_shape import PoseShape

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Line:
    """One line over a picture.

    Parameters
    ----------
    kind : "measured", "before" or "after"
    points : str
        "u,v u,v ..." as SVG has it.
    near : str
        Of a prediction: its points beside the measured ones, one for one; deviations are enlarged
        by moving them away from those.
    solid, near_solid : str
        The same points in a room, "x,y,z x,y,z ...".
    """

    kind: str
    points: str
    near: str = ""
    solid: str = ""
    near_solid: str = ""


@dataclass(frozen=True)
class Solid:
    """A line beside the cable, or a word there (see `room.Mark`), as the page has it."""

    kind: str
    points: str
    solid: str = ""
    label: str = ""


@dataclass(frozen=True)
class Picture:
    """One pose as the page shows it.

    Parameters
    ----------
    behind : Background
        What lies under the lines.
    box : (left, top, width, height)
        What of it is shown at first: the part with the cable.
    start, end : (u, v) or None
        Where the cable begins and ends: predicted, or declared where nothing was.
    facts : tuple of (kind, name, text)
        The kind is that of the line that a fact is about.
    notes : tuple of str
        What the camera step noticed, or why the pose could not be read.
    under, over : tuple of Solid
        What stands there behind the cable, and in front of it; in a plane the forces that were
        read, beside the predicted ones.
    """

    name: str
    role: str
    alt: str
    behind: Background
    box: Box
    lines: tuple[Line, ...] = ()
    start: tuple[float, float] | None = None
    end: tuple[float, float] | None = None
    facts: tuple[tuple[str, str, str], ...] = ()
    problem: str = ""
    notes: tuple[str, ...] = ()
    under: tuple[Solid, ...] = ()
    over: tuple[Solid, ...] = ()


def pictures(outcome: Outcome) -> list[Picture]:
    """A picture of every pose of a run, in the order in which they were taken."""
    return _pictures(outcome.config, outcome.poses, compared(outcome), outcome.measurement)


def pictures_of_failure(config: Config, poses: Sequence[PoseInput]) -> list[Picture]:
    """A picture of every pose of a run that has failed, with what was measured until then."""
    return _pictures(config, poses, [], None)


def scene_pictures(outcome: Outcome) -> dict[str, Picture]:
    """Pictures of all poses in one room: "pull", "next"; none in a plane."""
    said = {
        "pull": ("with the pull as an arrow in each pose", outcome.unexplained, pull_marks),
        "next": ("with the proposed end", outcome.next_pose, next_marks),
    }
    shown = {key: value for key, value in said.items() if value[1] is not None}
    room, under = scene_of(outcome)
    if not isinstance(room, Room):
        return {}
    return {
        key: Picture(
            name=key,
            role="fit",
            alt=f"Measured cables in space, {text}",
            behind=in_room(room),
            box=in_room(room).whole,
            under=tuple(map(_drawn, [*under, *marks(outcome, room)])),
        )
        for key, (text, _, marks) in shown.items()
    }


def _pictures(
    config: Config,
    poses: Sequence[PoseInput],
    stages: Sequence[Compared],
    measurement: MeasurementSummary | None,
) -> list[Picture]:
    behind = backgrounds(config, poses, [stage for *_, stage in stages])
    in_plane = stages and not config.experiment.in_space
    read = forces_read(stages[-1][2], config.cable.length) if in_plane else {}
    declared = {pose.name: pose for pose in config.experiment.poses}
    return [
        _picture(pose, declared[pose.name], b, stages, read.get(pose.name, ()), measurement)
        for pose, b in zip(poses, behind, strict=True)
    ]


def _picture(
    pose: PoseInput,
    declared: Pose,
    behind: Background,
    stages: Sequence[Compared],
    read: Sequence[tuple[str, FloatArray]],
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
        lines.append(
            Line(
                kind,
                svg(drawn[-1], 1),
                svg(behind.points(near), 2),
                _solid(behind.room, shape.curve, 1),
                _solid(behind.room, near, 2),
            )
        )
        if shape.rmse is not None:
            facts.append((kind, label, millimetres(shape.rmse)))
        if not shape.stable:
            facts.append((kind, label, "not stable"))
        if shape.measured_branch is not None:
            facts.append((kind, label, branch_text(shape.measured_branch)))
    if lines:
        ends = [drawn[-1][:1], drawn[-1][-1:]]
    else:
        nowhere = (np.nan,) * len(declared.start)
        held = (declared.start, declared.end or nowhere)
        ends = [behind.points(np.array([place])) for place in held]
    if len(measured):
        solid = _solid(behind.room, pose.points, 2)
        lines.append(Line("measured", svg(measured, 2), solid=solid))
        facts.append(("measured", "measured", _seen(pose)))
    last = stages[-1][2].shapes.get(pose.name) if stages else None
    if behind.room is not None and last is not None:
        facts.append(("force", "forces on start, end", _newtons(last.forces)))
    if last is not None and measurement is not None:
        facts += [("force-read", *fact) for fact in _readings(measurement, last)]
    under, over = _around(declared, pose, last, behind.room)
    arrows = [(kind, behind.points(line)) for kind, line in read]
    over += tuple(Solid(kind, svg(line, 1)) for kind, line in arrows)
    start, end = (None if behind.room else _point(at) for at in ends)
    return Picture(
        name=pose.name,
        role=pose.role,
        alt=_alt(pose, behind, stages),
        behind=behind,
        box=behind.about([*drawn, *ends, *(line for _, line in arrows)]),
        lines=tuple(line for line in lines if line.points),
        start=start,
        end=end,
        facts=tuple(facts),
        problem=pose.problem,
        notes=pose.messages,
        under=under,
        over=over,
    )


def _around(
    declared: Pose, pose: PoseInput, shape: PoseShape | None, room: Room | None
) -> tuple[tuple[Solid, ...], tuple[Solid, ...]]:
    """What stands in a room behind a cable and in front of it."""
    if room is None:
        return (), ()
    under, over = around(room, declared, pose.points, shape)
    return tuple(map(_drawn, under)), tuple(map(_drawn, over))


def _drawn(mark: Mark) -> Solid:
    return Solid(mark.kind, svg(flat(mark.points), 1), _text(mark.points, 1), mark.label)


def _solid(room: Room | None, points: FloatArray, decimals: int) -> str:
    """Points [m] of the world as they stand in a room; nothing without one."""
    return "" if room is None else _text(room.points(points), decimals)


def _text(points: FloatArray, decimals: int) -> str:
    return " ".join(",".join(f"{x:.{decimals}f}" for x in point) for point in points)


def _newtons(forces: FloatArray) -> str:
    return ", ".join(f"{np.linalg.norm(force):.3g}" for force in forces) + " N"


def _readings(measurement: MeasurementSummary, shape: PoseShape) -> list[tuple[str, str]]:
    """Each reading by its name: how far from the predicted one, in units and in its noise."""
    facts = []
    for name, (known, model) in shape.readings.items():
        kind = name.split("_")[1]
        std, unit = measurement.std_of(kind)
        off = float(np.linalg.norm(known - model))
        size = float(np.linalg.norm(known))
        text = f"{size:.3g} {unit}, off by {off:.2g} {unit}"
        facts.append((name.replace("_", " "), f"{text} ({off / std:.1f} std)"))
    return facts


def _seen(pose: PoseInput) -> str:
    text = counted(len(pose.points), "point")
    return text if pose.coverage is None else f"{text}, {pose.coverage:.0%} of the cable"


def _what(pose: PoseInput, behind: Background) -> str:
    kind = "Photograph" if behind.photograph else "Drawing of the board"
    return f"{'Drawing in space' if behind.room else kind}, pose {pose.name}"


def _alt(pose: PoseInput, behind: Background, stages: Sequence[Compared]) -> str:
    if not len(pose.points):
        return f"{_what(pose, behind)}: no cable was measured."
    _, label, stage = stages[-1] if stages else ("", "", None)
    shape = None if stage is None else stage.shapes.get(pose.name)
    if shape is None or shape.rmse is None:
        return f"{_what(pose, behind)}, with the measured line."
    return (
        f"{_what(pose, behind)}, with the measured line and the predicted ones; "
        f"{label}, they are {millimetres(shape.rmse)} apart."
    )


def svg(points: FloatArray, decimals: int) -> str:
    """Points as SVG has them; nothing where the camera cannot see a point of it."""
    if not np.isfinite(points).all():
        return ""
    return " ".join(f"{u:.{decimals}f},{v:.{decimals}f}" for u, v in points)


def _point(points: FloatArray) -> tuple[float, float] | None:
    """The one point of an array (1, 2), if it is there."""
    if not len(points) or not np.isfinite(points).all():
        return None
    return round(float(points[0, 0]), 1), round(float(points[0, 1]), 1)
