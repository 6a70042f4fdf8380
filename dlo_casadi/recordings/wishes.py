"""What the recording does not contain, and the user may add."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dlo_casadi.errors import DloError

FREE = "free"
_OFFSET = 1.0  # m, longest distance from a gripper's markers to where the cable leaves it


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
    known: Mapping[str, float] = field(default_factory=dict)
    """Keys and values of the section `cable`."""

    def __post_init__(self) -> None:
        """Check every value that needs no recording."""
        for key, value in {"hold": self.hold, **self.known}.items():
            positive = bool(np.isfinite(value) and value > 0.0)
            require(positive, key, value, "a positive number")
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
