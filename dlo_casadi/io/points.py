"""Lines and markers as CSV files: points along a cable in metres, from its start to its end."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dlo_casadi.arrays import FloatArray, chord_lengths, length_of
from dlo_casadi.config.problems import show
from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.files import write_file

COLUMNS = ["x_m", "y_m", "z_m"]
PLACE = "s_m"

_LONGEST = 100.0
"""Length of a centre-line [m] from which on it is not in metres."""

_LARGEST = 20_000_000
"""Bytes of a file: half a million points, measured to take two seconds."""

_SAME_POINT = 1e-9
"""Distance [m] below which two points in a row are one."""

_COUNTS = {2: "two", 3: "three", 4: "four"}


@dataclass(frozen=True)
class MeasuredPoints:
    """Points along a cable.

    Parameters
    ----------
    points : (K, d) [m]
        From start to end.
    s : (K,) [m], optional
        Arc lengths of markers.
    count : (K,) or one for all
        Number of measured points averaged into each point.
    """

    points: FloatArray
    s: FloatArray | None = None
    count: FloatArray | float = 1.0

    def in_order(
        self,
        start: Sequence[float],
        end: Sequence[float] | None,
        length: float,
        name: str | None = None,
        place: str = "at",
    ) -> "MeasuredPoints":
        """The points from start to end, as `read_points` returns them.

        Raises MeasurementError if they cannot be a measurement of a cable of that length; the
        message begins with the file's `name` and calls the arc lengths `place`.
        """
        points, s = self.points, self.s
        if s is not None:
            order = np.argsort(s, kind="stable")
            points, s = points[order], s[order]
            twice = s[1:][np.diff(s) <= _SAME_POINT]
            if len(twice):
                raise MeasurementError(f"{place} {twice[0]:g} m stands twice", pose=name)
            outside = s[(s < 0) | (s > length + _SAME_POINT)]
            if len(outside):
                raise MeasurementError(
                    f"{place} {outside[0]:g} m is not between 0 and cable.length {length:g} m: "
                    "arc length from the start, in metres?",
                    pose=name,
                )
        else:
            step = np.linalg.norm(np.diff(points, axis=0), axis=1)
            points = points[np.concatenate(([True], step > _SAME_POINT))]
        if len(points) == 1:
            raise MeasurementError("holds one point only; a pose takes two or more", pose=name)
        along = length_of(points)
        if along > _LONGEST:
            raise MeasurementError(
                f"the centre-line is {along:.4g} m long: are the points in metres? If "
                "they are in millimetres, divide them by 1000",
                pose=name,
            )
        if s is None and _runs_backwards(points, start, end):
            points = points[::-1].copy()
        return MeasuredPoints(points, s)

    def means(self, most: int) -> "MeasuredPoints":
        """Means of the points in at most `most` intervals of equal length.

        White noise averages out; an interval without points has no mean. The mean over an arc of
        length h and curvature k is off by k h^2 / 24: 5 um for a circle of 1 m in 240 parts.
        """
        along, every = self.s, np.arange(len(self.points))
        if along is None:
            # Chords are longer than the noise, which then hardly changes their lengths.
            ends = np.linspace(0, every[-1], min(most, len(every))).astype(int)
            along = np.interp(every, ends, chord_lengths(self.points[ends]))
        share = (along - along[0]) / (along[-1] - along[0])
        stretch = np.minimum(most * share, most - 1).astype(int)
        _, first, count = np.unique(stretch, return_index=True, return_counts=True)
        points = np.add.reduceat(self.points, first) / count[:, None]
        s = None if self.s is None else np.add.reduceat(self.s, first) / count
        return MeasuredPoints(points, s, count.astype(float))


def read_points(
    path: str | Path,
    start: Sequence[float],
    end: Sequence[float] | None = None,
    length: float = math.inf,
) -> MeasuredPoints:
    """Read a measured line, or markers at known arc lengths, and put them in order.

    Parameters
    ----------
    path : str or Path
        CSV file, one point a line [m]. The header `x_m,y_m` (in space `x_m,y_m,z_m`) means a line
        in order along the cable; `s_m,x_m,y_m` (`s_m,x_m,y_m,z_m`) means markers at the arc lengths
        s_m from the start.
    start : (d,) [m]
        Fixture of the cable's start, d = 2 or 3.
    end : (d,) [m], optional
        Fixture of its end.
    length : float [m]
        Of the cable: no marker lies beyond it.

    Returns
    -------
    MeasuredPoints
        From start to end, K >= 2, without repeated points. A line from end to start is reversed:
        the first point is the one nearer to `start`; with `end` given, the order has the smaller
        sum of both distances, which also works for part of a loop.

    Raises
    ------
    MeasurementError
        If the file is not such a measurement; the message names the file and the line.
    """
    source = Path(path)
    header, table = _parse(source, len(start))
    if len(table) == 0:
        raise MeasurementError("has a header but no points", pose=source.name)
    if header[0] == PLACE:
        found = MeasuredPoints(table[:, 1:], table[:, 0])
    else:
        found = MeasuredPoints(table)
    return found.in_order(start, end, length, source.name, PLACE)


def _runs_backwards(
    points: FloatArray, start: Sequence[float], end: Sequence[float] | None
) -> bool:
    first, last = points[0], points[-1]
    forward, backward = math.dist(first, start), math.dist(last, start)
    if end is not None:
        forward += math.dist(last, end)
        backward += math.dist(first, end)
    return backward < forward


def write_points(path: str | Path, points: npt.ArrayLike, s: npt.ArrayLike | None = None) -> None:
    """Write a line, or markers at arc lengths s, as CSV, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file; an older one is replaced only once the new one is complete.
    points : (K, d) [m]
        From start to end, d = 2 or 3.
    s : (K,) [m], optional

    Raises
    ------
    MeasurementError
        If the points have another shape or are not finite.
    OutputError
        If the file cannot be written.
    """
    target = Path(path)
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise MeasurementError(
            f"points of shape {array.shape}; (K, 2) or (K, 3) expected", pose=target.name
        )
    if not np.all(np.isfinite(array)):
        bad = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise MeasurementError(f"point {bad} is {array[bad]}, not finite", pose=target.name)
    header = COLUMNS[: array.shape[1]]
    if s is not None:
        header, array = [PLACE, *header], np.column_stack([np.asarray(s, dtype=float), array])
    write_table(target, header, array)


def write_table(path: Path, header: Sequence[str], rows: FloatArray) -> None:
    """Write numbers (K, columns) under their names as CSV, whole or not at all."""
    lines = [",".join(header), *(",".join(map(repr, row)) for row in rows.tolist())]
    write_file(path, "\n".join(lines) + "\n")


def _parse(source: Path, dimension: int) -> tuple[list[str], FloatArray]:
    """Read header and numbers (K, columns), K >= 0."""
    try:
        with source.open("rb") as file:
            content = file.read(_LARGEST + 1)
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise MeasurementError("is not a text file", pose=source.name) from None
    except OSError as error:
        raise MeasurementError(f"cannot be read: {error.strerror}", pose=source.name) from None
    if len(content) > _LARGEST:
        raise MeasurementError(
            f"is larger than {_LARGEST} bytes; keep every tenth point, a few hundred suffice",
            pose=source.name,
        )
    axes = COLUMNS[:dimension]
    line, markers = ",".join(axes), ",".join([PLACE, *axes])
    header: list[str] = []
    table: list[list[float]] = []
    for number, text in enumerate(lines, start=1):
        try:
            cells = [cell.strip() for cell in next(csv.reader([text]), [])]
            if not any(cells) and len(cells) <= 1:
                continue
            if header:
                table.append(_numbers(cells, header))
            elif cells in (axes, [PLACE, *axes]):
                header = cells
            else:
                raise ValueError(
                    f"the header must be {line} (metres), or {markers} of markers at known arc "
                    f"lengths, found {show(text)}"
                )
        except csv.Error as error:
            wrong = f"line {number}: {error}; one point a line belongs here"
            raise MeasurementError(wrong, pose=source.name) from None
        except ValueError as error:
            raise MeasurementError(f"line {number}: {error}", pose=source.name) from None
    if not header:
        raise MeasurementError(f"is empty; a header {line} and points belong here", source.name)
    return header, np.array(table).reshape(-1, len(header))


def _numbers(cells: list[str], header: list[str]) -> list[float]:
    """Numbers of a line, or a ValueError that says what is wrong with it."""
    if len(cells) != len(header):
        names = ",".join(name.removesuffix("_m") for name in header)
        belongs = f"{_COUNTS[len(header)]} numbers {names} belong here"
        raise ValueError(f"{belongs}, found {len(cells)}: {show(','.join(cells))}")
    values = []
    for cell in cells:
        try:
            values.append(float(cell))
        except ValueError:
            raise ValueError(f"{show(cell)} is not a number") from None
        if not math.isfinite(values[-1]):
            raise ValueError(
                f"{show(cell)} is not a finite number; leave out the points that were not "
                "measured, gaps are allowed"
            )
    return values
