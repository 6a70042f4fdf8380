"""Recordings of the moving cable, as a session declares them."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import ValidationInfo, field_validator, model_validator

from dlo_casadi.config.frozen import ConfigSection, Given, Numbers, Rows, Turned, entry
from dlo_casadi.config.problems import PLACEHOLDER, show
from dlo_casadi.config.values import (
    ArcLengths,
    Heading,
    Headings,
    Name,
    Place,
    Points,
    Quaternion,
    Quaternions,
    Times,
    checked,
    no_file_name,
)
from dlo_casadi.errors import well_formed

_SHAPES = "points (T, K, d) have times t (T,) and, of markers, arc lengths at (K,)"


class FixturePath(ConfigSection):
    """How the fixtures moved, as arrays; what rests is left out and stands in the `Motion`."""

    t: Given[Times, Numbers]
    """Times (T,) [s] of the fixtures' clock, growing."""
    start: Given[Points | None, Rows | None] = entry(default=None)
    """Places (T, d) [m] of the start."""
    end: Given[Points | None, Rows | None] = entry(default=None)
    """Places (T, d) [m] of the end."""
    start_heading: Given[Headings | None, Numbers | None] = entry(default=None)
    """Directions (T,) [rad] of a clamped start in a plane."""
    end_heading: Given[Headings | None, Numbers | None] = entry(default=None)
    """Directions (T,) [rad] of a clamped end in a plane."""
    start_orientation: Given[Quaternions | None, Rows | None] = entry(default=None)
    """Frames (T, 4) of a clamped start in space, quaternions [qx, qy, qz, qw]."""
    end_orientation: Given[Quaternions | None, Rows | None] = entry(default=None)
    """Frames (T, 4) of a clamped end in space, quaternions [qx, qy, qz, qw]."""


class Motion(ConfigSection):
    """A recording of the moving cable: points at times, and how its ends were held meanwhile.

    From Python `t` (T,), `points` (T, K, d) and, for markers, `at` (K,) stand in place of `file`; a
    point that was not seen is NaN. So may the rows of a file: `t`, `at`, `points` of the same
    length.
    """

    file: Given[Path | None, str | PathLike[str] | None] = entry(default=None)
    """CSV, found relative to the YAML: t_s,s_m,x_m,y_m[,z_m] of markers, a row for each marker and
    time, or t_s,x_m,y_m[,z_m] of lines in order along the cable."""
    fixtures: Given[Path | FixturePath | None, str | PathLike[str] | Mapping[str, Any] | None] = (
        entry(default=None)
    )
    """CSV of how the ends moved: t_s,start_x_m,start_y_m[,start_z_m],start_heading_rad or
    start_qx,start_qy,start_qz,start_qw, and the same with end_; without it they rest."""
    t: Given[Times | None, Numbers | None] = entry(default=None)
    """Time [s] of each point, instead of a file."""
    points: Given[Points | None, Rows | None] = entry(default=None)
    """Points [m], one for each time."""
    at: Given[ArcLengths | None, Numbers | None] = entry(default=None)
    """Arc length [m] from the start of each point, which makes them markers."""
    name: Annotated[Name, checked(no_file_name)] = entry(default="", validate_default=True)
    """What to call the motion; as its file without folder and ending, or by its number, when
    absent."""
    start: Given[Place | None, Numbers | None] = entry(default=None)
    """Where the start rests [m], if it does."""
    end: Given[Place | None, Numbers | None] = entry(default=None)
    """Where the end rests [m], if it is held and does."""
    start_heading: Heading | None = None
    """Direction of the cable in a clamped start that rests [rad], as in a pose."""
    end_heading: Heading | None = None
    """Direction of the cable in a clamped end that rests [rad], as in a pose."""
    start_orientation: Given[Quaternion | None, Turned | None] = entry(default=None)
    """Frame of a clamped start in space that rests, as in a pose."""
    end_orientation: Given[Quaternion | None, Turned | None] = entry(default=None)
    """Frame of a clamped end in space that rests, as in a pose."""
    begins: Literal["moving", "at_rest"] = "moving"
    """at_rest: the cable hangs still at the first instant; moving: its first state is estimated."""
    role: Literal["fit", "held_out"] = "fit"
    """fit, or held_out: predicted from its first 0.15 s, or from rest."""

    @property
    def shown_by(self) -> str:
        """Name of its file, or its own name, for messages."""
        return self.name if self.file is None else self.file.name

    @field_validator("file", "fixtures", mode="before")
    @classmethod
    def _absolute(cls, value: object, info: ValidationInfo) -> object:
        if value is None or isinstance(value, Mapping | FixturePath):
            return value
        if not isinstance(value, str | Path) or str(value).strip() in ("", PLACEHOLDER):
            raise ValueError(f"a file name belongs here, found {show(value)}")
        return ((info.context or {}).get("folder", Path()) / value).absolute()

    @field_validator("name", mode="after")
    @classmethod
    def _named(cls, value: str, info: ValidationInfo) -> str:
        file = info.data.get("file")
        return value or ("" if file is None else well_formed(file.stem))

    @model_validator(mode="before")
    @classmethod
    def _in_rows(cls, given: Any) -> Any:
        """Arrays (T, K, d) as rows of a file, without the points that were not seen."""
        if not isinstance(given, Mapping) or given.get("points") is None:
            return given
        try:
            points = np.array(given["points"], dtype=float)
            t, at = (
                np.array(() if (x := given.get(key)) is None else x, dtype=float)
                for key in ("t", "at")
            )
        except (TypeError, ValueError):
            return given  # the fields themselves say what is wrong
        if points.ndim != 3:
            return given
        if t.shape != points.shape[:1] or (at.size and at.shape != points.shape[1:2]):
            found = f"found {points.shape}, {t.shape} and {at.shape}"
            raise ValueError(f"{_SHAPES}, {found}")
        seen = np.isfinite(points).all(axis=2)
        rows = {"points": points[seen].tolist(), "t": np.repeat(t, seen.sum(axis=1)).tolist()}
        if at.size:
            rows["at"] = np.broadcast_to(at, seen.shape)[seen].tolist()
        return {**given, **rows}

    @model_validator(mode="after")
    def _shown_once(self) -> Self:
        if (self.file is None) == (self.points is None):
            raise ValueError("one of file and points (with t) belongs here")
        count = {key: len(x) for key in ("t", "at", "points") if (x := getattr(self, key))}
        if self.points is not None and (self.t is None or len({*count.values()}) > 1):
            found = ", ".join(f"{number} of {key}" for key, number in count.items())
            raise ValueError(f"{_SHAPES}, found {found}")
        return self
