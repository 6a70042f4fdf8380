"""Lines and markers as CSV files: points along a cable in metres, from its start to its end."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dlo_casadi.arrays import FloatArray, chord_lengths, length_of
from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.files import write_file
from dlo_casadi.io.tables import Columns, read_table
from dlo_casadi.rod.supports import SAME_PLACE, place_problem

COLUMNS = ["x_m", "y_m", "z_m"]
PLACE = "s_m"
TIME = "t_s"
# Units other than metres in names of columns, and how many make a metre.
_UNITS = {"mm": 1000, "cm": 100, "um": 1_000_000}

_LONGEST = 100.0
"""Length of a centre-line [m] from which on it is not in metres."""


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
        fed: tuple[bool, bool] = (False, False),
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
            twice = s[1:][np.diff(s) <= SAME_PLACE]
            if len(twice):
                raise MeasurementError(f"{place} {twice[0]:g} m stands twice", pose=name)
            for text in filter(None, (place_problem(x, length, fed) for x in s)):
                asked = "arc length from the start, in metres?"
                raise MeasurementError(f"{place} {text}: {asked}", pose=name)
        else:
            step = np.linalg.norm(np.diff(points, axis=0), axis=1)
            points = points[np.concatenate(([True], step > SAME_PLACE))]
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
    fed: tuple[bool, bool] = (False, False),
) -> MeasuredPoints:
    """Read a measured line, or markers at known arc lengths, and put them in order.

    Parameters
    ----------
    path : str or Path
        Table as `read_table` takes it, one point a line [m]. The columns `x_m,y_m` (in space
        `x_m,y_m,z_m`) mean a line in order along the cable; with `s_m` they are markers at these
        arc lengths from the start. Other columns are not read.
    start : (d,) [m]
        Fixture of the cable's start, d = 2 or 3.
    end : (d,) [m], optional
        Fixture of its end.
    length : float [m]
        Of the cable: no marker lies beyond it, unless it is `fed` through its start or its end.

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
    axes = COLUMNS[: len(start)]
    table = read_table(source, _columns(len(axes)), f"a header {','.join(axes)} and points")
    if not table.lines:
        raise MeasurementError("has a header but no points", pose=source.name)
    points = np.column_stack([table[axis] for axis in axes])
    found = MeasuredPoints(points, table[PLACE] if PLACE in table.columns else None)
    return found.in_order(start, end, length, fed, source.name, PLACE)


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


def _columns(dimension: int) -> Columns:
    """Which columns of a file are coordinates, of points with `dimension` axes."""
    axes = COLUMNS[:dimension]
    line, markers = ",".join(axes), ",".join([PLACE, *axes])

    def chosen(names: tuple[str, ...]) -> list[str]:
        wanted = [PLACE, *axes] if PLACE in names else axes
        told = [name for name in names if name in (PLACE, TIME, *COLUMNS)]
        if twice := [name for name in told if told.count(name) > 1]:
            raise ValueError(f"two columns are called {twice[0]}: leave one of them")
        if sorted(told) != sorted(wanted):
            raise ValueError(
                f"the header must be {line} (metres), or {markers} of markers at known arc lengths",
                _meant(names, wanted),
            )
        return wanted

    return chosen


def _meant(names: Sequence[str], wanted: Sequence[str]) -> str:
    """What columns of other names may have been meant to be."""
    if TIME in names:
        return f"; a pose is one instant: keep the rows of one and leave out {TIME}"
    given = set(names) & set(COLUMNS)
    if given >= {*COLUMNS[:2]} and given != {*wanted} - {PLACE}:
        return "; two coordinates belong to a cable in a plane, three to one in space"
    for name in names:
        stem, _, unit = name.partition("_")
        if f"{stem}_m" in wanted and unit in _UNITS:
            return f"; divide {name} by {_UNITS[unit]} and call it {stem}_m"
        if f"{name}_m" in wanted:
            return f"; if {name} is in metres, call it {name}_m"
    return "; write it above the numbers"
