"""Stretches of a recording between its poses in which the cable moves, as motions of a session."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, Slerp

from dlo_casadi.arrays import FloatArray
from dlo_casadi.recordings.fixtures import Gripper, find_gripper
from dlo_casadi.recordings.recording import FREE, Kind, Recording, Stream, Wishes
from dlo_casadi.recordings.stills import Still

# Time [s] over which the noise of a gripper is smoothed, by cubic polynomials: its accelerations
# drive the cable.
_SMOOTH = 0.11
# Time [s] of rest before a motion; longest time without any marker, and fewest instants.
_BEFORE, _GAP, _LEAST = 0.05, 0.5, 20
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class MovingStretch:
    """Markers and grippers between two poses.

    Parameters
    ----------
    t : (T,) [s]
        From zero.
    points : (T, M, 3) [m]
        Of the cable's markers in their order; NaN where one was not seen.
    start, end : Gripper or None
        At each time.
    speed : float [m/s]
        The greatest of a marker, 95 % of all instants are slower.
    """

    t: FloatArray
    points: FloatArray
    start: Gripper
    end: Gripper | None
    speed: float

    def points_table(self, s: FloatArray) -> str:
        """CSV of the markers at arc lengths s (M,)."""
        lines = ["t_s,s_m,x_m,y_m,z_m"]
        for t, row in zip(self.t, self.points, strict=True):
            for at, place in zip(s, row, strict=True):
                if np.isfinite(place).all():
                    lines.append(",".join(f"{x:.6f}" for x in (t, at, *place)))
        return "\n".join(lines) + "\n"

    def fixtures_table(self) -> str:
        """CSV of the grippers."""
        header, columns = ["t_s"], [self.t[:, None]]
        for side, gripper in (("start", self.start), ("end", self.end)):
            if gripper is not None:
                header += [f"{side}_{axis}_m" for axis in _AXES]
                header += [f"{side}_q{axis}" for axis in (*_AXES, "w")]
                turns = Rotation.from_matrix(gripper.frames).as_quat()
                columns += [gripper.places, turns]
        rows = np.hstack(columns)
        text = [",".join(header), *(",".join(f"{x:.7f}" for x in row) for row in rows)]
        return "\n".join(text) + "\n"


def moving_stretches(
    recording: Recording,
    stills: Sequence[Still],
    names: Sequence[str],
    wishes: Wishes,
    held: tuple[Gripper, Gripper | None],
) -> list[MovingStretch]:
    """What lies between each two poses, from just before the first one ends.

    `names`: of the cable's markers in their order. `held`: the grippers in the poses, whose axes
    along the cable hold for all times. Stretches in which a gripper or all markers were not seen
    for half a second are left out.
    """
    found = []
    for one, other in pairwise(stills):
        stretch = _between(recording, one.end - _BEFORE, other.begin, names, wishes, stills, held)
        if stretch is not None:
            found.append(stretch)
    return found


def _between(
    recording: Recording,
    begin: float,
    end: float,
    names: Sequence[str],
    wishes: Wishes,
    stills: Sequence[Still],
    held: tuple[Gripper, Gripper | None],
) -> MovingStretch | None:
    markers = recording.of("marker")
    first = markers[names[0]]
    t = first.t[(first.t >= begin) & (first.t <= end)]
    if len(t) < _LEAST:
        return None
    points = np.stack([_sampled(markers[name], t)[:, :3] for name in names], axis=1)
    seen = np.isfinite(points[..., 0]).any(axis=1)
    if not seen.any() or np.diff(t[seen]).max(initial=0.0) > _GAP:
        return None
    grippers: list[Gripper | None] = []
    for side, poses in zip(("start", "end"), held, strict=True):
        called = getattr(wishes, side)
        if poses is None or called == FREE:
            grippers.append(None)
            continue
        instants = [
            Still(x, x, values, 0.0, 0.0)
            for x, values in zip(t, _values(recording, called, t), strict=True)
        ]
        if not all(item.values for item in instants):
            return None
        offset = getattr(wishes, f"{side}_offset")
        moving = _smoothed(find_gripper(called, offset, side, instants, recording), t)
        resting = find_gripper(called, offset, side, stills, recording)
        assert resting is not None
        grippers.append(moving.turned(resting.frames[0].T @ poses.frames[0]))
    start, last = grippers
    assert start is not None
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2) / np.diff(t)[:, None]
    speed = float(np.nanquantile(steps, 0.95)) if np.isfinite(steps).any() else 0.0
    return MovingStretch(t - t[0], points, start, last, speed)


def _smoothed(gripper: Gripper | None, t: FloatArray) -> Gripper:
    """The gripper without noise from frame to frame."""
    assert gripper is not None
    width = min(2 * round(_SMOOTH / float(np.median(np.diff(t))) / 2) + 1, len(t) - 1)
    if width < 5:
        return gripper
    middle = Rotation.from_matrix(gripper.frames[:1])
    turns = (middle.inv() * Rotation.from_matrix(gripper.frames)).as_rotvec()
    places, turns = (savgol_filter(x, width, 3, axis=0) for x in (gripper.places, turns))
    return Gripper(places, (middle * Rotation.from_rotvec(turns)).as_matrix())


def _values(
    recording: Recording, called: str, t: FloatArray
) -> Iterator[dict[tuple[Kind, str], FloatArray]]:
    """Values of the body, or of the three markers, of this name at each time; empty if unseen."""
    kind: Kind = "marker" if called.count(",") == 2 else "body"
    parts = called.split(",") if kind == "marker" else [called]
    keys: list[tuple[Kind, str]] = [(kind, part.strip()) for part in parts]
    columns = [_sampled(recording.of(kind)[name], t) for kind, name in keys]
    for k in range(len(t)):
        rows = [column[k] for column in columns]
        whole = all(np.isfinite(row).all() for row in rows)
        yield dict(zip(keys, rows, strict=True)) if whole else {}


def _sampled(stream: Stream, t: FloatArray) -> FloatArray:
    """Values (T, ...) of a stream at times: between frames less than twice the usual step apart."""
    seen = np.isfinite(stream.values).all(axis=1)
    if len(stream.t) == 1:
        return np.tile(stream.values, (len(t), 1))
    own, values = stream.t[seen], stream.values[seen]
    out = np.full((len(t), stream.values.shape[1]), np.nan)
    if len(own) < 2:
        return out
    after = np.clip(np.searchsorted(own, t), 1, len(own) - 1)
    # A marker is taken where it was seen; a gripper, which moves smoothly, over short gaps, too.
    step = float(np.median(np.diff(stream.t)))
    longest = 1.5 * step if stream.kind == "marker" else max(0.1, 1.5 * step)
    near = (own[after] - own[after - 1] <= longest) & (t >= own[0]) & (t <= own[-1])
    inside = t[near]
    out[near] = np.column_stack([np.interp(inside, own, column) for column in values.T])
    if stream.kind == "body" and len(inside):
        out[near, 3:] = Slerp(own, Rotation.from_quat(values[:, 3:]))(inside).as_quat()
    return out
