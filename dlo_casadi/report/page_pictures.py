"""Pictures of the page: every pose with its measured line and the predictions, as drawings.

A picture is a photograph made smaller, or the board of a centre-line, under lines whose
coordinates are those of the photograph [px] or of the board [mm, y down]. The lines stay sharp
at any size and can be hidden one by one.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dlo_casadi.config import Config
from dlo_casadi.errors import MeasurementError
from dlo_casadi.report.canvas import before_after, label_of, millimetres
from dlo_casadi.report.geometry import beside
from dlo_casadi.session.outcome import Outcome, PoseInput, Stage
from dlo_casadi.vision import read_image

FloatArray = NDArray[np.floating]
Box = tuple[float, float, float, float]
Place = Callable[[FloatArray], FloatArray]

# All photographs of a page together [bytes], before they become text, which takes a third more.
PHOTOGRAPHS = 3_000_000
_WIDEST = 1280  # px
_NARROWEST = 320  # px
_QUALITIES = (82, 70, 55)
# Of a part of a photograph about the cable: its sides over those of the cable.
_ROOM = 1.3
_MM = 1e3
_GRID = 100.0  # mm


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
    """

    kind: str
    points: str
    near: str = ""


@dataclass(frozen=True)
class Picture:
    """One pose as the page shows it.

    Parameters
    ----------
    box, whole : (left, top, width, height)
        What is shown at first, the part with the cable; and all there is.
    photograph : str
        As a data URI; empty for a board.
    grid : tuple of (x1, y1, x2, y2)
        Lines of the board, every 100 mm.
    start, end : (u, v) or None
        Where the cable begins and ends: predicted, or declared where nothing was.
    facts : tuple of (kind, name, text)
        The kind is that of the line that a fact is about.
    notes : tuple of str
        What the camera step noticed, or why the pose could not be read.
    """

    name: str
    role: str
    alt: str
    box: Box
    whole: Box
    photograph: str = ""
    grid: tuple[Box, ...] = ()
    lines: tuple[Line, ...] = ()
    start: tuple[float, float] | None = None
    end: tuple[float, float] | None = None
    facts: tuple[tuple[str, str, str], ...] = ()
    problem: str = ""
    notes: tuple[str, ...] = field(default_factory=tuple)


def pictures(outcome: Outcome) -> list[Picture]:
    """A picture of every pose of a run, in the order in which they were taken."""
    predicted = [
        shape.curve
        for stage in before_after(outcome)
        if stage is not None
        for shape in stage.shapes.values()
    ]
    backgrounds = _backgrounds(outcome.config, outcome.poses, predicted)
    return [
        _picture(outcome, pose, *background)
        for pose, background in zip(outcome.poses, backgrounds, strict=True)
    ]


def pictures_of_failure(config: Config, poses: Sequence[PoseInput]) -> list[Picture]:
    """A picture of every pose of a run that has failed, with what was measured until then."""
    declared = {pose.name: pose for pose in config.experiment.poses}
    backgrounds = _backgrounds(config, poses, [])
    drawn = []
    for pose, (box, place, photograph) in zip(poses, backgrounds, strict=True):
        measured = _placed(pose, place)
        found = len(measured) > 0
        held = [declared[pose.name].start, declared[pose.name].end]
        ends = [
            None if at is None or place is None else _point(np.asarray(place(np.array([at])))[0])
            for at in held
        ]
        seen = [measured, np.array([at for at in ends if at is not None]).reshape(-1, 2)]
        drawn.append(
            Picture(
                name=pose.name,
                role=pose.role,
                alt=f"{_what(photograph)}, pose {pose.name}"
                + (", with the measured line." if found else ": no cable was measured."),
                box=_about(box, seen) if photograph else box,
                whole=box,
                photograph=photograph,
                grid=() if photograph else _grid(box),
                lines=(Line("measured", _svg(measured, 2)),) if found else (),
                start=ends[0],
                end=ends[1],
                facts=(("measured", "measured", _seen(pose)),) if found else (),
                problem=pose.problem,
                notes=pose.messages,
            )
        )
    return drawn


def _backgrounds(
    config: Config, poses: Sequence[PoseInput], predicted: Sequence[FloatArray]
) -> list[tuple[Box, Place | None, str]]:
    """Window, map from the board [m] into it and photograph, if there is one, of every pose."""
    files = {pose.name: pose.file for pose in config.experiment.poses}
    photographed = config.experiment.measurement.kind == "images"
    budget = PHOTOGRAPHS // max(1, len(poses))
    board = _board_box(config, [*(pose.points for pose in poses if len(pose.points)), *predicted])
    found: list[tuple[Box, Place | None, str]] = []
    for pose in poses:
        photograph = photograph_of(files[pose.name], budget) if photographed else None
        if photograph is not None and (pose.to_pixels is not None or not len(pose.points)):
            uri, width, height = photograph
            found.append(((-0.5, -0.5, float(width), float(height)), pose.to_pixels, uri))
        else:
            found.append((board, _to_millimetres, ""))
    return found


def photograph_of(path: Path, budget: int) -> tuple[str, int, int] | None:
    """Read a photograph as a small JPEG in a data URI, with its true width and height [px].

    Parameters
    ----------
    budget : int
        Largest size [bytes] of the JPEG; quality goes first, then width.

    None where the file cannot be read (any more).
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
        small = (
            whole if size == whole.size else whole.resize(size, Image.Resampling.LANCZOS, None, 2)
        )
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


def _picture(
    outcome: Outcome,
    pose: PoseInput,
    box: Box,
    place: Place | None,
    photograph: str,
) -> Picture:
    before, after = before_after(outcome)
    std = outcome.measurement.std
    lines, facts = [], []
    measured = _placed(pose, place)
    drawn = [measured]
    ends: list[tuple[float, float] | None] = [None, None]
    for kind, stage in (("before", before), ("after", after)):
        shape = None if stage is None else stage.shapes.get(pose.name)
        if stage is None or shape is None or place is None:
            continue
        curve = np.asarray(place(shape.curve))
        near = ""
        if len(measured):
            near = _svg(np.asarray(place(beside(pose, shape, std))), 2)
        lines.append(Line(kind, _svg(curve, 1), near))
        drawn.append(curve)
        ends = [_point(curve[0]), _point(curve[-1])]
        if shape.rmse is not None:
            facts.append((kind, label_of(stage, outcome), millimetres(shape.rmse)))
        if not shape.stable:
            facts.append((kind, label_of(stage, outcome), "not stable"))
    if len(measured):
        lines.append(Line("measured", _svg(measured, 2)))
        facts.append(("measured", "measured", _seen(pose)))
    elif after is not None and pose.name not in after.shapes:
        facts.append(("after", label_of(after, outcome), "no equilibrium"))
    return Picture(
        name=pose.name,
        role=pose.role,
        alt=_alt(outcome, pose, after, _what(photograph)),
        box=_about(box, drawn) if photograph else box,
        whole=box,
        photograph=photograph,
        grid=() if photograph else _grid(box),
        lines=tuple(lines),
        start=ends[0],
        end=ends[1],
        facts=tuple(facts),
        problem=pose.problem,
        notes=pose.messages,
    )


def _about(whole: Box, lines: Sequence[FloatArray]) -> Box:
    """The part of a photograph about all lines, with its sides in the same ratio."""
    left, top, width, height = whole
    drawn = np.concatenate(lines)
    corner, size = np.array([left, top]), np.array([width, height])
    drawn = np.clip(drawn[np.isfinite(drawn).all(axis=1)], corner, corner + size)
    if not len(drawn):
        return whole
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    share = min(1.0, max(0.25, _ROOM * float(((high - low) / size).max())))
    at = np.clip((low + high - share * size) / 2, corner, corner + (1 - share) * size)
    return (
        round(float(at[0]), 1),
        round(float(at[1]), 1),
        round(share * width, 1),
        round(share * height, 1),
    )


def _placed(pose: PoseInput, place: Place | None) -> FloatArray:
    """The measured points in the picture."""
    if place is None or not len(pose.points):
        return np.zeros((0, 2))
    return np.asarray(place(pose.points))


def _seen(pose: PoseInput) -> str:
    text = f"{len(pose.points)} points"
    return text if pose.coverage is None else f"{text}, {pose.coverage:.0%} of the cable"


def _what(photograph: str) -> str:
    return "Photograph" if photograph else "Drawing of the board"


def _alt(outcome: Outcome, pose: PoseInput, after: Stage | None, what: str) -> str:
    shape = None if after is None else after.shapes.get(pose.name)
    if not len(pose.points):
        return f"{what}, pose {pose.name}: no cable was measured."
    if after is None or shape is None or shape.rmse is None:
        return f"{what}, pose {pose.name}, with the measured line."
    return (
        f"{what}, pose {pose.name}, with the measured line and the predicted ones; "
        f"{label_of(after, outcome)}, they are {millimetres(shape.rmse)} apart."
    )


# ---- the board ---------------------------------------------------------------------------------


def _to_millimetres(points: FloatArray) -> FloatArray:
    return np.asarray(points, dtype=float).reshape(-1, 2) * [_MM, -_MM]


def _board_box(config: Config, lines: Sequence[FloatArray]) -> Box:
    """Window [mm, y down] that holds all lines [m] and all fixtures."""
    held = [
        np.array([point for point in (pose.start, pose.end) if point is not None])
        for pose in config.experiment.poses
    ]
    drawn = _to_millimetres(np.concatenate([*held, *lines]))
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    span = float((high - low).max())
    size = np.maximum(high - low + 0.12 * span, 0.45 * span)
    left, top = (low + high - size) / 2
    return float(left), float(top), float(size[0]), float(size[1])


def _grid(box: Box) -> tuple[Box, ...]:
    left, top, width, height = box
    across = np.arange(np.ceil(left / _GRID), np.floor((left + width) / _GRID) + 1) * _GRID
    down = np.arange(np.ceil(top / _GRID), np.floor((top + height) / _GRID) + 1) * _GRID
    return (
        *((float(x), top, float(x), top + height) for x in across),
        *((left, float(y), left + width, float(y)) for y in down),
    )


def _svg(points: FloatArray, decimals: int) -> str:
    return " ".join(
        f"{u:.{decimals}f},{v:.{decimals}f}" for u, v in points if np.isfinite(u) and np.isfinite(v)
    )


def _point(point: FloatArray) -> tuple[float, float]:
    return round(float(point[0]), 1), round(float(point[1]), 1)
