"""Recordings of a moving cable, and of its fixtures, as CSV files.

t_s,s_m,x_m,y_m[,z_m]        markers: a row for each marker and time; those not seen are left out
t_s,x_m,y_m[,z_m]            lines: the points of one time in order along the cable
t_s,start_x_m,start_y_m[,start_z_m][,start_heading_rad | start_qx,...,start_qw][, ... end_...]
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.io.points import COLUMNS, PLACE, TIME
from dlo_casadi.io.tables import Table, read_table

GAP = 0.5
"""Longest time [s] without a point: whoever looks away for longer made two recordings."""

_SLOWEST = 0.5
"""Median step of time [s] from which on it is in milliseconds: nobody samples a swing so slowly."""

_LEAST = 10
"""Fewest instants of a recording."""

_FIRST, _ALONE = 3, 0.75
"""Errors of cubics in which the release of a cable shows; the share of one that markers beside it
do not have, if it is that of one marker: 1, or more if two exchange their labels."""

_DEGREES = 30.0
"""Largest heading [rad]: nearly five turns; 30 degrees are no rare angle."""


@dataclass(frozen=True)
class MotionPoints:
    """Points of a moving cable.

    Parameters
    ----------
    t : (T,) [s]
        Growing.
    points : (T, K, d) [m]
        NaN where a marker was not seen; of lines, behind their last points.
    s : (K,) [m], optional
        Arc lengths of markers, growing.
    """

    t: FloatArray
    points: FloatArray
    s: FloatArray | None = None

    @property
    def seen(self) -> IntArray:
        """Number (T,) of points of each instant."""
        return np.isfinite(self.points[..., 0]).sum(axis=1)


@dataclass(frozen=True)
class FixtureTrack:
    """How fixtures moved.

    Parameters
    ----------
    t : (T,) [s]
        Growing.
    values : dict
        By the names of a pose's fields, those that moved: start, end (T, d) [m], start_heading,
        end_heading (T,) [rad], start_orientation, end_orientation (T, 4).
    """

    t: FloatArray
    values: dict[str, FloatArray]


# ---- points ------------------------------------------------------------------------------------


def read_motion(path: str | Path, dimension: int, length: float) -> MotionPoints:
    """Read the points of a moving cable.

    Parameters
    ----------
    path : str or Path
        Table as `read_table` takes it.
    dimension : int
        2 or 3: the number of coordinates.
    length : float [m]
        Of the cable: no marker lies beyond it.

    Raises
    ------
    MeasurementError
        If the file is no such recording; the message names the file and the line.
    """
    source, axes = Path(path), COLUMNS[:dimension]
    line, markers = ",".join([TIME, *axes]), ",".join([TIME, PLACE, *axes])

    def chosen(names: tuple[str, ...]) -> list[str]:
        wanted = [TIME, *([PLACE] if PLACE in names else []), *axes]
        told = [name for name in names if name in (PLACE, TIME, *COLUMNS)]
        if sorted(told) != sorted(wanted):
            raise ValueError(
                f"the header must be {markers} of markers, or {line} of lines "
                "(seconds, metres)" + _meant(names, told, wanted)
            )
        return wanted

    table = read_table(source, chosen, f"a header {markers} and points")
    try:
        s = table[PLACE] if PLACE in table.columns else None
        points = np.column_stack([table[axis] for axis in axes])
        return motion_points(table[TIME], points, s, length, table.lines)
    except MeasurementError as error:
        raise MeasurementError(error.message, pose=source.name) from None


def _meant(names: Sequence[str], told: Sequence[str], wanted: Sequence[str]) -> str:
    if twice := [name for name in told if told.count(name) > 1]:
        return f"; two columns are called {twice[0]}: leave one of them"
    if TIME not in names:
        other = [name for name in names if name.partition("_")[0] in ("t", "time")]
        meant = f"; {other[0]} in seconds is called {TIME}" if other else ""
        return meant or f"; {TIME} is missing, the time of each row"
    return f"; found {','.join(told)}" if set(told) != set(wanted) else ""


def motion_points(
    t: FloatArray,
    points: FloatArray,
    s: FloatArray | None,
    length: float,
    lines: Sequence[int] | None = None,
) -> MotionPoints:
    """Sort the rows of a recording by instant and marker, and check them.

    Parameters
    ----------
    t : (M,) [s]
    points : (M, d) [m]
    s : (M,) [m], optional
    length : float [m]
    lines : (M,), optional
        Where the rows stand, for messages; by default they are counted.

    Raises
    ------
    MeasurementError
        If times do not grow, are too far apart or too few, if a marker stands twice at one time or
        beyond the cable, or if one jumps.
    """
    where = _Where(lines)
    _check_times(t, where)
    times, instant = np.unique(t, return_inverse=True)
    if len(times) < _LEAST:
        raise MeasurementError(
            f"holds {counted(len(times), 'instant')}; a motion takes {_LEAST} or more"
        )
    if s is None:
        first = np.searchsorted(instant, np.arange(len(times)))
        column, places = np.arange(len(t)) - first[instant], None
    else:
        outside = np.flatnonzero((s < 0) | (s > length * (1 + 1e-9)))
        if len(outside):
            at = outside[0]
            raise MeasurementError(
                f"{where(at)}: {PLACE} {s[at]:g} m is not between 0 and cable.length {length:g} m: "
                "arc length from the start, in metres?"
            )
        places, column = np.unique(s, return_inverse=True)
        cells = instant * len(places) + column
        order = np.argsort(cells, kind="stable")
        twice = order[1:][np.diff(cells[order]) == 0]
        if len(twice):
            at = twice[0]
            raise MeasurementError(
                f"{where(at)}: the marker at {s[at]:g} m stands twice at {t[at]:g} s.\n"
                "  Try: one row for each marker and time"
            )
    filled = np.full((len(times), column.max() + 1, points.shape[1]), np.nan)
    filled[instant, column] = points
    found = MotionPoints(times, filled, places)
    if places is not None and (jump := first_jump(found, length)):
        k, j, off = jump
        at = np.flatnonzero((instant == k) & (column == j))[0]
        raise MeasurementError(
            f"{where(at)}: the marker at {places[j]:g} m is {1e3 * off:.3g} mm away from where it "
            f"was just before and after {times[k]:g} s: a wrong label?\n"
            "  Try: leave its rows out there; a marker need not be seen all the time"
        )
    return found


@dataclass(frozen=True)
class _Where:
    """Words for the place of a row."""

    lines: Sequence[int] | None

    def __call__(self, row: int) -> str:
        return f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"


def _check_growing(t: FloatArray, where: _Where) -> None:
    """Refuse times that go backwards."""
    back = np.flatnonzero(np.diff(t) < 0)
    if len(back):
        k = back[0] + 1
        raise MeasurementError(
            f"{where(k)}: {TIME} {t[k]:g} follows {t[k - 1]:g}: times grow from row to row.\n"
            "  Try: sort the rows by time; two recordings are two motions"
        )


def _check_times(t: FloatArray, where: _Where) -> None:
    """Refuse times of points that go backwards, are not in seconds, or leave a gap."""
    _check_growing(t, where)
    steps = np.diff(t)
    apart = steps[steps > 0]
    usual = float(np.median(apart)) if len(apart) else 0.0
    if usual > _SLOWEST:
        raise MeasurementError(
            f"{TIME} has steps of {usual:g} s: in milliseconds? Then divide it by 1000; a motion "
            f"is recorded more often than every {_SLOWEST:g} s"
        )
    gaps = np.flatnonzero(steps > GAP)
    if len(gaps):
        k = gaps[0] + 1
        raise MeasurementError(
            f"{where(k)}: nothing was seen between {t[k - 1]:g} and {t[k]:g} s, a gap of "
            f"{t[k] - t[k - 1]:.2g} s (at most {GAP:g}).\n"
            "  Try: two motions, one before the gap and one after it"
        )


def first_jump(
    motion: MotionPoints, length: float, *, together: bool = False
) -> tuple[int, int, float] | None:
    """Instant, marker and distance [m] of the first point that jumps; None if none does.

    A point is compared with the cubic polynomial through two points before and two after it, whose
    error in a smooth motion is x'''' dt^4 / 6 and alike at neighbouring instants; a jump is six
    times what these show at the median, and a hundredth of the cable's length. A cable let go is
    not smooth in its first instants, but along itself: there a jump is not that of the markers
    beside it, either, unless all points of an instant may jump `together`.
    """
    found: list[tuple[int, int, float]] = []
    errors = _errors_of_cubics(motion)
    for j, error in enumerate(np.moveaxis(errors, 1, 0)):
        k = np.flatnonzero(np.isfinite(error[:, 0]))
        if not len(k):
            continue
        off, count = np.linalg.norm(error[k], axis=1), len(k)
        padded = np.pad(off, 9, mode="reflect" if count > 9 else "edge")
        # Beside a jump at one instant the two before and after it are off as well.
        beside = [padded[9 + lag : 9 + lag + count] for lag in range(-9, 10) if abs(lag) > 2]
        large = (off > 6 * np.median(beside, axis=0)) & (off > 0.01 * length)
        if not together:
            along = error[k[:_FIRST]] - _beside(errors[k[:_FIRST]], j)
            large[:_FIRST] &= np.linalg.norm(along, axis=1) > _ALONE * off[:_FIRST]
        if large.any():
            first = int(large.argmax())
            best = first + int(off[first : first + 3].argmax())
            found.append((int(k[best]), j, float(off[best])))
    return min(found, default=None)


def _errors_of_cubics(motion: MotionPoints) -> FloatArray:
    """Points (T, K, d) less cubics through the two before and the two after them; else NaN."""
    errors = np.full_like(motion.points, np.nan)
    for j in range(motion.points.shape[1]):
        k = np.flatnonzero(np.isfinite(motion.points[:, j, 0]))
        if len(k) < _LEAST:
            continue
        t, x = motion.t[k], motion.points[k, j]
        count = len(k) - 4
        others = [t[lag : lag + count] for lag in (0, 1, 3, 4)]
        through = np.zeros((count, x.shape[1]))
        for i, lag in enumerate((0, 1, 3, 4)):
            weight = np.ones(count)
            for other in (*others[:i], *others[i + 1 :]):
                weight *= (t[2:-2] - other) / (others[i] - other)
            through += weight[:, None] * x[lag : lag + count]
        errors[k[2:-2], j] = x[2:-2] - through
    return errors


def _beside(errors: FloatArray, j: int) -> FloatArray:
    """Mean (T, d) of the errors (T, K, d) of the markers next to marker j; 0 where none is seen."""
    sides = np.delete(errors[:, max(j - 1, 0) : j + 2], min(j, 1), axis=1)
    seen = np.isfinite(sides[..., :1])
    total = np.where(seen, sides, 0.0).sum(axis=1)
    return np.asarray(total / np.maximum(seen.sum(axis=1), 1))


# ---- fixtures ----------------------------------------------------------------------------------


def read_fixtures(path: str | Path, dimension: int) -> FixtureTrack:
    """Read how fixtures moved; raises MeasurementError with file and line."""
    source, axes = Path(path), COLUMNS[:dimension]
    turned = ["heading_rad"] if dimension == 2 else ["qx", "qy", "qz", "qw"]
    fields = {
        f"{side}{field}": [f"{side}_{name}" for name in names]
        for side in ("start", "end")
        for field, names in (("", axes), ("_heading" if dimension == 2 else "_orientation", turned))
    }
    all_names = {name for names in fields.values() for name in names}

    def chosen(names: tuple[str, ...]) -> list[str]:
        whole = [each for each in fields.values() if set(each) & set(names)]
        wanted = [TIME, *(name for each in whole for name in each)]
        if TIME not in names or not whole or set(wanted) - set(names):
            missing = sorted(set(wanted) - set(names)) or sorted(all_names)
            raise ValueError(
                f"the header must be {TIME} and some of "
                + ", ".join(",".join(each) for each in fields.values())
                + f" (seconds, metres, rad); missing: {', '.join(missing)}"
            )
        return wanted

    table = read_table(source, chosen, f"a header {TIME},{','.join(fields['start'])} and numbers")
    values = {
        field: table[names[0]] if field.endswith("heading") else _stacked(table, names)
        for field, names in fields.items()
        if names[0] in table.columns
    }
    try:
        return fixture_track(table[TIME], values, table.lines)
    except MeasurementError as error:
        raise MeasurementError(error.message, pose=source.name) from None


def _stacked(table: Table, names: Sequence[str]) -> FloatArray:
    return np.column_stack([table[name] for name in names])


def fixture_track(
    t: FloatArray, values: dict[str, FloatArray], lines: Sequence[int] | None = None
) -> FixtureTrack:
    """Check how fixtures moved; raises MeasurementError as `read_fixtures` does."""
    where = _Where(lines)
    _check_growing(t, where)
    same = np.flatnonzero(np.diff(t) == 0)
    if len(same):
        raise MeasurementError(f"{where(same[0] + 1)}: {TIME} {t[same[0]]:g} stands twice")
    if len(t) < 2:
        raise MeasurementError("holds one instant; fixtures that rest need no file")
    for field, x in values.items():
        if field.endswith("_heading") and np.abs(x).max() > _DEGREES:
            k = int(np.abs(x).argmax())
            raise MeasurementError(
                f"{where(k)}: {field}_rad is {x[k]:g} rad: in degrees? then {np.deg2rad(x[k]):.4g}"
            )
        if field.endswith("_orientation"):
            size = np.linalg.norm(x, axis=1)
            k = int(np.abs(size - 1).argmax())
            if abs(size[k] - 1) > 2e-3:
                raise MeasurementError(
                    f"{where(k)}: the quaternion of {field.partition('_')[0]} has the length "
                    f"{size[k]:.4g}; a unit quaternion qx, qy, qz, qw belongs here"
                )
    return FixtureTrack(t, values)
