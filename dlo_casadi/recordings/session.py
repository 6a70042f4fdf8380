"""Turn a recording into a session's files: poses, gripper frames, markers along the cable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import wrap

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.cable import DENSITY
from dlo_casadi.config.options import DeclaredTolerances
from dlo_casadi.config.template import template
from dlo_casadi.errors import MeasurementError, counted
from dlo_casadi.recordings.clouds import cloud_lines
from dlo_casadi.recordings.fixtures import (
    Gripper,
    along_cable,
    find_gripper,
    full_names,
    readings_of,
)
from dlo_casadi.recordings.moving import MovingStretch, moving_stretches
from dlo_casadi.recordings.order import (
    LONGER,
    arc_lengths,
    check_arc_lengths,
    exchanged_labels,
    in_order,
)
from dlo_casadi.recordings.recording import FREE, Cloud, Recording, Stream, Wishes
from dlo_casadi.recordings.stills import Still, align_clocks, find_stills

_COLUMNS = 98  # width of a comment
# Scatter of the length from pose to pose beyond which arc lengths are doubtful, relative. Rendered
# from one session: below 0.1 % for eight markers or more, up to 0.15 % for six, 0.9 % for four, 2.9
# % for three; errors of arc lengths are 0.5 to 1.6 times the scatter. Grippers 20 mm off: 0.3 %.
_DOUBTFUL = 2e-3
# How well clocks are aligned by the motion of grippers and markers [s]: these lag, as cables do.
_DELAY = 0.03
# Speed [lengths/s] from which on a stretch between two poses is a motion.
_QUICK = 0.1
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
    motions: tuple[dict[str, str], ...] = ()
    """Entries of the configuration."""
    tables: Mapping[str, str] = field(default_factory=dict)
    """Text of the CSV files of the motions."""

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
            motions=self.motions,
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
    asked, wishes = wishes.holders, full_names(recording, wishes)
    recording, offsets = align_clocks(recording.without_held())
    stills = find_stills(recording, wishes.hold)
    start = find_gripper(wishes.start, wishes.start_offset, "start", stills, recording)
    end = None
    if wishes.end != FREE:
        end = find_gripper(wishes.end, wishes.end_offset, "end", stills, recording)
    doubts: list[str] = []
    motions: list[dict[str, str]] = []
    tables: dict[str, str] = {}
    tolerances: dict[str, float] = {}
    remarks = [*recording.assumptions, *recording.unread, *(offset.told for offset in offsets)]
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
        _check_labels(markers, stills, start, end, wishes)
        order = in_order(markers, start, end)
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
        if start is not None and (end is not None or wishes.end == FREE):
            stretches = moving_stretches(recording, stills, names, wishes, (start, end))
            motions, tables, on_motions = _motions(stretches, np.round(s, 6), length, wishes)
            remarks += on_motions
            if motions and offsets:
                tolerances["delay"] = _DELAY
    called = {side: [*names, *asked[side]] for side, names in wishes.holders.items()}
    readings, on_forces = readings_of(recording, stills, called)
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
        tuple(motions),
        tables,
    )


def _motions(
    stretches: Sequence[MovingStretch], s: FloatArray, length: float, wishes: Wishes
) -> tuple[list[dict[str, str]], dict[str, str], list[str]]:
    """Entries and files of the quickest moving stretches, in their order, and what to say."""
    quick = [one for one in stretches if one.speed > _QUICK * length]
    if not quick:
        return [], {}, []
    if not wishes.motions:
        longest = max(one.t[-1] for one in quick)
        said = f"between poses the cable moves quickly {counted(len(quick), 'time')}, for up to"
        return [], {}, [f"{said} {longest:.1f} s; --motions 4 writes the quickest as motions"]
    least = sorted((one.speed for one in quick), reverse=True)[: wishes.motions][-1]
    entries: list[dict[str, str]] = []
    tables: dict[str, str] = {}
    for k, one in enumerate([x for x in quick if x.speed >= least], start=1):
        file, ends = f"motion_{k:02d}.csv", f"motion_{k:02d}_ends.csv"
        tables |= {file: one.points_table(s), ends: one.fixtures_table()}
        left_out = wishes.held_out and not k % wishes.held_out
        role = "held_out" if left_out else "fit"
        entries.append({"file": file, "fixtures": ends, "begins": "at_rest", "role": role})
    return entries, tables, []


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
        known = recording.of("marker")
        remedy = "\n  Try: --cable with a part of their names." if known else recording.told_unread
        remedy = remedy or "\n  Try: a recording with markers on the cable."
        raise MeasurementError(
            f"{counted(len(found), 'marker')} of the cable: a pose takes two or more. Markers in "
            f"this recording: {', '.join(known) or 'none'}.{remedy}"
        )
    return found


def _check_labels(
    markers: Mapping[str, FloatArray],
    stills: Sequence[Still],
    start: Gripper | None,
    end: Gripper | None,
    wishes: Wishes,
) -> None:
    """Raise MeasurementError with the markers and the poses if labels are exchanged."""
    holders = wishes.holders
    names = [*markers, *(holders.get(side, [side])[0] for side in ("start", "end"))]
    found = exchanged_labels(np.array([*markers.values()]), start, end)
    if not found:
        return
    told = []
    for (i, j), poses in found.items():
        where = ", ".join(f"pose {k + 1} ({stills[k].span})" for k in poses)
        one, other = sorted((names[i], names[j]))
        told.append(f"the labels of {one} and {other} are exchanged in {where}")
    raise MeasurementError(
        f"{'; '.join(told)}: exchanged back, their distances from their neighbours are those of "
        "the other poses.\n  Try: exchange the labels there in the program that tracks them, or "
        "cut the recording there."
    )


def _along(
    start: Gripper | None,
    places: FloatArray,
    end: Gripper | None,
    names: Sequence[str],
    wishes: Wishes,
    remarks: list[str],
) -> tuple[FloatArray, float, float]:
    """Arc lengths (M,) [m] of the markers; the measured length of the cable and its scatter [m]."""
    s, length, scatter = arc_lengths(start, places, end)
    if not wishes.at:
        check_arc_lengths(s, length, scatter, places, names)
    fixtures = "from fixture to fixture" if start and end else "as far as fixtures and markers go"
    declared = wishes.known.get("length")
    longer = length / declared - 1.0 if declared else 0.0
    slack = LONGER + 3.0 * scatter / length  # splines through few markers are too short
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
    longest = declared or (1.0 + LONGER) * length
    if start and end and wishes.at[-1] > longest:
        raise MeasurementError(
            f"--at ends at {wishes.at[-1]:g} m, but the cable is {length:.4f} m long {fixtures} (a "
            "spline through the markers).\n  Try: arc lengths from the start in metres."
        )
    remarks.append(f"markers: {', '.join(names)}, at the arc lengths of --at")
    return np.array(wishes.at), length, scatter
