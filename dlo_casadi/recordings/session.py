"""Turn a recording into a session's files: poses, gripper frames, markers along the cable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import wrap
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.config.options import DeclaredTolerances
from dlo_casadi.config.sections import DENSITY
from dlo_casadi.config.template import template
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.recordings.clouds import cloud_lines
from dlo_casadi.recordings.fixtures import Gripper, along_cable, find_gripper, readings_of
from dlo_casadi.recordings.recording import FREE, Cloud, Recording, Stream, Wishes
from dlo_casadi.recordings.stills import Still, align_clocks, find_stills
from dlo_casadi.thresholds import STRETCHED

_COLUMNS = 98  # width of a comment
_LONGER = 0.03  # relative difference of declared and measured length beyond which one is a mistake
# Scatter of the length from pose to pose beyond which arc lengths are doubtful, relative. Rendered
# from one session: below 0.1 % for eight markers or more, up to 0.15 % for six, 0.9 % for four, 2.9
# % for three; errors of arc lengths are 0.5 to 1.6 times the scatter. Grippers 20 mm off: 0.3 %.
_DOUBTFUL = 2e-3
_FEW = 4  # markers through which a spline is often shorter than the cable
# m, distance of a marker from a fixture below which their direction is not the cable's: a spline
# through a marker 1 mm from a gripper's origin, in any direction, was 4 to 14 mm too long.
_BESIDE = 0.01
_SAMPLES = 50  # points of a spline between two markers, to compute its length: exact to 1e-5
_LENGTH = DeclaredTolerances().length  # m

Points = tuple[FloatArray, FloatArray | None]  # (K, 3) [m], and arc lengths (K,) [m] of markers


@dataclass(frozen=True)
class Imported:
    """Files of a session that are not yet written."""

    name: str
    points: dict[str, Points]
    """Of each CSV file."""
    cable: dict[str, str]
    """What is known of the cable, as text."""
    length: float
    """Length [m] of the cable as far as it is known."""
    poses: tuple[dict[str, str], ...]
    end: str
    remarks: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    """Those of the remarks that may spoil the result."""
    tolerances: Mapping[str, float] = field(default_factory=dict)
    """How well values of the cable are known, where that is worse than usual."""

    def text(self, cable: Mapping[str, str] | None = None) -> str:
        """Text of the configuration; with other values of the cable, if given."""
        return template(
            self.name,
            list(self.points),
            "centerlines",
            in_space=True,
            cable=self.cable if cable is None else cable,
            poses=self.poses,
            end=self.end,
            tolerances={key: f"{value:.2g}" for key, value in self.tolerances.items()},
            remarks=[line for remark in self.remarks for line in wrap(remark, _COLUMNS)],
        )

    @property
    def stand_ins(self) -> dict[str, str]:
        """Values of the cable with which the geometry can be checked before all are known.

        Shapes determine only stiffness over weight: any mass will do, the fit finds its stiffness.
        """
        length = self.length
        diameter = float(self.cable.get("diameter", 0.01 * length))
        mass = float(self.cable.get("mass", DENSITY * np.pi / 4 * diameter**2 * length))
        found = {"length": length, "diameter": diameter, "mass": mass}
        found["bending_stiffness"] = _guess(mass, length)
        return {**{key: f"{value:.4g}" for key, value in found.items()}, **self.cable}


def make_session(name: str, recording: Recording, wishes: Wishes) -> Imported:
    """Make a session from a recording: align clocks, find poses, name markers, orient grippers.

    Called `name`. Raises MeasurementError if the recording lacks something that a session needs;
    the message says what to try.
    """
    recording, offsets = align_clocks(recording.without_held())
    stills = find_stills(recording, wishes.hold)
    start = find_gripper(wishes.start, wishes.start_offset, "start", stills, recording)
    end = None
    if wishes.end != FREE:
        end = find_gripper(wishes.end, wishes.end_offset, "end", stills, recording)
    doubts: list[str] = []
    tolerances: dict[str, float] = {}
    remarks = [*recording.assumptions, *(offset.told for offset in offsets)]
    holders = wishes.holders.values()
    used: list[Stream | Cloud] = list(recording.clouds)
    used += [s for s in recording.streams if s.kind == "marker" or [s.name] in holders]
    frames = {(item.file, item.frame) for item in used}
    if start is not None and len(frames) > 1:
        origin = "files"
        if len({item.file for item in used}) == 1:
            origin = f"frames ({', '.join(sorted(x or 'one without a name' for _, x in frames))})"
        remarks.append(
            "world frame: cable and grippers are taken to have the same origin and axes, though "
            f"they come from several {origin}, and nothing here registers them. If theirs differ, "
            "calibrate both systems to one frame and export again, or record a bag whose TF joins "
            "the frames"
        )
    if start is None or (end is None and wishes.end != FREE):
        remarks.append(
            "no body holds the cable in this recording: fill in places and orientations, or "
            "--start, --end with three markers each; an end that nothing holds is free"
        )
    if recording.clouds:
        lines, told = cloud_lines(recording, stills, start, end, wishes, remarks)
        start, end = along_cable(start, end, lines, remarks)
        points: list[Points] = [(np.round(line, 6), None) for line in lines]
        length = wishes.known["length"]
    else:
        told = [still.told for still in stills]
        markers = _cable_markers(recording, stills, wishes)
        order = _in_order(markers, start, end)
        names, places = [list(markers)[k] for k in order], np.array([*markers.values()])[order]
        seen = np.isfinite(places).all(axis=2)
        lines = [places[here, k] for k, here in enumerate(seen.T)]
        for k, (line, still) in enumerate(zip(lines, stills, strict=True), start=1):
            if len(line) < 2:
                raise MeasurementError(
                    f"pose {k} ({still.span}) shows {counted(len(line), 'marker')} of the cable, "
                    "but it takes two.\n  Try: fill their gaps, or cut the recording there."
                )
        start, end = along_cable(start, end, lines, remarks)
        s, length, scatter = _along(start, places, end, names, wishes, remarks)
        if "length" not in wishes.known and start and end and scatter > _LENGTH:
            tolerances["length"] = scatter
        if scatter > _DOUBTFUL * length and not (wishes.at and "length" in wishes.known):
            doubts.append(
                f"the length along the markers scatters by {1e3 * scatter:.1f} mm from pose to "
                "pose: arc lengths and length may be wrong by as much. Try: --length and --at, "
                "measured with a tape; more markers; cable and grippers in one frame."
            )
        points = [
            (np.round(line, 6), np.round(s[here], 6))
            for line, here in zip(lines, seen.T, strict=True)
        ]
    readings, on_forces = readings_of(recording, stills, wishes.holders)
    remarks += on_forces
    whole = {"length": length} if start and end else {}  # beyond the last marker it is unknown
    known = {**whole, **wishes.known}
    if "mass" in known and "bending_stiffness" not in known:
        known["bending_stiffness"] = _guess(known["mass"], length)
        remarks.append("bending_stiffness: a guess from weight and length")
    return Imported(
        name,
        {f"pose_{k:02d}.csv": shown for k, shown in enumerate(points, start=1)},
        {key: f"{value:.6g}" for key, value in known.items()},
        known.get("length", length),
        tuple(
            {
                "remark": told[k],
                **_declared(k, start, end, wishes),
                **{key: _row(value) for key, value in readings[k].items()},
            }
            for k in range(len(stills))
        ),
        FREE if wishes.end == FREE else "clamped",
        (*remarks, *doubts),
        tuple(doubts),
        tolerances,
    )


def _guess(mass: float, length: float) -> float:
    """Rough stiffness [N m^2], within decades, of a cable that bends visibly under its weight."""
    return mass * 9.81 * length**2 / 30.0


def _declared(k: int, start: Gripper | None, end: Gripper | None, wishes: Wishes) -> dict[str, str]:
    """Entries of pose `k` in a configuration."""
    left_out = wishes.held_out and not (k + 1) % wishes.held_out
    found = {"role": "held_out" if left_out else "fit"}
    for side, gripper in (("start", start), ("end", end)):
        if gripper is not None:
            turn = Rotation.from_matrix(gripper.frames[k]).as_quat(canonical=True)
            found[side] = _row(gripper.places[k])
            found[f"{side}_orientation"] = _row(turn)
    return found


def _row(values: FloatArray) -> str:
    return f"[{', '.join(f'{x:.6f}' for x in values + 0.0)}]"


# ---- markers ------------------------------------------------------------------------------------


def _cable_markers(
    recording: Recording, stills: Sequence[Still], wishes: Wishes
) -> dict[str, FloatArray]:
    """Positions (P, 3) [m] of each of the cable's markers; nan in poses where it is not seen."""
    of_grippers = {part for parts in wishes.holders.values() for part in parts}
    on_bodies = tuple(f"{body}:" for body in recording.of("body"))  # naming of Motive and Vicon
    names = [
        name
        for name in recording.of("marker")
        if wishes.cable in name and name not in of_grippers and not name.startswith(on_bodies)
    ]
    nowhere = np.full(3, np.nan)
    found = {
        name: np.array([still.values.get(("marker", name), nowhere) for still in stills])
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


def _in_order(
    markers: Mapping[str, FloatArray], start: Gripper | None, end: Gripper | None
) -> list[int]:
    """Order of the markers from the start to the end of the cable.

    The largest distance of two markers over all poses approximates their distance along the cable.
    With these distances the shortest tree that joins all markers is the cable itself.
    """
    places = np.array([*markers.values()])

    def away(a: FloatArray, b: FloatArray) -> float:
        return float(np.nanmax(np.linalg.norm(a - b, axis=1), initial=0.0))

    apart = np.array([[away(a, b) for b in places] for a in places])
    tree = minimum_spanning_tree(apart)  # without edges between markers never seen together
    neighbours = np.bincount(np.concatenate(tree.nonzero()), minlength=len(places))
    if neighbours.max() > 2:
        branch = list(markers)[int(np.argmax(neighbours))]
        raise MeasurementError(
            f"the markers are no chain: three lead to {branch!r}.\n  Try: --cable with a part of "
            "the names of the cable's own markers."
        )
    tips = np.flatnonzero(neighbours <= 1).tolist()
    if start is not None:
        tips.sort(key=lambda k: away(places[k], start.places))
    elif end is not None:
        tips.sort(key=lambda k: -away(places[k], end.places))
    order, _ = depth_first_order(tree, tips[0], directed=False)
    if len(order) < len(places):
        raise MeasurementError(
            f"no pose shows one of the markers {', '.join(np.array([*markers])[order])} and one of "
            "the others.\n  Try: fill their gaps, or leave some out: --cable"
        )
    return [int(k) for k in order]


def _along(
    start: Gripper | None,
    places: FloatArray,
    end: Gripper | None,
    names: Sequence[str],
    wishes: Wishes,
    remarks: list[str],
) -> tuple[FloatArray, float, float]:
    """Arc lengths (M,) [m] of the markers; the measured length of the cable and its scatter [m]."""
    s, length, scatter = _arc_lengths(start, places, end)
    if not wishes.at:
        _check_arc_lengths(s, length, scatter, places, names)
    fixtures = "from fixture to fixture" if start and end else "as far as fixtures and markers go"
    declared = wishes.known.get("length")
    longer = length / declared - 1.0 if declared else 0.0
    slack = _LONGER + 3.0 * scatter / length  # splines through few markers are too short
    if longer > slack or (start and end and longer < -slack):
        raise MeasurementError(
            f"the cable is {length:.4f} m long {fixtures} (a spline through the markers), but "
            f"--length is {declared:g} m.\n  Try: --length between the fixtures; "
            "--start-offset and --end-offset where the cable does not leave a body at its origin."
        )
    remarks.append(
        f"length: {length:.4f} m along a spline {fixtures}, mean of all poses, with a scatter of "
        f"{1e3 * scatter:.1f} mm; one of mm hints at different frames of cable and grippers"
    )
    if not wishes.at:
        remarks.append(
            f"markers by arc length ({', '.join(names)}) along that spline; --at if they were "
            "measured with a tape"
        )
        return s, length, scatter
    if len(wishes.at) != len(names):
        raise MeasurementError(
            f"--at gives {counted(len(wishes.at), 'arc length')} of "
            f"{counted(len(names), 'marker')} ({', '.join(names)})"
        )
    longest = declared or (1.0 + _LONGER) * length
    if start and end and wishes.at[-1] > longest:
        raise MeasurementError(
            f"--at ends at {wishes.at[-1]:g} m, but the cable is {length:.4f} m long {fixtures} (a "
            "spline through the markers).\n  Try: arc lengths from the start in metres."
        )
    remarks.append(f"markers: {', '.join(names)}, at the arc lengths of --at")
    return np.array(wishes.at), length, scatter


def _arc_lengths(
    start: Gripper | None, places: FloatArray, end: Gripper | None
) -> tuple[FloatArray, float, float]:
    """Arc lengths (M,) [m] of markers from the start; length of the cable and its scatter [m].

    They are means over all poses of lengths along a cubic spline through fixtures and markers,
    clamped in the grippers' directions. A marker beside a fixture is no knot of it.
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
        chords = np.linalg.norm(np.diff(x, axis=0), axis=1)
        at_start = start is not None and chords[0] < _BESIDE
        at_end = end is not None and chords[-1] < _BESIDE
        kept = np.ones(len(x), bool)
        kept[1] &= not at_start
        kept[-2] &= not at_end
        s = np.zeros(len(x))
        s[kept] = _along_spline(x[kept], ends)
        if at_start:
            s[1] = chords[0]
        if at_end:
            s[-2] = s[-1] - chords[-1]
        near = np.diff(seen) == 1
        row[seen[:-1][near]] = np.diff(s)[near]
    if np.isnan(spans).all(axis=0).any():
        raise MeasurementError(
            "two neighbouring markers of the cable are seen together in no pose.\n  Try: fill "
            "their gaps, or leave one of them out: --cable"
        )
    found = np.nanmean(spans, axis=0)
    s = np.concatenate([[0.0], np.cumsum(found)])
    first = 0 if start is None else 1
    scatter = float(np.where(np.isnan(spans), found, spans).sum(axis=1).std())
    return s[first : first + len(places)], float(s[-1]), scatter


def _along_spline(x: FloatArray, ends: Any) -> FloatArray:
    """Lengths (K,) [m] to each of the points (K, 3) along a cubic spline with these conditions."""
    s = chord_lengths(x)
    for _ in range(3):  # the parameter converges to the arc length
        fine = np.linspace(s[:-1], s[1:], _SAMPLES + 1, axis=1)
        curve = CubicSpline(s, x, bc_type=ends)(fine)
        s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=1), axis=2).sum(axis=1)))
    return s


def _check_arc_lengths(
    s: FloatArray, length: float, scatter: float, places: FloatArray, names: Sequence[str]
) -> None:
    """Raise MeasurementError if measured arc lengths (M,) [m] are proven wrong.

    No marker is farther from the next than the cable between them is long, and the length does not
    change from pose to pose.
    """
    chords = np.linalg.norm(np.diff(places, axis=0), axis=2)  # (M - 1, P)
    excess = np.nanmax(chords, axis=1, initial=0.0) - np.diff(s)
    k = int(np.argmax(excess))
    if excess[k] > STRETCHED * length:
        pose = int(np.nanargmax(chords[k])) + 1
        cause = f"{counted(len(s), 'marker')} are too few for that"
        if len(s) > _FEW:
            cause = f"are labels exchanged in pose {pose}?"
        raise MeasurementError(
            f"markers {names[k]} and {names[k + 1]} are {np.nanmax(chords[k]):.4f} m apart in pose "
            f"{pose}, but {np.diff(s)[k]:.4f} m along a spline through the markers (mean of all "
            f"poses): {cause}.\n  Try: --length and --at, measured with a tape; more markers; "
            "other labels; --start-offset."
        )
    if scatter > _LONGER * length:
        raise MeasurementError(
            f"the cable's length along a spline through {counted(len(s), 'marker')} is "
            f"{length:.4f} m with a scatter of {scatter:.4f} m from pose to pose: a cable does not "
            "change its length.\n  Try: --length and --at, measured with a tape; the body that "
            "holds each end: --start, --end; cable and grippers in one frame."
        )
