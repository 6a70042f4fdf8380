"""Mistakes that the measured lines themselves give away: units, frames, files out of step.

Pure functions on arrays. The lines of a session are compared with what is declared of them: their
lengths with the cable's, the places where they end with the fixtures. A wrong unit shows as a
factor of a thousand, an axis that points the other way as ends that fit once they are mirrored,
a list out of step as ends that fit another pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from dlo_casadi.errors import counted
from dlo_casadi.session.frames import exchanges, named
from dlo_casadi.thresholds import (
    CONTRADICTS,
    FITS,
    MUCH_BETTER,
    NEAR_UNIT,
    NEARLY_ALL,
    OUT_OF_STEP,
    STRETCHED,
    TOO_LONG,
)

FloatArray = NDArray[np.floating]

# A rotation so near to exchanged axes is told by their names [rad].
_NAMED = 0.3
# Fits of a frame, each followed by a new choice of which end of a line is which.
_FITS_OF_FRAME = 4

UNITS = {"millimetres": 1.0e-3, "centimetres": 1.0e-2, "inches": 0.0254}


class Suspicion(NamedTuple):
    """What looks like a mistake, and what to do about it.

    It is certain where nothing else explains the whole session; of a single pose it tells the name.
    """

    message: str
    certain: bool
    pose: str = ""

    @classmethod
    def of_pose(cls, name: str, text: str) -> Self:
        """What looks like a mistake in a single pose."""
        return cls(f"{name}: {text}", False, name)


@dataclass(frozen=True)
class Lines:
    """Measured lines beside what is declared of them.

    Parameters
    ----------
    names : tuple of str
        Of the m poses.
    declared : (m, 2, d) [m]
        Start and end fixture of each pose; NaN for a free end.
    measured : (m, 2, d) [m]
        The two ends of each measured line, in any order unless it is known.
    lengths : (m,) [m]
        Along each measured line, from point to point; of markers so much longer as the cable is.
    length : float [m]
        Of the cable.
    gaps : (m, 2) [m]
        Arc lengths between the fixtures and the ends of what was measured, as far as that is to
        be expected: of markers, and of lines whose points are far apart; else zero.
    known : (m,) of bool, optional
        Of which line it is known where it begins, as of markers; of none by default.
    """

    names: tuple[str, ...]
    declared: FloatArray
    measured: FloatArray
    lengths: FloatArray
    length: float
    gaps: FloatArray
    known: NDArray[np.bool_] | None = None

    @property
    def ordered(self) -> NDArray[np.bool_]:
        """Of which line (m,) it is known where it begins."""
        return np.zeros(len(self.names), dtype=bool) if self.known is None else self.known

    @property
    def whole(self) -> bool:
        """Whether nearly all were measured from fixture to fixture."""
        return bool(np.mean(self.gaps.max(axis=1) < FITS * self.length) >= NEARLY_ALL)

    def misfit(self, measured: FloatArray, declared: FloatArray) -> FloatArray:
        """Distance of ends from fixtures over the length: the better order, RMS over both.

        Less the gaps that are to be expected.
        Shapes (m, ..., 2, 2) and (..., 2, 2) -> (m, ...).
        """
        gaps = self.gaps.reshape((len(self.gaps), *(1,) * (measured.ndim - 3), 2))
        ways = [
            np.maximum(np.linalg.norm(ends - declared, axis=-1) - gaps, 0.0)
            for ends in (measured, measured[..., ::-1, :])
        ]
        given, turned = (np.sqrt(np.nanmean(way**2, axis=-1)) for way in ways)
        known = self.ordered.reshape((-1, *(1,) * (given.ndim - 1)))
        return np.where(known, given, np.minimum(given, turned)) / self.length


def suspicions(lines: Lines) -> tuple[Suspicion, ...]:
    """All that looks like a mistake; the first kind that explains the ends is the only one.

    Parameters
    ----------
    lines : Lines
        Poses that could be read; at least one.
    """
    if not len(lines.names):
        return ()
    for look in (wrong_units, counted_from_the_end, wrong_frame, out_of_step):
        found = look(lines)
        if found is not None:
            return (found,)
    return single_poses(lines)


def single_poses(lines: Lines) -> tuple[Suspicion, ...]:
    """Poses that are wrong by themselves; of each the first reason."""
    single = (*too_long(lines), *exchanged(lines), *far_ends(lines))
    first = {item.pose: item for item in reversed(single)}
    return tuple(item for item in single if first[item.pose] is item)


def wrong_units(lines: Lines) -> Suspicion | None:
    """Lengths, or distances of the ends, that are off by the factor of a unit."""
    ratio = lines.lengths / lines.length
    typical = float(np.median(lines.lengths))
    for unit, size in UNITS.items():
        if _all_near(ratio, 1.0 / size):
            return Suspicion(
                f"the measured lines are {typical:.4g} m long (median), the cable "
                f"{lines.length:.4g} m: the points look like {unit}. Try: write them in metres, "
                "as the header x_m,y_m says.",
                True,
            )
        if _all_near(ratio, size):
            return Suspicion(
                f"the measured lines are {typical:.4g} m long (median), cable.length is "
                f"{lines.length:.4g} m: it looks like {unit}. Try: cable.length: "
                f"{lines.length * size:.6g}, and all lengths in metres.",
                True,
            )
    declared = np.linalg.norm(np.diff(lines.declared, axis=1)[:, 0], axis=1)
    measured = np.linalg.norm(np.diff(lines.measured, axis=1)[:, 0], axis=1)
    apart = np.isfinite(declared) & (np.maximum(declared, measured) > CONTRADICTS * lines.length)
    if apart.sum() < 2 or not lines.whole:
        return None
    spans = declared[apart] / np.maximum(measured[apart], 1e-12)
    for unit, size in UNITS.items():
        if _all_near(spans, size) or _all_near(spans, 1.0 / size):
            return Suspicion(
                f"the ends of the lines are {np.median(measured[apart]):.4g} m apart (median), "
                f"start and end of their poses {np.median(declared[apart]):.4g} m: the factor of "
                f"{unit}. Try: start and end of all poses in metres.",
                True,
            )
    return None


def wrong_frame(lines: Lines) -> Suspicion | None:
    """Ends that fit all fixtures once the points are moved, turned or mirrored as a whole."""
    own = overall(lines.misfit(lines.measured, lines.declared))
    enough = min(FITS, MUCH_BETTER * own)
    if own < FITS:
        return None
    several = len(lines.names) > 2  # to the ends of fewer, some turn and some origin fit
    if own > CONTRADICTS:
        shifted, shift = _moved(lines, lines.measured)
        if shifted < enough:
            return Suspicion(
                f"all lines lie {_at(shift, '.4g')} m away from their start and end. Try: measure "
                "fixtures and lines from the same origin; subtract this from the points, or add "
                "it to start and end.",
                True,
            )
        origins = (True, False) if several else (True,)
        for in_place, axes in product(origins, exchanges(len(shift))[1:]):
            turned, what = lines.measured @ axes.T, named(axes)
            misfit, shift = _moved(lines, turned)
            if in_place:
                misfit = overall(lines.misfit(turned, lines.declared))
            else:
                what += f" and moved by {_at(-shift, '.4g')} m"
            if misfit < enough:
                return _in_frame(lines, own, misfit, what)
    if several and np.all(np.isfinite(lines.declared)):
        found = [_fitted(lines, axes) for axes in exchanges(lines.declared.shape[2])]
        misfit, turn, shift = min(found, key=lambda item: item[0])
        if misfit < enough:
            return _in_frame(lines, own, misfit, _told(turn, shift))
    return None


def _in_frame(lines: Lines, own: float, misfit: float, what: str) -> Suspicion:
    return Suspicion(
        f"the lines do not end at start and end of their poses ({own * lines.length:.3g} m RMS), "
        f"but do ({misfit * lines.length:.3g} m) with {what}. Try: points, start, end, "
        "orientations and gravity in one frame, right-handed, in a plane x to the right and y up; "
        "in pictures rows count downwards; a camera's points by its calibration.",
        own > CONTRADICTS,
    )


def _fitted(lines: Lines, turn: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Misfit, rotation (d, d) and translation (d,) [m] of the frame that fits best, from a first.

    Declared = rotation measured + translation, least squares (Kabsch 1976), of the handedness of
    the first one; the middle of both ends needs no order of a line.
    """
    d, hand = len(turn), np.sign(np.linalg.det(turn))
    shift = np.median(lines.declared.mean(axis=1) - lines.measured.mean(axis=1) @ turn.T, axis=0)
    for _ in range(_FITS_OF_FRAME):
        moved = lines.measured @ turn.T + shift
        given, other = (
            np.linalg.norm(ends - lines.declared, axis=(1, 2)) for ends in (moved, moved[:, ::-1])
        )
        swapped = ~lines.ordered & (other < given)
        source = np.where(swapped[:, None, None], lines.measured[:, ::-1], lines.measured)
        source, goal = source.reshape(-1, d), lines.declared.reshape(-1, d)
        centres = source.mean(axis=0), goal.mean(axis=0)
        u, _, v = np.linalg.svd((goal - centres[1]).T @ (source - centres[0]))
        turn = u @ np.diag([*np.ones(d - 1), hand * np.sign(np.linalg.det(u @ v))]) @ v
        shift = centres[1] - turn @ centres[0]
    moved = lines.measured @ turn.T + shift
    return overall(lines.misfit(moved, lines.declared)), turn, shift


def _told(turn: FloatArray, shift: FloatArray) -> str:
    """A frame in words: exchanged axes by their names, else how far it is turned and moved."""
    moved = f"moved by {_at(shift, '.3g')} m"
    near = min(exchanges(len(turn)), key=lambda axes: float(np.linalg.norm(turn - axes)))
    if np.linalg.norm(turn - near) < _NAMED * np.sqrt(2) and not np.allclose(
        near, np.eye(len(turn))
    ):
        return f"{named(near)} and {moved}"
    hand = np.sign(np.linalg.det(turn))
    whole = hand * np.eye(3)
    whole[: len(turn), : len(turn)] = turn
    vector = Rotation.from_matrix(hand * whole).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return (
        f"the points {'mirrored, ' if hand < 0 else ''}turned by {np.degrees(angle):.3g} degrees "
        f"about {_at(vector / max(angle, 1e-12), '.2g')} and {moved}"
    )


def out_of_step(lines: Lines) -> Suspicion | None:
    """Ends that fit the fixtures of other poses: files and end positions in different orders."""
    misfit = lines.misfit(lines.measured[:, None], lines.declared[None, :])
    own = np.diag(misfit)
    _, best = linear_sum_assignment(misfit**2)
    other = misfit[np.arange(len(own)), best]
    wrong = (own > OUT_OF_STEP) & (other < np.minimum(FITS, MUCH_BETTER * own))
    if wrong.sum() < 2:
        return None
    pairs = [
        f"{lines.names[i]} shows the ends of {lines.names[best[i]]}" for i in np.flatnonzero(wrong)
    ]
    more = f", and {len(pairs) - 4} more" if len(pairs) > 4 else ""
    step = set((best - np.arange(len(own)))[wrong].tolist())
    shift = f" (all of them {abs(step.pop())} further in the list)" if len(step) == 1 else ""
    return Suspicion(
        f"{len(pairs)} of {len(own)} files belong to other entries of the list of poses{shift}: "
        f"{'; '.join(pairs[:4])}{more}. Try: put file names and end positions in step.",
        True,
    )


def counted_from_the_end(lines: Lines) -> Suspicion | None:
    """Markers that fit their fixtures once they are counted from the other end."""
    marked = np.flatnonzero(lines.ordered)
    if not len(marked):
        return None
    own = lines.misfit(lines.measured, lines.declared)[marked]
    turned = replace(lines, gaps=lines.gaps[:, ::-1])
    other = turned.misfit(lines.measured[:, ::-1], lines.declared)[marked]
    if not (overall(own) > FITS and overall(other) < min(FITS, MUCH_BETTER * overall(own))):
        return None
    return Suspicion(
        f"the markers are {overall(own) * lines.length:.3g} m RMS from the declared start and end, "
        f"but {overall(other) * lines.length:.3g} m once they are counted from the other end. Try: "
        "s_m from the start; or are start and end of the poses exchanged?",
        True,
    )


def too_long(lines: Lines) -> tuple[Suspicion, ...]:
    """Single poses whose points, in their order, run to and fro."""
    return tuple(
        Suspicion.of_pose(
            lines.names[i],
            f"from point to point its line is {lines.lengths[i]:.4g} m long, the cable "
            f"{lines.length:.4g} m. Try: are its points in order along the cable?",
        )
        for i in np.flatnonzero(lines.lengths > TOO_LONG * lines.length)
    )


def exchanged(lines: Lines) -> tuple[Suspicion, ...]:
    """Poses whose end is where all others have their start, as if both were exchanged."""
    starts, ends = lines.declared[:, 0], lines.declared[:, 1]
    if len(starts) < 4:
        return ()
    common = np.median(starts, axis=0)
    near = FITS * lines.length
    regular = np.linalg.norm(starts - common, axis=1) < near
    turned = ~regular & (np.linalg.norm(ends - common, axis=1) < near)
    if regular.sum() < 3 * turned.sum():
        return ()
    return tuple(
        Suspicion.of_pose(
            lines.names[i],
            f"its end {_at(ends[i], 'g')} m is where the other poses have their start. Try: are "
            "start and end exchanged?",
        )
        for i in np.flatnonzero(turned)
    )


def far_ends(lines: Lines) -> tuple[Suspicion, ...]:
    """Single poses whose line ends far from the fixtures."""
    own = lines.misfit(lines.measured, lines.declared)
    return tuple(
        Suspicion.of_pose(
            lines.names[i],
            f"its line runs from {_at(lines.measured[i, 0])} to {_at(lines.measured[i, 1])} m, "
            f"{own[i] * lines.length:.3g} m RMS away from the declared ends. Try: start and end "
            "of this pose, and whether it is the right file.",
        )
        for i in np.flatnonzero(own > CONTRADICTS)
    )


def repeated(names: Sequence[str], points: Sequence[FloatArray]) -> tuple[Suspicion, ...]:
    """Poses with exactly the same points (K, 2): one file under two names."""
    seen: dict[bytes, str] = {}
    found = []
    for name, array in zip(names, points, strict=True):
        key = np.ascontiguousarray(array, dtype=float).tobytes()
        if key in seen:
            found.append(
                Suspicion(
                    f"{name} holds exactly the points of {seen[key]}, and no two measurements "
                    "agree to the last digit. Try: is one file there twice, under two names?",
                    False,
                    name,
                )
            )
        seen.setdefault(key, name)
    return tuple(found)


def stretched(
    marked: Sequence[tuple[str, FloatArray, FloatArray]], length: float
) -> tuple[Suspicion, ...]:
    """Markers farther apart than the cable between them; pose, points (K, d) and s (K,) [m]."""
    texts = {}
    for name, place, along in marked:
        chords = np.linalg.norm(np.diff(place, axis=0), axis=1)
        beyond = chords - np.diff(along)
        k = int(beyond.argmax()) if len(beyond) else 0
        if len(beyond) and beyond[k] > STRETCHED * length:
            texts[name] = (
                f"its markers at s_m {along[k]:g} and {along[k + 1]:g} are {chords[k]:.4g} m "
                f"apart, the cable between them is {along[k + 1] - along[k]:.4g} m long"
            )
    advice = ". Try: s_m in metres along the cable, each beside its own point."
    if texts and 2 * len(texts) > len(marked):
        name = next(iter(texts))
        told = f"{len(texts)} of {counted(len(marked), 'pose')}"
        said = f"s_m contradicts the points of {told}. {name}: "
        return (Suspicion(said + texts[name] + advice, True),)
    return tuple(Suspicion.of_pose(name, text + advice) for name, text in texts.items())


def _all_near(ratio: FloatArray, factor: float) -> bool:
    """Whether nearly all ratios are the factor, up to a quarter."""
    near = (ratio > factor / NEAR_UNIT) & (ratio < factor * NEAR_UNIT)
    return bool(near.mean() >= NEARLY_ALL)


def overall(misfit: FloatArray) -> float:
    """Root mean square over the poses, the worst fifth left out: a pose or two may be wrong."""
    kept = np.sort(misfit)[: max(1, int(np.ceil(NEARLY_ALL * len(misfit))))]
    return float(np.sqrt(np.mean(kept**2)))


def _moved(lines: Lines, measured: FloatArray) -> tuple[float, FloatArray]:
    """Misfit after the one translation (2,) [m] that fits best, in the middle of both ends.

    With a free end: at the start, which the line's first point is then taken for.
    """
    away = measured.mean(axis=1) - lines.declared.mean(axis=1)
    shift = np.median(np.where(np.isfinite(away), away, (measured - lines.declared)[:, 0]), axis=0)
    return overall(lines.misfit(measured - shift, lines.declared)), shift


def _at(point: FloatArray, form: str = ".3f") -> str:
    return f"({', '.join(format(value, form) for value in point)})"
