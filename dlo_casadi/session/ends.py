"""Find mistakes from points and their ends: units, frames, files in the wrong order.

A wrong unit is a factor of a thousand in the lengths; with a mirrored axis the ends fit once
they are mirrored back; with files in the wrong order the ends fit another pose.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.errors import counted
from dlo_casadi.session.hypotheses import (
    NEAR_AXES,
    Hypothesis,
    Lines,
    ReadSession,
    Suspicion,
    T,
    exchanges,
    likeliest,
    listed,
    named,
    overall,
)
from dlo_casadi.thresholds import (
    CONTRADICTS,
    FITS,
    MUCH_BETTER,
    NEAR_UNIT,
    NEARLY_ALL,
    OUT_OF_STEP,
    SHORTER,
    STRETCHED,
    TOO_LONG,
)

UNITS = {"millimetres": 1.0e-3, "centimetres": 1.0e-2, "inches": 0.0254}
# Iterations of fitting a frame and then choosing which end of each line is the start.
_FITS_OF_FRAME = 4


def wrong_units(session: ReadSession) -> tuple[Suspicion, ...]:
    """Lengths, or distances of the ends, that are off by the factor of a unit."""
    lines, meant = session.lines, []
    ratio, typical = lines.lengths / lines.length, float(np.median(lines.lengths))
    for unit, size in UNITS.items():
        points = (
            f"the measured lines are {typical:.4g} m long (median), the cable {lines.length:.4g} "
            f"m: the points look like {unit}. Try: write them in metres, as the header x_m,y_m "
            "says."
        )
        length = (
            f"the measured lines are {typical:.4g} m long (median), cable.length is "
            f"{lines.length:.4g} m: it looks like {unit}. Try: cable.length: "
            f"{lines.length * size:.6g}, and all lengths in metres."
        )
        meant += [Hypothesis(points, ratio * size), Hypothesis(length, ratio / size)]
    declared, measured = (
        np.linalg.norm(np.diff(ends, axis=1)[:, 0], axis=1)
        for ends in (lines.declared, lines.measured)
    )
    apart = np.isfinite(declared) & (np.maximum(declared, measured) > CONTRADICTS * lines.length)
    whole = np.mean(lines.gaps.max(axis=1) < FITS * lines.length) >= NEARLY_ALL
    if apart.sum() > 1 and whole:
        spans = declared[apart] / np.maximum(measured[apart], 1e-12)
        for (unit, size), sign in product(UNITS.items(), (-1, 1)):
            wrong = "start and end of all poses" if sign > 0 else "points and cable.length"
            ends = (
                f"the ends of the lines are {np.median(measured[apart]):.4g} m apart (median), "
                f"start and end of their poses {np.median(declared[apart]):.4g} m: the factor of "
                f"{unit}. Try: {wrong} in metres."
            )
            meant.append(Hypothesis(ends, spans * size**sign))

    def far_from_one(ratio: FloatArray) -> float:
        """Share of ratios that differ from one, up to a quarter."""
        return float(1.0 - ((ratio > 1 / NEAR_UNIT) & (ratio < NEAR_UNIT)).mean())

    found = likeliest(meant, far_from_one, 1 - NEARLY_ALL + 1e-9)
    return () if found is None else (Suspicion(found[0].said, True),)


def counted_from_the_end(session: ReadSession) -> tuple[Suspicion, ...]:
    """Markers that fit their fixtures if they are counted from the other end."""
    lines = session.lines
    if not lines.known.any():
        return ()
    turned = replace(lines, measured=lines.measured[:, ::-1], gaps=lines.gaps[:, ::-1])
    said = (
        "the markers are {own:.3g} m RMS from the declared start and end, but {left:.3g} m once "
        "they are counted from the other end. Try: s_m from the start; or are start and end of "
        "the poses exchanged?"
    )

    def misfit(one: Lines) -> float:
        return overall(one.misfit(one.measured, one.declared)[one.known])

    return _by_ends(lines, misfit(lines), [Hypothesis(said, turned)], misfit)


def _by_ends(
    lines: Lines,
    own: float,
    hypotheses: Iterable[Hypothesis[T]],
    misfit: Callable[[T], float],
    near: float = np.inf,
    certain: bool = True,
) -> tuple[Suspicion, ...]:
    """Explanation of ends that are `own` cable lengths away from their fixtures."""
    if own < FITS:
        return ()
    found = likeliest(hypotheses, misfit, min(FITS, MUCH_BETTER * own), near)
    if found is None:
        return ()
    said = found[0].said.format(own=own * lines.length, left=found[1] * lines.length)
    return (Suspicion(said, certain),)


def wrong_frame(session: ReadSession) -> tuple[Suspicion, ...]:
    """Ends that fit all fixtures once all points are moved, rotated or mirrored together."""
    lines = session.lines
    own = lines.overall(lines.measured)
    several = len(lines.names) > 2  # with fewer lines some rotation and origin always fit
    if own > CONTRADICTS and (
        found := _by_ends(lines, own, _exchanged_axes(lines, several), lines.overall)
    ):
        return found
    if not (several and np.all(np.isfinite(lines.declared))):
        return ()
    fitted = (_fitted(lines, axes) for axes in exchanges(lines.declared.shape[2]))
    return _by_ends(lines, own, fitted, lines.overall, near=1.0, certain=own > CONTRADICTS)


def _exchanged_axes(lines: Lines, several: bool) -> Iterator[Hypothesis[FloatArray]]:
    """Ends of the points from another origin, with other axes, and with both."""
    shift = _shift(lines, lines.measured)
    yield Hypothesis(
        f"all lines lie ({listed(shift, '.4g')}) m away from their start and end. Try: measure "
        "fixtures and lines from the same origin; subtract this from the points, or add it to "
        "start and end.",
        lines.measured - shift,
    )
    for moved, axes in product((False, True)[: 1 + several], exchanges(len(shift))[1:]):
        turned, what = lines.measured @ axes.T, named(axes)
        if moved:
            shift = _shift(lines, turned)
            turned, what = turned - shift, f"{what} and moved by ({listed(-shift, '.4g')}) m"
        yield _in_frame(what, turned)


def _in_frame(what: str, measured: FloatArray) -> Hypothesis[FloatArray]:
    said = (
        "the lines do not end at start and end of their poses ({own:.3g} m RMS), but do "
        f"({{left:.3g}} m) with {what}. Try: points, start, end, orientations and gravity in one "
        "frame, right-handed, in a plane x to the right and y up; in pictures rows count "
        "downwards; a camera's points by its calibration."
    )
    return Hypothesis(said, measured)


def _shift(lines: Lines, measured: FloatArray) -> FloatArray:
    """Best translation (d,) [m], taken at the middle of both ends.

    With a free end it is taken at the start, assumed to be the line's first point.
    """
    away = measured.mean(axis=1) - lines.declared.mean(axis=1)
    away = np.where(np.isfinite(away), away, (measured - lines.declared)[:, 0])
    return np.asarray(np.median(away, axis=0))


def _fitted(lines: Lines, turn: FloatArray) -> Hypothesis[FloatArray]:
    """Ends in the frame that fits best, from a first rotation (d, d).

    Declared = rotation measured + translation, by least squares (Kabsch 1976). Its handedness is
    that of the first rotation; the middle of both ends does not depend on the line's order.
    """
    d, hand = len(turn), np.sign(np.linalg.det(turn))
    shift = np.median(lines.declared.mean(axis=1) - lines.measured.mean(axis=1) @ turn.T, axis=0)
    for _ in range(_FITS_OF_FRAME):
        moved = lines.measured @ turn.T + shift
        given, other = (
            np.linalg.norm(ends - lines.declared, axis=(1, 2)) for ends in (moved, moved[:, ::-1])
        )
        swapped = ~lines.known & (other < given)
        source = np.where(swapped[:, None, None], lines.measured[:, ::-1], lines.measured)
        source, goal = source.reshape(-1, d), lines.declared.reshape(-1, d)
        centres = source.mean(axis=0), goal.mean(axis=0)
        u, _, v = np.linalg.svd((goal - centres[1]).T @ (source - centres[0]))
        turn = u @ np.diag([*np.ones(d - 1), hand * np.sign(np.linalg.det(u @ v))]) @ v
        shift = centres[1] - turn @ centres[0]
    return _in_frame(_described(turn, shift), lines.measured @ turn.T + shift)


def _described(turn: FloatArray, shift: FloatArray) -> str:
    """Describe a frame: by its exchanged axes, or by how far it is rotated and moved."""
    d, moved = len(turn), f"moved by ({listed(shift, '.3g')}) m"
    near = min(exchanges(d), key=lambda axes: float(np.linalg.norm(turn - axes)))
    if np.linalg.norm(turn - near) < NEAR_AXES and not np.allclose(near, np.eye(d)):
        return f"{named(near)} and {moved}"
    hand = np.sign(np.linalg.det(turn))
    # A mirrored axis is mirrored before the rotation: y in a plane, all axes in space.
    mirror, whole = np.array([hand**d, hand, hand][:d]), np.eye(3)
    whole[:d, :d] = turn * mirror
    vector = Rotation.from_matrix(whole).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return (
        f"the points {'mirrored, ' if hand < 0 else ''}turned by {np.degrees(angle):.3g} degrees "
        f"about ({listed(vector / max(angle, 1e-12), '.2g')}) and {moved}"
    )


def out_of_step(session: ReadSession) -> tuple[Suspicion, ...]:
    """Ends that fit the fixtures of other poses: files and end positions differ in order."""
    lines = session.lines
    misfit = lines.misfit(lines.measured[:, None], lines.declared[None, :])
    own, order = np.diag(misfit), np.arange(len(misfit))
    _, best = linear_sum_assignment(misfit**2)
    other = misfit[order, best]
    wrong = (own > OUT_OF_STEP) & (other < np.minimum(FITS, MUCH_BETTER * own))
    if wrong.sum() < 2:
        return ()
    pairs = [
        f"{lines.names[i]} shows the ends of {lines.names[best[i]]}" for i in np.flatnonzero(wrong)
    ]
    more = f", and {len(pairs) - 4} more" if len(pairs) > 4 else ""
    step = set((best - order)[wrong].tolist())
    shift = ""
    if len(step) == 1:
        places = step.pop()
        way = "further" if places > 0 else "earlier"
        shift = f" (all of them {abs(places)} {way} in the list)"
    text = (
        f"{len(pairs)} of {len(own)} files belong to other entries of the list of poses{shift}: "
        f"{'; '.join(pairs[:4])}{more}. Try: put file names and end positions in step."
    )
    return (Suspicion(text, True),)


def single_poses(session: ReadSession) -> tuple[Suspicion, ...]:
    """Single wrong poses, each with its first reason.

    Reasons: points in zigzag order; an end where all others have their start, as if both were
    exchanged; a line that ends far from the fixtures.
    """
    lines = session.lines
    ends, own = lines.declared, lines.misfit(lines.measured, lines.declared)
    near = np.linalg.norm(ends - np.median(ends[:, 0], axis=0), axis=2) < FITS * lines.length
    turned = ~near[:, 0] & near[:, 1]
    if len(ends) < 4 or near[:, 0].sum() < 3 * turned.sum():
        turned = np.zeros(len(ends), dtype=bool)
    reasons: list[tuple[BoolArray, Callable[[int], str]]] = [
        (
            lines.lengths > TOO_LONG * lines.length,
            lambda i: (
                f"from point to point its line is {lines.lengths[i]:.4g} m long, the cable "
                f"{lines.length:.4g} m. Try: are its points in order along the cable?"
            ),
        ),
        (
            turned,
            lambda i: (
                f"its end ({listed(ends[i, 1], 'g')}) m is where the other poses have their start. "
                "Try: are start and end exchanged?"
            ),
        ),
        (
            own > CONTRADICTS,
            lambda i: (
                f"its line runs from ({listed(lines.measured[i, 0])}) to "
                f"({listed(lines.measured[i, 1])}) m, {own[i] * lines.length:.3g} m RMS away from "
                f"the declared ends.{lines.short(i)} Try: start and end of this pose, and whether "
                "these are its points."
            ),
        ),
    ]
    said: dict[str, Suspicion] = {}
    for wrong, text in reasons:
        for i in np.flatnonzero(wrong).tolist():
            name = lines.names[i]
            said.setdefault(name, Suspicion.of_pose(name, text(i)))
    return tuple(said.values())


# ---- what the points show -----------------------------------------------------------------------


def repeated(session: ReadSession) -> tuple[Suspicion, ...]:
    """Poses with exactly the same points: one file under two names."""
    seen: dict[bytes, str] = {}
    found = []
    for item in session.read:
        first = seen.setdefault(np.ascontiguousarray(item.points, float).tobytes(), item.name)
        if first != item.name:
            text = (
                f"{item.name} holds exactly the points of {first}, and no two measurements agree "
                "to the last digit. Try: is one file there twice, under two names?"
            )
            found.append(Suspicion(text, False, item.name))
    return tuple(found)


def stretched(session: ReadSession) -> tuple[Suspicion, ...]:
    """Markers that are farther apart than the cable between them is long."""
    marked = [(x.name, x.points, x.s) for x in session.read if x.s is not None]
    texts = {}
    for name, points, s in marked:
        chords, along = np.linalg.norm(np.diff(points, axis=0), axis=1), np.diff(s)
        k = int((chords - along).argmax()) if len(along) else 0
        if len(along) and chords[k] - along[k] > STRETCHED * session.config.cable.length:
            texts[name] = (
                f"its markers at s_m {s[k]:g} and {s[k + 1]:g} are {chords[k]:.4g} m apart, the "
                f"cable between them is {along[k]:.4g} m long"
            )
    advice = ". Try: s_m in metres along the cable, each beside its own point."
    if texts and 2 * len(texts) > len(marked):
        name = next(iter(texts))
        told = f"{len(texts)} of {counted(len(marked), 'pose')}"
        said = f"s_m contradicts the points of {told}. {name}: "
        return (Suspicion(said + texts[name] + advice, True),)
    return tuple(Suspicion.of_pose(name, text + advice) for name, text in texts.items())


def shorter(session: ReadSession) -> tuple[Suspicion, ...]:
    """Lines that are shorter than the cable although no gap could hide the difference.

    A straight piece c, of a curve that turns by an angle a along it, is shorter than the curve by
    a^2 c / 24; with noise, measured angles are too large. A gap that is shorter than the difference
    hides it only in a loop. Gaps to the held ends count as straight.
    """
    length, lines = session.config.cable.length, []
    if not session.config.experiment.boundary.end.place:
        return ()
    read = [item for item in session.read if item.s is None and len(item.points) > 2]
    for item in read:
        pose = session.declared[item.name]
        start, end = np.array(pose.start), np.array(pose.end)
        ways = (np.vstack([start, points, end]) for points in (item.points, item.points[::-1]))
        # In the order in which the gaps to the fixtures are smaller.
        steps = min(
            (np.diff(way, axis=0) for way in ways),
            key=lambda steps: float(np.linalg.norm(steps[[0, -1]], axis=1).sum()),
        )
        chords = np.linalg.norm(steps, axis=1)
        steps = steps[chords > 0] / chords[chords > 0, None]
        chords = chords[chords > 0]
        turns = np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1), -1.0, 1.0))
        turned = np.maximum(np.append(turns, turns[-1:]), np.append(turns[:1], turns))
        least, gap = float(chords.sum()), float(chords.max(initial=0.0))
        missed = float((chords * turned**2).sum() / 24)
        if length - least - missed > max(SHORTER * length, gap):
            lines.append((least, gap))
    if len(lines) < max(2, NEARLY_ALL * len(read)):
        return ()
    shown, gap = np.median(lines, axis=0)
    text = (
        f"from the start along its points to the end the cable is {shown:.3g} m long (median of "
        f"{counted(len(lines), 'pose')}), cable.length is {length:.4g} m, and gaps of at most "
        f"{gap:.2g} m do not hide the difference. Try: cable.length: {shown:.3g}, the length "
        "between the places where the ends are held."
    )
    return (Suspicion(text, False),)


# Alternatives: only the first that finds anything is reported; then independent questions.
ENDS = (wrong_units, counted_from_the_end, wrong_frame, out_of_step, single_poses)
POINTS = (repeated, stretched, shorter)
