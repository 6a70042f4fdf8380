"""What is asked of a motion, checked: poses, limits, numbers, names of files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.cable.held import HELD
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import DloError
from dlo_casadi.planning.problem import FIXTURES

LIMITS = (*FIXTURES, "force", "moment", "bend_radius", "clearance", "swing")


def number(name: str, value: Any) -> float:
    """A number above zero."""
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < float(value) < np.inf:
        raise DloError(f"{name}: a number above zero belongs here, found {value!r}")
    return float(value)


def table_file(path: str | PathLike[str]) -> Path:
    """The name of a table: it ends in .csv or .json."""
    file = Path(path)
    if file.suffix.lower() not in (".csv", ".json"):
        raise DloError(f"{file}: a table is CSV or JSON.\n  Try: {file.with_suffix('.csv')}")
    return file


def checked_limits(
    limits: Mapping[str, float] | None, obstacles: Sequence[Any]
) -> dict[str, float]:
    """Limits by name."""
    if limits is not None and not isinstance(limits, Mapping):
        raise DloError(f'limits: {{"speed": 0.5, ...}} belongs here, found {limits!r}')
    asked = dict(limits or {})
    for name, value in asked.items():
        if name not in LIMITS:
            raise DloError(f"limits: {name!r} is no limit of a motion.\n  Try: {', '.join(LIMITS)}")
        asked[name] = number(f"limits: {name}", value)
    if obstacles and "clearance" not in asked:
        asked["clearance"] = 0.0
    if "clearance" in asked and not obstacles:
        raise DloError("limits: clearance: there are no obstacles.\n  Try: obstacles=[...]")
    return asked


def checked_pose(cable: Any, name: str, given: Any) -> dict[str, Any] | None:
    """Keywords of `solve`; None for a shape of the cable."""
    if isinstance(given, Mapping):
        if beside := [key for key in given if key in ("obstacles", "clips", "over")]:
            raise DloError(
                f"{name}: {', '.join(beside)} cannot stand in a pose of a motion.\n"
                "  Try: obstacles=[...] of move; clips do not move yet."
            )
        if unknown := [str(key) for key in given if key not in HELD]:
            raise DloError(
                f"{name}: nothing is held by {', '.join(unknown)}.\n  Try: {', '.join(HELD)}"
            )
        return dict(given)
    own = getattr(given, "cable", None)
    if own is None or not hasattr(given, "equilibrium"):
        raise DloError(
            f"{name}: a shape, or keywords of solve belong here, found {given!r}.\n"
            '  Try: {"start": (0, 0), "start_heading": -1.2}'
        )
    same = own.model == cable.model and np.array_equal(own.p, cable.p)
    if not (same and np.array_equal(own.rest, cable.rest)):
        raise DloError(f"{name}: this shape is of another cable.\n  Try: cable.solve(...)")
    return None


def held_by(pose: HeldPose) -> dict[str, Any]:
    """Arguments of `simulate` of a pose at rest."""
    names = ("start", "end", f"start_{pose.node.direction}", f"end_{pose.node.direction}")
    return {name: getattr(pose, name) for name in names if getattr(pose, name) is not None}
