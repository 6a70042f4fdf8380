"""The declared data of a cable, the parameters of its models, how it is held and measured."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite, pi
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from dlo_casadi.errors import DloError
from dlo_casadi.rod.supports import SupportKind

# Bounds of a bending stiffness [N m^2]: below that of a carbon fibre, above that of a steel bar.
STIFFNESS_BOUNDS = (1e-12, 1e9)
# Largest deviation of a declared value from the nominal one, in `scale`, if it is unbounded.
_FARTHEST = 1e6


@dataclass(frozen=True)
class CableData:
    """The declared data of a cable.

    Parameters
    ----------
    length : float [m]
        Along the cable between its fixtures.
    mass : float [kg]
        Of that length.
    diameter : float [m]
    bending_stiffness : float [N m^2]
        Crude prior of EI.
    name : str
    straight : bool
        True if no rest curvature is fitted.
    torsional_stiffness : float [N m^2], optional
        Crude prior of GJ. A cable that has one is in space; others stay in a plane.
    damping_time : float [s], optional
        First guess of tau: M = EI (kappa - kappa_0 + tau dkappa/dt), the same for the twist. A
        cable that has one has it as a parameter; it has no effect at rest.
    """

    length: float
    mass: float
    diameter: float
    bending_stiffness: float
    name: str = "cable"
    straight: bool = False
    torsional_stiffness: float | None = None
    damping_time: float | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the components of a position or a force."""
        return ("x", "y") if self.torsional_stiffness is None else ("x", "y", "z")

    @property
    def curvature_scale(self) -> float:
        """One full turn over the length [1/m]."""
        return 2 * pi / self.length


@dataclass(frozen=True)
class Parameter:
    """One scalar parameter of a model.

    Parameters
    ----------
    name : str
        Name within its effect; the model prefixes it with the effect's label.
    unit : str
        SI unit, "" for a pure number.
    nominal : float
        Value at which the effect vanishes, or the prior mean [unit].
    scale : float
        Typical size of a change [unit], > 0; solvers work in value / scale.
    lower, upper : float
        Bounds of the estimation [unit].
    prior_std : float
        Standard deviation of a Gaussian prior about `nominal`; inf = flat [unit, or
        natural logarithm if `log`].
    log : bool
        Estimated as its natural logarithm (positive, uncertain by decades).
    possible : (float, float), optional
        Bounds of a declared value that is not estimated [unit]: what physics allows, if that is
        more than `lower` and `upper`.
    """

    name: str
    unit: str = ""
    nominal: float = 0.0
    scale: float = 1.0
    lower: float = -inf
    upper: float = inf
    prior_std: float = inf
    log: bool = False
    possible: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not (isfinite(self.scale) and self.scale > 0):
            raise DloError(f"parameter {self.name}: scale {self.scale} must be positive")
        if not self.lower <= self.nominal <= self.upper:
            raise DloError(
                f"parameter {self.name}: nominal {self.nominal} {self.unit} lies outside its "
                f"bounds [{self.lower}, {self.upper}]"
            )
        if self.log and self.nominal <= 0:
            raise DloError(f"parameter {self.name}: a logarithmic parameter must be positive")

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest value of an estimation; finite even if a bound is not."""
        return self._finite(self.lower, self.upper)

    def bounds(self, *, estimated: bool) -> tuple[float, float]:
        """Bounds of a value that is estimated, or of a declared one that is kept."""
        return (self.lower, self.upper) if estimated else self.possible or (self.lower, self.upper)

    @property
    def known_range(self) -> tuple[float, float]:
        """Lowest and highest value that may be declared and kept; finite, too."""
        return self._finite(*self.bounds(estimated=False))

    def _finite(self, lower: float, upper: float) -> tuple[float, float]:
        away = _FARTHEST * self.scale
        return max(lower, self.nominal - away), min(upper, self.nominal + away)

    @classmethod
    def symmetric(
        cls,
        names: Iterable[str],
        unit: str,
        scale: float,
        bound: float = inf,
        possible: float | None = None,
    ) -> tuple[Self, ...]:
        """Parameters of equal scale that vanish at 0 and lie between -bound and bound.

        Without an estimation they lie between -possible and possible.
        """
        known = None if possible is None else (-possible, possible)
        return tuple(
            cls(name, unit, scale=scale, lower=-bound, upper=bound, possible=known)
            for name in names
        )


def height_of(places: ArrayLike, gravity: ArrayLike) -> Any:
    """Heights (...) [m] of places (..., d) above the origin along the vertical; 0 without one."""
    size = float(np.linalg.norm(gravity))
    return -np.array(places) @ np.array(gravity) / size if size else 0.0 * np.array(places)[..., 0]


@dataclass(frozen=True)
class Setup:
    """How a cable is held and measured.

    Parameters
    ----------
    cable : CableData
    start, end : SupportKind
        How the ends are held; also by its word.
    gravity : (dimension,) [m/s^2]
    curved : bool
        Whether a rest curvature is fitted.
    n_poses : int
        Number of fitted poses. A change of the rest curvature, or of a force with the shape, is
        visible only in two or more poses.
    center : (float, float), optional [m]
        Middle of the photographs in the board frame; absent without photographs.
    pixel : float, optional [m]
        Size of a pixel on the board; absent without photographs.
    camera : bool
        Whether the place of the camera is known.
    readings : tuple of str
        Names of the measured forces and moments on the fixtures, see `ends.reaction_rows`.
    tolerances : mapping
        Standard deviations of declared values, by the names of `tolerances` in a configuration.
    directions : (float, float) [rad]
        Mean headings at start and end.
    largest_bend : float, optional [1/m]
        Largest |curvature - rest curvature| of all poses.
    clips : tuple of SupportKind
        Kinds of the clips between the ends.
    obstacles : int
        Number of obstacles that the cable may touch.
    level : float [m]
        Height of the first pose's start fixture, along the vertical from the origin.
    resting : float, optional [m]
        Lowest height that several shapes have in common; absent if there is none.
    moves : bool
        Whether there are recordings of the moving cable.
    """

    cable: CableData
    start: SupportKind = SupportKind.PINNED
    end: SupportKind = SupportKind.PINNED
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
    clips: tuple[SupportKind, ...] = ()
    obstacles: int = 0
    level: float = 0.0
    resting: float | None = None
    moves: bool = False

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            object.__setattr__(self, name, SupportKind(getattr(self, name)))
        object.__setattr__(self, "clips", tuple(map(SupportKind, self.clips)))
