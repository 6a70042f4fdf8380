"""First guesses of the nodes of a cable held at the ends of a pose.

The generated solver tries the same guesses with the same numbers: codegen/templates/guesses*.c.in.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, cross, unit
from dlo_casadi.equilibrium.guess_table import (
    CURVED,
    FAR,
    HALF_ANGLE,
    HALF_TURN,
    LARGEST_BEND,
    ONE_POINT,
    SLACK,
    TIE,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.quaternions import same_sign

Clamps = tuple[FloatArray | None, FloatArray | None]
Turned = tuple[Rotation | None, Rotation | None]

# Power of the decay (1 - s/L)^5 of a clamp's bend. In 1200 random problems with clamps the powers
# 3, 4, 5, 6, 8 missed the lowest equilibrium 9, 2, 0, 0, 1 times; high powers converge less often.
_DECAY = 5
_FORWARD, _NOWHERE = np.array([1.0, 0.0, 0.0]), np.zeros(3)


def _held(
    model: CableModel, p: FloatArray, pose: HeldPose
) -> tuple[FloatArray, FloatArray | None, Clamps]:
    """Inputs of guesses: arc lengths of the nodes, end minus start, and frames of clamps.

    Lengths are relative to the cable's. The chord is None for a free end, the frame for a pin.
    """
    (start, end), clamps, length = true_ends(model, p, pose)
    chord = (end - start) / length if model.end.place else None
    return model.chain.places / model.chain.length, chord, clamps


def true_ends(
    model: CableModel, p: FloatArray, pose: HeldPose
) -> tuple[tuple[FloatArray, FloatArray], Clamps, float]:
    """Positions [m] of the ends; frames of clamps, None for a pin or a free end; length [m].

    The length of a cable that slides through an end is a first guess: SLACK beyond the chord.
    """
    ends, own = lagrangian_of(model).true_ends_and_length(p, pose.ends, 0)
    d, c = model.node.dimension, model.node.coordinates
    start, end, first, last = np.split(np.array(ends).ravel(), [d, 2 * d, 2 * d + c])
    clamps = (
        first if model.start.direction else None,
        last if model.end.direction else None,
    )
    length = float(own)
    if model.slides:
        length = max((1 + SLACK) * float(np.linalg.norm(end - start)), SLACK * length)
    return (start, end), clamps, length


# ---- in a plane ----------------------------------------------------------------------------------


def guesses(model: CableModel, p: FloatArray, rest: FloatArray, pose: HeldPose) -> list[FloatArray]:
    """First guesses of the headings, in the order in which they are tried.

    Pinned at both ends:

    1. the arc of the cable's length through both ends that turns counter-clockwise, and
    2. the one that turns clockwise; a pose that names its branch swaps them;
    3. the rest shape turned into the chord, if it turns by more than 0.05 rad;
    4. a loop in the middle of a straight cable, counter-clockwise, and
    5. clockwise; both if the rest shape turns by more than 1 rad and the loop has 4.5 elements.

    With a clamp at one end or at both:

    1. the counter-clockwise arc, bent into the headings of the clamps (`arc_into_clamps`), and
    2. the clockwise one; a pose that names its branch swaps them;
    3. and 4. the same with the next k: where the nearer one bends the cable by more than 1.5 rad,
       or the rest shape turns by more than 1 rad.

    With a free end:

    1. the rest shape from the start on;
    2. the cable falling down from the start's direction;
    3. straight on;
    4. the cable falling down the other way round: where the nearer one turns by more than 1.5 rad,
       or the rest shape by more than 1 rad.

    In all of them bends are limited to 0.9 of the joints' bound, and clamps keep their headings.
    `p` (n_parameters,). `rest` (n_rests,) [1/m].
    """
    u, chord, clamps = _held(model, p, pose)
    bent = resting_headings(model.chain, rest)
    sides = (-1, 1) if pose.branch == "cw" else (1, -1)
    if chord is None:
        found = _hanging(model, u, bent, clamps[0])
    elif model.start.turns and model.end.turns:
        found = [arc_headings(u, 1.0, chord, side) for side in sides]
        found += _curved(model.n, u, bent, chord)
    else:
        into = [arc_into_clamps(u, chord, clamps, side) for side in sides]
        found = [near for near, _, _ in into]
        found += [far for _, far, bend in into if bend > FAR or np.ptp(bent) > CURVED]
    out = [limited(phi) for phi in found]
    for end, clamp in zip((0, -1), clamps, strict=True):
        if clamp is not None:
            for phi in out:
                phi[end] = clamp[0]
    return out


def resting_headings(chain: Chain, rest: FloatArray) -> FloatArray:
    """Headings (n_nodes,) [rad] of the cable at rest, relative to its start."""
    cells = chain.cells
    turn = np.concatenate([[0.0], np.cumsum(rest * np.diff(cells, axis=1).ravel())])
    edges = np.concatenate([cells[:1, 0], cells[:, 1]])
    return np.interp(chain.places, edges, turn)


def arc_half_angle(chord: float, length: float) -> float:
    """Half the turning angle of a circular arc: sin(a) / a = chord / length, a in [0, pi].

    Computed by a polynomial, to 2e-4 rad. `chord`, `length` [m]: 0 <= chord; the result is 0 if the
    chord is longer than the arc.
    """
    y = max(1.0 - chord / length, 0.0)
    total = 0.0
    for coefficient in HALF_ANGLE[::-1]:
        total = coefficient + y * total
    return float(np.sqrt(y * total))


def arc_headings(places: FloatArray, length: float, chord: FloatArray, side: int) -> FloatArray:
    """Headings (k,) [rad] of the circular arc of the given length through both ends.

    Parameters
    ----------
    places : (k,) [m]
        Arc lengths.
    chord : (2,) [m]
        End minus start.
    side : +1 or -1
        +1 turns counter-clockwise from start to end.
    """
    half = arc_half_angle(float(np.hypot(*chord)), length)
    direction = np.arctan2(chord[1], chord[0])
    return direction + side * half * (2 * places / length - 1)


def arc_into_clamps(
    u: FloatArray, chord: FloatArray, clamps: Clamps, side: int
) -> tuple[FloatArray, FloatArray, float]:
    """Headings of the arc through both ends that bends into the headings of the clamps.

        phi(u) = arc(u) + t + (1 - u)^5 (first - arc(0) - t) + u^5 (last - arc(1) - t),  t = 2 pi k

    Headings are continuous along the cable, so the arc may need k whole turns.

    Parameters
    ----------
    u : (k,)
        Arc length over length.
    chord : (2,)
        End minus start, over length.
    clamps : (1,) [rad] or None, each
        First and last heading; None where the cable may turn, but not both.
    side : +1 or -1

    Returns
    -------
    (k,) [rad]
        Headings with the k that bends the cable least at its clamps.
    (k,) [rad]
        Headings with the next k, which bends it the other way.
    float [rad]
        Bend of the first result at the clamps: the mean over them, at most pi.
    """
    arc = arc_headings(np.concatenate([[0.0], u, [1.0]]), 1.0, chord, side)
    excess = [
        (float(clamp[0] - own), (1 - from_clamp) ** _DECAY)
        for clamp, own, from_clamp in zip(clamps, arc[[0, -1]], (u, 1 - u), strict=True)
        if clamp is not None
    ]
    mean = sum(angle for angle, _ in excess) / len(excess)
    turns = np.floor(mean / (2 * np.pi) + 0.5)
    rest = mean - 2 * np.pi * turns

    def bent(turns: float) -> FloatArray:
        shift = 2 * np.pi * turns
        return sum(((angle - shift) * decay for angle, decay in excess), start=arc[1:-1] + shift)

    return bent(turns), bent(turns + 1 if rest > 0 else turns - 1), abs(rest)


def limited(phi: FloatArray) -> FloatArray:
    """Headings (k,) with bends limited to LARGEST_BEND; the first heading is kept."""
    bends = np.clip(np.diff(phi), -LARGEST_BEND, LARGEST_BEND)
    return phi[0] + np.concatenate([[0.0], np.cumsum(bends)])


def downwards(model: CableModel) -> float:
    """Heading [rad] of gravity in a plane; 0 without gravity."""
    return float(np.arctan2(model.gravity[1], model.gravity[0])) if any(model.gravity) else 0.0


def fallen(u: FloatArray) -> FloatArray:
    """Share (k,) of its fall by which a cable with a free end has turned at places u of 0 to 1."""
    return 1 - np.exp(-4 * u)


def _hanging(
    model: CableModel, u: FloatArray, bent: FloatArray, clamp: FloatArray | None
) -> list[FloatArray]:
    """Guesses for a cable with a free end."""
    down, decay = downwards(model), fallen(u)
    first = down if clamp is None else float(clamp[0])
    drop = down - first - 2 * np.pi * np.floor((down - first + np.pi) / (2 * np.pi))
    found = [first + bent, first + drop * decay, np.full_like(u, first)]
    if abs(drop) > FAR or np.ptp(bent) > CURVED:
        found.append(first + (drop - 2 * np.pi * (1 if drop > 0 else -1)) * decay)
    return found


def _curved(n: int, u: FloatArray, bent: FloatArray, chord: FloatArray) -> list[FloatArray]:
    """Guesses for a cable of n elements between two pins that is curved at rest."""
    direction, slack = np.arctan2(chord[1], chord[0]), 1 - float(np.hypot(*chord))
    turning = np.ptp(bent)
    found = []
    if turning > 0.05:
        bent = limited(bent)
        found.append(bent + direction - np.arctan2(np.sin(bent).sum(), np.cos(bent).sum()))
    if turning > CURVED and slack * n > 4.5:
        looped = 2 * np.pi * np.clip((u - 0.5) / slack + 0.5, 0.0, 1.0)
        found += [direction + looped, direction - looped]
    return found


# ---- in space ------------------------------------------------------------------------------------


def guessed_frames(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: HeldPose
) -> list[FloatArray]:
    """First guesses of the frames (n_nodes, 4) of a cable in space.

    Between two ends: four arcs of the cable's length, the first sagging along gravity, the others
    rotated about the chord by quarter turns. They are bent into the clamps; the roll of the end
    clamp nearest to `turns` is spread evenly, and there is no twist where an end may roll. Without
    `turns`, a roll of nearly half a turn is tried both ways round. With a free end: the rest shape,
    the cable fallen down, and straight on. `turns` refers to the first arc; the other arcs use the
    nearest value.
    """
    u, chord, frames = _held(model, p, pose)
    clamps = frame_rotation(frames[0]), frame_rotation(frames[1])
    rolls, down = (model.start.roll, model.end.roll), np.array(model.gravity)
    if chord is None:
        bends = model.chain.curvatures(rest) * np.diff(model.chain.cells, axis=1).ravel()
        return _hanging_frames(u, clamps[0], down, bends)
    along = chord_direction(chord, clamps, down)
    side, ratio = sagging(along, down), float(np.linalg.norm(chord))
    found: list[FloatArray] = []
    others: list[FloatArray] = []
    aimed = turns = pose.turns if all(rolls) else 0.0
    for quarter in range(4):
        turned = Rotation.from_rotvec(quarter * np.pi / 2 * along).apply(side)
        free, roll = carried(u, arc_tangents(u, ratio, along, turned), clamps)
        roll = nearest_roll(roll, aimed) if rolls[1] else 0.0
        if turns and not found:
            aimed = roll / (2 * np.pi)
        if not turns and all(rolls) and abs(roll) > np.pi - HALF_TURN:
            opposite = roll - np.copysign(2 * np.pi, roll)
            others.append(rolled(u, free, opposite, at_start=rolls[0]))
        found.append(rolled(u, free, roll, at_start=rolls[0]))
    return found + others


def frame_rotation(frame: Sequence[float] | FloatArray | None) -> Rotation | None:
    """Rotation of a frame; None for None."""
    return None if frame is None else Rotation.from_quat(frame)


def smallest_turn(a: FloatArray, b: FloatArray) -> Rotation:
    """Smallest rotations of unit vectors a (..., 3) into b (..., 3)."""
    axis, real = cross(a, b), 1 + (a * b).sum(axis=-1, keepdims=True)
    opposite = real < 1e-12
    if opposite.any():
        aside = unit(cross(a, np.eye(3)[np.abs(a).argmin(axis=-1)]))
        axis, real = np.where(opposite, aside, axis), np.where(opposite, 0.0, real)
    return Rotation.from_quat(np.concatenate([axis, real], axis=-1))


def chord_direction(chord: FloatArray, clamps: Turned, down: FloatArray) -> FloatArray:
    """Unit vector (3,) from the start to the end of an arc; `chord` (3,) is relative to its length.

    If both are at one place, the arc is a circle that leaves against this direction: it leaves or
    arrives along a clamp, or hangs down, see `sagging`.
    """
    size = float(np.linalg.norm(chord))
    if size > ONE_POINT:
        return chord / size
    for clamp in clamps:
        if clamp is not None:
            return np.asarray(-clamp.apply(_FORWARD))
    return unit(sagging(down / np.linalg.norm(down), _NOWHERE)) if np.any(down) else _FORWARD


def sagging(along: FloatArray, down: FloatArray) -> FloatArray:
    """Part (3,) of gravity across a unit vector; any vector across it if there is none."""
    side = down - (down @ along) * along
    if np.linalg.norm(side) < 1e-9 * max(float(np.linalg.norm(down)), 1.0):
        return cross(along, np.eye(3)[np.argmin(np.abs(along))])
    return side


def arc_tangents(u: FloatArray, chord: float, along: FloatArray, side: FloatArray) -> FloatArray:
    """Tangents (k, 3) of the circular arc of length 1 over a chord, bulging to a side (3,).

    `along` (3,): unit vector of the chord, see `chord_direction`.
    """
    across = unit(side - (side @ along) * along)
    angle = arc_half_angle(chord, 1.0) * (1 - 2 * u)
    return np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * across


def _hanging_frames(
    u: FloatArray, first: Rotation | None, down: FloatArray, bends: FloatArray
) -> list[FloatArray]:
    """Guesses for a cable with a free end; rest bends (2, k - 1) [rad] about the axes y and z."""
    down = down / max(float(np.linalg.norm(down)), 1e-12)
    if first is None:
        first = smallest_turn(_FORWARD, down if np.any(down) else _FORWARD)
    rest = [first]
    for bend in bends.T:
        rest.append(rest[-1] * Rotation.from_rotvec([0.0, *bend]))
    shapes = [Rotation.concatenate(rest)]
    if np.any(down):
        fall = smallest_turn(first.apply(_FORWARD), down).as_rotvec()
        shapes.append(Rotation.from_rotvec(fallen(u)[:, None] * fall) * first)
    shapes.append(Rotation.concatenate([first] * len(u)))
    return [same_sign(shape.as_quat()) for shape in shapes]


def bent_into(
    u: FloatArray, tangents: FloatArray, ends: FloatArray, ways: Sequence[FloatArray | None]
) -> FloatArray:
    """Tangents (k, 3), which have directions `ends` (2, 3) at both ends, bent into those of clamps.

    `ways`: directions (3,) of the clamps; None where an end is free to turn.
    """
    for own, way, decay in zip(ends, ways, ((1 - u) ** _DECAY, u**_DECAY), strict=True):
        if way is not None:
            bend = smallest_turn(own, way).as_rotvec()
            tangents = Rotation.from_rotvec(decay[:, None] * bend).apply(tangents)
    return tangents


def carried(u: FloatArray, tangents: FloatArray, clamps: Turned) -> tuple[Rotation, float]:
    """Frames (k,) without twist along tangents bent into the clamps, and the end clamp's roll.

    The roll is the angle [rad] about the cable's axis from last frame to clamp, in (-pi, pi].
    """
    ways = [None if clamp is None else clamp.apply(_FORWARD) for clamp in clamps]
    axes = bent_into(u, tangents, tangents[[0, -1]], ways)
    first = clamps[0] or smallest_turn(_FORWARD, axes[0])
    quaternions = [(smallest_turn(first.apply(_FORWARD), axes[0]) * first).as_quat()]
    x, y, z, w = smallest_turn(axes[:-1], axes[1:]).as_quat().T
    for turn in np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]]).T:
        quaternions.append(quaternions[-1] @ turn)
    frames = Rotation.from_quat(quaternions)
    if clamps[1] is None:
        return frames, 0.0
    x, _, _, w = (frames[-1].inv() * clamps[1]).as_quat()
    return frames, float(np.pi - (np.pi - 2 * np.arctan2(x, w)) % (2 * np.pi))


def rolled(u: FloatArray, frames: Rotation, roll: float, *, at_start: bool) -> FloatArray:
    """Frames (k, 4) with a roll [rad] at the end, linear from a start that holds its own."""
    share = u if at_start else np.ones_like(u)
    about = Rotation.from_rotvec(np.outer(roll * share, _FORWARD))
    return same_sign((frames * about).as_quat())


def frames_along(
    s: FloatArray,
    axes: FloatArray,
    held: Sequence[tuple[float, Sequence[float] | FloatArray | None]],
    turns: float,
    *,
    other_way: bool = False,
) -> tuple[FloatArray, float]:
    """Frames (k, 4) at arc lengths s (k,) [m] with these tangents (k, 3), and the last roll [rad].

    That is 0 unless both sides of the last stretch hold it.

    Parameters
    ----------
    held : sequence of (arc length [m], frame or None)
        The ends and all between them that hold the roll of the cable, in order. From one to the
        next its roll is spread evenly.
    turns : float
        Of twist before the end, see `HeldPose`.
    other_way : bool
        Whether the last roll goes the other way round.
    """
    frames, last_roll = np.zeros((len(s), 4)), 0.0
    for (low, first), (high, last) in pairwise(held):
        inside = (s >= low - 1e-9) & (s <= high + 1e-9)
        if not inside.any():  # two clamped clips between nodes of the mesh
            continue
        u = (s[inside] - low) / (high - low)
        both = frame_rotation(first), frame_rotation(last)
        turned, roll = carried(u, axes[inside], both)
        at_end = high == held[-1][0] and None not in both
        roll = nearest_roll(roll, turns if at_end else 0.0)
        if at_end:
            roll = last_roll = roll - other_way * float(np.copysign(2 * np.pi, roll))
        frames[inside] = rolled(u, turned, roll, at_start=both[0] is not None)
    return same_sign(frames), last_roll


def nearest_roll(roll: float, aimed: float) -> float:
    """The roll [rad], up to full turns, that is nearest to `aimed` [turns].

    If two are equally near up to rounding, the larger one.
    """
    return roll + 2 * np.pi * float(np.floor(aimed - roll / (2 * np.pi) + 0.5 + TIE))
