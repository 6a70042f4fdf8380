"""First guesses of the headings: arcs through both ends, and headings between clamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares

FloatArray = NDArray[np.floating]


def arc_half_angle(chord: float, length: float) -> float:
    """Half the turning of a circular arc: sin(a) / a = chord / length, a in [0, pi].

    Parameters
    ----------
    chord, length : float [m]
        0 <= chord; a chord longer than the arc gives 0.
    """
    ratio = chord / length
    if ratio >= 1.0:
        return 0.0
    if ratio <= 1e-9:
        return float(np.pi)
    return float(brentq(lambda a: np.sinc(a / np.pi) - ratio, 1e-9, np.pi))


def arc_headings(
    places: FloatArray, length: float, start: FloatArray, end: FloatArray, side: int
) -> FloatArray:
    """Headings of the circular arc of the given length through both ends.

    Parameters
    ----------
    places : (k,) [m]
        Arc lengths.
    start, end : (2,) [m]
    side : +1 or -1
        +1 turns counter-clockwise from start to end.

    Returns
    -------
    (k,) [rad]
    """
    chord = end - start
    half = arc_half_angle(float(np.hypot(*chord)), length)
    direction = np.arctan2(chord[1], chord[0])
    return direction + side * half * (2 * places / length - 1)


def clamped_headings(
    places: FloatArray,
    length: float,
    chord: FloatArray | None,
    start_heading: float | None,
    end_heading: float | None,
    bow: float,
) -> FloatArray:
    """Smooth headings that meet the clamps and, as well as they can, the end point.

    phi(s) = a + b s/L + c sin(pi s/L) + d sin(2 pi s/L)

    Parameters
    ----------
    places : (k,) [m]
    chord : (2,) [m] or None
        End minus start; None for a free end.
    start_heading, end_heading : float [rad] or None
        None where the cable may turn.
    bow : float [rad]
        First guess of c; its sign chooses the side of the bow.
    """
    grid = np.linspace(0.0, 1.0, 129)

    def headings(q: FloatArray, u: FloatArray) -> FloatArray:
        return q[0] + q[1] * u + q[2] * np.sin(np.pi * u) + q[3] * np.sin(2 * np.pi * u)

    def residual(q: FloatArray) -> FloatArray:
        phi = headings(q, grid)
        rows = [1e-2 * q[1], 1e-2 * (q[2] - bow), 2e-2 * q[3]]
        if chord is not None:
            mean = np.array([np.cos(phi).mean(), np.sin(phi).mean()])
            rows += list(10 * (mean - chord / length))
        if start_heading is not None:
            rows.append(10 * (phi[0] - start_heading))
        if end_heading is not None:
            rows.append(10 * (phi[-1] - end_heading))
        return np.array(rows)

    direction = 0.0 if chord is None else float(np.arctan2(chord[1], chord[0]))
    first = start_heading if start_heading is not None else direction
    last = end_heading if end_heading is not None else first
    guess = least_squares(residual, np.array([first, last - first, bow, 0.0]), max_nfev=60)
    return headings(guess.x, places / length)
