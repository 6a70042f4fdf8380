"""Supports between the ends: clips that hold the cable, and obstacles; with checks of both."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Literal, TypeAlias

from dlo_casadi.config.frozen import ConfigSection, Given, Numbers, Turned, entry
from dlo_casadi.config.problems import ConfigProblem, did_you_mean
from dlo_casadi.config.values import (
    AXES,
    Force,
    Heading,
    Name,
    NonNegative,
    Place,
    Positive,
    Quaternion,
    one_of,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.clips import HeldClip
from dlo_casadi.rod.obstacles import Capsule, Plane, bars_of
from dlo_casadi.rod.obstacles import Obstacle as Surface
from dlo_casadi.rod.quantities import FORCE
from dlo_casadi.rod.supports import CLIPS, ENDS, STARTS, SupportKind

# What type checkers accept as the kind of a start, an end, a clip.
_Start: TypeAlias = SupportKind | Literal["pinned", "clamped", "swivel", "slide"]
_End: TypeAlias = SupportKind | Literal["pinned", "clamped", "swivel", "slide", "free"]
_Clip: TypeAlias = SupportKind | Literal["pinned", "clamped", "swivel", "eyelet"]


class Boundary(ConfigSection):
    """How the two ends are held."""

    start: Given[Annotated[SupportKind, one_of(STARTS)], _Start] = entry()
    """Start of the cable: pinned (free to turn), clamped (its direction is held, in space its roll,
    too), swivel (its direction is held, it may roll about its axis) or slide: it is fed through a
    guide that holds its direction; `start_tension` of the pose determines its free length, which
    is estimated where no pose has one."""
    end: Given[Annotated[SupportKind, one_of(ENDS)], _End] = entry()
    """End of the cable: pinned, clamped, swivel, free, or slide as the start, with `end_tension` of
    the pose."""

    @property
    def fed(self) -> tuple[bool, bool]:
        """Whether the cable is fed through its start, and through its end."""
        return self.start.slides, self.end.slides

    @property
    def directed(self) -> bool:
        """Whether an end holds the direction of the cable."""
        return self.start.direction or self.end.direction


def undetermined(start: SupportKind, end: SupportKind, in_space: bool) -> Iterator[ConfigProblem]:
    """Why ends held in this way leave the cable's position undetermined."""
    if start.slides and not end.place:
        text = (
            "through a start that slides a cable with a free end runs out of it, or falls through "
            "it. Try: the end that is held as the start, or end: pinned, swivel or clamped"
        )
        yield ConfigProblem(("experiment", "boundary"), text)
    if in_space and not (start.direction or end.place):
        text = (
            "on a ball joint and with a free end a cable in space can turn freely about the "
            "direction of gravity, so its position is undetermined. Try: start: clamped, with "
            "start_orientation; or two numbers of gravity, in the plane in which it hangs"
        )
        yield ConfigProblem(("experiment", "boundary"), text)


def unused_directions(start: SupportKind, end: SupportKind) -> list[str]:
    """Keys of a pose that ends held in this way do not use: directions of pinned ends."""
    pinned = [side for side, how in (("start", start), ("end", end)) if how.turns]
    return [f"{side}_{axes.direction}" for side in pinned for axes in AXES.values()]


class Clip(ConfigSection):
    """A clip that holds the cable between its ends."""

    name: Name = ""
    """What to call the clip; clip_1, clip_2, ... when absent."""
    kind: Given[Annotated[SupportKind, one_of(CLIPS)], _Clip] = entry()
    """pinned (holds the cable at `at`, it may turn), clamped (a saddle: holds its direction and
    roll, too), swivel (in space: a saddle in which the cable may roll about its axis) or eyelet
    (the cable slides through without friction)."""
    at: NonNegative | None = None
    """Arc length from the start at which it holds the cable [m]; an eyelet has none."""
    place: Given[Place, Numbers] = entry()
    """Where the cable is held [m]: [x, y], in space [x, y, z]."""
    heading: Heading | None = None
    """Direction of the cable in a clamped clip in a plane, continuous along the cable [rad]."""
    orientation: Given[Quaternion | None, Turned | None] = entry(default=None)
    """Frame of a clamped clip in space, a quaternion [qx, qy, qz, qw]; x forward along the
    cable."""
    roll: Literal["held", "free"] = "held"
    """In space: whether a clamped clip holds the roll of the cable about its axis; with roll: free
    it is a swivel."""
    clip_force: Given[Force | None, Numbers | None] = entry(default=None)
    """Force [N] that the cable exerts on the clip, where it was measured, as start_force."""

    def held(self, number: int) -> HeldClip:
        """The clip in the form that the statics use; `number` names it if it has no name."""
        return HeldClip(
            kind=self.kind if self.roll == "held" else self.kind.without_roll(),
            place=self.place,
            at=self.at,
            heading=self.heading,
            orientation=self.orientation,
            name=self.name or f"clip_{number}",
        )


def clip_problems(clips: Sequence[Clip], length: float, axes: int) -> Iterator[tuple[str, int]]:
    """Problems with the clips of a pose on a cable of that length [m], each with the clip's index.

    `axes`: 2 in a plane, 3 in space.
    """
    last, own, other = 0.0, AXES[axes], AXES[5 - axes]
    names = [clip.held(k).name for k, clip in enumerate(clips, start=1)]
    for k, (clip, called) in enumerate(zip(clips, names, strict=True)):
        clamped = clip.kind.direction
        if names.index(called) < k:
            yield f"two clips are called {called}", k
        if len(clip.place) != axes:
            yield f"{called}: place: {own.place} belongs here", k
        if clamped and getattr(clip, own.direction) is None:
            yield f"{called}: a {clip.kind} clip needs its {own.direction} {own.unit}", k
        if getattr(clip, other.direction) is not None:
            yield f"{called}: {other.direction} is of a cable in {other.where}", k
        if not clamped and getattr(clip, own.direction) is not None:
            yield f"{called}: {own.direction} is of a clamped clip, it is {clip.kind}", k
        if clip.clip_force is not None and len(clip.clip_force) != axes:
            yield f"{called}: clip_force: {FORCE.written('xyz'[:axes])} belongs here", k
        if clip.roll != "held" and not (clamped and own is AXES[3]):
            yield f"{called}: roll: free is of a clamped clip in space", k
        elif clamped and not clip.kind.roll and own is not AXES[3]:
            text = "is of a cable in space; in a plane nothing rolls. Try: kind: clamped"
            yield f"{called}: {clip.kind} {text}", k
        if (clip.at is None) != clip.kind.slides:
            how = "no at: the cable slides through" if clip.at is not None else "at [m]"
            yield f"{called}: {clip.kind} clips have {how}", k
        elif clip.at is not None and not 0.0 < clip.at < length:
            yield f"{called}: at {clip.at:g} m is not between 0 and cable.length {length:g} m", k
        elif clip.at is not None and clip.at <= last:
            text = f"at {clip.at:g} m follows {last:g} m: clips stand in the order along the cable"
            yield f"{called}: {text}", k
        last = clip.at if clip.at is not None else last


def too_short(pose: HeldPose, held: Boundary, length: float, slack: float) -> str:
    """Why a pose is impossible: a span exceeds its cable by more than a slack [m]; empty if not."""
    names = ["the start", *(clip.name for clip in pose.clips)]
    places = [pose.start, *(clip.place for clip in pose.clips)]
    # A free end is at the last clip at best.
    names.append(names[-1] if pose.end is None else "the end")
    places.append(places[-1] if pose.end is None else pose.end)
    first, last = (
        None if kind.slides else s for kind, s in ((held.start, 0.0), (held.end, length))
    )
    at = [first, *(clip.at for clip in pose.clips), last]
    low, straight = 0, 0.0
    for k in range(1, len(places)):
        straight += math.dist(places[k - 1], places[k])
        s, start = at[k], at[low]
        if s is None:
            continue
        if start is not None and straight > s - start + slack:
            return (
                f"{names[low]} and {names[k]} are {straight:.4g} m apart"
                f"{' by way of the eyelets' if k > low + 1 else ''}, with {s - start:.4g} m of "
                "cable between them. Places and arc lengths in metres?"
            )
        low, straight = k, 0.0
    return ""


def clips_differ(poses: Sequence[HeldPose]) -> str:
    """Why poses cannot share a session: kinds or numbers of clips differ; empty if they agree."""
    kinds = [[clip.kind for clip in pose.clips] for pose in poses]
    for i, own in enumerate(kinds):
        if own != kinds[0]:
            first, other = (", ".join(x) or "none" for x in (kinds[0], own))
            return (
                f"pose {i + 1} has the clips {other}, pose 1 {first}: the poses of a session have "
                "clips of the same kinds in the same order. Try: a session of its own"
            )
    return ""


# Kind of an obstacle -> its keys.
_KEYS = {
    "plane": ("point", "normal"),
    "sphere": ("center", "radius"),
    "capsule": ("a", "b", "radius"),
}


class Obstacle(ConfigSection):
    """A rigid obstacle without friction; the cable's own radius counts."""

    name: Name = ""
    """What to call the obstacle; obstacle_1, obstacle_2, ... when absent."""
    kind: Literal["plane", "sphere", "capsule"]
    """plane (point, normal), sphere (center, radius) or capsule (a, b, radius: a rod with round
    ends); in a plane a sphere is a disc, a capsule a stadium."""
    point: Given[Place | None, Numbers | None] = entry(default=None)
    """A point of a plane [m]."""
    normal: Given[Place | None, Numbers | None] = entry(default=None)
    """Normal of a plane, of any length; the cable is on its side."""
    center: Given[Place | None, Numbers | None] = entry(default=None)
    """Centre of a sphere [m]."""
    a: Given[Place | None, Numbers | None] = entry(default=None)
    """Start of a capsule's axis [m]."""
    b: Given[Place | None, Numbers | None] = entry(default=None)
    """End of a capsule's axis [m]."""
    radius: Positive | None = None
    """Radius of a sphere or capsule [m]."""
    touch: Literal["allowed", "avoided"] = "avoided"
    """Whether the cable is meant to touch it: limits.clearance then leaves it out. Shapes are the
    same either way."""

    def surface(self, number: int) -> Surface:
        """The obstacle in the form that the statics use; `number` names it if it has no name."""
        name = self.name or f"obstacle_{number}"
        if self.kind == "plane":
            normal, point = self.normal or (), self.point or ()
            size = math.hypot(*normal)
            return Plane(point, tuple(x / size for x in normal), name, self.touch == "allowed")
        a, b = (self.center, self.center) if self.kind == "sphere" else (self.a, self.b)
        return Capsule(a or (), b or (), self.radius or 0.0, name, self.touch == "allowed")


# Side of bars in a pose: over all (true) or under all (false), or by the names of some bars.
Sides = bool | Mapping[str, bool] | None


def obstacle_problems(
    obstacles: Sequence[Obstacle], gravity: Sequence[float], sides: Sequence[Sides]
) -> Iterator[ConfigProblem]:
    """Problems with obstacles, and with the sides of bars that poses declare."""
    names = [item.name or f"obstacle_{k}" for k, item in enumerate(obstacles, start=1)]
    usable = True
    for k, (item, name) in enumerate(zip(obstacles, names, strict=True)):
        wrong = [f"{name}: {text}" for text in _wrong(item, len(gravity))]
        wrong += [f"two obstacles are called {name}"] if names.index(name) < k else []
        usable = usable and not wrong
        yield from (ConfigProblem(("experiment", "obstacles", k), text) for text in wrong)
    if not usable:
        return
    surfaces = [item.surface(k) for k, item in enumerate(obstacles, start=1)]
    bars = [bar.name for bar, _ in bars_of(surfaces, gravity)]
    for k, over in enumerate(sides):
        called = f"pose {k + 1}: over" if len(sides) > 1 else "over"
        for text in _no_sides(over, names, bars, len(gravity)):
            yield ConfigProblem(("experiment", "poses", k, "over"), f"{called}: {text}")


def _no_sides(over: Sides, names: list[str], bars: list[str], axes: int) -> Iterator[str]:
    what = "a disc or a stadium" if axes == 2 else "a capsule whose axis is not upright"
    have = f"those here are {', '.join(bars)}" if bars else "there is none here, or no gravity"
    belongs = f"with gravity a cable passes over or under {what}; {have}"
    if not isinstance(over, Mapping):
        if over is not None and not bars:
            yield belongs
        return
    for name in over:
        if name not in names:
            yield f"no obstacle is called {name!r}{did_you_mean(name, names)}"
        elif name not in bars:
            yield f"{name}: {belongs}"


def _wrong(item: Obstacle, axes: int) -> Iterator[str]:
    wanted = _KEYS[item.kind]
    known = {key: getattr(item, key) for keys in _KEYS.values() for key in keys}
    if missing := [key for key in wanted if known[key] is None]:
        yield f"a {item.kind} needs {' and '.join(missing)}"
    for key, value in known.items():
        if value is not None and key not in wanted:
            yield f"a {item.kind} has no {key}, it has {', '.join(wanted)}"
        elif value is not None and key != "radius" and len(value) != axes:
            yield f"{key}: {AXES[axes].place} belongs here, found {list(value)}"
    if item.normal is not None and not any(item.normal):
        yield "the normal of a plane is not zero"
