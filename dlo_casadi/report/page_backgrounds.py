"""What lies under the lines of a picture: a photograph made smaller, the board, or a room."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dlo_casadi.config import Config
from dlo_casadi.errors import MeasurementError
from dlo_casadi.report.arrows import forces_read
from dlo_casadi.report.room import Room, rooms, seen
from dlo_casadi.session.outcome import PoseInput, Stage
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
class Background:
    """A photograph [px], the board or a room [mm, y down].

    Parameters
    ----------
    whole : (left, top, width, height)
        All there is.
    place : callable or None
        Maps points (K, d) [m] of the world into it; None where the camera was not located.
    photograph : str
        As a data URI; empty for the board.
    room : Room or None
        In which a pose in space stands.
    """

    whole: Box
    place: Place | None
    photograph: str = ""
    room: Room | None = None

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
        """Points (K, d) [m] of the world in the picture; none where it was not located."""
        if self.place is None or not len(points):
            return np.zeros((0, 2))
        return np.asarray(self.place(points))

    def about(self, lines: Sequence[FloatArray]) -> Box:
        """The part of a photograph about all lines, sides in the same ratio; all of a board."""
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
        return (
            round(float(at[0]), 1),
            round(float(at[1]), 1),
            round(share * width, 1),
            round(share * height, 1),
        )


def backgrounds(
    config: Config, poses: Sequence[PoseInput], stages: Sequence[Stage]
) -> list[Background]:
    """What lies under each pose, all boards and rooms on one scale.

    Parameters
    ----------
    stages : sequence of Stage
        Whose predictions a board or a room must hold beside the measured lines.
    """
    if config.experiment.in_space:
        return [in_room(room) for room in rooms(config, poses, stages)]
    files = {pose.name: pose.paths[0] for pose in config.experiment.poses}
    photographed = config.experiment.measurement.kind == "images"
    budget = PHOTOGRAPHS // max(1, len(poses))
    predicted = [shape.curve for stage in stages for shape in stage.shapes.values()]
    read = [forces_read(stage, config.cable.length).values() for stage in stages[-1:]]
    arrows = [line for every in read for own in every for _, line in own]
    measured = [pose.points for pose in poses if len(pose.points)]
    board = _board_box(config, [*measured, *predicted, *arrows])
    found = []
    for pose in poses:
        photograph = photograph_of(files[pose.name], budget) if photographed else None
        if photograph is not None and (pose.to_pixels is not None or not len(pose.points)):
            uri, width, height = photograph
            whole = (-0.5, -0.5, float(width), float(height))
            found.append(Background(whole, pose.to_pixels, uri))
        else:
            found.append(Background(board, _to_millimetres))
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


def _to_millimetres(points: FloatArray) -> FloatArray:
    return np.asarray(points, dtype=float).reshape(-1, 2) * [_MM, -_MM]


def flat(points: FloatArray) -> FloatArray:
    """Points (K, 3) of a room in a picture of it (K, 2), y down."""
    return seen(points) * [1.0, -1.0]


def in_room(room: Room) -> Background:
    """A room as it is seen at first."""
    low, size = -room.window / 2, room.window
    whole = (float(low[0]), float(low[1]), float(size[0]), float(size[1]))
    return Background(whole, lambda points: flat(room.points(points)), room=room)


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
