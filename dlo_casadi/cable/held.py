"""End conditions of a fitted cable, from what a caller gives and what a session shares."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.config.frozen import ConfigSection
from dlo_casadi.config.supports import Obstacle, Sides, clip_problems, obstacle_problems
from dlo_casadi.config.values import AXES
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import Branch, HeldPose
from dlo_casadi.equilibrium.spread import Tipping
from dlo_casadi.errors import DloError
from dlo_casadi.io.tables import read_table
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import outwards
from dlo_casadi.model.functions import functions_of
from dlo_casadi.show.text import millimetres, vector

# Arguments of `FittedCable.solve` that say how the ends are held.
# Those that tell how long the cable between its ends is where it slides through one.
FED = ("start_tension", "end_tension", "free_length")
HELD = (
    *("end", "start", "start_heading", "end_heading", "start_orientation", "end_orientation"),
    *("turns", "branch", *FED),
)
# Smallest distance [m] between a fixture and the cable that a table reports.
_SHOWN = 5e-6


def side_texts(
    sides: tuple[str, str], energy: float, apart: float, near: Tipping
) -> list[tuple[str, str]]:
    """The side on which a cable hangs, and the other one with its energy [J], as text."""
    own, other = sides
    said = (
        f"`{other}`: {energy:.6g} J, up to {millimetres(apart)} away; equally low with the clamp "
        f"turned by {near.angle:.2g} rad (known to {near.std:.2g} rad)"
    )
    return [("this side", f"`{own}`"), ("also stable", said)]


def _load_texts(on: str, force: FloatArray, moment: FloatArray | None) -> list[tuple[str, str]]:
    rows = [(f"force of the cable on {on}", vector(force, ".4g", "N"))]
    if moment is not None:
        said = vector(moment, ".4g", "N m") if np.ndim(moment) else f"{moment:.4g} N m"
        rows.append((f"moment of the cable on {on}", said))
    return rows


def reaction_texts(
    model: CableModel, pose: HeldPose, found: Equilibrium, points: FloatArray
) -> list[tuple[str, str]]:
    """All that holds or touches a cable whose points (K, d) [m] start and end there, as text.

    Forces and moments are those of the cable on its ends, clips and obstacles.
    """
    rows: list[tuple[str, str]] = []
    ends = (("start", pose.start, points[0]), ("end", pose.end, points[-1]))
    forces, turned = (found.start_force, found.end_force), functions_of(model).moment_ends
    for (side, at, reached), force, moment in zip(ends, forces, found.moments, strict=True):
        if at is None:
            rows.append((side, str(model.end)))
            continue
        rows.append((side, vector(at, "g", "m")))
        if math.dist(at, reached) > _SHOWN:
            place = vector(reached, ".5f", "m")
            rows.append((f"{side} of the cable", f"{place}: fixture errors of the fit included"))
        rows += _load_texts(f"its {side}", force, moment if side in turned else None)
    for clip, load in zip(pose.clips, found.clips, strict=True):
        place = vector(clip.place, "g", "m")
        rows.append((clip.name, f"{clip.kind} at {load.at:.4g} m of the cable, {place}"))
        rows += _load_texts(clip.name, load.force, load.moment if clip.kind.direction else None)
    for one in found.contacts:
        apart = one.end > one.start
        where = f"from {one.start:.4g} to {one.end:.4g}" if apart else f"at {one.start:.4g}"
        ((on, force_text),) = _load_texts(one.obstacle, one.force, None)
        rows.append((on, f"{force_text} {where} m of the cable"))
    return rows


class _Obstacles(ConfigSection):
    """Obstacles of a call, so that messages name them by their index in the list."""

    obstacles: tuple[Obstacle, ...]


def among(
    model: CableModel,
    p: FloatArray,
    obstacles: Sequence[Obstacle | Mapping[str, Any]],
    over: Sides = None,
) -> dict[str, Any]:
    """Model and parameters `p` of a cable among obstacles, checked like those of a session.

    Obstacles are exactly where they are declared: an `obstacle_offset` belongs to the session only.
    `over`: as in `HeldPose`. Raises DloError if an obstacle is impossible.
    """
    given: dict[str, Any] = {"obstacles": obstacles}
    listed = _Obstacles(**given).obstacles
    if wrong := [x.message for x in obstacle_problems(listed, model.gravity, [over])]:
        raise DloError("; ".join(wrong))
    surfaces = tuple(item.surface(k) for k, item in enumerate(listed, start=1))
    model = replace(model, obstacles=surfaces)
    moved = outwards(model)[: len(surfaces)]
    return {"model": model, "p": np.where(moved.any(axis=0), model.nominal, p)}


def all_asked(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `FittedCable.solve`, by name, with those of a Pose in the place of the end.

    Raises
    ------
    DloError
        If other arguments stand beside the Pose.
    """
    pose = asked["end"]
    if not isinstance(pose, Pose):
        return dict(asked)
    given = {key: value for key, value in asked.items() if key != "end"}
    beside = [key for key in ("turns", "clips") if given.pop(key)]
    beside += [key for key, value in given.items() if value is not None]
    if beside:
        said = ", ".join(beside)
        raise DloError(f"solve(pose) beside {said}: a Pose has them.\n  Try: Pose(..., {said}).")
    return {key: getattr(pose, key) for key in asked}


def posed(cable: Any, asked: Mapping[str, Any]) -> tuple[Any, HeldPose]:
    """A cable with the clips of a pose, and its end conditions; see `held_pose`."""
    pose = held_pose(cable.model, cable.metadata.fixtures, all_asked(asked))
    held = cable.with_clips([clip.kind for clip in pose.clips])
    by_length = pose.free_length is not None
    return replace(held, model=replace(held.model, fed_by_length=by_length)), pose


def held_pose(model: CableModel, shared: Mapping[str, Any], asked: Mapping[str, Any]) -> HeldPose:
    """End conditions, checked like those of a session and against the boundary.

    Parameters
    ----------
    shared : dict
        End conditions that all poses of the session share; defaults for `asked`.
    asked : dict
        Arguments of `FittedCable.solve`, by name.

    Raises
    ------
    DloError
        If the ends are not held as the cable's boundary requires, or are not finite numbers.
    """
    name, branch = repr(model.cable.name), asked["branch"]
    own, other = AXES[model.node.dimension], AXES[5 - model.node.dimension]
    kind, gravity = own.direction, f"{own.gravity} of gravity"
    given = {key: value for key, value in asked.items() if value is not None}
    if not (branch is None or (isinstance(branch, str) and branch in get_args(Branch))):
        raise DloError(f"branch must be 'ccw', 'cw' or None, found {branch!r}")
    if branch not in (None, *model.node.branches):
        raise DloError(f"{name} is in space: a branch has no meaning")
    if not model.end.place and "end" in given:
        raise DloError(f"the end of {name} is free: it cannot be held at {given['end']} m")
    if model.end.place and "end" not in given:
        raise DloError(
            f"the end of {name} is {model.end}: where is it?\n"
            f"  Try: end={own.place} [m], of the command --end {' '.join(model.node.axes).upper()}."
        )
    given.setdefault("start", shared.get("start") or (0.0,) * model.node.dimension)
    for side, held in (("start", model.start), ("end", model.end)):
        key = f"{side}_{kind}"
        if (strange := f"{side}_{other.direction}") in given:
            text = f"{strange}: {name} is in {own.where} ({gravity})"
            raise DloError(f"{text}.\n  Try: {key} {own.unit}")
        if not held.direction and key in given:
            raise DloError(f"the {side} of {name} is {held}: {key} has no meaning")
        if held.direction and given.setdefault(key, shared.get(key)) is None:
            raise DloError(
                f"the {side} of {name} is {held}, with no {kind} that all poses share: "
                f"give {key} {own.unit}"
            )
    posed = Pose(**given)
    length, axes = model.cable.length, model.node.dimension
    if wrong := [text for text, _ in clip_problems(posed.clips, length, axes)]:
        raise DloError(f"{name}: {'; '.join(wrong)}")
    pose = posed.held
    for key, at in (("start", pose.start), ("end", pose.end)):
        if at is not None and len(at) != model.node.dimension:
            raise DloError(f"{key}: {own.place} belongs here ({gravity}), found {at}")
    by_length = pose.free_length is not None
    if fed := pose.wrongly_fed((model.start, model.end), by_length=by_length):
        raise DloError(fed.replace("the cable", name))
    if pose.turns and not (model.node.twists and model.start.roll and model.end.roll):
        raise DloError(f"{name} has no turns: it is not in space and clamped at both ends")
    return replace(pose, name=model.cable.name or "cable")


def listed_poses(model: CableModel, path: Path) -> dict[str, dict[str, Any]]:
    """Arguments of `FittedCable.solve` for each line of a table, by the pose's name.

    Columns are end_x_m, end_y_m and, where they differ from pose to pose, start_x_m, start_y_m,
    start_heading_rad, end_heading_rad; in space also end_z_m, start_z_m, start_qx to start_qw,
    end_qx to end_qw and turns; and name, by default the line's number. Raises DloError if the file
    is missing, has other columns or one twice, cells that are not numbers, or a name twice; see
    `read_table` for what it may look like.
    """
    node, sides = model.node, ("start", "end")
    keys = {side: [f"{side}_{axis}_m" for axis in node.axes] for side in sides}
    keys |= {f"{side}_{node.direction}": [f"{side}_{x}" for x in node.columns] for side in sides}
    keys |= {"turns": ["turns"]} if node.twists else {}
    known = ["name", *(column for group in keys.values() for column in group)]
    advice = f".\n  Try: {', '.join(known)}; the first line names them"

    def chosen(names: tuple[str, ...]) -> list[str]:
        """All columns but that of the names."""
        if strange := [name for name in names if name and name not in known]:
            raise ValueError(f"unknown columns {strange}", advice)
        if twice := [name for name in names if name and names.count(name) > 1]:
            raise ValueError(f"two columns are called {twice[0]}", advice)
        groups = [group for group in keys.values() if {*group} & {*names}]
        if absent := [name for group in groups for name in group if name not in names]:
            raise ValueError(f"the column {absent[0]} is missing", advice)
        return [name for group in groups for name in group]

    table = read_table(path, chosen, f"a header {','.join(keys['end'])} and poses")
    if not table.lines:
        raise DloError(f"{path}: no poses{advice}")
    texts = table.texts("name") if "name" in table.names else [""] * len(table.lines)
    out: dict[str, dict[str, Any]] = {}
    for k, (text, line) in enumerate(zip(texts, table.lines, strict=True)):
        name = text or f"pose_{k + 1:02d}"
        if name in out:
            raise DloError(
                f"{path}, line {line}: an earlier pose is called {name!r}, too.\n"
                "  Try: a name for each pose, or no column `name`"
            )
        given = {}
        for key, group in keys.items():
            if group[0] in table.columns:
                numbers = [float(table[column][k]) for column in group]
                given[key] = numbers if len(group) > 1 else numbers[0]
        out[name] = given
    return out
