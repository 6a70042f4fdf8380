"""Align clocks by motion, and find intervals in which nothing moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import find_objects, gaussian_filter1d, label, median_filter, uniform_filter1d
from scipy.signal import correlate
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings.recording import Kind, Recording, Stream

_LEVER = 0.1  # m, distance from a body of the points that show its rotation
_SMOOTH = 0.05  # s, window in which speeds are smoothed before clocks are compared
# Smallest correlation of speeds at which two clocks are aligned. For a gripper and the markers of
# its cable it is above 0.9; for two unrelated recordings of ten moves below 0.4 (simulated).
_ALIKE = 0.6
_WINDOW = 0.4  # s, window in which scatter is compared with the noise
_QUIET = 0.1  # smallest share of the time in which the cable is still
# Ratio of scatter to noise beyond which something moves: RMS over all streams; noise alone changes
# it by a few per cent.
_MOVES = 2.0
_FLOOR = 1.0e-5  # m, smallest noise, below the resolution of files
# Largest ratio of a still interval's scatter to the noise from frame to frame: filters of the
# export raise it to about 10, slow motion to hundreds.
_NEVER = 50.0
_EXACT = 1.0e-7  # m, scatter of positions that are exactly constant, with its rounding
# Share of the time in which a body is exactly constant beyond which it has no noise: a robot's pose
# is constant whenever the cable is still; one that was tracked is if its last value was held.
_NOISELESS = 0.3
_SPIKE = 6.0  # noises from the median of five frames beyond which a frame does not show motion
# Most frames of the time that all streams share: 14 h at 100 Hz; an array of three coordinates for
# each of them has 0.12 GB.
_MOST = 5_000_000
_OUTLIER = 5.0  # median absolute deviations beyond which a frame is left out of a mean


@dataclass(frozen=True)
class Offset:
    """Time by which a clock is ahead of another one."""

    clock: str
    other: str
    seconds: float
    correlation: float
    speed: float
    """[m/s], the greatest of the moving streams."""

    @property
    def told(self) -> str:
        """One sentence on the offset and on whether it matters."""
        if abs(self.seconds) > 1e6:  # one clock counts from 1970
            return f"{self.clock} and {self.other}: different origins of time, aligned by motion"
        moved = 1e3 * abs(self.seconds) * self.speed
        matters = (
            f"it would move the fastest pose by {moved:.0f} mm, still ones not at all"
            if moved >= 1.0
            else "it does not matter at these speeds"
        )
        ahead = "ahead of" if self.seconds > 0 else "behind"
        return (
            f"{self.clock} is {1e3 * abs(self.seconds):.0f} ms {ahead} {self.other} and was moved "
            f"there (speeds correlate by {self.correlation:.2f}); {matters}"
        )


@dataclass(frozen=True)
class Still:
    """An interval in which nothing moves, and the means in it."""

    begin: float  # [s]
    end: float  # [s]
    values: dict[tuple[Kind, str], FloatArray]
    """Mean of each stream that was seen, by kind and name."""
    scatter: float  # [m], standard deviation of a coordinate of a marker or body
    drift: float  # [m], largest distance between the means of its two halves

    @property
    def span(self) -> str:
        """When it was."""
        return f"{self.begin:.2f} to {self.end:.2f} s"

    @property
    def told(self) -> str:
        """Describe how still it was."""
        return (
            f"still from {self.span}: scatter {1e3 * self.scatter:.2f} mm, drift "
            f"{1e3 * self.drift:.2f} mm"
        )


def align_clocks(recording: Recording) -> tuple[Recording, tuple[Offset, ...]]:
    """Shift all clocks to that of the first marker or body, which then begins at zero.

    The offset of two clocks is the lag at which the mean speeds of their markers and bodies
    correlate best, to a fraction of a frame by a parabola through the maximum. A clock without
    moving streams, such as that of a force sensor, is taken to agree with the first one. Raises
    MeasurementError if the motions in two recordings do not match.
    """
    clocks = tuple(dict.fromkeys(s.clock for s in recording.streams if s.moves))
    if not clocks:
        return recording, ()
    moving = [stream for stream in recording.streams if stream.moves]
    dt = _period(moving)
    speeds = [_speed([s for s in moving if s.clock == c], dt) for c in clocks]
    first, reference = speeds[0]
    offsets = []
    for clock, (begin, speed) in zip(clocks[1:], speeds[1:], strict=True):
        v, w = reference - reference.mean(), speed - speed.mean()
        found = correlate(w, v, "full", "fft")
        k = int(np.argmax(found))
        height = float(found[k] / max(np.linalg.norm(v) * np.linalg.norm(w), 1e-300))
        if height < _ALIKE:
            raise MeasurementError(
                f"the clocks of {clocks[0]} and {clock} cannot be aligned: the speeds in them "
                f"correlate by {height:.2f} at best.\n  Try: recordings of the same motions, "
                "from before the first pose until after the last."
            )
        a, b, c = found[max(k - 1, 0)], found[k], found[min(k + 1, len(found) - 1)]
        lag = (k - (len(v) - 1) + 0.5 * (a - c) / min(a - 2 * b + c, -1e-300)) * dt
        fastest = float(max(reference.max(), speed.max()))
        offsets.append(Offset(clock, clocks[0], begin - first + float(lag), height, fastest))
    shift = {item.clock: first + item.seconds for item in offsets}
    moved = tuple(replace(s, t=s.t - shift.get(s.clock, first)) for s in recording.streams)
    clouds = tuple(replace(c, t=c.t - shift.get(c.clock, first)) for c in recording.clouds)
    return replace(recording, streams=moved, clouds=clouds), tuple(offsets)


def find_stills(recording: Recording, hold: float) -> tuple[Still, ...]:
    """Intervals of at least `hold` [s] in which no marker and no body moves.

    The noise of each stream is its scatter in the quietest tenth of the time, in windows of 0.4 s.
    The recording is still where the RMS over all streams of scatter over noise is below 2. The
    slowest steady drift that this detects is 6 noises a second. Raises MeasurementError if nothing
    was seen, or if the recording never stands still.
    """
    shown = [stream for stream in recording.streams if stream.moves]
    tracks = [(t, x, s.kind == "body") for s in shown for t, x in _tracks(s)]
    if not tracks:
        raise MeasurementError(
            "no marker and no body was seen in this recording.\n  Try: label them; clouds take a "
            "recording of the grippers beside them."
        )
    dt = _period(shown)
    grid = _grid(shown, dt)
    width = max(3, round(_WINDOW / dt))
    total, count = np.zeros(len(grid)), np.zeros(len(grid))
    for t, x, of_body in tracks:
        scatter, known = _scatter(t, x, grid, width)
        judged = scatter[known]
        if of_body and (judged < _EXACT).sum() < _NOISELESS * len(judged):
            judged = judged[judged >= _EXACT]
        noise = max(float(np.quantile(judged, _QUIET)) if len(judged) else 0.0, _FLOOR)
        jitter = _jitter(x)
        if jitter > 0.1 * _FLOOR and noise > _NEVER * jitter:
            raise MeasurementError(
                f"this recording never stands still: even its quietest tenth scatters by "
                f"{1e3 * noise:.2g} mm in {_WINDOW:g} s, {noise / jitter:.0f} times its noise.\n"
                "  Try: hold the cable still for two seconds in each pose."
            )
        total[known] += (scatter[known] / noise) ** 2
        count[known] += 1
    quiet = (count >= 0.5 * len(tracks)) & (total < _MOVES**2 * np.maximum(count, 1))
    found = []
    for (run,) in find_objects(label(quiet)[0]):
        inside = grid[run]
        if inside[-1] - inside[0] >= hold:
            found.append(_still(recording.streams, float(inside[0]), float(inside[-1])))
    merged: list[Still] = []
    for still in found:  # a glitch of a second must not split one pose in two
        last = merged[-1] if merged else None
        if last and still.begin - last.end < _WINDOW + hold and _same(last, still):
            merged[-1] = _still(recording.streams, last.begin, still.end)
        else:
            merged.append(still)
    if not merged:
        raise MeasurementError(
            f"no stretch of {hold:g} s or more is still.\n  Try: --hold with less, or hold the "
            "cable longer in each pose."
        )
    return tuple(merged)


def _still(streams: Sequence[Stream], begin: float, end: float) -> Still:
    """Robust means between two times, with their scatter and drift."""
    values: dict[tuple[Kind, str], FloatArray] = {}
    scatters, drifts = [], [0.0]
    for stream in streams:
        seen = np.isfinite(stream.values).all(axis=1)
        if stream.moves or stream.kind == "wrench":
            seen &= (stream.t >= begin) & (stream.t <= end)
        if not seen.any():
            continue
        x = stream.values[seen]
        away = np.linalg.norm(x[:, :3] - np.median(x[:, :3], axis=0), axis=1)
        kept = away <= _OUTLIER * max(float(np.median(away)), 1e-9)
        mean = x[kept].mean(axis=0)
        if stream.kind == "body":
            mean[3:] = Rotation.from_quat(x[kept, 3:]).mean().as_quat()
        values[stream.kind, stream.name] = mean
        if stream.moves:
            scatters.append(x[kept, :3].var(axis=0).mean())
            halves = np.array_split(x[kept, :3], 2)
            if len(halves[1]):
                drifts.append(float(np.linalg.norm(halves[0].mean(0) - halves[1].mean(0))))
    return Still(begin, end, values, float(np.sqrt(np.mean(scatters))), max(drifts))


def _same(one: Still, other: Still) -> bool:
    """Whether two intervals show the same pose, to the noise of a single frame."""
    away = [
        float(np.linalg.norm(one.values[key][:3] - other.values[key][:3]))
        for key in one.values.keys() & other.values.keys()
        if key[0] != "wrench"
    ]
    return bool(away) and max(away) < 3.0 * max(one.scatter, other.scatter, _FLOOR)


def _tracks(stream: Stream) -> list[tuple[FloatArray, FloatArray]]:
    """Times and positions (n, 3) of points that show a stream's motion, while it is seen.

    Spikes of one or two frames, which are no motion, are left out.
    """
    seen = np.isfinite(stream.values).all(axis=1)
    t, x = stream.t[seen], stream.values[seen, :3]
    if len(t) <= 3:
        return []
    points = [x]
    if stream.kind == "body":
        axes = Rotation.from_quat(stream.values[seen, 3:]).as_matrix()
        points += [x + _LEVER * axes[:, :, k] for k in (0, 1)]
    found = []
    for x in points:
        off = np.abs(x - median_filter(x, (5, 1), mode="nearest")).max(axis=1)
        kept = off <= _SPIKE * max(_jitter(x), _FLOOR)
        found.append((t[kept], x[kept]))
    return [(t, x) for t, x in found if len(t) > 3]


def _period(streams: Sequence[Stream]) -> float:
    """Shortest median time [s] between frames of streams that move; readers check their times."""
    return min(float(np.median(np.diff(stream.t))) for stream in streams)


def _grid(streams: Sequence[Stream], dt: float) -> FloatArray:
    """Times [s] every `dt` from the first frame of all streams to the last.

    Raises MeasurementError if they are too many: times that are not on one clock.
    """
    first, last = min(streams, key=lambda s: s.t[0]), max(streams, key=lambda s: s.t[-1])
    begin, end = float(first.t[0]), float(last.t[-1])
    if end - begin > _MOST * dt:
        raise MeasurementError(
            f"times run from {begin:.2f} s ({first.name} in {first.file}) to {end:.2f} s "
            f"({last.name} in {last.file}): {(end - begin) / dt:.1e} frames every {dt:.3g} s are "
            f"more than {_MOST:.0e}.\n  Try: time stamps of one clock in all topics of a bag; a "
            "shorter recording."
        )
    return np.arange(begin, end + 0.5 * dt, dt)


def _speed(streams: Sequence[Stream], dt: float) -> tuple[float, FloatArray]:
    """First time [s], and RMS speed [m/s] every `dt` of all moving streams on one clock."""
    tracks = [track for stream in streams for track in _tracks(stream)]
    if not tracks:
        raise MeasurementError(
            f"nothing was seen in {streams[0].clock}: all its values are NaN.\n  Try: label "
            "markers and bodies, solve, and export again."
        )
    grid = _grid(streams, dt)
    squares = np.zeros(len(grid))
    for t, x in tracks:
        path = np.column_stack([np.interp(grid, t, column) for column in x.T])
        path = gaussian_filter1d(path, _SMOOTH / dt, axis=0, mode="nearest")
        squares += (np.gradient(path, dt, axis=0) ** 2).sum(axis=1)
    return float(grid[0]), np.sqrt(squares / len(tracks))


def _scatter(
    t: FloatArray, x: FloatArray, grid: FloatArray, width: int
) -> tuple[FloatArray, BoolArray]:
    """Standard deviation of a coordinate in windows about each time, and whether it is known."""
    path = np.column_stack([np.interp(grid, t, column) for column in x.T]) - x.mean(axis=0)
    mean = uniform_filter1d(path, width, axis=0, mode="nearest")
    square = uniform_filter1d(path**2, width, axis=0, mode="nearest") - mean**2
    gap = np.diff(grid[:2])[0] * width
    after = np.searchsorted(t, grid).clip(1, len(t) - 1)
    known = (grid >= t[0]) & (grid <= t[-1]) & (t[after] - t[after - 1] <= gap)
    return np.sqrt(np.maximum(square.mean(axis=1), 0.0)), known


def _jitter(x: FloatArray) -> float:
    """Noise [m] of a coordinate from frame to frame; smooth motion hardly affects it.

    The median absolute second difference of white noise is 0.6745 sqrt(6) times its std.
    """
    second = x[2:] - 2.0 * x[1:-1] + x[:-2]
    return float(np.median(np.abs(second))) / (0.6745 * 6.0**0.5)
