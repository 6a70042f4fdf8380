"""The fixtures of a recording: bodies turned so that x points along the cable."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.errors import MeasurementError
from dlo_casadi.recordings.recording import Recording
from dlo_casadi.recordings.stills import Still

_STRAY = 0.5  # direction cosine of a gripper's axis and the cable from which they may be the same


@dataclass(frozen=True)
class Gripper:
    """A fixture in all poses: places (P, 3) [m], and frames (P, 3, 3) with x along the cable."""

    places: FloatArray
    frames: FloatArray

    def turned(self, axes: FloatArray) -> "Gripper":
        """With other axes, given as columns in its own."""
        return Gripper(self.places, self.frames @ axes)


def find_gripper(
    name: str, offset: Sequence[float], side: str, stills: Sequence[Still], recording: Recording
) -> Gripper | None:
    """The body, or the three markers, that hold an end; None where the recording has no body."""
    if name.count(",") == 2:
        o, x, y = (_means(stills, f"marker {part.strip()}", recording) for part in name.split(","))
        first = unit(x - o)
        third = unit(np.cross(first, y - o))
        frames = np.stack([first, np.cross(third, first), third], axis=2)
        return Gripper(o + frames @ np.array(offset or np.zeros(3)), frames)
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
    return Gripper(values[:, :3] + frames @ np.array(offset or np.zeros(3)), frames)


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


def along_cable(
    start: Gripper | None, end: Gripper | None, lines: Sequence[FloatArray], remarks: list[str]
) -> tuple[Gripper | None, Gripper | None]:
    """Grippers with x along the cable from start to end, and the least roll between them.

    Of the six axes of a body the one that points most along the way to the nearest marker; of the
    four ways to roll the end about it the one with the smallest twist of the cable over all poses.
    What is left of it is a nuisance of the fit, `end_roll`.
    """
    if start is not None:
        ways = np.array([line[0] for line in lines]) - start.places
        start = _aimed(start, ways, "start", remarks)
    if end is not None:
        ways = end.places - np.array([line[-1] for line in lines])
        end = _aimed(end, ways, "end", remarks)
    if start is not None and end is not None:
        rolls = [Rotation.from_rotvec([k * np.pi / 2, 0, 0]).as_matrix() for k in range(4)]
        twists = [_twist(start, lines, end.turned(roll)) for roll in rolls]
        end = end.turned(rolls[int(np.argmin(np.abs(twists)))])
        remarks.append(
            "roll of the grippers: of four ways the one with the least twist of the cable; a fit "
            "finds what is left as end_roll"
        )
    return start, end


def _aimed(gripper: Gripper, ways: FloatArray, side: str, remarks: list[str]) -> Gripper:
    """The gripper with that of its axes as x that points most along the ways (P, 3)."""
    ways = unit(ways)
    cosines = np.mean(np.einsum("pij,pi->pj", gripper.frames, ways), axis=0)
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


def _twist(start: Gripper, lines: Sequence[FloatArray], end: Gripper) -> float:
    """Mean angle [rad] from the start frame, moved along the cable without twist, to the end's."""
    total = 0j
    for k, (first, last) in enumerate(zip(start.frames, end.frames, strict=True)):
        steps = np.diff(np.vstack([start.places[k], lines[k], end.places[k]]), axis=0)
        ways = [first[:, 0], *(steps / np.linalg.norm(steps, axis=1)[:, None]), last[:, 0]]
        side = first[:, 1]
        for a, b in pairwise(ways):
            side = side - (side @ b) / (1.0 + a @ b) * (a + b)
        total += complex(side @ last[:, 1], side @ last[:, 2])
    return float(-np.angle(total))
