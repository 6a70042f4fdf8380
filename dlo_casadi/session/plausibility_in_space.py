"""Mistakes of sessions in space: frames, the order of markers, orientations of grippers.

As `plausibility`, of which the units, the order of files and single poses serve space, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.errors import counted
from dlo_casadi.session.plausibility import (
    Lines,
    Suspicion,
    counted_from_the_end,
    exchanges,
    out_of_step,
    overall,
    read_as,
    single_poses,
    wrong_units,
)
from dlo_casadi.thresholds import (
    CONTRADICTS,
    FITS,
    HEADING_NEAR,
    HEADING_OFF,
    MUCH_BETTER,
    NEARLY_ALL,
    STRETCHED,
)

FloatArray = NDArray[np.floating]

# Of the length: the part of a line beside its clamp that tells its direction there.
_PART = 0.15
# A rotation so near to exchanged axes is told by their names [rad].
_NAMED = 0.3
# Fits of a frame, each followed by a new choice of which end of a line is which.
_FITS_OF_FRAME = 4


def suspicions_in_space(lines: Lines) -> tuple[Suspicion, ...]:
    """All that looks like a mistake; the first kind that explains the ends is the only one."""
    if not len(lines.names):
        return ()
    for look in (wrong_units, counted_from_the_end, other_frame, out_of_step):
        found = look(lines)
        if found is not None:
            return (found,)
    return single_poses(lines)


def other_frame(lines: Lines) -> Suspicion | None:
    """Ends that fit all fixtures once the points are turned, mirrored or moved as a whole."""
    own = overall(lines.misfit(lines.measured, lines.declared))
    if own < FITS or not np.all(np.isfinite(lines.declared)):
        return None
    found = [_fitted(lines, axes) for axes in exchanges(3)]
    misfit, turn, shift = min(found, key=lambda item: item[0])
    if misfit > min(FITS, MUCH_BETTER * own):
        return None
    return Suspicion(
        f"the lines end {own * lines.length:.3g} m RMS from start and end of their poses, but "
        f"{misfit * lines.length:.3g} m once the points' frame is {_told(turn, shift)}. Try: "
        "points, start, end, orientations and gravity in one right-handed frame; a camera's points "
        "by its calibration against the robot.",
        own > CONTRADICTS,
    )


def _fitted(lines: Lines, turn: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Misfit, rotation (3, 3) and translation (3,) [m] of the frame that fits best, from a first.

    Declared = rotation measured + translation, least squares (Kabsch 1976), of the handedness of
    the first one; the middle of both ends needs no order of a line.
    """
    middle = lines.declared.mean(axis=1) - lines.measured.mean(axis=1) @ turn.T
    shift, hand = np.median(middle, axis=0), np.sign(np.linalg.det(turn))
    for _ in range(_FITS_OF_FRAME):
        moved = lines.measured @ turn.T + shift
        swapped = ~lines.ordered & (_apart(moved[:, ::-1], lines) < _apart(moved, lines))
        source = np.where(swapped[:, None, None], lines.measured[:, ::-1], lines.measured)
        source, goal = source.reshape(-1, 3), lines.declared.reshape(-1, 3)
        centres = source.mean(axis=0), goal.mean(axis=0)
        u, _, v = np.linalg.svd((goal - centres[1]).T @ (source - centres[0]))
        turn = u @ np.diag([1.0, 1.0, hand * np.sign(np.linalg.det(u @ v))]) @ v
        shift = centres[1] - turn @ centres[0]
    moved = lines.measured @ turn.T + shift
    return overall(lines.misfit(moved, lines.declared)), turn, shift


def _apart(measured: FloatArray, lines: Lines) -> FloatArray:
    return np.asarray(((measured - lines.declared) ** 2).sum(axis=(1, 2)))


def _told(turn: FloatArray, shift: FloatArray) -> str:
    """A frame in words: exchanged axes by their names, else how far it is turned and moved."""
    named = np.rint(turn)
    moved = f"moved by ({', '.join(f'{value:.3g}' for value in shift)}) m"
    exchanged = np.all(np.abs(named).sum(axis=0) == 1) and np.all(np.abs(named).sum(axis=1) == 1)
    close = exchanged and np.linalg.norm(turn - named) < _NAMED * np.sqrt(2)
    if close and not np.allclose(named, np.eye(3)):
        hand = ", mirrored (a left-handed frame)" if np.linalg.det(turn) < 0 else ""
        up = (
            " (y up in one, z up in the other?)"
            if abs(named[1, 2]) == abs(named[2, 1]) == 1
            else ""
        )
        return f"read as {read_as(named)}{hand}{up} and {moved}"
    hand = "mirrored, " if np.linalg.det(turn) < 0 else ""
    vector = Rotation.from_matrix(turn * np.sign(np.linalg.det(turn))).as_rotvec()
    angle = float(np.linalg.norm(vector))
    about = ", ".join(f"{value:.2g}" for value in vector / max(angle, 1e-12))
    return f"{hand}turned by {np.degrees(angle):.3g} degrees about ({about}) and {moved}"


# ---- markers ------------------------------------------------------------------------------------


def stretched(
    names: Sequence[str], points: Sequence[FloatArray], s: Sequence[FloatArray], length: float
) -> tuple[Suspicion, ...]:
    """Markers (K, d) [m] farther apart than the cable between them, by their s (K,) [m]."""
    texts = {}
    for name, place, along in zip(names, points, s, strict=True):
        chords = np.linalg.norm(np.diff(place, axis=0), axis=1)
        beyond = chords - np.diff(along)
        k = int(beyond.argmax()) if len(beyond) else 0
        if len(beyond) and beyond[k] > STRETCHED * length:
            texts[name] = (
                f"its markers at s_m {along[k]:g} and {along[k + 1]:g} are {chords[k]:.4g} m "
                f"apart, the cable between them is {along[k + 1] - along[k]:.4g} m long"
            )
    advice = ". Try: s_m in metres along the cable, each beside its own point."
    if texts and 2 * len(texts) > len(names):
        name = next(iter(texts))
        told = f"{len(texts)} of {counted(len(names), 'pose')}"
        said = f"s_m contradicts the points of {told}. {name}: "
        return (Suspicion(said + texts[name] + advice, True),)
    return tuple(Suspicion(f"{name}: {text}{advice}", False, name) for name, text in texts.items())


# ---- orientations -------------------------------------------------------------------------------


class Clamped(NamedTuple):
    """A clamp of one pose: its quaternion (x, y, z, w) as declared, and the line beside it.

    `points` (K, 3) [m] lead away from the fixture at `place` (3,) [m].
    """

    name: str
    orientation: tuple[float, ...]
    place: tuple[float, ...]
    points: FloatArray


def wrong_orientations(
    clamps: Mapping[str, Sequence[Clamped]], length: float
) -> tuple[Suspicion, ...]:
    """Orientations of clamps that the lines contradict: of single poses, or of most of them.

    Parameters
    ----------
    clamps : dict
        Of the sides "start" and "end".
    """
    found: list[Suspicion] = []
    common: dict[str, list[tuple[FloatArray, Clamped]]] = {}
    for side, listed in clamps.items():
        sign = 1.0 if side == "start" else -1.0
        shown = [(sign * way, item) for item in listed for way in (_directions(item, length),)]
        shown = [(ways, item) for ways, item in shown if len(ways)]
        wrong = [pair for pair in shown if _angle(pair, _READINGS[""]) > HEADING_OFF]
        alike = len(wrong) > 1 and _best_reading(shown)[1] < HEADING_NEAR
        if wrong and (alike or 2 * len(wrong) > len(shown)):
            common[side] = shown
            continue
        for pair in wrong:
            off = np.degrees(_angle(pair, _READINGS[""]))
            found.append(
                Suspicion(
                    f"{pair[1].name}: the x axis of its {side}_orientation is {off:.0f} degrees "
                    f"off the line there{_meant([pair])}",
                    False,
                    pair[1].name,
                )
            )
    if common:
        pairs = [pair for shown in common.values() for pair in shown]
        off = np.degrees(np.median([_angle(pair, _READINGS[""]) for pair in pairs]))
        keys = " and ".join(f"{side}_orientation" for side in common)
        text = f"the x axis of {keys} is {off:.0f} degrees (median) off the lines{_meant(pairs)}"
        # Certain only where another reading explains what the declared one does not.
        found.insert(0, Suspicion(text, _best_reading(pairs)[1] < HEADING_NEAR))
    return tuple(found)


def _x_axis(q: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_quat(q).as_matrix()[..., 0])


# What a quaternion may have been meant as -> the direction of the cable that it then gives.
_READINGS = {
    "": _x_axis,
    "w last, [qx, qy, qz, qw]; here w seems to stand first": lambda q: _x_axis(np.roll(q, -1)),
    "x along the cable from start to end, at both clamps; here it points backwards, or start and "
    "end are exchanged": lambda q: -_x_axis(q),
    "the clamp's frame in the world; here it seems to be the world's in the clamp, turn the signs "
    "of qx, qy, qz round": lambda q: _x_axis(q * [-1, -1, -1, 1]),
    "x along the cable; here the clamp's z axis does": lambda q: Rotation.from_quat(q).apply(
        [0.0, 0.0, 1.0]
    ),
    "x along the cable; here the clamp's -z axis does": lambda q: Rotation.from_quat(q).apply(
        [0.0, 0.0, -1.0]
    ),
    "x along the cable; here the clamp's y axis does": lambda q: Rotation.from_quat(q).apply(
        [0.0, 1.0, 0.0]
    ),
    "x along the cable; here the clamp's -y axis does": lambda q: Rotation.from_quat(q).apply(
        [0.0, -1.0, 0.0]
    ),
}


def _best_reading(pairs: Sequence[tuple[FloatArray, Clamped]]) -> tuple[str, float]:
    """What orientations may have been meant as, and how far nearly all are then off [rad]."""
    angles = {
        text: float(np.quantile([_angle(pair, axis) for pair in pairs], NEARLY_ALL))
        for text, axis in _READINGS.items()
        if text
    }
    best = min(angles, key=lambda text: angles[text])
    return best, angles[best]


def _meant(pairs: Sequence[tuple[FloatArray, Clamped]]) -> str:
    """What to try."""
    best, angle = _best_reading(pairs)
    if angle > HEADING_NEAR:
        best = "unit quaternions [qx, qy, qz, qw], x along the cable; start and end exchanged"
    return f". Try: {best}."


def _angle(pair: tuple[FloatArray, Clamped], reading: object) -> float:
    """Angle [rad] between a clamp's axis and the nearest of the directions that the line shows."""
    ways, clamp = pair
    axis = reading(np.array(clamp.orientation))  # type: ignore[operator]
    return float(np.arccos(np.clip(ways @ axis, -1.0, 1.0)).min())


def _directions(clamp: Clamped, length: float) -> FloatArray:
    """Directions (n, 3) in which a line may leave its fixture; none where it cannot be told.

    The slope at the fixture of the parabola through it and the points beside it, their chord, and
    that without the fixture, which may be elsewhere.
    """
    points = np.vstack([clamp.place, clamp.points])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    near = s <= _PART * length
    points, s = points[near], s[near]
    if len(points) < 3 or s[-1] < FITS * length:
        return np.zeros((0, 3))
    moved = (points - points[0])[1:]
    powers = s[1:, None] ** np.array([1, 2])
    slope = np.linalg.lstsq(powers, moved, rcond=None)[0][0]
    ways = np.array([slope, moved[-1], moved[-1] - moved[0]])
    return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True))
