"""First guesses of the headings: arcs through both ends, bent into the clamps.

The generated solver holds the same formulas (codegen/templates/guesses.c.in), number for number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]

# Joints of a first guess stay within this: 0.9 of the bound of an equilibrium's joints [rad].
LARGEST_BEND = 0.9 * np.pi / 2
# Least squares of half_angle / sqrt(1 - ratio), squared, in powers of 1 - ratio; to 2e-4 rad.
_HALF_ANGLE = (
    *(5.9998487866413575, 1.818549938733748, 0.45541329964829563, 3.159529741805951),
    *(-9.268767992481754, 17.431184753381647, -15.583929636428092, 5.856747675543661),
)
# A clamp's turning decays as (1 - s/L)^5 from it. Of 1200 random problems with clamps, the lowest
# equilibrium was missed in 9, 2, 0, 0, 1 with the power 3, 4, 5, 6, 8; high ones seldom converge.
_DECAY = 5


def wrapped(angle: float) -> float:
    """The angle within [-pi, pi)."""
    return float(angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi)))


def arc_half_angle(chord: float, length: float) -> float:
    """Half the turning of a circular arc: sin(a) / a = chord / length, a in [0, pi].

    By a polynomial, to 2e-4 rad.

    Parameters
    ----------
    chord, length : float [m]
        0 <= chord; a chord longer than the arc gives 0.
    """
    y = max(1.0 - chord / length, 0.0)
    total = 0.0
    for coefficient in _HALF_ANGLE[::-1]:
        total = coefficient + y * total
    return float(np.sqrt(y * total))


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


def arc_into_clamps(
    u: FloatArray, chord: FloatArray, clamps: tuple[float | None, float | None], side: int
) -> tuple[FloatArray, FloatArray, float]:
    """Headings of the arc through both ends that bends into the headings of the clamps.

        phi(u) = arc(u) + t + (1 - u)^5 (first - arc(0) - t) + u^5 (last - arc(1) - t),  t = 2 pi k

    Headings are continuous along the cable, so that whole turns k of the arc count.

    Parameters
    ----------
    u : (k,)
        Arc length over length.
    chord : (2,)
        End minus start, over length.
    clamps : float [rad] or None, each
        First and last heading; None where the cable may turn, not both.
    side : +1 or -1

    Returns
    -------
    (k,) [rad]
        With the k that bends the cable least at its clamps.
    (k,) [rad]
        With the next k, that bends it the other way.
    float [rad]
        How far the first bends it, in the mean over the clamps, at most pi.
    """
    arc = arc_headings(np.concatenate([[0.0], u, [1.0]]), 1.0, np.zeros(2), chord, side)
    excess = [
        None if held is None else held - own
        for held, own in zip(clamps, (arc[0], arc[-1]), strict=True)
    ]
    held = [angle for angle in excess if angle is not None]
    mean = sum(held) / len(held)
    turns = np.floor(mean / (2 * np.pi) + 0.5)
    rest = mean - 2 * np.pi * turns

    def bent(shift: float) -> FloatArray:
        phi = arc[1:-1] + shift
        for angle, from_clamp in zip(excess, (u, 1 - u), strict=True):
            if angle is not None:
                phi = phi + (angle - shift) * (1 - from_clamp) ** _DECAY
        return phi

    other = turns + 1 if rest > 0 else turns - 1
    return bent(2 * np.pi * turns), bent(2 * np.pi * other), abs(rest)


def limited(phi: FloatArray) -> FloatArray:
    """Headings (k,) whose bends are cut at LARGEST_BEND; the first heading stays."""
    bends = np.clip(np.diff(phi), -LARGEST_BEND, LARGEST_BEND)
    return phi[0] + np.concatenate([[0.0], np.cumsum(bends)])
