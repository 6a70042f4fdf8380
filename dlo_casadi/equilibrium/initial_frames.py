"""First guesses of the frames of a cable in space: arcs through both ends, bent into the clamps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.equilibrium.initial_arcs import arc_half_angle

FloatArray = NDArray[np.floating]

# A clamp's turning decays as (1 - s/L)^5 from it, as in a plane.
_DECAY = 5
# Rolls so near to half a turn [rad] are as near to none the other way round: arcs to four sides
# differ by as much, 1.2 rad in a pose whose lowest equilibrium is the other one.
HALF_TURN = 1.0
# Turns by which one twist must be nearer than another: arcs to two sides may lie half a turn apart.
_ROUNDING = 1e-6


def parallel_frames(tangents: FloatArray, first: Rotation) -> Rotation:
    """Frames along unit tangents (k, 3) that do not turn about them, from the given first one.

    The first frame is turned by the smallest rotation into the first tangent.
    """
    frame = smallest_turn(first.apply([1.0, 0.0, 0.0]), tangents[0]) * first
    out = [frame]
    for before, after in pairwise(tangents):
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


def guessed_frames_of(
    u: FloatArray,
    chord: FloatArray | None,
    clamps: tuple[FloatArray | None, FloatArray | None],
    down: FloatArray,
    bent: FloatArray,
    turns: float,
) -> list[FloatArray]:
    """First guesses of frames (k, 4), see `guesses.guessed_frames`.

    Parameters
    ----------
    u : (k,)
        Arc length of the nodes over length, from 0 to 1.
    chord : (3,) or None
        End minus start, over length; None for a free end.
    clamps : (4,) or None, each
        Frames of the first and the last node; None where the cable may turn.
    down : (3,)
        Along gravity; zeros without.
    bent : (2, k - 1) [rad]
        Rest bends about the axes y and z from node to node.
    turns : float
        See `pose.Pose`; counted along the first arc, and as near to that along the others.
    """
    first, last = (None if clamp is None else Rotation.from_quat(clamp) for clamp in clamps)
    held = (first, last)
    if chord is None:
        return _hanging(u, first, down, bent)
    along = chord / max(float(np.linalg.norm(chord)), 1e-12)
    side = down - (down @ along) * along
    if np.linalg.norm(side) < 1e-9 * max(float(np.linalg.norm(down)), 1.0):
        side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    found: list[FloatArray] = []
    others: list[FloatArray] = []
    aimed = turns = 0.0 if None in held else turns
    for quarter in range(4):
        turned = Rotation.from_rotvec(quarter * np.pi / 2 * along).apply(side)
        frames, roll = carried(u, arc_tangents(u, chord, turned), held)
        roll = nearest(roll, aimed)
        if turns and not found:
            aimed = roll / (2 * np.pi)
        if not turns and None not in held and abs(roll) > np.pi - HALF_TURN:
            others.append(rolled(u, frames, held, roll - np.copysign(2 * np.pi, roll)))
        found.append(rolled(u, frames, held, roll))
    return found + others


def _hanging(
    u: FloatArray, first: Rotation | None, down: FloatArray, bent: FloatArray
) -> list[FloatArray]:
    """Guesses for a cable with a free end."""
    down = down / max(float(np.linalg.norm(down)), 1e-12)
    if first is None:
        start = down if np.any(down) else np.array([1.0, 0.0, 0.0])
        first = smallest_turn(np.array([1.0, 0.0, 0.0]), start)
    turns = [Rotation.from_rotvec([0.0, *step]) for step in bent.T]
    rest = [first]
    for turn in turns:
        rest.append(rest[-1] * turn)
    shapes = [Rotation.concatenate(rest)]
    if np.any(down):
        fall = smallest_turn(first.apply([1.0, 0.0, 0.0]), down).as_rotvec()
        shapes.append(Rotation.from_rotvec((1 - np.exp(-4 * u))[:, None] * fall) * first)
    shapes.append(Rotation.concatenate([first] * len(u)))
    return [same_sign(shape.as_quat()) for shape in shapes]


def into_clamps(
    u: FloatArray,
    tangents: FloatArray,
    clamps: tuple[Rotation | None, Rotation | None],
    turns: float,
) -> FloatArray:
    """Frames (k, 4) along tangents (k, 3), bent into the clamps, of the twist nearest to `turns`.

    Parameters
    ----------
    u : (k,)
        Arc length over length, from 0 to 1.
    clamps : Rotation or None, each
        Frames of the first and the last node; None where the cable may turn.
    turns : float
    """
    frames, roll = carried(u, tangents, clamps)
    aimed = 0.0 if None in clamps else turns
    return rolled(u, frames, clamps, nearest(roll, aimed))


def carried(
    u: FloatArray, tangents: FloatArray, clamps: tuple[Rotation | None, Rotation | None]
) -> tuple[Rotation, float]:
    """Frames (k,) along tangents bent into the clamps, without twist, and the end clamp's roll.

    It is the angle [rad] about the cable by which the end clamp is turned against the last of them.
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
    return frames, 0.0 if last is None else roll_between(frames[-1], last)


def rolled(
    u: FloatArray,
    frames: Rotation,
    clamps: tuple[Rotation | None, Rotation | None],
    roll: float,
) -> FloatArray:
    """Frames (k, 4) with a roll [rad] at the end: spread evenly from a clamp, alike from a pin."""
    share = np.ones_like(u) if clamps[0] is None else u
    about = Rotation.from_rotvec(np.outer(roll * share, [1.0, 0.0, 0.0]))
    return same_sign((frames * about).as_quat())


def nearest(roll: float, aimed: float) -> float:
    """The roll [rad], by whole turns more or less, nearest to those aimed at [turns].

    Of two that are as near to rounding the larger.
    """
    return roll + 2 * np.pi * float(np.floor(aimed - roll / (2 * np.pi) + 0.5 + _ROUNDING))


def same_sign(quaternions: FloatArray) -> FloatArray:
    """Quaternions (k, 4) of which neighbours have the same sign."""
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(axis=1))
    return (
        quaternions * np.concatenate([[1.0], np.cumprod(np.where(flips < 0, -1.0, 1.0))])[:, None]
    )
