"""Poses as the C solver takes them, checked where they enter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.errors import DloError

FloatArray = NDArray[np.floating]

# As in the header.
_BRANCHES = {None: 0, "ccw": 1, "cw": 2}
# What to try, by the name of the status.
_HINTS = {
    "unreachable": "is the end in metres?",
    "iteration_limit": "warm: the shape of a pose nearby.",
    "not_finite": "finite numbers for end, start and headings.",
    "unstable": "another branch, or a pose nearby.",
    "other_branch": "the other branch, or none: the equilibria that were found turn the other way.",
    "turns_shed": "fewer turns, or the end farther from the start.",
}


def branch_number(branch: object) -> int:
    """The C solver's number of a branch.

    Raises
    ------
    DloError
        If it is neither "ccw", "cw" nor None.
    """
    if branch is not None and not (isinstance(branch, str) and branch in _BRANCHES):
        raise DloError(f"branch must be 'ccw', 'cw' or None, found {branch!r}")
    return _BRANCHES[branch]


def pose_table(ends: ArrayLike, start: ArrayLike, headings: ArrayLike) -> FloatArray:
    """Poses (m, 6) of many ends (m, 2): start, end, headings.

    Parameters
    ----------
    ends : (m, 2) or (2,) [m]
    start : (2,) or (m, 2) [m]
    headings : (2,) or (m, 2) [rad]

    Raises
    ------
    DloError
        If they are no numbers, or do not belong together.
    """
    held = np.atleast_2d(_numbers("ends", ends))
    if held.ndim != 2 or held.shape[1] != 2:
        raise DloError(f"ends must have the shape (m, 2), found {np.shape(ends)}")
    poses = np.zeros((len(held), 6))
    poses[:, 2:4] = held
    for name, given, at in (("start", start, slice(0, 2)), ("headings", headings, slice(4, 6))):
        values = _numbers(name, given)
        if values.shape not in ((2,), held.shape):
            raise DloError(
                f"{name} must have the shape (2,) or, as the ends, {held.shape}; "
                f"found {values.shape}"
            )
        poses[:, at] = values
    return poses


def one_pose(end: ArrayLike, start: ArrayLike, headings: ArrayLike) -> FloatArray:
    """Pose (1, 6): start, end, headings, each of shape (2,).

    Raises
    ------
    DloError
        If one of them is not two numbers.
    """
    for name, given in (("end", end), ("start", start), ("headings", headings)):
        shape = _numbers(name, given).shape
        if shape != (2,):
            many = " Try: solve_many for many ends." if name == "end" and len(shape) == 2 else ""
            raise DloError(f"{name}: two numbers belong here, found the shape {shape}.{many}")
    return pose_table(end, start, headings)


def frame_poses(poses: Sequence[Pose]) -> FloatArray:
    """Poses (m, 15) in space: start, end, orientations, turns."""
    return np.array([[*pose.ends, pose.turns] for pose in poses], dtype=float).reshape(-1, 15)


def no_equilibrium(status: str, start: FloatArray, end: FloatArray, length: float) -> str:
    """Message on a pose that ends in a status other than ok."""
    here, there = (", ".join(f"{x:.4f}" for x in place) for place in (start, end))
    hint = _HINTS.get(status)
    return (
        f"no equilibrium: {status} with the end at ({there}) m, the start at ({here}) m; the cable "
        f"is {length:.4f} m long." + (f"\n  Try: {hint}" if hint else "")
    )


def _numbers(name: str, values: Any) -> FloatArray:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise DloError(f"{name}: numbers belong here, found {values!r}") from None
