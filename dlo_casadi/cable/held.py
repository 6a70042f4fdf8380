"""How the ends of a fitted cable are held, from what a caller gives and what a session shares."""

from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from dlo_casadi.config.values import implausible_quaternion
from dlo_casadi.equilibrium.pose import Branch, HeldPose
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel


def held_pose(model: CableModel, shared: Mapping[str, Any], asked: Mapping[str, Any]) -> HeldPose:
    """End conditions, checked against the boundary.

    Parameters
    ----------
    shared : dict
        What all poses of the session had in common, for what is not asked for.
    asked : dict
        The arguments of `FittedCable.solve` by their names.

    Raises
    ------
    DloError
        If the ends are not held as the cable's boundary asks, or are no finite numbers.
    """
    name, size, spatial = model.cable.name, model.node.dimension, model.in_space
    start, end, branch = asked["start"], asked["end"], asked["branch"]
    if branch is not None and branch not in get_args(Branch):
        raise DloError(f"branch must be 'ccw', 'cw' or None, found {branch!r}")
    if branch is not None and spatial:
        raise DloError(f"{name!r} is in space: a branch has no meaning")
    if model.end == "free" and end is not None:
        raise DloError(f"the end of {name!r} is free: it cannot be held at {end} m")
    if model.end != "free" and end is None:
        raise DloError(
            f"the end of {name!r} is {model.end}: where is it?\n"
            f"  Try: --end {' '.join(model.node.axes).upper()} [m], in Python end."
        )
    turns = _number(asked["turns"], "turns", "full turns")
    if turns and not (spatial and model.start == model.end == "clamped"):
        raise DloError(f"{name!r} has no turns: it is not in space and clamped at both ends")
    if start is None:
        start = shared.get("start") or (0.0,) * size
    return HeldPose(
        start=_point(start, "start", size),
        end=None if end is None else _point(end, "end", size),
        turns=turns,
        branch=branch,
        name=name or "cable",
        **_directions(model, shared, asked),
    )


def _directions(
    model: CableModel, shared: Mapping[str, Any], asked: Mapping[str, Any]
) -> dict[str, Any]:
    """Directions of the clamps, by their key; none of pins."""
    name = repr(model.cable.name)
    kind, unit, other, where = _DIRECTIONS[model.node.increment]
    found: dict[str, Any] = {}
    for side, held in (("start", model.start), ("end", model.end)):
        key = f"{side}_{kind}"
        value = asked[key]
        if asked[f"{side}_{other}"] is not None:
            raise DloError(f"{side}_{other}: {name} is in {where}.\n  Try: {key}{unit}")
        if held != "clamped" and value is not None:
            raise DloError(f"the {side} of {name} is {held}: {key} has no meaning")
        if held != "clamped":
            continue
        value = shared.get(key) if value is None else value
        if value is None:
            raise DloError(
                f"the {side} of {name} is clamped, and its {kind} differed from pose to pose: "
                f"give {key}{unit}"
            )
        found[key] = (
            _orientation(value, key) if kind == "orientation" else _number(value, key, "rad")
        )
    return found


# Size of a node's increment -> key of a clamp's direction, unit, the other dimension's key, words.
_DIRECTIONS = {
    1: ("heading", " [rad]", "orientation", "a plane (two numbers of gravity)"),
    3: ("orientation", " [qx, qy, qz, qw]", "heading", "space (three numbers of gravity)"),
}
_WORDS = {2: "two finite numbers (x, y)", 3: "three finite numbers (x, y, z)"}


def _point(values: Any, what: str, size: int) -> tuple[float, ...]:
    point = _finite(values)
    if len(point) != size:
        raise DloError(f"{what}: {_WORDS[size]} in metres belong here, found {values!r}")
    return point


def _orientation(values: Any, what: str) -> tuple[float, ...]:
    quaternion = _finite(values)
    wrong = "four finite numbers [qx, qy, qz, qw] belong here"
    if not quaternion or (wrong := implausible_quaternion(quaternion)):
        raise DloError(f"{what}: {wrong}, found {values!r}")
    return quaternion


def _number(value: Any, what: str, unit: str) -> float:
    numbers = _finite([value])
    if not numbers:
        raise DloError(f"{what}: a finite number [{unit}] belongs here, found {value!r}")
    return numbers[0]


def _finite(values: Any) -> tuple[float, ...]:
    """Finite numbers, or nothing."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        return ()
    return tuple(array.tolist()) if array.ndim == 1 and np.all(np.isfinite(array)) else ()
