"""Poses as the C solver takes them, checked where they enter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.codegen.records import pose_size
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import EndConditions

FloatArray = NDArray[np.floating]

# As in the header.
_BRANCHES = {None: 0, "ccw": 1, "cw": 2}
# What to try, by the name of the status.
_HINTS = {
    "unreachable": "is the end in metres?",
    "iteration_limit": "warm: the shape of a pose nearby.",
    "not_finite": "finite numbers for start, end and directions.",
    "unstable": "another branch, or a pose nearby.",
    "bad_argument": "in space a pose without a branch, and orientations that are not zero.",
    "other_branch": "the other branch, or none: the equilibria that were found turn the other way.",
    "turns_shed": "fewer turns, or the end farther from the start.",
}


def pose_table(
    model: CableModel, poses: Sequence[Pose] | FloatArray, branch: object = None
) -> tuple[FloatArray, int]:
    """Poses (m, k) laid out as dlo_pose, and the C solver's number of their branch.

    Parameters
    ----------
    poses : sequence of Pose, or (m, k)
    branch : "ccw", "cw" or None
        Of rows of numbers; a Pose has its own.

    Raises
    ------
    DloError
        If they are no poses of this cable, of several branches, or of an unknown one.
    """
    if isinstance(poses, np.ndarray):
        size = pose_size(model)
        if poses.ndim != 2 or poses.shape[1] != size:
            raise DloError(
                f"poses: an array (m, {size}) as dlo_pose in the C header belongs here, found "
                f"{poses.shape}"
            )
        if poses.dtype.kind not in "fiu":
            raise DloError(f"poses: real numbers belong in the array, found {poses.dtype}")
        return np.ascontiguousarray(poses, float), _branch_number(branch)
    if branch is not None:
        raise DloError(f"branch {branch!r} is for poses in an array; a Pose names its own")
    table = np.array([_row(model, pose) for pose in poses]).reshape(-1, pose_size(model))
    numbers = {_branch_number(pose.branch) for pose in poses} or {0}
    if len(numbers) > 1:
        found = ", ".join(sorted({str(pose.branch) for pose in poses}))
        raise DloError(f"poses of one branch belong in one call, found {found}\n  Try: two calls.")
    return table, numbers.pop()


def _branch_number(branch: object) -> int:
    if branch is not None and not (isinstance(branch, str) and branch in _BRANCHES):
        raise DloError(f"branch must be 'ccw', 'cw' or None, found {branch!r}")
    return _BRANCHES[branch]


def _row(model: CableModel, pose: object) -> FloatArray:
    if not isinstance(pose, Pose):
        raise DloError(f"a Pose belongs here, found {pose!r}\n  Try: dlo_casadi.Pose(start, end)")
    if pose.end is None and model.end != "free":
        raise DloError(
            f"{pose.name}: the end of the cable is {model.end}: where is it?\n  Try: end"
        )
    d = model.node.dimension
    for name, place in (("start", pose.start), ("end", pose.end)):
        if place is not None and np.shape(place) != (d,):
            raise DloError(f"{pose.name}: {name} must have {counted(d, 'number')}, found {place!r}")
    try:
        numbers = np.asarray([*pose.ends, pose.turns], float)
    except (TypeError, ValueError):
        raise DloError(f"numbers belong in a pose, found {pose!r}") from None
    if len(numbers) != EndConditions.size(model.node) + 1:
        raise DloError(f"{pose.name}: an orientation must have 4 numbers, found {pose!r}")
    return numbers[: pose_size(model)]


def no_equilibrium(status: str, pose: Pose, length: float) -> str:
    """Message on a pose that ends in a status other than ok."""
    start, end = (", ".join(f"{x:.4f}" for x in place or ()) for place in (pose.start, pose.end))
    hint = _HINTS.get(status)
    return (
        f"no equilibrium: {status} with the end {f'at ({end}) m' if end else 'free'}, the start at "
        f"({start}) m; the cable is {length:.4f} m long." + (f"\n  Try: {hint}" if hint else "")
    )
