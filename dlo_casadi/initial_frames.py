"""First guesses of the frames of a cable in space: arcs through both ends, bent into the clamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.initial import arc_half_angle

FloatArray = NDArray[np.floating]

# A clamp's turning decays as (1 - s/L)^5 from it, as in a plane.
_DECAY = 5


def parallel_frames(tangents: FloatArray, first: Rotation) -> Rotation:
    """Frames along unit tangents (k, 3) that do not turn about them, from the given first one.

    The first frame is turned by the smallest rotation into the first tangent.
    """
    frame = smallest_turn(first.apply([1.0, 0.0, 0.0]), tangents[0]) * first
    out = [frame]
    for before, after in zip(tangents[:-1], tangents[1:], strict=True):
        frame = smallest_turn(before, after) * frame
        out.append(frame)
    return Rotation.concatenate(out)


def smallest_turn(a: FloatArray, b: FloatArray) -> Rotation:
    """Smallest rotation of the unit vector a into b."""
    axis = np.cross(a, b)
    cosine = float(a @ b)
    if cosine < -1 + 1e-12:
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis))
    return Rotation.from_quat(np.append(axis, 1 + cosine))


def roll_between(a: Rotation, b: Rotation) -> float:
    """Angle [rad], within (-pi, pi], by which b is turned about a's x axis; x axes agree."""
    x, _, _, w = (a.inv() * b).as_quat()
    angle = 2 * np.arctan2(x, w)
    return float(np.pi - (np.pi - angle) % (2 * np.pi))


def arc_tangents(u: FloatArray, chord: FloatArray, side: FloatArray) -> FloatArray:
    """Tangents (k, 3) of the circular arc of length 1 over a chord (3,), bulging to a side (3,)."""
    along = chord / max(float(np.linalg.norm(chord)), 1e-12)
    across = side - (side @ along) * along
    across = across / max(float(np.linalg.norm(across)), 1e-12)
    angle = arc_half_angle(float(np.linalg.norm(chord)), 1.0) * (1 - 2 * u)
    return np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * across


def into_clamps(
    u: FloatArray,
    tangents: FloatArray,
    clamps: tuple[Rotation | None, Rotation | None],
    turns: float,
) -> FloatArray:
    """Frames (k, 4) along tangents (k, 3), bent into the clamps, their roll spread evenly.

    Parameters
    ----------
    u : (k,)
        Arc length over length, from 0 to 1.
    clamps : Rotation or None, each
        Frames of the first and the last node; None where the cable may turn.
    turns : float
        Full turns of twist beside the roll nearest to none.
    """
    first, last = clamps
    axes = tangents.copy()
    bends = []
    for clamp, end, decay in ((first, 0, (1 - u) ** _DECAY), (last, -1, u**_DECAY)):
        if clamp is not None:
            turn = smallest_turn(tangents[end], clamp.apply([1.0, 0.0, 0.0])).as_rotvec()
            bends.append(decay[:, None] * turn)
    for bend in bends:
        axes = Rotation.from_rotvec(bend).apply(axes)
    frames = parallel_frames(axes, first or smallest_turn(np.array([1.0, 0.0, 0.0]), axes[0]))
    if last is not None:
        missing = roll_between(frames[-1], last)
        roll = missing if first is None else u * (missing + 2 * np.pi * turns)
        frames = frames * Rotation.from_rotvec(
            np.broadcast_to(roll, u.shape)[:, None] * np.array([1.0, 0.0, 0.0])
        )
    return same_sign(frames.as_quat())


def same_sign(quaternions: FloatArray) -> FloatArray:
    """Quaternions (k, 4) of which neighbours have the same sign."""
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(axis=1))
    return quaternions * np.concatenate([[1.0], np.cumprod(np.where(flips < 0, -1.0, 1.0))])[:, None]
