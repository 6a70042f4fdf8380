"""One form for everything that laboratories record: streams in SI units, z up, with own clocks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError

Kind = Literal["marker", "body", "wrench"]

# Axis that points up in a file -> rotation to z up that keeps x or y.
_UP = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
_LARGEST = 100.0  # m, distance from the origin beyond which coordinates cannot be in metres
METRES = {"m": 1.0, "meters": 1.0, "metres": 1.0, "cm": 0.01, "centimeters": 0.01}
METRES |= {"mm": 1e-3, "millimeters": 1e-3, "millimetres": 1e-3}


@dataclass(frozen=True)
class Stream:
    """The record of one marker, rigid body or force sensor."""

    name: str
    kind: Kind
    t: FloatArray
    """(n,) [s], on its own clock, increasing."""
    values: FloatArray
    """(n, 3) [m] of a marker; (n, 7) position [m] and quaternion (x, y, z, w) of a body; (n, 6)
    force [N] and moment [N m]. nan where it was not seen."""
    clock: str
    """Streams with the same clock share their origin of time."""
    frame: str = ""
    """Axes of a wrench: of the world, or the name of what carries the sensor."""


@dataclass(frozen=True)
class Cloud:
    """Points that a depth camera has seen at one time."""

    name: str
    points: FloatArray
    """(K, 3) [m]."""
    colors: FloatArray | None = None
    """(K, 3) red, green, blue, 0 to 255."""
    camera: FloatArray | None = None
    """(3,) [m], place of the camera."""
    t: float = np.nan
    """[s]; nan in a file without a time."""
    clock: str = ""


@dataclass(frozen=True)
class Recording:
    """Everything that was recorded, and the assumptions made to read it."""

    streams: tuple[Stream, ...] = ()
    clouds: tuple[Cloud, ...] = ()
    assumptions: tuple[str, ...] = ()
    up: str = "z"
    """The axis, x, y or z, that points up."""
    up_by: str = ""
    """Why it is taken for the one."""

    def of(self, kind: Kind) -> dict[str, Stream]:
        """Streams of one kind, by name."""
        return {stream.name: stream for stream in self.streams if stream.kind == kind}

    def with_z_up(self, up: str | None) -> "Recording":
        """The recording rotated to z up, from axes in which `up` points up, or as it was read."""
        turn = _UP[up or self.up]
        assumed = () if up else (f"{self.up} is up, {self.up_by}; or --up",)

        def turned(stream: Stream) -> Stream:
            values = stream.values.copy()
            if stream.kind != "wrench":
                values[:, :3] = values[:, :3] @ turn.T
            if stream.kind == "body":
                seen = np.linalg.norm(values[:, 3:], axis=1) > 0.5  # zero where tracking was lost
                values[~seen] = np.nan
                turns = Rotation.from_matrix(turn) * Rotation.from_quat(values[seen, 3:])
                values[seen, 3:] = turns.as_quat()
            if stream.kind == "wrench" and not stream.frame:
                values = np.hstack([values[:, :3] @ turn.T, values[:, 3:] @ turn.T])
            return replace(stream, values=values)

        clouds = tuple(
            replace(
                cloud,
                points=cloud.points @ turn.T,
                camera=None if cloud.camera is None else turn @ cloud.camera,
            )
            for cloud in self.clouds
        )
        streams = tuple(map(turned, self.streams))
        return Recording(streams, clouds, (*self.assumptions, *assumed))


def together(recordings: Sequence[Recording]) -> Recording:
    """Combine several files into one recording.

    Raises MeasurementError if two streams have the same name, or if coordinates are not in metres.
    """
    streams = [stream for item in recordings for stream in item.streams]
    names = [(stream.kind, stream.name) for stream in streams]
    for (kind, name), stream in zip(names, streams, strict=True):
        if names.count((kind, name)) > 1:
            raise MeasurementError(
                f"two streams ({kind}) are called {name!r}: of {stream.clock} and another.\n"
                "  Try: one file for each cable, or other names in the export."
            )
        places = stream.values[:, :3]
        far = float(np.abs(places[np.isfinite(places)]).max(initial=0.0))
        if kind != "wrench" and far > _LARGEST:
            raise MeasurementError(
                f"{kind} {name!r} is {far:.4g} m from the origin: are its coordinates in "
                "metres?\n  Try: an export that names its units."
            )
    return Recording(
        tuple(streams),
        tuple(cloud for item in recordings for cloud in item.clouds),
        tuple(dict.fromkeys(text for item in recordings for text in item.assumptions)),
    )


def factor(unit: str, name: str) -> float:
    """Convert a unit of length named in a file to metres."""
    if unit.strip().lower() not in METRES:
        known = ", ".join(METRES)
        raise MeasurementError(f"the unit of length {unit!r} is none of {known}", pose=name)
    return METRES[unit.strip().lower()]
