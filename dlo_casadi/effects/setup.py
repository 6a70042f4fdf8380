"""What effects are told: how a cable is held and measured, and what a fit has found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.effects.effect import Cable, Effect, Params
from dlo_casadi.thresholds import NEAR_END


@dataclass(frozen=True)
class Setup:
    """How a cable is held and measured.

    Parameters
    ----------
    cable : Cable
    start : "pinned" or "clamped"
    end : "pinned", "clamped" or "free"
    gravity : (dimension,) [m/s^2]
    curved : bool
        Whether a rest curvature is fitted.
    n_poses : int
        That are fitted. What a pose leaves behind, and how a force changes with the shape, takes
        two to be seen.
    center : (float, float), optional [m]
        Middle of the photographs in the board frame; absent without photographs.
    pixel : float, optional [m]
        Size of a pixel on the board; absent without photographs.
    camera : bool
        Whether it is known from where the photographs were taken.
    readings : tuple of str
        Which forces and moments on the fixtures were measured, of `ends.REACTIONS`.
    tolerances : mapping
        How well declared values are known, one standard deviation, by the names of `tolerances`
        in a configuration.
    directions : (float, float) [rad]
        Mean headings at start and end.
    largest_bend : float, optional [1/m]
        Of all poses, curvature minus rest curvature.
    """

    cable: Cable
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

    @property
    def in_space(self) -> bool:
        """Whether the cable may leave the plane."""
        return len(self.gravity) == 3


@dataclass(frozen=True)
class Fitted:
    """An effect as a fit has found it, by its own parameters' names.

    `values` and `stds` hold each parameter's value and standard deviation.
    """

    effect: Effect
    setup: Setup
    values: Mapping[str, float]
    stds: Mapping[str, float]

    @property
    def near_start(self) -> bool:
        """Whether it acts so near to the start that it may be the fixture's."""
        place = self.effect.place(self.values)
        return place is not None and place < NEAR_END * self.setup.cable.length

    @property
    def near_end(self) -> bool:
        """Whether it acts so near to the end that it may be the fixture's."""
        place = self.effect.place(self.values)
        return place is not None and place > (1 - NEAR_END) * self.setup.cable.length

    def propagated(
        self, of: Callable[[Params], ca.SX]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Value (k,) of an expression of the parameters, and what each std moves it by (k, n)."""
        names = list(self.values)
        own = ca.SX.sym("own", len(names))
        result = of(dict(zip(names, ca.vertsplit(own), strict=True)))
        both = ca.Function("of", [own], [result, ca.jacobian(result, own)])
        value, slopes = both([self.values[name] for name in names])
        return np.array(value)[:, 0], np.array(slopes) * [self.stds[name] for name in names]
