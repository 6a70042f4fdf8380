"""Lines of a moving cable, out of files and videos: marks at arc lengths, compared across."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from dlo_casadi import vision
from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.config import Config
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.io.motions import GAP, MotionPoints, first_jump
from dlo_casadi.session.measure import THREADS, view_of

# From a side and times (T,) to the places (T, d) of its fixture; None if it holds no place.
Place = Callable[[str, FloatArray], FloatArray | None]

# Marks on a line, and means of neighbouring points through which it is interpolated.
MARKS, _MEANS = 20, 40
# Fewest points of a line.
_LEAST = 5
# Distance of neighbouring means, in their usual distance, beyond which a stretch was not seen.
_GAP = 2.5
# Error of a frame's line, over that of the usual frame, from which on it is blurred; and the share
# of the usual frame's coverage below which it is.
_BLURRED, _HIDDEN = 2.5, 0.8
# Least share of the frames that must be read.
_READ = 0.5


def marks_of_lines(
    lines: MotionPoints, place: Place, length: float
) -> tuple[MotionPoints, FloatArray]:
    """Points at even arc lengths of each instant's line, and the directions across it.

    The arc length of a point is that along the line from the start's fixture; between two held ends
    it is stretched to the cable's. An error of it moves a mark along its line alone.

    Returns
    -------
    marks : MotionPoints
        (T, MARKS, d); NaN where the line was not seen.
    across : (T, MARKS, d - 1, d)
        Unit vectors.

    Raises
    ------
    MeasurementError
        If hardly any line has enough points.
    """
    t, d = lines.t, lines.points.shape[2]
    s = (np.arange(MARKS) + 0.5) / MARKS * length
    points, tangents = (np.full((len(t), MARKS, d), np.nan) for _ in range(2))
    start, end = place("start", t), place("end", t)
    for k, row in enumerate(lines.points):
        line = row[np.isfinite(row[:, 0])]
        if len(line) >= _LEAST:
            held = [None if x is None else x[k] for x in (start, end)]
            points[k], tangents[k] = _marks(line, s, length, *held)
    seen = np.isfinite(points[..., 0])
    if seen.any(axis=1).mean() < _READ:
        raise MeasurementError(
            f"a line of {_LEAST} or more points stands at "
            f"{counted(int(seen.any(axis=1).sum()), 'instant')} of {len(t)}.\n"
            "  Try: points in order along the cable, from start to end, for each time"
        )
    return MotionPoints(t, points, s), _across(tangents)


def _marks(
    line: FloatArray,
    s: FloatArray,
    length: float,
    start: FloatArray | None,
    end: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Points and tangents (MARKS, d) of a line (K, d); NaN where it was not seen."""
    count = min(len(line), _MEANS)
    means = [part.mean(axis=0) for part in np.array_split(line, count)]
    spread = np.array([x.var() for x in np.array_split(chord_lengths(line), count)])
    spread = np.minimum(spread, _GAP**2 * np.median(spread))
    ends = [[] if x is None else [x] for x in (start, end)]
    knots = np.array([*ends[0], *means, *ends[1]])
    u = chord_lengths(knots)
    knots, u = knots[np.append(True, np.diff(u) > 0)], np.unique(u)
    # The mean of an arc lies inside of it, by half its variance along the line times its curvature:
    # for a fortieth of a cable that is curved by 3 / L, by 8e-5 L.
    averaged = slice(len(ends[0]), len(ends[0]) + count)
    knots[averaged] -= spread[:, None] / 2 * CubicSpline(u, knots)(u[averaged], 2)
    curve = CubicSpline(u, knots)
    fine = np.linspace(0.0, u[-1], 8 * len(u))
    along = chord_lengths(curve(fine))
    if end is not None:
        along *= length / along[-1]
    at = np.interp(s, along, fine)
    apart = np.diff(u)
    shown = apart < _GAP * max(float(np.median(apart)), length / _MEANS)
    cell = np.clip(np.searchsorted(u, at) - 1, 0, len(apart) - 1)
    seen = shown[cell] & (s <= along[-1])
    points, tangents = curve(at), curve(at, 1)
    points[~seen] = np.nan
    return points, tangents


def _across(tangents: FloatArray) -> FloatArray:
    """Unit vectors (..., d - 1, d) across tangents (..., d)."""
    unit = tangents / np.linalg.norm(tangents, axis=-1, keepdims=True)
    if unit.shape[-1] == 2:
        return np.stack([-unit[..., 1], unit[..., 0]], axis=-1)[..., None, :]
    other = np.eye(3)[np.argmin(np.abs(np.nan_to_num(unit)), axis=-1)]
    first = np.cross(unit, other)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(unit, first)], axis=-2)


def check_lines(marks: MotionPoints, length: float) -> None:
    """Refuse a line that is far from those just before and after it."""
    if jump := first_jump(marks, length, together=True):
        k, _, off = jump
        raise MeasurementError(
            f"the line at {marks.t[k]:g} s is {1e3 * off:.3g} mm away from those just before and "
            "after it.\n  Try: leave it out; the points of a line stand in order from the start"
        )


# ---- videos ------------------------------------------------------------------------------------


def read_video(
    config: Config, file: Path, place: Place, most: int | None = None
) -> tuple[MotionPoints, str]:
    """Lines of a video's frames, and how many frames were left out.

    Each frame is read as a photograph is. Frames in which no line is found are lost; those with an
    error far above the usual one, or with half a line, are blurred. `most`: only about this number
    of frames, evenly spaced.

    Raises
    ------
    MeasurementError
        If the session has no plane that a video shows, or if most frames are lost.
    """
    if config.experiment.measurement.kind != "images" or config.experiment.in_space:
        raise MeasurementError(
            "a video shows a cable before a board, in a plane.\n"
            "  Try: measurement: {kind: images, board: ...}; in space, markers of motion capture"
        )
    times: list[float] = []
    found: list[vision.ExtractedCenterline | MeasurementError] = []
    with ThreadPoolExecutor(THREADS) as threads:
        frames = vision.frames_of(file)
        if most is not None:
            frames = islice(frames, 0, None, max(1, vision.count_of(file) // most))
        # A few at a time: a minute of pictures does not fit into the memory.
        while some := list(islice(frames, 4 * THREADS)):
            t = np.array([t for t, _ in some])
            held = [_rows(place(side, t), len(t)) for side in ("start", "end")]
            images = [image for _, image in some]
            found += threads.map(lambda *x: _line(config, *x), images, *held)
            times += t.tolist()
    lines = [x for x in found if not isinstance(x, MeasurementError)]
    lost = [x for x in found if isinstance(x, MeasurementError)]
    if len(lines) < _READ * len(found):
        raise MeasurementError(f"{len(lost)} of {len(found)} frames are lost: {lost[0].message}")
    usual = float(np.median([np.median(x.std) for x in lines]))
    covered = float(np.median([x.coverage for x in lines]))
    sharp = {
        id(x)
        for x in lines
        if np.median(x.std) < _BLURRED * usual and x.coverage > _HIDDEN * covered
    }
    kept = [(t, x) for t, x in zip(times, found, strict=True) if id(x) in sharp]
    width = max(len(x.points) for x in lines)
    points = np.full((len(kept), width, 2), np.nan)
    for row, (_, line) in zip(points, kept, strict=True):
        assert not isinstance(line, MeasurementError)
        row[: len(line.points)] = line.points
    marks = MotionPoints(np.array([t for t, _ in kept]), points)
    blurred = len(lines) - len(kept)
    note = f"{len(kept)} of {counted(len(found), 'frame')} read"
    if left := [f"{n} {what}" for n, what in ((len(lost), "lost"), (blurred, "blurred")) if n]:
        note += f", {' and '.join(left)} left out"
    return marks, note


def check_gaps(marks: MotionPoints, note: str) -> None:
    """Refuse a video that does not show the cable for too long; `note`: what was left out."""
    seen = marks.t[np.isfinite(marks.points[..., 0]).any(axis=1)]
    gaps = np.diff(seen)
    if len(gaps) and gaps.max() > GAP:
        k = int(gaps.argmax())
        raise MeasurementError(
            f"no frame from {seen[k]:.2f} to {seen[k + 1]:.2f} s could be used, a gap of "
            f"{gaps[k]:.2g} s (at most {GAP:g}); {note}.\n"
            f"  Try: two motions, one video until {seen[k]:.2f} s and one from {seen[k + 1]:.2f} s"
        )


def _rows(places: FloatArray | None, count: int) -> list[tuple[float, ...] | None]:
    if places is None:
        return [None] * count
    return [tuple(row) for row in places.tolist()]


def _line(
    config: Config,
    image: vision.Picture,
    start: tuple[float, ...] | None,
    end: tuple[float, ...] | None,
) -> vision.ExtractedCenterline | MeasurementError:
    """The line in a frame, or why there is none."""
    assert start is not None
    known = vision.KnownCable(start, end, config.cable.diameter, config.cable.length)
    try:
        return vision.extract_centerline(image, view_of(config, image), known)
    except MeasurementError as error:
        return error


def without_jumps(marks: MotionPoints, length: float, note: str) -> tuple[MotionPoints, str]:
    """Marks without frames whose line is far from those just before and after it."""
    points, count = marks.points.copy(), 0
    while jump := first_jump(replace(marks, points=points), length, together=True):
        points[jump[0]] = np.nan
        count += 1
    if count:
        note += f", {counted(count, 'frame')} that jump left out"
    return replace(marks, points=points), note
