"""Courses to compare with: least jerk, and the same shaped to leave out one mode."""

from __future__ import annotations

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.planning.course import Course


def least_jerk(course: Course, t: FloatArray) -> FloatArray:
    """Coordinates (N, C) of least jerk between rest and rest: 10 u^3 - 15 u^4 + 6 u^5."""
    return _between(course, t / course.duration)


def shaped(course: Course, t: FloatArray, frequency: float, damping: float) -> FloatArray | None:
    """Coordinates (N, C) of zero-vibration shaping; None if the duration is too short for it.

    Two courses of least jerk, the second half a damped period later, with the weights 1 / (1 + K)
    and K / (1 + K), K = exp(-zeta pi / sqrt(1 - zeta^2)), so that their swings in a mode of natural
    `frequency` [Hz] and damping ratio zeta cancel.

    References
    ----------
    Singer and Seering, J. Dyn. Sys. Meas. Control 112 (1990).
    """
    if damping >= 1:
        return None
    root = np.sqrt(1 - damping**2)
    later, share = 0.5 / (frequency * root), np.exp(-damping * np.pi / root)
    own = course.duration - later
    if own <= 0:
        return None
    first, second = (_between(course, x / own) for x in (t, t - later))
    return np.asarray((first + share * second) / (1 + share))


def _between(course: Course, u: FloatArray) -> FloatArray:
    first, last = course.ends
    u = np.clip(u, 0.0, 1.0)[:, None]
    return np.asarray(first + (last - first) * (10 * u**3 - 15 * u**4 + 6 * u**5))
