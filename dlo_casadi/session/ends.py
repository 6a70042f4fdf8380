"""Find mistakes from points and their ends: units, frames, files in the wrong order.

A wrong unit is a factor of a thousand in the lengths; with a mirrored axis the ends fit once
they are mirrored back; with files in the wrong order the ends fit another pose.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.errors import counted
from dlo_casadi.session.axes import listed
from dlo_casadi.session.lines import SEVERAL, Lines
from dlo_casadi.session.mistakes import (
    COUNTED,
    FITTED_FRAMES,
    FRAMES,
    UNITS_OF_ENDS,
    UNITS_OF_LENGTHS,
)
from dlo_casadi.session.questions import Alternatives, Suspicion
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.thresholds import (
    CONTRADICTS,
    FITS,
    MUCH_BETTER,
    NEAR_UNIT,
    NEARLY_ALL,
    TOO_LONG,
)

# ---- units and frames ---------------------------------------------------------------------------


def _far_from_one(ratio: FloatArray) -> float:
    """Share of ratios that differ from one, up to a quarter."""
    return float(1.0 - ((ratio > 1 / NEAR_UNIT) & (ratio < NEAR_UNIT)).mean())


def _off_spans(lines: Lines) -> float:
    declared, measured = lines.spans
    return _far_from_one(declared / np.maximum(measured, 1e-12))


def _off_fixtures(lines: Lines) -> float:
    return lines.overall


_FEW_OFF = 1 - NEARLY_ALL + 1e-9
_LENGTHS = Alternatives(
    UNITS_OF_LENGTHS, lambda lines: _far_from_one(lines.lengths / lines.length), enough=_FEW_OFF
)
_SPANS = Alternatives(UNITS_OF_ENDS, _off_spans, enough=_FEW_OFF)
_COUNTED = Alternatives(COUNTED, _off_fixtures, FITS, FITS, MUCH_BETTER)
_FRAMES = Alternatives(FRAMES, _off_fixtures, CONTRADICTS, FITS, MUCH_BETTER)
_FITTED = Alternatives(FITTED_FRAMES, _off_fixtures, FITS, FITS, MUCH_BETTER, near=1.0)


def wrong_units(session: ReadSession) -> tuple[Suspicion, ...]:
    """Lengths, or distances of the ends, that are off by the factor of a unit."""
    lines = session.lines
    declared, measured = lines.spans
    far = np.maximum(declared, measured) > CONTRADICTS * lines.length
    apart = np.isfinite(declared) & far
    whole = np.mean(lines.gaps.max(axis=1) < FITS * lines.length) >= NEARLY_ALL
    ends = [lines.of(apart)] * bool(apart.sum() > 1 and whole)
    return _LENGTHS.suspicions([lines]) or _SPANS.suspicions(ends)


def counted_from_the_end(session: ReadSession) -> tuple[Suspicion, ...]:
    """Markers that fit their fixtures if they are counted from the other end."""
    known = session.lines.known
    return _COUNTED.suspicions([session.lines.of(known)] * bool(known.any()))


def wrong_frame(session: ReadSession) -> tuple[Suspicion, ...]:
    """Ends that fit all fixtures once all points are moved, rotated or mirrored together."""
    lines = session.lines
    fitted = [lines] * bool(len(lines.names) >= SEVERAL and np.all(np.isfinite(lines.declared)))
    return _FRAMES.suspicions([lines]) or _FITTED.suspicions(fitted)


# ---- order --------------------------------------------------------------------------------------


def out_of_step(session: ReadSession) -> tuple[Suspicion, ...]:
    """Ends that fit the fixtures of other poses: files and end positions differ in order."""
    lines = session.lines
    misfit = lines.misfit(lines.measured[:, None], lines.declared[None, :])
    own, order = np.diag(misfit), np.arange(len(misfit))
    _, best = linear_sum_assignment(misfit**2)
    other = misfit[order, best]
    wrong = (own > FITS) & (other < np.minimum(FITS, MUCH_BETTER * own))
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
        if len(along) and chords[k] - along[k] > FITS * session.config.cable.length / 2:
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
    held = session.config.experiment.boundary
    if not held.end.place or held.start.slides or held.end.slides:
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
        if length - least - missed > max(FITS * length, gap):
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
