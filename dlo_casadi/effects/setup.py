"""Setup: how a cable is held and measured, the argument of an effect's methods."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.effects.cable import CableData


def height_of(places: ArrayLike, gravity: ArrayLike) -> Any:
    """Heights (...) [m] of places (..., d) along the vertical from the origin; 0 without one."""
    size = float(np.linalg.norm(gravity))
    return -np.array(places) @ np.array(gravity) / size if size else 0.0 * np.array(places)[..., 0]


@dataclass(frozen=True)
class Setup:
    """How a cable is held and measured.

    Parameters
    ----------
    cable : CableData
    start : "pinned" or "clamped"
    end : "pinned", "clamped" or "free"
    gravity : (dimension,) [m/s^2]
    curved : bool
        Whether a rest curvature is fitted.
    n_poses : int
        Number of fitted poses. A change of the rest curvature, or of a force with the shape, is
        visible only with two or more.
    center : (float, float), optional [m]
        Middle of the photographs in the board frame; absent without photographs.
    pixel : float, optional [m]
        Size of a pixel on the board; absent without photographs.
    camera : bool
        Whether the place of the camera is known.
    readings : tuple of str
        Which forces and moments on the fixtures were measured, of `ends.reaction_rows`.
    tolerances : mapping
        Standard deviations of declared values, by the names of `tolerances` in a configuration.
    directions : (float, float) [rad]
        Mean headings at start and end.
    largest_bend : float, optional [1/m]
        Largest |curvature - rest curvature| of all poses.
    clips : tuple of str
        Kinds of the clips between the ends.
    obstacles : int
        Number of obstacles that the cable may touch.
    level : float [m]
        Height of the first pose's start fixture, along the vertical from the origin.
    resting : float, optional [m]
        Lowest height that several shapes have in common; absent where none do.
    """

    cable: CableData
    start: str = "pinned"
    end: str = "pinned"
    gravity: tuple[float, ...] = (0.0, -9.81)
    curved: bool = True
    n_poses: int = 1
    center: tuple[float, float] | None = None
    pixel: float | None = None
    camera: bool = False
    readings: tuple[str, ...] = ()
    tolerances: Mapping[str, float] = field(default_factory=dict)
    directions: tuple[float, float] = (0.0, 0.0)
    largest_bend: float | None = None
    clips: tuple[str, ...] = ()
    obstacles: int = 0
    level: float = 0.0
    resting: float | None = None
