"""The steps of an extraction as pictures that a person can judge."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.vision.search import Workings
from dlo_casadi.vision.view import Array, View
from dlo_casadi.vision.workplane import WorkPlane

Picture = NDArray[np.uint8]

# Blue, green, red.
_BLUE, _ORANGE, _RED = (178, 114, 0), (0, 159, 230), (0, 94, 213)
_GREEN, _GREY = (115, 158, 0), (150, 150, 150)
_SATURATED = 4.0  # contrast that is drawn white, over the cut


def draw_steps(
    image: Picture,
    view: View | None,
    workings: Workings,
    line: Array | None,
    start: ArrayLike,
    end: ArrayLike | None,
    gaps: Sequence[int] = (),
) -> dict[str, Picture]:
    """Draw the steps that were reached.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph, blue, green, red.
    view : View or None
        None where the board was not found; the photograph is then all there is to see.
    workings : Workings
        Filled by `extract_centerline` or `see_cable`, as far as it came.
    line : (K, 2) [px] or None
        What that has found, if anything.
    start, end : (2,) [m]
        The declared fixtures, in the plane of the view.
    gaps : sequence of int
        Indices of the pixels after which a stretch of the line is missing.

    Returns
    -------
    dict of (h, w, 3) uint8
        By the name of the step, in order: 1_workplane, 2_contrast, 3_strands, 4_centerline.
    """
    declared = {"start": start, "end": end}
    fixtures = {name: np.asarray(at, float) for name, at in declared.items() if at is not None}
    pictures: dict[str, Picture] = {}
    plane = workings.plane
    if plane is not None:
        pictures["1_workplane"] = _workplane(plane, fixtures)
    if plane is not None and workings.candidate is not None:
        pictures["2_contrast"] = _contrast(plane, workings.candidate, workings.cut)
        pictures["3_strands"] = _strands(plane, workings)
    pictures["4_centerline"] = image.copy()
    if view is not None:
        _draw_line(pictures["4_centerline"], view, workings, line, gaps)
        for name, at in fixtures.items():
            _mark(pictures["4_centerline"], view.to_pixels(at)[0], name, 0.6 * _size(image))
    return pictures


def encoded(picture: Picture, ending: str) -> bytes:
    """Content of a picture's file, in the format of its ending, such as ".jpg"."""
    return bytes(cv2.imencode(ending, picture)[1])


def _workplane(plane: WorkPlane, fixtures: dict[str, Array]) -> Picture:
    """The rectified picture; what the cable cannot reach, and the markers, are dimmed."""
    picture = plane.image.copy()
    picture[~plane.reachable] //= 3
    for name, at in fixtures.items():
        _mark(picture, plane.to_pixels(at), name, 0.5)
    return picture


def _contrast(plane: WorkPlane, candidate: NDArray[np.float32], cut: float) -> Picture:
    """Contrast in grey; what is above the cut, and within reach, in orange."""
    grey = np.clip(candidate / max(_SATURATED * cut, 1e-6) * 255, 0, 255).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    above = (candidate > cut) & plane.reachable
    picture[above] = (0.4 * picture[above] + 0.6 * np.array(_ORANGE)).astype(np.uint8)
    return picture


def _strands(plane: WorkPlane, workings: Workings) -> Picture:
    """All strands in grey, the chosen ones in blue, numbered from start to end."""
    picture = (plane.image // 3 + 170).astype(np.uint8)
    for line in workings.lines:
        _polyline(picture, plane.to_pixels(line), _GREY, 2)
    for k, line in enumerate(workings.chosen):
        at = plane.to_pixels(line)
        _polyline(picture, at, _BLUE, 2)
        _text(picture, at[len(at) // 2], str(k + 1), _BLUE, 0.5)
    return picture


def _draw_line(
    picture: Picture, view: View, workings: Workings, line: Array | None, gaps: Sequence[int]
) -> None:
    """Markers green, sound stretches blue with arrows from start to end, unsound profiles red."""
    size = _size(picture)
    thick = max(1, round(1.5 * size))
    for marker in view.markers:
        _polyline(picture, np.vstack([marker, marker[:1]]), _GREEN, thick)
    trace = workings.trace
    if trace is not None:
        for at in view.to_pixels(trace.points[~trace.sound & trace.inside]):
            cv2.circle(picture, _pixel(at), thick, _RED, -1, cv2.LINE_AA)
    if line is not None:
        for part in np.split(line, np.array(gaps, dtype=int) + 1):
            _polyline(picture, part, _BLUE, thick)
        _arrows(picture, line, size)


def _size(picture: Picture) -> float:
    """How large to draw: 1 in a picture of 1200 pixels."""
    return max(1.0, max(picture.shape[:2]) / 1200)


def _arrows(picture: Picture, pixels: Array, size: float) -> None:
    """Arrowheads along the line, every eighth of it."""
    for k in np.linspace(0, len(pixels) - 1, 9)[1:-1].astype(int):
        ahead = pixels[min(k + 3, len(pixels) - 1)] - pixels[max(k - 3, 0)]
        step = 9 * size * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        tail, tip = _pixel(pixels[k] - step), _pixel(pixels[k] + step)
        cv2.arrowedLine(picture, tail, tip, _ORANGE, max(2, round(2 * size)), cv2.LINE_AA, 0, 0.7)


def _mark(picture: Picture, at: Array, name: str, size: float) -> None:
    cv2.circle(picture, _pixel(at), round(12 * size), _RED, max(1, round(3 * size)), cv2.LINE_AA)
    _text(picture, at + 16 * size, name, _RED, size)


def _text(picture: Picture, at: Array, text: str, color: tuple[int, int, int], size: float) -> None:
    font, thick = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(2 * size))
    cv2.putText(picture, text, _pixel(at), font, size, (255, 255, 255), 3 * thick, cv2.LINE_AA)
    cv2.putText(picture, text, _pixel(at), font, size, color, thick, cv2.LINE_AA)


def _polyline(picture: Picture, at: Array, color: tuple[int, int, int], thick: int) -> None:
    points = np.round(np.clip(at, -1e5, 1e5)).astype(np.int32)
    cv2.polylines(picture, [points], False, color, thick, cv2.LINE_AA)


def _pixel(at: Array) -> tuple[int, int]:
    u, v = np.clip(at, -1e5, 1e5).round().astype(int)
    return int(u), int(v)
