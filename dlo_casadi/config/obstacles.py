"""Obstacles that the cable may touch, and what may be wrong with them."""

import math
from collections.abc import Iterator, Sequence
from typing import Literal

from dlo_casadi.config.problems import ConfigProblem
from dlo_casadi.config.values import ConfigSection, Name, Place, Positive
from dlo_casadi.rod.obstacles import Capsule, Plane
from dlo_casadi.rod.obstacles import Obstacle as Surface

# Kind -> its keys.
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
    point: Place | None = None
    """A point of a plane [m]."""
    normal: Place | None = None
    """Normal of a plane, of any length; the cable is on its side."""
    center: Place | None = None
    """Centre of a sphere [m]."""
    a: Place | None = None
    """Start of a capsule's axis [m]."""
    b: Place | None = None
    """End of a capsule's axis [m]."""
    radius: Positive | None = None
    """Radius of a sphere or capsule [m]."""

    def surface(self, number: int) -> Surface:
        """The same for the statics; `number` names it where it has no name."""
        name = self.name or f"obstacle_{number}"
        if self.kind == "plane":
            normal, point = self.normal or (), self.point or ()
            size = math.hypot(*normal)
            return Plane(point, tuple(x / size for x in normal), name)
        a, b = (self.center, self.center) if self.kind == "sphere" else (self.a, self.b)
        return Capsule(a or (), b or (), self.radius or 0.0, name)


def obstacle_problems(obstacles: Sequence[Obstacle], axes: int) -> Iterator[ConfigProblem]:
    """What is wrong with obstacles. `axes`: 2 in a plane, 3 in space."""
    names = [item.name or f"obstacle_{k}" for k, item in enumerate(obstacles, start=1)]
    for k, (item, name) in enumerate(zip(obstacles, names, strict=True)):
        for text in _wrong(item, axes):
            yield ConfigProblem(("experiment", "obstacles", k), f"{name}: {text}")
        if names.index(name) < k:
            text = f"two obstacles are called {name}"
            yield ConfigProblem(("experiment", "obstacles", k), text)


def _wrong(item: Obstacle, axes: int) -> Iterator[str]:
    wanted = _KEYS[item.kind]
    known = {key: getattr(item, key) for keys in _KEYS.values() for key in keys}
    if missing := [key for key in wanted if known[key] is None]:
        yield f"a {item.kind} needs {' and '.join(missing)}"
    for key, value in known.items():
        if value is not None and key not in wanted:
            yield f"a {item.kind} has no {key}, it has {', '.join(wanted)}"
        elif value is not None and key != "radius" and len(value) != axes:
            place = "[x, y, z]" if axes == 3 else "[x, y]"
            yield f"{key}: {place} belongs here, found {list(value)}"
    if item.normal is not None and not any(item.normal):
        yield "the normal of a plane is not zero"
