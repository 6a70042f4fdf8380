"""Rigid obstacles without friction: planes, and capsules, of which spheres are a special case.

At a place X these give the distance g(X) from the surface, its gradient n (a unit normal, away from
the obstacle) and its Hessian. The Hessian is zero for a plane. For a capsule it is (I - n n^T) /
distance from the axis, without the axis's direction unless the nearest point is an end of the axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray

# Smallest distance [m] from an axis at which a normal is defined.
_ON_AXIS = 1e-12
# Smallest share of gravity across the axis of a bar that a cable can pass over or under.
_ACROSS = 0.1


class Surface(NamedTuple):
    """A surface near places.

    `distance` (...) [m], positive outside; `normal` (..., d); `bends` (..., d, d - 1): vectors
    whose outer products add up to the Hessian of the distance [1/m].
    """

    distance: FloatArray
    normal: FloatArray
    bends: FloatArray


@dataclass(frozen=True)
class Plane:
    """A plane through `point` (d,) [m]; the cable is on the side of its unit `normal` (d,).

    `touch`: whether the cable is meant to touch it; a limit on clearance then ignores it.
    """

    point: tuple[float, ...]
    normal: tuple[float, ...]
    name: str = "plane"
    touch: bool = False

    def grown(self, offset: float) -> "Plane":
        """The same plane with its surface moved outwards by an offset [m]."""
        point = np.array(self.point) + offset * np.array(self.normal)
        return replace(self, point=tuple(point.tolist()))

    def near(self, places: FloatArray) -> Surface:
        """The surface near places (..., d) [m]."""
        n = np.array(self.normal)
        distance = (places - np.array(self.point)) @ n
        bends = np.zeros((*places.shape, len(n) - 1))
        return Surface(distance, np.broadcast_to(n, places.shape), bends)

    def symbolic(self, places: Any) -> Any:
        """Distances (1, n) [m] of CasADi's places (d, n)."""
        return ca.DM(self.normal).T @ (places - ca.DM(self.point))

    @property
    def drawn(self) -> dict[str, Any]:
        """As plain data."""
        own = {"point": list(self.point), "normal": list(self.normal)}
        return {"name": self.name, "kind": "plane", **own}


@dataclass(frozen=True)
class Capsule:
    """All places within `radius` [m] of the line from `a` to `b` (d,) [m]; a sphere where a = b.

    In a plane it is a disc or a stadium. `touch` as for a plane.
    """

    a: tuple[float, ...]
    b: tuple[float, ...]
    radius: float
    name: str = "capsule"
    touch: bool = False

    def grown(self, offset: float) -> "Capsule":
        """The same capsule with its surface moved outwards by an offset [m]."""
        return replace(self, radius=self.radius + offset)

    def near(self, places: FloatArray) -> Surface:
        """The surface near places (..., d) [m]."""
        a, axis = np.array(self.a), np.subtract(self.b, self.a)
        square = float(axis @ axis)
        share = (places - a) @ axis / square if square else np.zeros(places.shape[:-1])
        beside = (share > 0) & (share < 1)
        gap = places - a - np.clip(share, 0.0, 1.0)[..., None] * axis
        size = np.linalg.norm(gap, axis=-1, keepdims=True)
        above = np.eye(len(a))[-1]
        normal = np.where(size > _ON_AXIS, gap / np.maximum(size, _ON_AXIS), above)
        bends = _across(normal, axis if square else above)
        bends = bends / np.sqrt(np.maximum(size, _ON_AXIS))[..., None]
        bends[..., -1] *= ~beside[..., None]
        return Surface(size[..., 0] - self.radius, normal, bends)

    def symbolic(self, places: Any) -> Any:
        """Distances (1, n) [m] of CasADi's places (d, n)."""
        axis = ca.DM(self.b) - ca.DM(self.a)
        gap = places - ca.DM(self.a)
        share = axis.T @ gap / max(float(ca.sumsqr(axis)), _ON_AXIS)
        gap = gap - axis @ ca.fmax(ca.fmin(share, 1.0), 0.0)
        return ca.sqrt(ca.sum1(gap**2)) - self.radius

    def up(self, gravity: Sequence[float]) -> FloatArray | None:
        """Unit vector (d,) against gravity; in space its part across the axis.

        None if nothing passes over or under it: without gravity; in space also for a sphere or for
        an axis along gravity.
        """
        up, axis = -np.array(gravity, dtype=float), np.subtract(self.b, self.a)
        least = _ACROSS * float(np.linalg.norm(up))
        if len(up) == 3:
            square = float(axis @ axis)
            up = up - up @ axis / square * axis if square else np.zeros(3)
        size = float(np.linalg.norm(up))
        return up / size if size > least else None

    def passed(self, up: FloatArray, points: FloatArray) -> tuple[BoolArray, BoolArray]:
        """Whether lines (m, n, d) [m] pass over it, and whether under it.

        A line passes over it if it crosses the upper half-plane (in a plane: half-line), which
        stands on the axis, an odd number of times, and the lower one an even number of times.
        """
        axis, middle = np.subtract(self.b, self.a), np.add(self.a, self.b) / 2
        across = np.array([up[1], -up[0]]) if len(up) == 2 else np.cross(axis, up)
        places = points - middle
        beside = places @ across
        crossing = (beside[:, 1:] > 0) != (beside[:, :-1] > 0)
        share = beside[:, :-1] / np.where(crossing, beside[:, :-1] - beside[:, 1:], 1.0)
        there = places[:, :-1] + share[..., None] * np.diff(places, axis=1)
        if len(up) == 3:
            crossing &= np.abs(there @ axis) <= axis @ axis / 2
        above = there @ up > 0
        odd = [np.sum(crossing & side, axis=1) % 2 == 1 for side in (above, ~above)]
        return odd[0] & ~odd[1], odd[1] & ~odd[0]

    @property
    def drawn(self) -> dict[str, Any]:
        """As plain data."""
        own = {"a": list(self.a), "b": list(self.b), "radius": self.radius}
        return {"name": self.name, "kind": "capsule", **own}


Obstacle = Plane | Capsule


def _across(normal: FloatArray, axis: FloatArray) -> FloatArray:
    """Unit vectors (..., d, d - 1) across normals (..., d); the last is the nearest to an axis."""
    if len(axis) == 2:
        return np.stack([-normal[..., 1], normal[..., 0]], axis=-1)[..., None]
    along = axis - (normal @ axis)[..., None] * normal
    size = np.linalg.norm(along, axis=-1, keepdims=True)
    other = np.eye(3)[np.abs(normal).argmin(axis=-1)]
    other = other - (normal * other).sum(axis=-1, keepdims=True) * normal
    along = np.where(size > 1e-6 * np.linalg.norm(axis), along, other)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([np.cross(normal, along), along], axis=-1)


def bars_of(
    obstacles: Sequence[Obstacle], gravity: Sequence[float]
) -> list[tuple[Capsule, FloatArray]]:
    """Obstacles over or under which a cable passes, each with `Capsule.up`."""
    capsules = [(one, one.up(gravity)) for one in obstacles if isinstance(one, Capsule)]
    return [(bar, up) for bar, up in capsules if up is not None]


def surfaces_near(obstacles: Sequence[Obstacle], places: FloatArray) -> Surface:
    """Surfaces near places (m, n, d) [m]: one obstacle after the other (m, n k)."""
    each = [obstacle.near(places) for obstacle in obstacles]
    return Surface(*(np.concatenate(part, axis=1) for part in zip(*each, strict=True)))
