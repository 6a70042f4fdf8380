"""Centre-lines as CSV files: points along a cable in metres, from its start to its end."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dlo_casadi.config.problems import show
from dlo_casadi.durable import write_file
from dlo_casadi.errors import MeasurementError

HEADER = ["x_m", "y_m"]

_LONGEST = 100.0
"""Length of a centre-line [m] from which on it is not in metres."""

_LARGEST = 20_000_000
"""Bytes of a file: half a million points, measured to take two seconds."""

_SAME_POINT = 1e-9
"""Distance [m] below which two points in a row are one."""


def read_centerline(
    path: str | Path,
    start: Sequence[float],
    end: Sequence[float] | None = None,
) -> npt.NDArray[np.float64]:
    """Read a measured centre-line and put it in order.

    Parameters
    ----------
    path : str or Path
        CSV file with the header `x_m,y_m`; one point a line, in order along the cable [m].
    start : (2,) [m]
        Where the start of the cable is held.
    end : (2,) [m], optional
        Where its end is held.

    Returns
    -------
    points : (K, 2) [m]
        From start to end, K >= 2, without repeated points. A file that runs from end to start is
        put right: the first point is the one nearer to `start` (with `end` given, the order with
        the smaller sum of both distances, which also tells the order of a part of a loop).

    Raises
    ------
    MeasurementError
        If the file cannot be read as a centre-line; the message names the file and the line.
    """
    source = Path(path)
    points = _parse(source)
    if len(points) == 0:
        raise MeasurementError("has a header but no points", pose=source.name)

    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.concatenate(([True], step > _SAME_POINT))]
    if len(points) == 1:
        raise MeasurementError(
            "holds one point only; a centre-line takes two or more", pose=source.name
        )
    if step.sum() > _LONGEST:
        raise MeasurementError(
            f"the centre-line is {step.sum():.4g} m long: are the points in metres? If "
            "they are in millimetres, divide them by 1000",
            pose=source.name,
        )
    return points[::-1].copy() if _runs_backwards(points, start, end) else points


def write_centerline(path: str | Path, points: npt.ArrayLike) -> None:
    """Write a centre-line as CSV, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file; an older one is replaced only once the new one is complete.
    points : (K, 2) [m]
        From start to end.

    Raises
    ------
    MeasurementError
        If the points have another shape or are not finite.
    OutputError
        If the file cannot be written.
    """
    target = Path(path)
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] != 2:
        raise MeasurementError(f"points of shape {array.shape}; (K, 2) expected", pose=target.name)
    if not np.all(np.isfinite(array)):
        bad = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise MeasurementError(f"point {bad} is {array[bad]}, not finite", pose=target.name)

    lines = [",".join(HEADER), *(f"{x!r},{y!r}" for x, y in array.tolist())]
    write_file(target, "\n".join(lines) + "\n")


def _parse(source: Path) -> npt.NDArray[np.float64]:
    """Read header and numbers; (K, 2) with K >= 0."""
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

    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            cells = next(csv.reader([line]), [])
        except csv.Error as error:
            raise MeasurementError(
                f"line {number}: {error}; two numbers x,y belong here", pose=source.name
            ) from None
        if any(cell.strip() for cell in cells) or len(cells) > 1:
            rows.append((number, [cell.strip() for cell in cells]))
    if not rows:
        raise MeasurementError("is empty; a header x_m,y_m and points belong here", source.name)
    number, header = rows[0]
    if header != HEADER:
        raise MeasurementError(
            f"line {number}: the header must be x_m,y_m (metres), found {show(lines[number - 1])}",
            pose=source.name,
        )
    return np.array([_point(source, *row) for row in rows[1:]]).reshape(-1, 2)


def _point(source: Path, number: int, cells: list[str]) -> tuple[float, float]:
    if len(cells) != 2:
        raise MeasurementError(
            f"line {number}: two numbers x,y belong here, found {len(cells)}: "
            f"{show(','.join(cells))}",
            pose=source.name,
        )
    values = []
    for cell in cells:
        try:
            values.append(float(cell))
        except ValueError:
            raise MeasurementError(
                f"line {number}: {show(cell)} is not a number", pose=source.name
            ) from None
        if not math.isfinite(values[-1]):
            raise MeasurementError(
                f"line {number}: {show(cell)} is not a finite number; leave out the points that "
                "were not measured, gaps are allowed",
                pose=source.name,
            )
    return values[0], values[1]


def _runs_backwards(
    points: npt.NDArray[np.float64], start: Sequence[float], end: Sequence[float] | None
) -> bool:
    first, last = points[0], points[-1]
    forward, backward = math.dist(first, start), math.dist(last, start)
    if end is not None:
        forward += math.dist(last, end)
        backward += math.dist(first, end)
    return backward < forward
