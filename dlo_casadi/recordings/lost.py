"""Frames in which tracking was lost though a position is there: exact zeros, and held positions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import find_objects, label

from dlo_casadi.arrays import BoolArray
from dlo_casadi.recordings.recording import Recording, Stream

_HELD = 0.4  # s, shortest stretch in which an exactly constant marker is a held one
_CHANGES = 0.8  # share of the frames in which a marker with noise changes; one without moves less
_EQUAL = 1e-9  # m, above the rounding of a change of axes, below the resolution of all files


def without_zeros(streams: Sequence[Stream]) -> tuple[tuple[Stream, ...], tuple[str, ...]]:
    """Streams that are nan where their position is exactly (0, 0, 0), and a remark on each.

    Programs write zeros for what they do not see. Forces may be zero, and a body that is always at
    the origin, such as a frame of TF, is there.
    """
    found, remarks = [], []
    for stream in streams:
        zero: BoolArray = np.all(stream.values[:, :3] == 0.0, axis=1)
        if stream.kind == "wrench" or (stream.kind == "body" and zero.all()):
            zero[:] = False
        if zero.any():
            remarks.append(_told(stream, zero, "at exactly (0, 0, 0)"))
        found.append(_without(stream, zero))
    return tuple(found), tuple(remarks)


def without_held(recording: Recording) -> Recording:
    """The recording, markers nan where their last position is held while most others change.

    A recording without noise, in which others change only while they move, stays as it is.
    """
    markers = [*recording.of("marker").values()]
    found, remarks = [], []
    for stream in recording.streams:
        held = np.zeros(len(stream.t), bool)
        if stream.kind == "marker" and stream.moves:
            step = np.abs(np.diff(stream.values, axis=0)).max(axis=1)
            for (run,) in find_objects(label(step < _EQUAL)[0]):
                begin, end = stream.t[run.start], stream.t[run.stop]
                if end - begin >= _HELD and _most_change(markers, stream, begin, end):
                    held[run.start + 1 : run.stop + 1] = True
        if held.any():
            remarks.append(_told(stream, held, "exactly constant, unlike most markers,"))
        found.append(_without(stream, held))
    return replace(recording, streams=tuple(found), assumptions=(*recording.assumptions, *remarks))


def _most_change(markers: Sequence[Stream], held: Stream, begin: float, end: float) -> bool:
    """Whether most other markers on the same clock change all the time between two times [s]."""
    changes = []
    for other in markers:
        if other is held or other.clock != held.clock:
            continue
        inside = other.values[(other.t >= begin) & (other.t <= end)]
        inside = inside[np.isfinite(inside).all(axis=1)]
        if len(inside) > 1:
            steps = np.abs(np.diff(inside, axis=0)).max(axis=1)
            changes.append(bool(np.mean(steps > _EQUAL) > _CHANGES))
    return 2 * sum(changes) > len(changes)


def _without(stream: Stream, lost: BoolArray) -> Stream:
    return replace(stream, values=np.where(lost[:, None], np.nan, stream.values))


def _told(stream: Stream, lost: BoolArray, how: str) -> str:
    return (
        f"{stream.kind} {stream.name} is {how} in {lost.sum()} of {len(lost)} frames, which count "
        "as not seen"
    )
