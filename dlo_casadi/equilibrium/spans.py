"""First guesses of a cable held by clips between its ends: arcs, span by span.

A span reaches from one holder to the next; bars whose sides a pose names count as holders here. In
a plane the arc of a span turns either way; in space it bulges along gravity or is rotated about its
chord by quarter turns. The spans also determine whether a pose is within reach.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.arcs import Span, arc_frames
from dlo_casadi.equilibrium.guess_table import SLACK, SLACKS, GuessRow, guess_table
from dlo_casadi.equilibrium.guesses import (
    arc_headings,
    arc_into_clamps,
    downwards,
    fallen,
    guessed_frames,
    guesses,
    true_ends,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.sides import named_sides
from dlo_casadi.errors import EquilibriumError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import tangents
from dlo_casadi.model.contact import surfaces_at
from dlo_casadi.model.functions import functions_of
from dlo_casadi.rod.ends import fed_ends
from dlo_casadi.rod.node import Frame

# Distance [lengths] within which two places are one; eyelets 1 mm apart are no difficulty.
ONE_PLACE = 1e-6
# Largest free length over the cable's: one beyond it is given in another unit.
MOST_FED = 10.0
# Number of candidate places along the axis of a bar at one of which the cable passes it.
_ALONG = 21


@dataclass(frozen=True)
class _Holder:
    """Something that holds the cable: an end, a clip, or a bar that it passes.

    `at` is None for an eyelet, an end that slides, or a bar, `place` is None for a free end.
    """

    at: float | None
    place: FloatArray | None
    frame: FloatArray | None = None
    rolls: bool = False
    passed: bool = False

    def chord_to(self, other: "_Holder") -> FloatArray | None:
        """Vector (dimension,) [m] to the next holder; None to a free end."""
        return None if self.place is None or other.place is None else other.place - self.place


def holders(model: CableModel, p: FloatArray, pose: HeldPose) -> list[_Holder]:
    """All holders of the cable, from start to end; arc lengths relative to the declared length."""
    (start, end), clamps, _ = true_ends(model, p, pose)
    first = None if model.start.slides else 0.0
    found = [_Holder(first, start, clamps[0], not model.start.roll)]
    places, at, turns = (np.array(x) for x in functions_of(model).true_clips(p, pose.vector))
    for k, clip in enumerate(pose.clips):
        s = None if clip.kind.slides else float(at[k, 0])
        frame = None if clip.frame is None else model.node.moved(clip.frame, turns[:, k])
        found.append(_Holder(s, places[:, k], frame, not clip.kind.roll))
    place = end if model.end.place else None
    last = None if model.end.slides else model.cable.length
    found.append(_Holder(last, place, clamps[1], not model.end.roll))
    return found


def _with_bars(model: CableModel, pose: HeldPose, held: Sequence[_Holder]) -> list[_Holder]:
    """All holders, including the bars whose sides a pose names, see `named_sides`."""
    found = list(held)
    for bar, up, over in named_sides(model, pose):
        clear = (bar.radius + model.cable.diameter / 2) * (1 if over else -1)
        share = np.linspace(0.0, 1.0, _ALONG)[:, None]
        places = bar.a + share * np.subtract(bar.b, bar.a) + clear * up
        _insert(found, places)
    return found


def _insert(held: list[_Holder], places: FloatArray) -> int:
    """Insert one of places (K, d) [m] between the holders where it lengthens the path least.

    Returns its index among them.
    """
    longer: list[FloatArray] = []
    for before, beyond, apart in zip(held, held[1:], chords(held), strict=False):
        ways = [x.place for x in (before, beyond) if x.place is not None]
        longer.append(sum(np.linalg.norm(places - x, axis=1) for x in ways) - apart)
    k, i = np.unravel_index(np.argmin(longer), (len(longer), len(places)))
    held.insert(int(k) + 1, _Holder(None, places[i], passed=True))
    return int(k) + 1


def arches(
    model: CableModel, p: FloatArray, pose: HeldPose, place: FloatArray
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """First guesses of a cable that touches down at a place (d,) [m], as `first_guesses`.

    The slack forms an arch against gravity on each side of the place; all other spans sag.
    """
    held = holders(model, p, pose)
    k = _insert(held, place[None])
    up = model.node.sides // 2
    spans = range(len(held) - 1)
    rows = [GuessRow(tuple(up * (i == arch) for i in spans)) for arch in (k - 1, k)]
    yield from _span_guesses(model, pose, held, rows)


def chords(held: Sequence[_Holder]) -> list[float]:
    """Distances [m] from each holder to the next; zero to a free end."""
    steps = (a.chord_to(b) for a, b in pairwise(held))
    return [0.0 if step is None else float(np.linalg.norm(step)) for step in steps]


def fixed_stretches(held: Sequence[_Holder]) -> list[tuple[int, int, float]]:
    """Pairs of holders with only eyelets between them, and the declared length [m] in between."""
    known = [(k, one.at) for k, one in enumerate(held) if one.at is not None]
    return [(low, high, end - start) for (low, start), (high, end) in pairwise(known)]


def _arc_lengths(held: Sequence[_Holder], share: float) -> list[float]:
    """Arc lengths [m] of all holders; eyelets share the slack evenly, or as in SLACKS.

    Beyond the holders of known arc lengths, up to ends that slide, spans are longer than their
    chords by SLACK.
    """
    at, apart = [one.at or 0.0 for one in held], chords(held)
    known = [k for k, one in enumerate(held) if one.at is not None] or [0]
    for k in range(known[0], 0, -1):
        at[k - 1] = at[k] - (1 + SLACK) * apart[k - 1]
    for k in range(known[-1], len(held) - 1):
        at[k + 1] = at[k] + (1 + SLACK) * apart[k]
    for low, high, length in fixed_stretches(held):
        own = np.array(apart[low:high])
        slack = max(length - own.sum(), 0.0)
        weights = own + 1e-3 * length
        if share != SLACKS[0]:
            weights = np.full(len(own), (1 - share) / max(len(own) - 1, 1))
            weights[0] = share
        parts = own + slack * weights / weights.sum()
        at[low + 1 : high] = at[low] + np.cumsum(parts)[:-1] * length / parts.sum()
    return at


def spans_of(held: Sequence[_Holder], at: Sequence[float]) -> list[Span]:
    """The spans between holders at these arc lengths [m]."""
    both = zip(pairwise(held), pairwise(at), strict=True)
    return [Span(s, e, a.chord_to(b), (a.frame, b.frame)) for (a, b), (s, e) in both]


def first_guesses(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: HeldPose
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """First guesses of a pose, one by one: nodes (n_nodes, coordinates), and border (n_border,).

    Without clips these are `guesses` or `guessed_frames`; with clips, arcs span by span. If the
    pose names sides of bars, arcs past these bars come first.
    """
    none, held = border_guess(model, p, pose), holders(model, p, pose)
    if named_sides(model, pose):
        past = _with_bars(model, pose, held)
        yield from _span_guesses(
            model, pose, past, guess_table(len(past) - 1, model.in_space, True)
        )
    if pose.clips:
        slides = any(kind.slides for kind in model.clips)
        rows = guess_table(len(held) - 1, model.in_space, slides)
        yield from _span_guesses(model, pose, held, rows)
    elif model.node is Frame:
        yield from ((x, none) for x in guessed_frames(model, p, rest, pose))
    else:
        yield from ((phi[:, None], none) for phi in guesses(model, p, rest, pose))


def _span_guesses(
    model: CableModel, pose: HeldPose, held: Sequence[_Holder], rows: Sequence[GuessRow]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Arcs span by span, for each row of a table; taut spans have one side alone."""
    rolls = [k for k, one in enumerate(held) if one.frame is not None and not one.rolls]
    own = [k for k, one in enumerate(held) if not one.passed]
    tried = set()
    for row in rows:
        at = _arc_lengths(held, SLACKS[row.slack])
        spans, border = spans_of(held, at), np.zeros(model.n_border)
        for k, place in model.sliding.items():
            border[place] = at[own[k]]
        sides = tuple(0 if x.taut else side for side, x in zip(row.sides, spans, strict=True))
        if (known := row._replace(sides=sides)) in tried:
            continue
        tried.add(known)
        places = at[0] + (at[-1] - at[0]) * (model.chain.places / model.chain.length)
        if model.node is Frame:
            edges = [(at[k], held[k].frame) for k in rolls]
            x = arc_frames(model, pose, places, spans, edges, known)
        else:
            x = _joined_headings(model, places, spans, sides)
        if x is not None:
            yield x, border


def border_guess(model: CableModel, p: FloatArray, pose: HeldPose) -> FloatArray:
    """First guess of the border (n_border,): where ends slide, for the length of `true_ends`."""
    border = np.zeros(model.n_border)
    if model.slides:
        *_, length = true_ends(model, p, pose)
        free = length / float(functions_of(model).stretch(p))
        ends = fed_ends(free, model.cable.length, model.loose)
        border[[*fed_rows(model)]] = [ends[k] for k in fed_rows(model).values()]
    return border


def fed_rows(model: CableModel) -> dict[int, int]:
    """Border row of the arc length of each end that slides -> 0 for the start, 1 for the end."""
    both = enumerate(model.sliding.get(k) for k in (0, len(model.clips) + 1))
    return {row: end for end, row in both if row is not None}


def border_of(model: CableModel, pose: HeldPose, x: FloatArray) -> FloatArray:
    """First guess of the border (n_border,) for nodes x: each eyelet is nearest to its place."""
    border, places = border_guess(model, model.nominal, pose), model.chain.places
    eyelets = {k: row for k, row in model.sliding.items() if 0 < k <= len(model.clips)}
    if not eyelets:
        return border
    ahead = tangents(model.node, x)
    steps = (ahead[1:] + ahead[:-1]) / 2 * np.diff(places)[:, None]
    points = np.vstack([np.zeros(steps.shape[1]), steps.cumsum(axis=0)]) + np.array(pose.start)
    low = 0.0
    for k, row in eyelets.items():
        gaps = np.linalg.norm(points - np.array(pose.clips[k - 1].place), axis=1)
        gaps[places <= low] = np.inf
        border[row] = low = float(np.clip(places[gaps.argmin()], places[1], places[-2]))
    return border


# ---- in a plane ----------------------------------------------------------------------------------


def _joined_headings(
    model: CableModel, places: FloatArray, spans: Sequence[Span], sides: tuple[int, ...]
) -> FloatArray:
    """Headings (n_nodes, 1) [rad] at arc lengths `places` (n_nodes,) [m]."""
    gravity = np.array(model.gravity)
    parts = [
        _headings(model, span, (1 - 2 * side) * _sagging(span, gravity))
        for span, side in zip(spans, sides, strict=True)
    ]
    _joined(parts, [any(frame is not None for frame in span.frames) for span in spans])
    at, phi = (np.concatenate(each) for each in zip(*parts, strict=True))
    return np.interp(places, at, phi)[:, None]


def _sagging(span: Span, gravity: FloatArray) -> int:
    """Side of the arc that bulges along gravity: +1 turns counter-clockwise."""
    if span.chord is None:
        return 1
    bulge = np.array([span.chord[1], -span.chord[0]])
    return 1 if bulge @ gravity >= 0 else -1


def _headings(model: CableModel, span: Span, side: int) -> tuple[FloatArray, FloatArray]:
    """Arc lengths and headings inside a span; its ends lie slightly inside to keep kinks apart."""
    u = np.linspace(0.0, 1.0, max(round(span.length / model.chain.h), 4) + 1)
    inner = span.start + span.length * (1e-9 + (1 - 2e-9) * u)
    if span.chord is None:
        down = downwards(model)
        first = down if span.frames[0] is None else float(span.frames[0][0])
        drop = np.angle(np.exp(1j * (down - first)))
        return inner, first + drop * fallen(u)
    chord = span.chord / span.length
    if span.frames == (None, None):
        return inner, arc_headings(u, 1.0, chord, side)
    return inner, arc_into_clamps(u, chord, span.frames, side)[0]


def _joined(parts: list[tuple[FloatArray, FloatArray]], fixed: list[bool]) -> None:
    """Shift spans without a clamp by full turns toward their neighbours."""
    known = list(fixed) if any(fixed) else [True] + [False] * (len(parts) - 1)
    for order, own, beside in (
        (range(1, len(parts)), 0, -1),
        (range(len(parts) - 2, -1, -1), -1, 0),
    ):
        for k in order:
            other = k - 1 if own == 0 else k + 1
            if known[other] and not known[k]:
                s, phi = parts[k]
                turns = np.round((parts[other][1][beside] - phi[own]) / (2 * np.pi))
                parts[k], known[k] = (s, phi + 2 * np.pi * turns), True


# ---- whether a pose is in reach ------------------------------------------------------------------


def no_equilibrium(pose: HeldPose, what: str, hint: str) -> EquilibriumError:
    """The error of a pose: what is wrong, and what to try."""
    return EquilibriumError(f"{what}.\n  Try: {hint}", pose.name, pose.end)


def nothing_found(model: CableModel, pose: HeldPose, start: str) -> EquilibriumError:
    """The error of a pose for which no equilibrium was found from this start."""
    where = "its end free" if pose.end is None else f"its end at {pose.end} m"
    checked = "stiffnesses and orientations" if pose.node is Frame else "stiffness and the headings"
    hint = f"a finer mesh (model.n), or check the {checked}."
    if pose.turns:
        where += f" and {pose.turns:g} turns"
        hint = f"fewer turns (a twisted cable loops), {hint}"
    for side, tension in zip(("start", "end"), pose.tensions, strict=True):
        if tension is not None:
            where += f" and {side}_tension {tension:g} N"
            hint = f"more tension, without which it runs through the guide, {hint}"
    beside = [*(clip.name for clip in pose.clips), *(one.name for one in model.surfaces)]
    if beside:
        where += f", beside {', '.join(beside)}"
        hint = f"more room between them, {hint}"
    return no_equilibrium(pose, f"no equilibrium found from {start} with {where}", hint)


def out_of_reach(model: CableModel, p: FloatArray, pose: HeldPose) -> EquilibriumError | None:
    """Why a pose is out of reach: its end is missing or too far, or a number is meaningless."""
    if fed := pose.wrongly_fed((model.start, model.end), by_length=model.fed_by_length):
        return no_equilibrium(pose, f"no equilibrium: {fed}", "one of them where an end slides.")
    if pose.end is None and model.end.place:
        what = f"no equilibrium: the end of the cable is {model.end}, and the pose has none"
        return no_equilibrium(pose, what, "Pose(start, end).")
    if wrong := _meaningless(pose) or _wrong_clips(model, p, pose) or _inside(model, p, pose):
        return no_equilibrium(pose, *wrong)
    if pose.free_length is not None and pose.free_length > MOST_FED * model.cable.length:
        what = f"free_length is {pose.free_length:g} m, the cable is {model.cable.length:g} m long"
        return no_equilibrium(pose, f"no equilibrium: {what}", "free_length in metres?")
    by_length, free = pose.free_length is not None, pose.free_length or 0.0
    if pose.end is None or model.extensible or (model.slides and not by_length):
        return None
    (start, end), _, length = true_ends(model, p, pose)
    distance = float(np.linalg.norm(end - start))
    if by_length:
        length = free * float(functions_of(model).stretch(p))
    if distance < length:
        return None
    where = ", ".join(f"{x:.4f}" for x in pose.end)
    told = "the free length" if by_length else "the cable"
    what = (
        f"no equilibrium: the end ({where}) m is {distance:.4f} m "
        f"from the start, {told} is {length:.4f} m"
    )
    what += " long" * (not by_length)
    asked = "a longer free_length?" if by_length else "cable.length?"
    return no_equilibrium(pose, what, f"end in metres? {asked}")


def _meaningless(pose: HeldPose) -> tuple[str, str] | None:
    """Which number of a pose is not finite, or which quaternion zero, and what to try."""
    camera = pose.vector[len(pose.ends) :][:3]
    known = {"start": pose.start, "end": pose.end, **pose.directions, "camera": camera}
    known |= {"start_tension": pose.start_tension, "end_tension": pose.end_tension}
    known["free_length"] = pose.free_length
    for clip in pose.clips:
        own = {"place": clip.place, "at": clip.at, "direction": clip.frame}
        known |= {f"{what} of {clip.name}": x for what, x in own.items()}
    for name, x in known.items():
        if x is not None and not np.all(np.isfinite(x)):
            what = f"no equilibrium: a number of the pose is not finite: {name} {x}"
            return what, "see where this number comes from."
        if np.size(x) == 4 and not np.any(x):
            what = f"no equilibrium: a quaternion of the pose is zero: {name}"
            return what, "(0, 0, 0, 1), which turns nothing."
    return None


def _inside(model: CableModel, p: FloatArray, pose: HeldPose) -> tuple[str, str] | None:
    """Why obstacles leave no equilibrium, and what to try: a fixture is inside an obstacle."""
    held = [("start", pose.start), *((clip.name, clip.place) for clip in pose.clips)]
    held += [("end", pose.end)] if pose.end is not None else []
    surfaces = surfaces_at(model, p)
    for name, place in held:
        for obstacle in surfaces:
            depth = -float(obstacle.near(np.array(place)).distance)
            if depth > 0:
                at = ", ".join(f"{x:.4f}" for x in place)
                what = f"no equilibrium: the {name} ({at}) m is {depth:.4f} m inside"
                return f"{what} {obstacle.name}", "the obstacle's place, or its normal."
    return None


def _wrong_clips(model: CableModel, p: FloatArray, pose: HeldPose) -> tuple[str, str] | None:
    """Why clips leave no equilibrium, and what to try: wrong kinds, no room on mesh or cable.

    Eyelets may be anywhere between the clips beside them.
    """
    if tuple(clip.kind for clip in pose.clips) != model.clips:
        own, others = (", ".join(x) or "none" for x in ([c.kind for c in pose.clips], model.clips))
        return f"no equilibrium: the pose has the clips {own}, the model {others}", "the same."
    if len(pose.clips) >= model.n:
        what = f"{counted(len(pose.clips), 'clip')} on {counted(model.n, 'element')}"
        return f"no equilibrium: {what}, a clip needs a node", "a finer mesh (model.n)."
    clamped = [float(x.at or 0.0) / model.chain.h for x in pose.clips if x.kind.direction]
    if len({*np.rint(clamped)}) < len(clamped):
        what = f"clamped clips are nearer to each other than an element, {model.chain.h:.4g} m"
        return f"no equilibrium: {what}", "a finer mesh (model.n)."
    held = holders(model, p, pose) if pose.clips and not model.extensible else []
    names = ["the start", *(clip.name for clip in pose.clips), "the end"]
    apart = chords(held)
    for k, (one, other) in enumerate(pairwise(held)):
        free = other.place is None or (one.at is not None and other.at is not None)
        if not free and apart[k] < ONE_PLACE * model.cable.length:
            what = f"no equilibrium: {names[k]} and {names[k + 1]} are at the same place, where any"
            return f"{what} length of cable may lie in a loop", "one of them, or places apart."
    stretch = float(functions_of(model).stretch(p))
    for low, high, declared in fixed_stretches(held):
        length = declared * stretch
        if sum(apart[low:high]) >= length:
            way = " by way of the eyelets" if high > low + 1 else ""
            what = (
                f"no equilibrium: {names[low]} and {names[high]} are {sum(apart[low:high]):.4f} m "
                f"apart{way}, with {length:.4f} m of cable between them"
            )
            return what, "places and arc lengths in metres, in the order along the cable?"
    return None
