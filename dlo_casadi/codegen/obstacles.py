"""Obstacles beside the cable, and how near it comes to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
Place = tuple[float, ...]


@dataclass(frozen=True)
class Capsule:
    """All within `radius` [m] of the segment from `a` to `b` [m]; a sphere where they agree."""

    a: Place
    b: Place
    radius: float

    @property
    def ends(self) -> tuple[Place, Place]:
        """As the C solver takes it."""
        return self.a, self.b


@dataclass(frozen=True)
class HalfSpace:
    """All behind the plane through `point` [m] across `normal`, which points out of it."""

    point: Place
    normal: Place

    @property
    def radius(self) -> float:
        """None."""
        return 0.0

    @property
    def ends(self) -> tuple[Place, Place]:
        """As the C solver takes it."""
        return self.point, self.normal


Obstacle = Capsule | HalfSpace


@dataclass(frozen=True)
class Gap:
    """Where the cable comes nearest to obstacles.

    Parameters
    ----------
    distance : float [m]
        Between the surfaces; negative where the cable cuts in.
    place : float
        Arc length over length.
    point, normal : (dimension,)
        Of the cable's axis there [m], and away from the obstacle.
    gradient : (4,) or (12,)
        Of the distance by the columns of the slope; zeros without one.
    obstacle : int
        Which one.
    """

    distance: float
    place: float
    point: FloatArray
    normal: FloatArray
    gradient: FloatArray
    obstacle: int
