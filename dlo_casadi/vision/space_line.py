"""The line in space that several photographs of one cable give without any model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.agreement import agreeing_fit
from dlo_casadi.vision.board import Board, locate_camera
from dlo_casadi.vision.centerline import SPACING
from dlo_casadi.vision.curve import chord_length
from dlo_casadi.vision.image import spoilt
from dlo_casadi.vision.image_curve import ImageCurve, see_cable
from dlo_casadi.vision.overlaps import measure_shared_outlines
from dlo_casadi.vision.space_curve import CurveFit
from dlo_casadi.vision.view import Array, Camera

# Diameters, of the spline: no cable bends sharper; with half of it the lines in space of rendered
# photographs move by less than a tenth of their std.
_SPAN = 2.0
_SPANS = (20, 100)
_UNKNOWN = 0.05  # unknown part of the length beyond which a message says why
_KNOWN = 0.25  # diameters: standard deviation beyond which a point is left out
_MISSING = 0.1  # of the length: a line that is shorter by more misses a hidden stretch


@dataclass(frozen=True)
class SpaceLine:
    """A line in space, and how well each of its points is known.

    Parameters
    ----------
    points : (K, 3) [m]
        In the board frame, ordered from start to end, evenly spaced.
    std : (K,) [m]
        Largest standard deviation in any direction across the line; where a point lies along it,
        photographs do not tell.
    gaps : tuple of int
        Indices of the points after which a stretch is missing.
    """

    points: Array
    std: Array
    gaps: tuple[int, ...]


@dataclass(frozen=True)
class Views:
    """What the photographs of one pose show.

    Parameters
    ----------
    line : SpaceLine or None
        None where fewer than two photographs agree.
    curves : dict of str to ImageCurve
        What is seen in each usable photograph, by its name, in pixels.
    problems : dict of str to str
        Why a photograph is not used, and what to try.
    messages : tuple of str
        What else a user should know; those on one photograph begin with its name.
    places : dict of str to (K, 3) [m]
        Where the pixels of the curves lie: on the line in space, nan for those that are not of it.
        Without a line it is a guess, at depths from fixture to fixture.
    """

    line: SpaceLine | None
    curves: Mapping[str, ImageCurve]
    problems: Mapping[str, str]
    messages: tuple[str, ...]
    places: Mapping[str, Array]


def measure_views(
    photographs: Mapping[str, NDArray[np.uint8]],
    board: Board,
    camera: Camera,
    *,
    start: ArrayLike,
    end: ArrayLike | None,
    diameter: float,
    length: float,
) -> Views:
    """Measure a cable in photographs from several places: the line in each, and in space.

    Parameters
    ----------
    photographs : dict of str to (H, W, 3) uint8
        Pictures of one pose, blue, green, red, by their names.
    board : Board
        The board that is seen in each.
    camera : Camera
        That took them all.
    start, end : (3,) [m]
        The fixtures in the board frame; `end` is None for a free end.
    diameter, length : scalar [m]
        Of the cable.

    Nothing is raised for a photograph that cannot be used: `problems` names it, and the others
    are used. One photograph alone gives no line.
    """
    problems: dict[str, str] = {}
    curves: dict[str, ImageCurve] = {}
    for name, image in photographs.items():
        try:
            viewpoint = locate_camera(image, board, camera)
            curves[name] = see_cable(
                image, viewpoint, start=start, end=end, diameter=diameter, length=length
            )
        except VisionError as error:
            why = spoilt(image)
            problems[name] = f"{name}: {error.message}{'' if why in error.message else why}"
    fixtures = [np.asarray(at, float) for at in (start, end) if at is not None]
    spans = int(np.clip(length / (_SPAN * diameter), *_SPANS))
    fit = agreeing_fit(curves, problems, fixtures, length, spans)
    line: SpaceLine | None = None
    messages: list[str] = []
    if fit is not None:
        images = [photographs[name] for name in curves]
        fit, seen = measure_shared_outlines(fit, list(curves.values()), images)
        curves = dict(zip(curves, seen, strict=True))
        line, messages = _line_and_messages(fit, fixtures, diameter, length)
    if fit is not None and line is not None:
        places = dict(zip(curves, fit.places, strict=True))
        unknown = 1.0 - _seen(line) / length
        if unknown > _UNKNOWN:
            why = _unsure(curves, photographs, diameter)
            messages.append(f"{100 * unknown:.0f} % of the cable are not known in space: {why}")
    else:
        places = {name: _guessed(curve, fixtures) for name, curve in curves.items()}
    if len(curves) == 1:
        messages.append(
            f"{next(iter(curves))}: one photograph alone gives no line in space: its pixels serve "
            "a fit, which has the depth from the cable's mechanics alone, and errors are those "
            "across the line of sight. Try: a second photograph from another place, 30 to 90 "
            "degrees around the cable."
        )
    of_one = [
        f"{name}: {message}"
        for name, curve in curves.items()
        for message in (*curve.viewpoint.messages, *curve.messages)
    ]
    return Views(line, curves, problems, (*of_one, *messages), places)


def _guessed(curve: ImageCurve, fixtures: list[Array]) -> Array:
    """Places (K, 3) [m] of pixels, if depth went evenly from fixture to fixture along the line."""
    viewpoint = curve.viewpoint
    depths = viewpoint.in_camera(fixtures)[:, 2]
    along = chord_length(curve.pixels)
    depth = np.interp(along / along[-1], np.linspace(0.0, 1.0, len(depths)), depths)
    at = np.column_stack([curve.rays, np.ones(len(depth))]) * depth[:, None]
    return np.asarray((at - viewpoint.translation) @ viewpoint.rotation)


def _line_and_messages(
    fit: CurveFit, fixtures: list[Array], diameter: float, length: float
) -> tuple[SpaceLine | None, list[str]]:
    """Evenly spaced points that are well known, and how they fit the fixtures and the length.

    No line where a stretch of the cable is shown by no photograph.
    """
    away = fit.curve.away_from(fixtures)
    whole = fit.curve.length + float(away.sum())
    missing = 1.0 - whole / length if len(fixtures) == 2 else 0.0
    if missing >= _MISSING:
        return None, [
            f"the photographs show a line in space that is {100 * missing:.0f} % shorter than the "
            "cable: a stretch is hidden in some of them, or pointed to the camera. No line is "
            "given. Try: a photograph from another side; check the length"
        ]
    t = np.linspace(0.0, 1.0, max(2, round(fit.curve.length / SPACING) + 1))
    std = fit.std(t)
    known = np.nonzero(std < _KNOWN * diameter)[0]
    gaps = tuple(int(i) for i in np.nonzero(np.diff(known) > 1)[0])
    line = SpaceLine(fit.curve.position(t[known]), std[known], gaps)
    messages = [
        f"the line in space stops {1e3 * distance:.0f} mm before the {name}"
        for name, distance in zip(("start", "end"), away, strict=False)
        if distance > max(0.03 * length, 0.01)
    ]
    if abs(missing) > 0.03:
        messages.append(
            f"the line in space is {100 * abs(missing):.1f} % "
            f"{'longer' if missing < 0 else 'shorter'} than declared ({whole:.3f} of "
            f"{length:g} m, up to both fixtures): check the length, camera.matrix and marker_size"
        )
    return line, messages


def _seen(line: SpaceLine) -> float:
    """Length [m] of what is known."""
    steps = np.linalg.norm(np.diff(line.points, axis=0), axis=1)
    return float(np.delete(steps, list(line.gaps)).sum())


def _unsure(
    curves: Mapping[str, ImageCurve], photographs: Mapping[str, NDArray[np.uint8]], diameter: float
) -> str:
    """Why a part of the line is not known, and what to try."""
    places = {
        name: float(np.sqrt(np.linalg.eigvalsh(curve.viewpoint.covariance[3:, 3:])[-1]))
        for name, curve in curves.items()
    }
    worst = max(places, key=lambda name: places[name])
    if places[worst] < _KNOWN * diameter:
        return (
            "hidden, or seen along their depth. A third photograph from another side would show "
            "them"
        )
    return (
        f"the markers in {worst} tell where its camera stands to {1e3 * places[worst]:.1f} mm, "
        f"their corners are {curves[worst].viewpoint.reprojection_error:.2f} px RMS off. Try: that "
        f"photograph once more, sharp and not too bright.{spoilt(photographs[worst])}"
    )
