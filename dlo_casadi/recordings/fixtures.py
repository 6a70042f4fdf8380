"""Fixtures of the cable in the poses of a recording: grippers with x along it, and forces."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, length_of, unit
from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings.recording import FREE, Kind, Recording, Stream, Wishes
from dlo_casadi.recordings.stills import Still

_INSIDE = 0.05  # share of a line's length, beyond the noise and the hidden ends of lines in clouds
_IN_LINE = 0.05  # smallest sine of the angle at the first of three markers on a gripper
# Share by which the distance of two markers on a gripper may change. Those of 20 mm that are known
# to 0.5 mm change by 0.04; exchanged ones by half of it, unless the three are equally far apart.
_RIGID = 0.15
_TINY = 1e-9  # m
_STRAY = 0.5  # smallest cosine at which a gripper's axis may be the cable's


def full_names(recording: Recording, wishes: Wishes) -> Wishes:
    """The wishes with the full names of bodies and markers at the fixtures.

    A name is full, or the last part of the full name, `subject/marker` or `asset:marker`, of one
    marker or body. Raises MeasurementError if it is that of several.
    """

    def full(name: str, side: str, kind: Kind) -> str:
        known, parts = recording.of(kind), re.split("[/:]", name)
        if name in known:
            return name
        found = [one for one in known if re.split("[/:]", one)[-len(parts) :] == parts]
        if len(found) > 1:
            raise MeasurementError(
                f"{kind} {name!r} at the {side} may be {' or '.join(found)}.\n  Try: --{side} "
                "with the full names."
            )
        return found[0] if found else name

    called = {}
    for side, names in wishes.holders.items():
        kind: Kind = "marker" if len(names) == 3 else "body"
        called[side] = ",".join(full(name, side, kind) for name in names)
    return replace(wishes, start=called["start"], end=called.get("end", FREE))


@dataclass(frozen=True)
class Gripper:
    """A fixture in all poses: positions (P, 3) [m], and frames (P, 3, 3) with x along the cable."""

    places: FloatArray
    frames: FloatArray

    def turned(self, axes: FloatArray) -> "Gripper":
        """Return the gripper with other axes, given as columns in its own frame."""
        return Gripper(self.places, self.frames @ axes)


def find_gripper(
    name: str, offset: Sequence[float], side: str, stills: Sequence[Still], recording: Recording
) -> Gripper | None:
    """The body, or the three markers, holding an end; None if the recording has no body."""
    if name.count(",") == 2:
        trio = [part.strip() for part in name.split(",")]
        o, x, y = (_means(stills, "marker", part, recording) for part in trio)
        _check_rigid(dict(zip(trio, (o, x, y), strict=True)), side, stills)
        first = unit(x - o)
        across = np.cross(first, unit(y - o))
        sines = np.linalg.norm(across, axis=1)
        if sines.min() < _IN_LINE:
            raise MeasurementError(
                f"markers {name} at the {side} are in one line in pose {sines.argmin() + 1}: they "
                "do not tell how the gripper is turned about it.\n  Try: a third marker beside it."
            )
        third = unit(across)
        frames = np.stack([first, np.cross(third, first), third], axis=2)
        return Gripper(o + frames @ np.array(offset or np.zeros(3)), frames)
    bodies = recording.of("body")
    if not bodies and name == side:
        if len(offset):
            why = f"--{side}-offset is in the axes of a body, and this recording has none"
            raise MeasurementError(f"{why}.\n  Try: --{side} O,X,Y of three markers on it.")
        return None
    if name not in bodies:
        why = "".join(f"; {remark}" for remark in recording.assumptions if name in remark)
        raise MeasurementError(
            f"no body is called {name!r}, which holds the {side} of the cable; found: "
            f"{', '.join(bodies) or 'none'}{why}.\n  Try: --{side} NAME of one of them, or "
            f"--{side} O,X,Y of three markers on it: its place, along its x axis, on the side of y."
            f"{recording.told_unread}"
        )
    values = _means(stills, "body", name, recording)
    frames = Rotation.from_quat(values[:, 3:]).as_matrix()
    return Gripper(values[:, :3] + frames @ np.array(offset or np.zeros(3)), frames)


def _check_rigid(markers: Mapping[str, FloatArray], side: str, stills: Sequence[Still]) -> None:
    """Raise MeasurementError if a distance of two markers (P, 3) on a gripper changes in a pose."""
    names, places = [*markers], np.array([*markers.values()])

    def apart(trio: FloatArray) -> FloatArray:
        return np.linalg.norm(trio - np.roll(trio, 1, axis=0), axis=-1)

    by_pose = apart(places)  # (3, P)
    usual = np.median(by_pose, axis=1)
    off = np.abs(by_pose - usual[:, None]) / np.maximum(usual[:, None], _TINY)
    if off.max() <= _RIGID:
        return
    pair, k = (int(i) for i in np.unravel_index(int(off.argmax()), off.shape))
    exchanges = []
    for i, (kind, other) in product(range(len(names)), stills[k].values):
        if kind != "marker" or other == names[i]:
            continue
        trio = places[:, k].copy()
        if other in names:
            trio[names.index(other)] = trio[i]
        trio[i] = stills[k].values[kind, other][:3]
        if np.all(np.abs(apart(trio) - usual) <= _RIGID * usual):
            exchanges.append(tuple(sorted((names[i], other))))
    where = f"pose {k + 1} ({stills[k].span})"
    one, two = names[pair], names[pair - 1]
    told = (
        f"markers {one} and {two} at the {side} are {1e3 * by_pose[pair, k]:.1f} mm apart in "
        f"{where}, but {1e3 * usual[pair]:.1f} mm in most poses: are labels exchanged there?"
    )
    if len(found := {*exchanges}) == 1:
        one, two = found.pop()
        told = (
            f"the labels of {one} and {two} are exchanged in {where}: exchanged back, the markers "
            f"at the {side} are as far apart as in the other poses."
        )
    raise MeasurementError(
        f"{told}\n  Try: other labels there in the program that tracks them, or cut the recording "
        "there."
    )


def _means(stills: Sequence[Still], kind: Kind, name: str, recording: Recording) -> FloatArray:
    """Means (P, k) of a stream in all poses."""
    if not any((kind, name) in still.values for still in stills):
        known = ", ".join(recording.of(kind)) or "none"
        raise MeasurementError(
            f"no {kind} {name!r} was seen in any pose; found: {known}.\n  Try: --start or --end "
            f"with one of these names.{recording.told_unread}"
        )
    for k, still in enumerate(stills, start=1):
        if (kind, name) not in still.values:
            raise MeasurementError(
                f"{kind} {name} is not seen in pose {k} ({still.span}).\n"
                "  Try: fill its gaps, or cut the recording there."
            )
    return np.array([still.values[kind, name] for still in stills])


def along_cable(
    start: Gripper | None, end: Gripper | None, lines: Sequence[FloatArray], remarks: list[str]
) -> tuple[Gripper | None, Gripper | None]:
    """Grippers with x along the cable from start to end, and the least roll between them.

    Of a body's six axes, x is the one closest to the cable's direction, see `_ways`. Of the four
    ways to roll the end about it, the one with the smallest twist of the cable over all poses is
    chosen. The remaining roll is a nuisance of the fit, `end_roll`.
    """
    if start is not None:
        start = _aimed(start, _ways(start, lines), "start", remarks)
    if end is not None:
        back = _ways(end, [line[::-1] for line in lines])
        end = _aimed(end, -back, "end", remarks)
    if start is not None and end is not None:
        rolls = [Rotation.from_rotvec([k * np.pi / 2, 0, 0]).as_matrix() for k in range(4)]
        twists = [_twist(start, lines, end.turned(roll)) for roll in rolls]
        end = end.turned(rolls[int(np.argmin(np.abs(twists)))])
        remarks.append(
            "roll of the grippers: of four ways the one with the least twist of the cable; a fit "
            "finds what is left as end_roll"
        )
    return start, end


def _ways(gripper: Gripper, lines: Sequence[FloatArray]) -> FloatArray:
    """Vectors (P, 3) [m] from a gripper to the first point of each line that is well inside it.

    That is a twentieth of its length away: the first points of a line in a cloud are at the place
    of the gripper, where the direction to them is noise.
    """
    found = []
    for place, line in zip(gripper.places, lines, strict=True):
        inside = np.linalg.norm(line - place, axis=1) >= _INSIDE * length_of(line)
        found.append(line[int(np.argmax(inside))] - place)
    return np.array(found)


def _aimed(gripper: Gripper, ways: FloatArray, side: str, remarks: list[str]) -> Gripper:
    """The gripper with x along the axis that is closest to the directions `ways` (P, 3)."""
    ways = unit(ways)
    cosines = np.mean(np.einsum("pij,pi->pj", gripper.frames, ways), axis=0)
    k = int(np.argmax(np.abs(cosines)))
    sign = float(np.sign(cosines[k]))
    angle = np.degrees(np.arccos(min(1.0, abs(cosines[k]))))
    if abs(cosines[k]) < _STRAY:
        raise MeasurementError(
            f"no axis of the body at the {side} is directed along the cable: the nearest is "
            f"{'-' if sign < 0 else ''}{'xyz'[k]}, {angle:.0f} degrees off the direction of the "
            "cable there.\n  Try: a body whose x axis is the cable's direction in the clamp; --up; "
            "cable and grippers in one frame."
        )
    remarks.append(
        f"{side} gripper: its {'-' if sign < 0 else ''}{'xyz'[k]} axis is taken along the cable "
        f"({angle:.0f} degrees off the cable's direction there)"
    )
    axes = np.zeros((3, 3))
    axes[k, 0], axes[(k + 1) % 3, 1], axes[(k + 2) % 3, 2] = sign, sign, 1.0
    return gripper.turned(axes)


def _twist(start: Gripper, lines: Sequence[FloatArray], end: Gripper) -> float:
    """Mean angle [rad] from the start frame, moved along the cable without twist, to the end's."""
    total = 0j
    for k, (first, last) in enumerate(zip(start.frames, end.frames, strict=True)):
        steps = np.diff(np.vstack([start.places[k], lines[k], end.places[k]]), axis=0)
        ways = [first[:, 0], *unit(steps), last[:, 0]]
        side = first[:, 1]
        for a, b in pairwise(ways):
            side = side - (side @ b) / (1.0 + a @ b) * (a + b)
        total += complex(side @ last[:, 1], side @ last[:, 2])
    return float(-np.angle(total))


# ---- forces --------------------------------------------------------------------------------------


def readings_of(
    recording: Recording, stills: Sequence[Still], holders: Mapping[str, Sequence[str]]
) -> tuple[list[dict[str, FloatArray]], list[str]]:
    """Forces (3,) [N] and moments (3,) [N m] of each pose in the world's axes, and remarks.

    The keys are those of a pose in a configuration. A sensor of no fixture, or in unknown axes, is
    left out with a remark. Raises MeasurementError if it is not clear which fixture one belongs to.
    """
    found: list[dict[str, FloatArray]] = [{} for _ in stills]
    sensors: dict[str, str] = {}  # of each side
    remarks, bodies = [], recording.of("body")
    for name, stream in recording.of("wrench").items():
        side = _side(stream, holders)
        if side is None or (stream.frame and stream.frame not in bodies):
            why = (
                "no fixture has the name of its frame or topic. Try: --start, --end with its frame"
            )
            if side is not None:
                why = "no TF and no body has its frame. Try: record /tf and /tf_static, too"
            remarks.append(f"force sensor {name} (frame {stream.frame!r}) is left out: {why}")
            continue
        if side in sensors:
            raise MeasurementError(
                f"two force sensors are at the {side}: {sensors[side]} and {name}.\n  Try: a "
                "recording with one of them; for a bag `ros2 bag convert` selects topics."
            )
        sensors[side] = name
        for still, row in zip(stills, found, strict=True):
            wrench = still.values.get(("wrench", name))
            body = still.values.get(("body", stream.frame))
            if wrench is not None and (body is not None or not stream.frame):
                turn = Rotation.from_quat([0.0, 0.0, 0.0, 1.0] if body is None else body[3:])
                row[f"{side}_force"] = turn.apply(wrench[:3])
                row[f"{side}_moment"] = turn.apply(wrench[3:])
        if not any(f"{side}_force" in row for row in found):
            remarks.append(
                f"force sensor {name} (frame {stream.frame!r}) is left out: nothing of it was seen "
                "in any pose. Try: a recording in which it shares the clock of markers or grippers"
            )
            continue
        remarks.append(
            f"{side}_force, {side}_moment: means of {name}, in axes of "
            f"{stream.frame or 'the world'}; taken as those of the cable on its fixture, about its "
            "place, with the gripper's weight taken off"
        )
    return found, remarks


def _side(sensor: Stream, holders: Mapping[str, Sequence[str]]) -> str | None:
    """The fixture, start or end, that a force sensor's frame or topic is called after, if any."""
    for names in ([sensor.frame], [sensor.name, *sensor.name.split("/")]):
        sides = [side for side, parts in holders.items() if {*parts} & {*names}]
        if len(sides) == 1:
            return sides[0]
    if sides:
        raise MeasurementError(
            f"the force sensor {sensor.name} (frame {sensor.frame!r}) is called after both of the "
            "fixtures.\n  Try: --start or --end with its frame."
        )
    return None
