"""A recording in one form, streams in SI units, z up, with own clocks; and what its user adds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.ndimage import find_objects, label
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.config.problems import show
from dlo_casadi.errors import DloError, MeasurementError

Kind = Literal["marker", "body", "wrench"]

# Axis that points up in a file -> rotation to z up that keeps x or y.
_UP = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
LARGEST = 100.0  # m, distance from the origin beyond which coordinates cannot be in metres
# Longest time between two frames of a recording: a longer one is a wrong time, such as one that is
# counted from 1970 beside others from the start of the recording (1.7e9 s).
_PAUSE = 86400.0  # s
_HELD = 0.4  # s, shortest stretch in which an exactly constant marker is a held one
_CHANGES = 0.8  # share of the frames in which a marker with noise changes; one without moves less
_EQUAL = 1e-9  # m, above the rounding of a change of axes, below the resolution of all files
FREE = "free"  # name of an end that nothing holds
_OFFSET = 1.0  # m, longest distance from a gripper's markers to where the cable leaves it
_PLURALS = {"marker": "markers", "body": "bodies", "wrench": "force sensors"}
METRES = {"m": 1.0, "meters": 1.0, "metres": 1.0, "cm": 0.01, "centimeters": 0.01}
METRES |= {"mm": 1e-3, "millimeters": 1e-3, "millimetres": 1e-3}


@dataclass(frozen=True)
class Stream:
    """The record of one marker, rigid body or force sensor.

    A marker or body of one row does not move: a static transform, or a pose that was sent once.
    """

    name: str
    kind: Kind
    t: FloatArray
    """(n,) [s], on its own clock, increasing."""
    values: FloatArray
    """(n, 3) [m] of a marker; (n, 7) position [m] and quaternion (x, y, z, w) of a body; (n, 6)
    force [N] and moment [N m]. nan where it was not seen."""
    clock: str = ""
    """Streams with the same clock share their origin of time. Readers name the clocks in a file if
    it has several."""
    frame: str = ""
    """The axes: of what the file calls its world, or those of a frame of this name."""
    file: str = ""

    @property
    def moves(self) -> bool:
        """Whether it is a marker or body that may move."""
        return self.kind != "wrench" and len(self.t) > 1

    def moved(self, turn: Rotation, place: FloatArray | float = 0.0) -> "Stream":
        """The stream in other axes, in which its own have the rotation `turn` and the `place`."""
        values = self.values.copy()
        values[:, :3] = turn.apply(values[:, :3])
        if self.kind == "wrench":
            values[:, 3:] = turn.apply(values[:, 3:])
            return replace(self, values=values)
        values[:, :3] += place
        if self.kind == "body":
            lost = ~(np.linalg.norm(values[:, 3:], axis=1) > 0.5)  # zero where tracking was lost
            values[lost, 3:] = [0.0, 0.0, 0.0, 1.0]
            values[:, 3:] = (turn * Rotation.from_quat(values[:, 3:])).as_quat()
            values[lost] = np.nan
        return replace(self, values=values)


@dataclass(frozen=True)
class Cloud:
    """Points that a depth camera has seen at one time."""

    points: FloatArray
    """(K, 3) [m]."""
    colors: FloatArray | None = None
    """(K, 3) red, green, blue, 0 to 255."""
    camera: FloatArray | None = None
    """(3,) [m], place of the camera."""
    t: float = np.nan
    """[s]; nan in a file without a time."""
    clock: str = ""
    frame: str = ""
    file: str = ""

    def moved(self, turn: Rotation, place: FloatArray | float = 0.0) -> "Cloud":
        """The cloud in other axes, in which its own have the rotation `turn` and the `place`."""
        camera = None if self.camera is None else turn.apply(self.camera) + place
        return replace(self, points=turn.apply(self.points) + place, camera=camera)


@dataclass(frozen=True)
class Recording:
    """Everything that was recorded, and the assumptions made to read it."""

    streams: tuple[Stream, ...] = ()
    clouds: tuple[Cloud, ...] = ()
    assumptions: tuple[str, ...] = ()
    up: str = "z"
    """The axis, x, y or z, that points up."""
    up_by: str = ""
    """Why this axis is assumed to point up."""
    unit: str = ""
    """The unit of length that its file names, if it names one."""
    unread: tuple[str, ...] = ()
    """What the files hold beside it that was not read, and why."""

    def of(self, kind: Kind) -> dict[str, Stream]:
        """Streams of one kind, by name."""
        return {stream.name: stream for stream in self.streams if stream.kind == kind}

    @property
    def told_unread(self) -> str:
        """What was not read, for the message of an error about something that is not there."""
        return "".join(f"\n  {text}." for text in self.unread)

    def with_z_up(self, up: str | None) -> "Recording":
        """The recording rotated to z up, from axes in which `up` points up, or as it was read."""
        turn = Rotation.from_matrix(_UP[up or self.up])
        assumed = () if up else (f"{self.up} is up, {self.up_by}; or --up",)
        streams = tuple(
            stream if stream.kind == "wrench" and stream.frame else stream.moved(turn)
            for stream in self.streams
        )
        clouds = tuple(cloud.moved(turn) for cloud in self.clouds)
        return Recording(streams, clouds, (*self.assumptions, *assumed), unread=self.unread)

    def scaled(self, scale: float) -> "Recording":
        """The recording with all places, but no forces, multiplied by `scale`."""
        ones = np.ones(7)
        ones[:3] = scale
        streams = tuple(
            x if x.kind == "wrench" else replace(x, values=x.values * ones[: x.values.shape[1]])
            for x in self.streams
        )
        return replace(self, streams=streams)

    def without_zeros(self) -> "Recording":
        """The recording, streams nan where their position is exactly (0, 0, 0).

        Programs write zeros for what they do not see. Forces may be zero, and a body that is always
        at the origin, such as a frame of TF, is there.
        """

        def zero(stream: Stream) -> BoolArray:
            found: BoolArray = np.all(stream.values[:, :3] == 0.0, axis=1)
            there = stream.kind == "wrench" or (stream.kind == "body" and found.all())
            return np.zeros_like(found) if there else found

        return self._without(zero, "at exactly (0, 0, 0)")

    def without_held(self) -> "Recording":
        """The recording, markers nan where their last position is held while most others change.

        A recording without noise, in which others change only while they move, stays as it is.
        """

        def held(stream: Stream) -> BoolArray:
            found = np.zeros(len(stream.t), bool)
            if stream.kind == "marker" and stream.moves:
                step = np.abs(np.diff(stream.values, axis=0)).max(axis=1)
                for (run,) in find_objects(label(step < _EQUAL)[0]):
                    begin, end = stream.t[run.start], stream.t[run.stop]
                    if end - begin >= _HELD and self._most_change(stream, begin, end):
                        found[run.start + 1 : run.stop + 1] = True
            return found

        return self._without(held, "exactly constant, unlike most markers,")

    def _most_change(self, held: Stream, begin: float, end: float) -> bool:
        """Whether most other markers on the same clock change all the time between times [s]."""
        changes = []
        for other in self.of("marker").values():
            if other is held or other.clock != held.clock:
                continue
            inside = other.values[(other.t >= begin) & (other.t <= end)]
            inside = inside[np.isfinite(inside).all(axis=1)]
            if len(inside) > 1:
                steps = np.abs(np.diff(inside, axis=0)).max(axis=1)
                changes.append(bool(np.mean(steps > _EQUAL) > _CHANGES))
        return 2 * sum(changes) > len(changes)

    def _without(self, lost: Callable[[Stream], BoolArray], how: str) -> "Recording":
        """Nan in the frames (n,) in which each stream is lost, with a remark on each."""
        streams, remarks = [], []
        for stream in self.streams:
            frames = lost(stream)
            values = np.where(frames[:, None], np.nan, stream.values)
            streams.append(replace(stream, values=values))
            if frames.any():
                remarks.append(
                    f"{stream.kind} {stream.name} is {how} in {frames.sum()} of {len(frames)} "
                    "frames, which count as not seen"
                )
        assumptions = (*self.assumptions, *remarks)
        return replace(self, streams=tuple(streams), assumptions=assumptions)


def together(recordings: Sequence[Recording]) -> Recording:
    """Combine several files into one recording.

    Raises MeasurementError if two streams have the same name, or if coordinates are not in metres.
    """
    streams = [stream for item in recordings for stream in item.streams]
    names = [(stream.kind, stream.name) for stream in streams]
    for (kind, name), stream in zip(names, streams, strict=True):
        if names.count((kind, name)) > 1:
            files = {other.file for other in streams if (other.kind, other.name) == (kind, name)}
            raise MeasurementError(
                f"two {_PLURALS[kind]} are called {name!r} in {' and '.join(sorted(files))}: they "
                "cannot be told apart.\n  Try: another name for one of them in the program that "
                "tracks them; recordings of different cables one by one."
            )
        places = stream.values[:, :3]
        far = float(np.abs(places[np.isfinite(places)]).max(initial=0.0))
        if kind != "wrench" and far > LARGEST:
            raise MeasurementError(
                f"{kind} {name!r} is {far:.4g} m from the origin: are its coordinates in "
                "metres?\n  Try: --units mm; an export that names its units."
            )
    return Recording(
        tuple(streams),
        tuple(cloud for item in recordings for cloud in item.clouds),
        tuple(dict.fromkeys(text for item in recordings for text in item.assumptions)),
        unread=tuple(dict.fromkeys(text for item in recordings for text in item.unread)),
    )


def factor(unit: str, of: str, known: Mapping[str, float]) -> float:
    """Size of a unit that is named in a file, among those that are known."""
    if unit.strip().lower() not in known:
        raise MeasurementError(
            f"the unit of {of} is {unit!r}.\n  Try: an export in one of {', '.join(known)}."
        )
    return known[unit.strip().lower()]


def length_unit(named: str, asked: str | None, usual: str, file: str) -> tuple[str, list[str]]:
    """The unit of the lengths in a file, by its key in `METRES`, and what of it is assumed.

    A file that names a known unit is in this one. One that names none is in the unit that its user
    has `asked` for, or the `usual` one of its format. Raises MeasurementError if it names another.
    """
    own = named.strip().lower()
    if own in METRES:
        return own, []
    if asked:
        why = f"whatever {show(named)} means" if own else "which it does not name"
        return asked, [f"{file} is taken to be in {asked}, {why}"]
    if own:
        known = "m, cm or mm"
        raise MeasurementError(
            f"the unit of length is {named!r}.\n  Try: an export in {known}; --units with the one "
            "that it means."
        )
    return usual, [f"{file} names no unit of length: {usual} is assumed; or --units"]


def checked_times(t: FloatArray, places: Sequence[str]) -> FloatArray:
    """Return times (n,) [s] as they are, if they are finite and increase without absurd pauses.

    Raises MeasurementError with the first of the n `places` in the file at which they do not.
    """
    step = np.diff(t, prepend=t[:1] - 1.0)
    bad = np.flatnonzero(~(np.isfinite(t) & (step > 0.0) & (step <= _PAUSE)))
    if not len(bad):
        return t
    k = int(bad[0])
    told = "has no time"
    if np.isfinite(t[k]):
        told = f"has the time {t[k]:.6f} s after {t[k - 1]:.6f} s in {places[k - 1]}"
    raise MeasurementError(
        f"{places[k]} {told}: times must increase, by less than a day from frame to frame.\n"
        "  Try: export it again, all frames in their order; or delete frames with wrong times."
    )


@dataclass(frozen=True)
class Wishes:
    """What the recording does not contain, and the user may add.

    Raises DloError with the name of the option whose value is impossible.
    """

    start: str = "start"
    """Name of the body that holds the start, or of three markers `o,x,y`: its place, a point along
    its x axis, and one on the side of y."""
    end: str = "end"
    """The same of the end; `free` if nothing holds it."""
    start_offset: Sequence[float] = ()
    """Where the cable leaves the start body, in its axes [m]; at its origin when empty."""
    end_offset: Sequence[float] = ()
    cable: str = ""
    """Text in the names of the cable's markers; if empty, all markers that no gripper has."""
    at: Sequence[float] = ()
    """Arc lengths of its markers from the start [m], ascending; measured in the poses if empty."""
    hold: float = 0.5
    """Shortest still stretch that is a pose [s]."""
    held_out: int = 4
    """One in this many poses is held out; 0 for none."""
    motions: int = 0
    """Most moving stretches between poses that are written as motions, the quickest ones."""
    known: Mapping[str, float] = field(default_factory=dict)
    """Keys and values of the section `cable`."""

    def __post_init__(self) -> None:
        """Check every value that needs no recording."""
        for key, value in {"hold": self.hold, **self.known}.items():
            positive = bool(np.isfinite(value) and value > 0.0)
            require(positive, key, value, "a positive number")
        require(self.motions >= 0, "motions", self.motions, "0 or more")
        few = self.held_out == 0 or self.held_out > 1
        require(few, "held_out", self.held_out, "0 for no pose, or 2 or more: one in so many")
        for side, offset in (("start", self.start_offset), ("end", self.end_offset)):
            near = bool(np.linalg.norm(offset) <= _OFFSET)  # False for nan
            require(
                near, f"{side}_offset", offset, f"three numbers in metres, {_OFFSET:g} m at most"
            )
            held = getattr(self, side) != FREE or not len(offset)
            require(held, f"{side}_offset", offset, f"left out with --{side} {FREE}")
        if len(self.at):
            longest = self.known.get("length", np.inf)
            ordered = all(np.diff(self.at) > 0.0) and self.at[0] >= 0.0
            wanted = "arc lengths in metres, each larger than the one before"
            if "length" in self.known:
                wanted += f", from 0 to --length {longest:g}"
            fine = bool(ordered and self.at[-1] <= longest and np.isfinite(self.at[-1]))
            require(fine, "at", self.at, wanted)
        require(self.start != self.end, "end", self.end, "another body than that at the start")

    @property
    def holders(self) -> dict[str, list[str]]:
        """Names of the body, or of the three markers, at each fixture."""
        sides = {"start": self.start} | ({} if self.end == FREE else {"end": self.end})
        return {side: list(map(str.strip, name.split(","))) for side, name in sides.items()}


def require(fine: bool, key: str, value: object, wanted: str) -> None:
    """Raise DloError with the name of an option unless its value is fine."""
    if not fine:
        if not isinstance(value, str):
            value = " ".join(f"{x:g}" for x in np.atleast_1d(np.asarray(value, float)))
        raise DloError(f"--{key.replace('_', '-')} {value}: it must be {wanted}.")
