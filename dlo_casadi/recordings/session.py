"""From a recording to the files of a session: poses, grippers' frames, markers along the cable."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from textwrap import wrap
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.template import template
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.recordings.recording import Recording
from dlo_casadi.recordings.stills import Still, align_clocks, find_stills

FREE = "free"
_COLUMNS = 98  # of a comment
_SAMPLES = 50  # points of a spline between two markers, for its length: exact to 1e-5
_STRAY = 0.7  # direction cosine of a gripper's axis and the cable from which they may be the same
_LONGER = 0.03  # relative difference of a declared and a measured length: a mistake
_DENSITY = 2200.0  # kg/m^3, of a cable whose mass is not known, for `Imported.stand_ins`


@dataclass(frozen=True)
class Wishes:
    """What a recording does not tell, and its user may."""

    start: str = "start"
    """Name of the body that holds the start, or of three markers `o,x,y`: its place, a point along
    its x axis, and one on the side of y."""
    end: str = "end"
    """The same of the end; `free` if nothing holds it."""
    start_offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Where the cable leaves the start body, in its axes [m]."""
    end_offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    cable: str = ""
    """What the names of the cable's markers contain; all that are left when empty."""
    at: tuple[float, ...] = ()
    """Arc lengths of its markers from the start [m], ascending; measured in the poses if empty."""
    hold: float = 0.5
    """Shortest still stretch that is a pose [s]."""
    held_out: int = 4
    """Every so many poses one is held out; 0 for none."""
    known: Mapping[str, float] = field(default_factory=dict)
    """Keys and values of the section `cable`."""


@dataclass(frozen=True)
class Imported:
    """Files of a session that are not written yet."""

    name: str
    points: dict[str, tuple[FloatArray, FloatArray | None]]
    """Points (K, 3) [m] and arc lengths (K,) [m] of each CSV file."""
    cable: dict[str, str]
    """What is known of the cable, as text."""
    poses: tuple[dict[str, str], ...]
    end: str
    remarks: tuple[str, ...]

    def text(self, cable: Mapping[str, str] | None = None) -> str:
        """The configuration; with other values of the cable, if given."""
        return template(
            self.name,
            list(self.points),
            "centerlines",
            in_space=True,
            cable=self.cable if cable is None else cable,
            poses=self.poses,
            end=self.end,
            remarks=[line for remark in self.remarks for line in wrap(remark, _COLUMNS)],
        )

    @property
    def stand_ins(self) -> dict[str, str]:
        """Values of the cable with which the geometry can be checked before all are known.

        Shapes tell stiffness over weight alone: any mass serves, and a fit finds its stiffness.
        """
        length = float(self.cable["length"])
        diameter = float(self.cable.get("diameter", 0.01 * length))
        mass = float(self.cable.get("mass", _DENSITY * np.pi / 4 * diameter**2 * length))
        found = {"diameter": diameter, "mass": mass, "bending_stiffness": _guess(mass, length)}
        return {**{key: f"{value:.4g}" for key, value in found.items()}, **self.cable}


@dataclass(frozen=True)
class _Gripper:
    """A fixture in all poses: places (P, 3) [m], and frames (P, 3, 3) with x along the cable."""

    places: FloatArray
    frames: FloatArray

    def turned(self, axes: FloatArray) -> "_Gripper":
        """With other axes, given as columns in its own."""
        return _Gripper(self.places, self.frames @ axes)


def make_session(name: str, recording: Recording, wishes: Wishes) -> Imported:
    """Make a session of a recording: align clocks, find poses, name markers, turn grippers.

    Parameters
    ----------
    name : str
        What to call the cable.

    Raises
    ------
    MeasurementError
        If the recording does not hold what a session takes; the message says what to try.
    """
    recording, offsets = align_clocks(recording)
    stills = find_stills(recording, wishes.hold)
    start = _gripper(wishes.start, wishes.start_offset, "start", stills, recording)
    end = None
    if wishes.end != FREE:
        end = _gripper(wishes.end, wishes.end_offset, "end", stills, recording)
    markers = _cable_markers(recording, stills, wishes)
    remarks = [*recording.assumptions, *(offset.told for offset in offsets)]
    if start is None or (end is None and wishes.end != FREE):
        remarks.append(
            "no body holds the cable in this recording: fill in places and orientations, or "
            "--start, --end with three markers each; an end that nothing holds is free"
        )
    order = _in_order(markers, None if start is None else start.places)
    names, places = [list(markers)[k] for k in order], np.array([*markers.values()])[order]
    start, end = _along_cable(start, end, places, remarks)
    s, length = _arc_lengths(start, places, end)
    fixtures = "from fixture to fixture" if start and end else "as far as fixtures and markers go"
    declared = wishes.known.get("length")
    remarks.append(f"length: {length:.4f} m along a spline {fixtures}, mean of all poses")
    if declared is not None and abs(length / declared - 1.0) > _LONGER:
        raise MeasurementError(
            f"the cable is {length:.4f} m long {fixtures} (a spline through the markers), but "
            f"--length is {declared:g} m.\n  Try: --length between the fixtures; --units; "
            "--start-offset and --end-offset where the cable does not leave a body at its origin."
        )
    if wishes.at:
        s = np.array(wishes.at)
        if len(s) != len(names):
            raise MeasurementError(
                f"--at gives {counted(len(s), 'arc length')} of {counted(len(names), 'marker')} "
                f"({', '.join(names)})"
            )
        remarks.append(f"markers: {', '.join(names)}, at the arc lengths of --at")
    else:
        remarks.append(
            f"markers by arc length ({', '.join(names)}) along that spline; --at if they were "
            "measured with a tape"
        )
    readings = _readings(recording, stills, wishes, remarks)
    known = {"length": length, **wishes.known}
    if "mass" in known and "bending_stiffness" not in known:
        known["bending_stiffness"] = _guess(known["mass"], known["length"])
        remarks.append("bending_stiffness: a guess from weight and length")
    return Imported(
        name,
        {f"pose_{k:02d}.csv": _seen(places[:, k - 1], s) for k in range(1, len(stills) + 1)},
        {key: f"{value:.6g}" for key, value in known.items()},
        tuple(
            {**_declared(k, still, start, end, wishes), **readings[k]}
            for k, still in enumerate(stills)
        ),
        FREE if wishes.end == FREE else "clamped",
        tuple(remarks),
    )


def _guess(mass: float, length: float) -> float:
    """Stiffness [N m^2] of a cable that bends visibly under its weight, right to decades."""
    return mass * 9.81 * length**2 / 30.0


def _declared(
    k: int, still: Still, start: _Gripper | None, end: _Gripper | None, wishes: Wishes
) -> dict[str, str]:
    """What a configuration says of pose `k`."""
    found = {"remark": still.told}
    found["role"] = "held_out" if wishes.held_out and not (k + 1) % wishes.held_out else "fit"
    for side, gripper in (("start", start), ("end", end)):
        if gripper is not None:
            turn = Rotation.from_matrix(gripper.frames[k]).as_quat(canonical=True)
            found[side] = _row(gripper.places[k])
            found[f"{side}_orientation"] = _row(turn)
    return found


def _row(values: FloatArray) -> str:
    return f"[{', '.join(f'{x:.6f}' for x in values + 0.0)}]"


def _seen(places: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Markers that were seen in a pose, rounded to a micrometre."""
    seen = np.isfinite(places).all(axis=1)
    return np.round(places[seen], 6), np.round(s[seen], 6)


# ---- grippers -----------------------------------------------------------------------------------


def _gripper(
    name: str, offset: Sequence[float], side: str, stills: Sequence[Still], recording: Recording
) -> _Gripper | None:
    """The body, or the three markers, that hold an end; None where the recording has no body."""
    if name.count(",") == 2:
        o, x, y = (_means(stills, f"marker {part.strip()}", recording) for part in name.split(","))
        first = (x - o) / np.linalg.norm(x - o, axis=1, keepdims=True)
        third = np.cross(first, y - o)
        third /= np.linalg.norm(third, axis=1, keepdims=True)
        frames = np.stack([first, np.cross(third, first), third], axis=2)
        return _Gripper(o + frames @ np.array(offset), frames)
    bodies = recording.of("body")
    if not bodies and name == side:
        return None
    if name not in bodies:
        raise MeasurementError(
            f"no body is called {name!r}, which holds the {side} of the cable; found: "
            f"{', '.join(bodies) or 'none'}.\n  Try: --{side} NAME of one of them, or --{side} "
            "O,X,Y of three markers on it: its place, along its x axis, on the side of y."
        )
    values = _means(stills, f"body {name}", recording)
    frames = Rotation.from_quat(values[:, 3:]).as_matrix()
    return _Gripper(values[:, :3] + frames @ np.array(offset), frames)


def _means(stills: Sequence[Still], key: str, recording: Recording) -> FloatArray:
    """Means (P, k) of a stream in all poses."""
    kind, name = key.split(" ", 1)
    if not any(key in still.values for still in stills):
        known = ", ".join(stream.name for stream in recording.streams if stream.kind == kind)
        raise MeasurementError(f"no {kind} {name!r} was seen in any pose; found: {known}")
    for k, still in enumerate(stills, start=1):
        if key not in still.values:
            raise MeasurementError(
                f"{key} is not seen in pose {k} ({still.begin:.2f} to {still.end:.2f} s).\n"
                "  Try: fill its gaps, or cut the recording there."
            )
    return np.array([still.values[key] for still in stills])


def _along_cable(
    start: _Gripper | None, end: _Gripper | None, places: FloatArray, remarks: list[str]
) -> tuple[_Gripper | None, _Gripper | None]:
    """Grippers with x along the cable from start to end, and the least roll between them.

    Of the six axes of a body the one that points most along the way to the nearest marker; of the
    four ways to roll the end about it the one with the smallest twist of the cable over all poses.
    What is left of it is a nuisance of the fit, `end_roll`.
    """
    if start is not None:
        start = _aimed(start, places[0] - start.places, "start", remarks)
    if end is not None:
        end = _aimed(end, end.places - places[-1], "end", remarks)
    if start is not None and end is not None:
        rolls = [Rotation.from_rotvec([k * np.pi / 2, 0, 0]).as_matrix() for k in range(4)]
        twists = [_twist(start, places, end.turned(roll)) for roll in rolls]
        end = end.turned(rolls[int(np.argmin(np.abs(twists)))])
    return start, end


def _aimed(gripper: _Gripper, ways: FloatArray, side: str, remarks: list[str]) -> _Gripper:
    """The gripper with that of its axes as x that points most along the ways (P, 3)."""
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    cosines = np.nanmean(np.einsum("pij,pi->pj", gripper.frames, ways), axis=0)
    k = int(np.argmax(np.abs(cosines)))
    sign = float(np.sign(cosines[k]))
    angle = np.degrees(np.arccos(min(1.0, abs(cosines[k]))))
    if abs(cosines[k]) < _STRAY:
        raise MeasurementError(
            f"no axis of the body at the {side} is directed along the cable: the nearest is "
            f"{'-' if sign < 0 else ''}{'xyz'[k]}, {angle:.0f} degrees off the way to the nearest "
            f"marker.\n  Try: a body whose x axis is the cable's direction in the clamp; --up; "
            "cable and grippers in one frame."
        )
    remarks.append(
        f"{side} gripper: its {'-' if sign < 0 else ''}{'xyz'[k]} axis is taken along the cable "
        f"({angle:.0f} degrees off the way to the nearest marker)"
    )
    axes = np.zeros((3, 3))
    axes[k, 0], axes[(k + 1) % 3, 1], axes[(k + 2) % 3, 2] = sign, sign, 1.0
    return gripper.turned(axes)


def _twist(start: _Gripper, places: FloatArray, end: _Gripper) -> float:
    """Mean angle [rad] from the start frame, moved along the cable without twist, to the end's."""
    total = 0j
    for k, (first, last) in enumerate(zip(start.frames, end.frames, strict=True)):
        line = places[:, k][np.isfinite(places[:, k]).all(axis=1)]
        line = np.vstack([start.places[k], line, end.places[k]])
        steps = np.diff(line, axis=0)
        ways = [first[:, 0], *(steps / np.linalg.norm(steps, axis=1)[:, None]), last[:, 0]]
        side = first[:, 1]
        for a, b in pairwise(ways):
            side = side - (side @ b) / (1.0 + a @ b) * (a + b)
        total += complex(side @ last[:, 1], side @ last[:, 2])
    return float(-np.angle(total))


def _readings(
    recording: Recording, stills: Sequence[Still], wishes: Wishes, remarks: list[str]
) -> list[dict[str, str]]:
    """Forces and moments of each pose in the world's axes, by their keys in a configuration."""
    found: list[dict[str, str]] = [{} for _ in stills]
    for name, stream in recording.of("wrench").items():
        named = (stream.frame, name)
        side = "start" if any(wishes.start in text for text in named) else "end"
        if wishes.end == FREE and side == "end":
            continue
        for still, row in zip(stills, found, strict=True):
            wrench, body = still.values.get(f"wrench {name}"), f"body {stream.frame}"
            if wrench is None or (
                stream.frame in recording.of("body") and body not in still.values
            ):
                continue
            turn = Rotation.identity()
            if body in still.values:
                turn = Rotation.from_quat(still.values[body][3:])
            row[f"{side}_force"] = _row(turn.apply(wrench[:3]))
            row[f"{side}_moment"] = _row(turn.apply(wrench[3:]))
        axes = stream.frame if stream.frame in recording.of("body") else "the world"
        remarks.append(
            f"{side}_force, {side}_moment: means of {name}, in axes of {axes}; taken as those of "
            "the cable on its fixture, about its place, with the gripper's weight taken off"
        )
    return found


# ---- markers ------------------------------------------------------------------------------------


def _cable_markers(
    recording: Recording, stills: Sequence[Still], wishes: Wishes
) -> dict[str, FloatArray]:
    """Places (P, 3) [m] of each of the cable's markers; nan in poses where it is not seen."""
    of_grippers = {part.strip() for name in (wishes.start, wishes.end) for part in name.split(",")}
    names = [
        name for name in recording.of("marker") if wishes.cable in name and name not in of_grippers
    ]
    nowhere = np.full(3, np.nan)
    found = {
        name: np.array([still.values.get(f"marker {name}", nowhere) for still in stills])
        for name in names
    }
    found = {name: places for name, places in found.items() if np.isfinite(places).any()}
    if len(found) < 2:
        known = ", ".join(recording.of("marker")) or "none"
        raise MeasurementError(
            f"{counted(len(found), 'marker')} of the cable: a pose takes two or more. Markers in "
            f"this recording: {known}.\n  Try: --cable with a part of their names."
        )
    return found


def _in_order(markers: Mapping[str, FloatArray], starts: FloatArray | None) -> list[int]:
    """Markers from the start to the end of the cable.

    The greatest distance of two markers over all poses is close to their distance along the cable,
    in which the shortest tree that joins all of them is the cable itself.
    """
    places = np.array([*markers.values()])
    away: Callable[[FloatArray, FloatArray], float] = lambda a, b: float(  # noqa: E731
        np.nanmax(np.linalg.norm(a - b, axis=1), initial=0.0)
    )
    apart = np.array([[away(a, b) for b in places] for a in places])
    tree = minimum_spanning_tree(apart)
    neighbours = np.bincount(np.concatenate(tree.nonzero()), minlength=len(places))
    if neighbours.max() > 2:
        branch = list(markers)[int(np.argmax(neighbours))]
        raise MeasurementError(
            f"the markers are no chain: three lead to {branch!r}.\n  Try: --cable with a part of "
            "the names of the cable's own markers."
        )
    tips = np.flatnonzero(neighbours == 1).tolist()
    if starts is not None:
        tips = sorted(tips, key=lambda k: away(places[k], starts))
    order, _ = depth_first_order(tree, tips[0], directed=False)
    return [int(k) for k in order]


def _arc_lengths(
    start: _Gripper | None, places: FloatArray, end: _Gripper | None
) -> tuple[FloatArray, float]:
    """Arc lengths (M,) [m] of markers from the start, and the cable's length [m].

    Means over all poses of the lengths of a cubic spline through fixtures and markers, clamped in
    the grippers' directions.
    """
    knots = places
    if start is not None:
        knots = np.concatenate([start.places[None], knots])
    if end is not None:
        knots = np.concatenate([knots, end.places[None]])
    spans = np.full((knots.shape[1], len(knots) - 1), np.nan)
    for k, row in enumerate(spans):
        seen = np.flatnonzero(np.isfinite(knots[:, k]).all(axis=1))
        if len(seen) < 2:
            continue
        x = knots[seen, k]
        ends: Any = tuple(
            (1, gripper.frames[k, :, 0]) if gripper is not None else (2, np.zeros(3))
            for gripper in (start, end)
        )
        lengths = np.linalg.norm(np.diff(x, axis=0), axis=1)
        for _ in range(3):  # the parameter tends to the arc length
            t = np.concatenate([[0.0], np.cumsum(lengths)])
            curve = CubicSpline(t, x, bc_type=ends)
            fine = np.linspace(t[:-1], t[1:], _SAMPLES + 1, axis=1)
            lengths = np.linalg.norm(np.diff(curve(fine), axis=1), axis=2).sum(axis=1)
        for i, j, span in zip(seen, seen[1:], lengths, strict=False):
            if j == i + 1:
                row[i] = span
    found = np.nanmean(spans, axis=0)
    s = np.concatenate([[0.0], np.cumsum(found)])
    first = 0 if start is None else 1
    return s[first : first + len(places)], float(s[-1])
