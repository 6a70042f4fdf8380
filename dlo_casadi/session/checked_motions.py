"""Recordings of the moving cable for `dlo check`: read, and asked what they can show.

Frequencies are those of the declared cable, straight at rest: EI is a first guess, but half of what
holds a hanging cable is its weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlo_casadi import vision
from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Config, Motion
from dlo_casadi.errors import ConfigError, DloError, MeasurementError
from dlo_casadi.estimation.motion_fit import moving_model
from dlo_casadi.estimation.motion_start import frequencies_at_first
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.session.fitting import declared_model
from dlo_casadi.session.motions import check_known, read_motion

# Frames of a video that are read.
_FRAMES = 12
# Modes whose frequencies are told, and pictures that a period takes at least.
_MODES, _PICTURES = 3, 4
# Lag [s] between a fixture and the marker beside it, correlation and speed [lengths/s] from which
# on it is told; steps between lags [s], and their largest.
_LAG, _ALIKE, _FAST = 0.05, 0.9, 0.1
_LAGS = np.arange(-0.5, 0.505, 0.01)
# Share of the points that are seen at least.
_SEEN = 0.5


@dataclass(frozen=True)
class CheckedMotion:
    """What a recording holds.

    Parameters
    ----------
    instants, points : int
        Number of times, and of points at each.
    duration : float [s]
    rate : float [1/s]
        Pictures a second.
    seen : float
        Share of the points that were seen.
    frequencies : tuple of float [Hz]
        Of the declared cable between the first fixtures.
    problem : str
        Why it cannot be read; empty if it can.
    warnings : tuple of str
        What it will not show.
    """

    name: str
    role: str
    instants: int | None = None
    points: int | None = None
    duration: float | None = None
    rate: float | None = None
    seen: float | None = None
    frequencies: tuple[float, ...] = ()
    problem: str | None = None
    warnings: tuple[str, ...] = ()


def check_motions(config: Config) -> tuple[CheckedMotion, ...]:
    """Read each motion of a session, a video in some of its frames, and judge it."""
    found = []
    for motion in config.experiment.motions:
        try:
            check_known(config)
            found.append(_checked(config, motion, read_motion(config, motion, _FRAMES)))
        except (MeasurementError, ConfigError) as error:
            problem = error.message.removeprefix(f"{motion.shown_by}: ")
            found.append(CheckedMotion(motion.name, motion.role, problem=problem))
    return tuple(found)


def _checked(config: Config, motion: Motion, read: MeasuredMotion) -> CheckedMotion:
    rate = 1 / float(np.median(np.diff(read.t)))
    if motion.file is not None and motion.file.suffix.lower() in vision.VIDEO_ENDINGS:
        rate = vision.rate_of(motion.file)
    frequencies = _frequencies(config, read)
    seen = float(np.isfinite(read.points[..., 0]).mean())
    duration = float(read.t[-1])
    warnings = [*_of_rate(rate, duration, frequencies), *_of_clocks(config, read)]
    if seen < _SEEN:
        warnings.append(f"only {100 * seen:.0f} % of its points were seen")
    if read.note:
        warnings.append(read.note)
    return CheckedMotion(
        read.name,
        motion.role,
        len(read.t),
        len(read.s),
        duration,
        rate,
        seen,
        frequencies,
        warnings=tuple(warnings),
    )


def _frequencies(config: Config, read: MeasuredMotion) -> tuple[float, ...]:
    """Lowest frequencies [Hz] of the declared cable; none if it finds no rest."""
    try:
        found = frequencies_at_first(moving_model(declared_model(config).model), read, _MODES)
    except DloError:
        return ()
    return tuple(found.tolist())


def _of_rate(rate: float, duration: float, frequencies: tuple[float, ...]) -> list[str]:
    """Whether a recording is quick and long enough for the declared cable."""
    if len(frequencies) < 2:
        return []
    said = ", ".join(f"{x:.2g}" for x in frequencies)
    about = f"the declared cable swings at about {said} Hz"
    told = []
    if (seen := sum(rate > _PICTURES * x for x in frequencies)) < 2:
        least = _PICTURES * frequencies[1]
        what = "none of these" if seen == 0 else "the first one alone"
        told.append(
            f"{about}; {rate:.3g} pictures a second show {what}. Try: {least:.0f} a second or more"
        )
    if duration * frequencies[0] < 1:
        told.append(
            f"{about}; {duration:.2g} s are less than a period: damping hardly shows. Try: record "
            f"{2 / frequencies[0]:.1f} s or more"
        )
    return told


def _of_clocks(config: Config, read: MeasuredMotion) -> list[str]:
    """Whether the marker next to a fixture moves when the fixture does."""
    told = []
    for side, k in (("start", int(np.argmin(read.s))), ("end", int(np.argmax(read.s)))):
        if side not in read.moving:
            continue
        rows = read.moving[side]
        t = np.arange(0.0, read.t[-1], 0.01)
        fixture = np.stack([np.interp(t, read.fixtures_t, row) for row in rows.T], axis=1)
        known = np.isfinite(read.points[:, k, 0])
        if known.sum() < len(read.t) // 2 or len(t) < 20:
            continue
        marker = np.stack(
            [np.interp(t, read.t[known], row) for row in read.points[known, k].T], axis=1
        )
        speed = np.linalg.norm(np.diff(fixture, axis=0), axis=1) / 0.01
        if speed.max() < _FAST * config.cable.length:
            continue
        lag, alike, at_zero = _lag(fixture, marker)
        if abs(lag) > _LAG and alike > _ALIKE and alike > at_zero + 0.05:
            told.append(
                f"the point at {read.s[k]:.3g} m moves as the {side} does, but {abs(lag):.2f} s "
                f"{'later' if lag > 0 else 'earlier'}: have both files the same zero of time?"
            )
    return told


def _lag(fixture: FloatArray, marker: FloatArray) -> tuple[float, float, float]:
    """Lag [s] of the second behind the first at which their velocities are most alike.

    Also the correlation there, and that without a lag.
    """
    a, b = (np.gradient(x, axis=0) for x in (fixture, marker))
    found = []
    for lag in _LAGS:
        n = round(lag / 0.01)
        first, second = (a[: len(a) - n], b[n:]) if n >= 0 else (a[-n:], b[:n])
        size = np.linalg.norm(first) * np.linalg.norm(second)
        found.append(float((first * second).sum() / size) if size > 0 else 0.0)
    best = int(np.argmax(found))
    return float(_LAGS[best]), found[best], found[len(_LAGS) // 2]
