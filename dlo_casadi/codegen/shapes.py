"""Arguments and results of the compiled solver, and the memory layout of its C structures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Obstacle, Pose
from dlo_casadi.config.supports import obstacle_problems
from dlo_casadi.config.values import AXES
from dlo_casadi.equilibrium.implicit import pose_size
from dlo_casadi.equilibrium.pose import Branch, HeldPose
from dlo_casadi.errors import DloError, counted
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import EndConditions
from dlo_casadi.rod.obstacles import Obstacle as Surface

_BRANCHES: dict[Branch | None, int] = {None: 0, "ccw": 1, "cw": 2}
# A pose or obstacle of a session, or only its ends, its form.
AnyPose = Pose | HeldPose
AnyObstacle = Obstacle | Surface


@dataclass(frozen=True)
class CompiledShape:
    """Shape of the cable in one pose, as in the C header.

    Parameters
    ----------
    points : (n + 1, dimension) [m]
    x : (n_nodes, coordinates)
        States of the nodes: in a plane headings [rad], in space unit quaternions (x, y, z, w).
    start_force, end_force : (dimension,) [N]
        Of the cable on whatever holds its start and its end.
    moments : (2, increment) [N m]
        Of the cable on its clamps and on springs of pins (start, end); in space about the world's
        axes.
    energy : float [J]
    min_bend_radius, min_bend_at : float [m]
        Smallest bend radius, and its arc length along the declared length.
    max_twist, max_twist_at : float [1/m, m]
        Largest twist of an element, with its sign, and its middle; 0 in a plane.
    end_error : float [m]
    imbalance : float [N m]
    iterations : int
    turn : int
        +1 counter-clockwise from start to end, -1 clockwise; 0 in space.
    status : str
        One of STATUSES; all numbers are zero unless it is "ok".
    clip_forces : (n_clips + n_tethers, dimension) [N]
        Of the cable on each clip, then on each tether.
    clip_grip : (n_clips + n_tethers,) [N]
        Components along the cable, forward: what a clip must hold against slipping.
    clip_at : (n_clips + n_tethers,) [m]
        Arc lengths at which they hold the cable.
    clip_moments : (n_clips + n_tethers, increment) [N m]
        With clamped clips: of the cable on them; in space about the world's axes.
    places : (n + 1,)
        With clips or tethers, or ends that slide: arc lengths over length of points and nodes;
        clips have one each.
    fed : float [m]
        Length between the ends beside the cable's own, without load, where it slides through one.
    laid : (2 + n_clips,)
        Then: arc lengths over length of the ends, then the clips, for which nodes are laid.
    contact_forces : (obstacles, 4 n) [N]
        Magnitudes of the forces on each obstacle, normal to its surface, at places of the cable; 0
        without contact.
    contact_places : (obstacles, 4 n)
        These places: arc lengths over length.
    obstacle_forces : (obstacles, dimension) [N]
        Of the cable on each obstacle.
    """

    points: FloatArray
    x: FloatArray
    start_force: FloatArray
    end_force: FloatArray
    moments: FloatArray
    energy: float
    min_bend_radius: float
    min_bend_at: float
    max_twist: float
    max_twist_at: float
    end_error: float
    imbalance: float
    iterations: int
    turn: int
    status: str
    clip_forces: FloatArray = field(default_factory=lambda: np.zeros(0))
    clip_grip: FloatArray = field(default_factory=lambda: np.zeros(0))
    clip_at: FloatArray = field(default_factory=lambda: np.zeros(0))
    clip_moments: FloatArray = field(default_factory=lambda: np.zeros(0))
    places: FloatArray = field(default_factory=lambda: np.zeros(0))
    contact_forces: FloatArray = field(default_factory=lambda: np.zeros(0))
    contact_places: FloatArray = field(default_factory=lambda: np.zeros(0))
    obstacle_forces: FloatArray = field(default_factory=lambda: np.zeros(0))
    fed: float = 0.0
    laid: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class ShapePath:
    """Shapes along a path of poses.

    `shapes` has one shape per pose; `first_jump` is the first pose without a shape on the held
    branch (also if its arguments are refused), None if there is none.
    """

    shapes: tuple[CompiledShape, ...]
    first_jump: int | None


@dataclass(frozen=True)
class Slope:
    """Derivatives of a shape by the k numbers of its pose, which are the last index.

    In a plane: end x, y [m], start heading, end heading [rad]; k = 4. In space: start x, y, z [m],
    rotation of the start about the world's axes x, y, z [rad], and the same for the end; k = 12.
    Then for each clip: its arc length, its place [m] and, if any clip is clamped, its heading, or
    its rotation about the world's axes [rad]. Then tensions beyond ends that slide [N], or the free
    length [m]. In a plane with obstacles the start x, y [m] come last.

    Parameters
    ----------
    points : (n + 1, dimension, k)
    rotations : (n_nodes, increment, k)
        Of the nodes, in space about the world's axes.
    end_force : (dimension, k)
    moments : (2, increment, k)
    min_bend_radius, max_twist : (k,)
    clip_forces, clip_at, clip_moments, places : (..., k)
        Of those of CompiledShape.
    energy_by_at : (n_clips,) [N]
        Derivatives of the energy by the clips' arc lengths.
    energy_by_feed : (ends that slide,)
        By the tensions [m], or the free length [N].
    fed, start_force : (k,), (dimension, k)
        Of those, where an end slides.
    obstacle_forces : (obstacles, dimension, k)
    degenerate : int
        Number of contacts that begin or end at the smallest change of the pose: the derivatives
        are then one-sided.
    """

    points: FloatArray
    rotations: FloatArray
    end_force: FloatArray
    moments: FloatArray
    min_bend_radius: FloatArray
    max_twist: FloatArray
    clip_forces: FloatArray = field(default_factory=lambda: np.zeros(0))
    clip_at: FloatArray = field(default_factory=lambda: np.zeros(0))
    clip_moments: FloatArray = field(default_factory=lambda: np.zeros(0))
    places: FloatArray = field(default_factory=lambda: np.zeros(0))
    energy_by_at: FloatArray = field(default_factory=lambda: np.zeros(0))
    obstacle_forces: FloatArray = field(default_factory=lambda: np.zeros(0))
    degenerate: int = 0
    fed: FloatArray = field(default_factory=lambda: np.zeros(0))
    start_force: FloatArray = field(default_factory=lambda: np.zeros(0))
    energy_by_feed: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Gap:
    """Place of the cable that is nearest to obstacles.

    Parameters
    ----------
    distance : float [m]
        Between the surfaces; negative if the cable penetrates the obstacle.
    place : float
        Arc length over length.
    point, normal : (dimension,)
        Point on the cable's axis [m], and direction away from the obstacle.
    gradient : (k,)
        Of the distance, by the slope's columns; NaN without a slope.
    obstacle : int
        Index of the nearest obstacle.
    """

    distance: float
    place: float
    point: FloatArray
    normal: FloatArray
    gradient: FloatArray
    obstacle: int


# Quantities that limits apply to, in the order of dlo_quantity.
QUANTITIES = ("bend_radius", "force", "moment", "twist", "clearance")


@dataclass(frozen=True)
class Usage:
    """Use of a limit by a shape.

    Parameters
    ----------
    value : float
        Smallest bend radius [m], largest force [N] and moment [N m] on a fixture, largest twist
        [1/m], smallest distance from obstacles [m]; inf if nothing bends, or without obstacles.
    margin : float
        Remaining share of the limit, negative where it is violated: 1 - value / limit; for a bend
        radius 1 - limit / value; for a clearance value / limit - 1. 1 without a limit.
    at : float [m]
        Arc length of the tightest place.
    gradient : (k,)
        Of the value, by the slope's columns; NaN without a slope.
    which : int
        For forces and moments the fixture: 0 the start, 1 the end, 2 the first clip. For a
        clearance the obstacle.
    """

    value: float
    margin: float
    at: float
    gradient: FloatArray
    which: int


class Records(NamedTuple):
    """Layouts of dlo_shape, dlo_slope, dlo_obstacle, dlo_gap and dlo_usage of a solver's C.

    `columns`: k, the number of numbers of a pose by which dlo_slope has derivatives, see `Slope`.
    """

    shape: np.dtype[Any]
    slope: np.dtype[Any]
    obstacle: np.dtype[Any]
    gap: np.dtype[Any]
    usage: np.dtype[Any]
    columns: int


def records_of(model: CableModel, n_obstacles: int = 0) -> Records:
    """Layouts of the structures of a model's solver with room for `n_obstacles` obstacles."""
    node, n, nodes = model.node, model.n + 1, model.chain.n_nodes
    d, turn = node.dimension, node.increment
    clips, holds = len(model.clips), len(model.clips) + model.n_springs
    clamps, turns = model.clamped_between, turn * model.clamped_between
    starts = model.in_space or n_obstacles > 0
    k = 2 * turn + (2 * d if starts else d) + (1 + d + turns) * clips + sum(model.loose)
    laid, fed = n * bool(holds or model.slides), sum(model.loose)
    forces: dict[str, tuple[int, ...]] = {"start_force": (d,), "end_force": (d,)}
    forces |= {"clip_forces": (holds, d), "clip_grip": (holds,), "clip_at": (holds,)}
    forces |= {
        "places": (laid,),
        **({"fed": (), "laid": (2 + clips,)} if fed else {}),
        "clip_moments": (holds * clamps, turn),
        "contact_forces": (n_obstacles, 4 * model.n),
        "contact_places": (n_obstacles, 4 * model.n),
        "obstacle_forces": (n_obstacles, d),
        "moments": (2, turn),
    }
    scalars = ["energy", "min_bend_radius", "min_bend_at", "max_twist", "max_twist_at"]
    scalars += ["end_error", "imbalance"]
    slope: dict[str, tuple[int, ...]] = {"points": (n, d, k), "rotations": (nodes, turn, k)}
    slope |= {"end_force": (d, k), "clip_forces": (holds, d, k), "clip_at": (holds, k)}
    slope |= {"places": (laid, k), "fed": (k * bool(fed),)}
    slope |= {"start_force": (d * bool(fed), k), "energy_by_feed": (fed,)}
    slope |= {"clip_moments": (holds * clamps, turn, k)}
    slope |= {"energy_by_at": (clips,), "obstacle_forces": (n_obstacles, d, k)}
    slope |= {"moments": (2, turn, k)}
    slope |= {"min_bend_radius": (k,), "max_twist": (k,)}
    gap = {"distance": (), "place": (), "point": (d,), "normal": (d,), "gradient": (k,)}
    usage = {"value": (), "margin": (), "at": (), "gradient": (k,)}
    return Records(
        _record(
            _floats({"points": (n, d), "x": (nodes, node.coordinates)}),
            _floats(forces | dict.fromkeys(scalars, ())),
            [("iterations", np.intc), ("turn", np.intc)],
        ),
        _record(_floats(slope), [("degenerate", np.intc)] if n_obstacles else []),
        _record([("kind", np.intc)], _floats({"a": (d,), "b": (d,), "radius": ()})),
        _record(_floats(gap), [("obstacle", np.uintp)]),
        _record(_floats(usage), [("which", np.intc)]),
        k,
    )


def _floats(shapes: dict[str, tuple[int, ...]]) -> list[Any]:
    return [(name, float, shape) for name, shape in shapes.items() if 0 not in shape]


def _record(*fields: list[Any]) -> np.dtype[Any]:
    return np.dtype([field for part in fields for field in part], align=True)


def pose_table(
    model: CableModel, poses: Sequence[AnyPose] | FloatArray, branch: object = None
) -> tuple[FloatArray, int]:
    """Poses (m, k) in the layout of dlo_pose, and the C solver's number of their branch.

    `branch` ("ccw", "cw" or None) applies to rows of numbers; a Pose has its own. Raises DloError
    if they are not poses of this cable, or are of several branches or an unknown one.
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
    if not isinstance(poses, Sequence):
        raise DloError(
            f"a list of poses or an array belongs here, found {_told(poses)}\n  Try: [pose]"
        )
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
    if isinstance(pose, Pose):
        pose = pose.held
    if not isinstance(pose, HeldPose):
        raise DloError(
            f"a Pose belongs here, found {_told(pose)}\n  Try: dlo_casadi.Pose(start, end)"
        )
    said = f"{pose.name}: " if pose.name else ""
    if pose.end is None and model.end.place:
        raise DloError(f"{said}the end of the cable is {model.end}: where is it?\n  Try: end")
    d = model.node.dimension
    places = {"start": pose.start, "end": pose.end}
    places |= {f"the place of clip {k}": clip.place for k, clip in enumerate(pose.clips, 1)}
    for name, place in places.items():
        if place is not None and np.shape(place) != (d,):
            raise DloError(
                f"{said}{name} must have {counted(d, 'number')}, found {place!r}\n"
                "  Try: as many as the cable's gravity has"
            )
    own = AXES[d]
    directions = {
        f"{side}_{own.direction}": getattr(pose, f"{side}_{own.direction}")
        for side in ("start", "end")
        if getattr(model, side).direction
    }
    directions |= {
        f"the {own.direction} of clip {k}": getattr(clip, own.direction)
        for k, clip in enumerate(pose.clips, 1)
        if clip.kind.direction
    }
    for name, direction in directions.items():
        if direction is None:
            raise DloError(f"{said}its fixture holds the direction, give {name} {own.unit}")
    try:
        numbers = np.asarray([*pose.ends, pose.turns], float)
    except (TypeError, ValueError):
        raise DloError(f"numbers belong in a pose, found {pose!r}") from None
    if len(numbers) != EndConditions.size(model.node) + 1:
        raise DloError(f"{said}an orientation must have 4 numbers, found {pose!r}")
    kinds = tuple(clip.kind for clip in pose.clips)
    if kinds != model.clips:
        mine, others = (", ".join(x) or "none" for x in (kinds, model.clips))
        raise DloError(f"{said}the pose has the clips {mine}, the solver {others}")
    if fed := pose.wrongly_fed((model.start, model.end), by_length=model.fed_by_length):
        other = "tension" if model.fed_by_length else "free_length"
        raise DloError(f"{said}{fed}\n  Try: cable.fed_by({other!r}), if the pose tells that.")
    return pose.numbers


def _told(value: object) -> str:
    """What was found in the place of a pose; a shape has too many numbers to show."""
    return "a CompiledShape" if isinstance(value, CompiledShape) else repr(value)


def surfaces_of(model: CableModel, obstacles: Sequence[AnyObstacle]) -> list[Surface]:
    """Obstacles as of a session, in the form of the statics; others are that already.

    Raises DloError if one is impossible.
    """
    declared = [one for one in obstacles if isinstance(one, Obstacle)]
    if wrong := [x.message for x in obstacle_problems(declared, model.gravity, [])]:
        raise DloError("; ".join(wrong))
    return [
        one.surface(k) if isinstance(one, Obstacle) else one
        for k, one in enumerate(obstacles, start=1)
    ]
