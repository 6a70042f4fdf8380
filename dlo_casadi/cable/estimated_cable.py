"""A fitted cable without its shapes: values, their uncertainty, and its curve in a pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.cable.estimate import Covariance, Estimate, Metadata, Named
from dlo_casadi.cable.limits import Asked
from dlo_casadi.cable.placing import Aim, Placing, placed
from dlo_casadi.config.values import MESH
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.symbolic import CasadiCable
from dlo_casadi.errors import DloError, counted
from dlo_casadi.rod.chain import ELEMENTS, ELEMENTS_IN_SPACE
from dlo_casadi.rod.node import Frame


@dataclass(frozen=True, eq=False)
class EstimatedCable(CasadiCable):
    """The model of a cable with its fitted values and their uncertainty.

    Parameters
    ----------
    metadata : Metadata
    """

    metadata: Metadata

    def __repr__(self) -> str:
        mesh = counted(self.model.n, f"{self.model.element} element")
        fitted = bool(self.covariance.names)
        hidden = tuple(f"{effect.label}." for effect in self.model.effects if not effect.shown)
        rows = (
            f"  {name}: {x}"
            for name, x in self.params.items()
            if not ((x.fixed and fitted) or name.startswith(hidden))
        )
        return "\n".join([f"<FittedCable {self.name!r}: {self.length:g} m, {mesh}>", *rows])

    @property
    def name(self) -> str:
        """Name of the cable."""
        return self.model.cable.name

    @property
    def params(self) -> dict[str, Estimate]:
        """All parameters of the model by name, with their estimates."""
        return Named(self.metadata.params)

    @property
    def covariance(self) -> Covariance:
        """Covariance of all fitted parameters by their names."""
        return self.metadata.covariance

    @property
    def length(self) -> float:
        """Length [m] as declared."""
        return self.model.cable.length

    def with_mesh(self, n: int | None = None, element: str | None = None) -> Self:
        """The same cable on another mesh.

        Raises
        ------
        DloError
            If there is no such mesh, or if the rest shape has changed from pose to pose: it is
            known on the fit's mesh only.
        """
        if n is None and element is None:
            return self
        if n is not None and (not isinstance(n, int | np.integer) or int(n) not in MESH):
            raise DloError(f"n: a whole number, {MESH}, found {n!r}")
        known = ELEMENTS_IN_SPACE if self.model.in_space else ELEMENTS
        if not (element is None or (isinstance(element, str) and element in known)):
            raise DloError(f"element: one of {', '.join(known)} belongs here, found {element!r}")
        if self.model.has_state:
            raise DloError(
                f"{self.name!r} has a rest shape that changed from pose to pose, which is known on "
                "the fit's elements alone: leave out the number and the kind of elements"
            )
        model = self.model.with_mesh(self.model.n if n is None else int(n), element)
        return replace(self, model=model, rest=model.rest_basis @ self.metadata.coefficients)

    def place(
        self,
        count: int,
        poses: Sequence[Mapping[str, Any]],
        within: ArrayLike,
        limits: Asked = None,
        *,
        aim: Aim = "margin",
    ) -> Placing:
        """Find arc lengths and places of pinned clips that keep limits in several poses.

        Maximizes the smallest margin of all limits in all poses, or minimizes the largest force on
        fixtures and clips within the limits. Shapes are the stable ones of lowest energy. The
        optimum is local: the best of those found from several first guesses.

        Parameters
        ----------
        count : int
            Number of clips.
        poses : sequence of mapping
            End conditions in each pose, as keywords of `solve`: [{"end": (0.3, -0.1)}, ...].
        within : ((d,), (d,)) [m]
            Two corners of the region for clips: smallest and largest coordinates. For a wall both
            corners share a coordinate.
        limits : Limits or mapping, optional
            As in `Shape.check`; by default the session's.
        aim : "margin" or "force"
            The quantity to optimize; "force" needs no limits.

        Raises
        ------
        DloError
            If no clips in the region keep the limits, if an argument is meaningless for this cable,
            or if a span has no room.
        EquilibriumError
            If the cable has no shape in one of the poses without clips.
        """
        return placed(self, self.metadata, count, poses, within, limits, aim)


# Rounding error allowed in arc lengths beyond the ends, relative to the length.
_ROUNDING = 1e-9


class CableCurve(NodeCurve):
    """A cable from its start at s = 0 to its end at s = L = `length` [m]."""

    def at(self, s: ArrayLike, derivative: int = 0) -> FloatArray:
        """Positions (K, d) [m] at arc lengths s (K,) [m] in [0, L], or derivatives by s.

        `derivative`: 0 for positions, 1 for the first derivative, 2 for the second.

        Raises
        ------
        DloError
            If an arc length is outside the cable, or if there is no such derivative.
        """
        if derivative not in (0, 1, 2):
            raise DloError(f"derivative: 0, 1 or 2 belongs here, found {derivative!r}")
        try:
            places = np.atleast_1d(np.asarray(s, dtype=float)).ravel()
        except (TypeError, ValueError):
            raise DloError(f"s: arc lengths [m] belong here, found {s!r}") from None
        slack = _ROUNDING * self.length
        outside = places[~((places >= -slack) & (places <= self.length + slack))]
        if len(outside):
            raise DloError(
                f"s = {outside[0]:g} m is not on the cable: {len(outside)} of "
                f"{counted(len(places), 'arc length')} lie outside 0 to {self.length:g} m.\n"
                "  Try: arc lengths in metres from the start."
            )
        return super().at(np.clip(places, 0.0, self.length), derivative)

    def frames(self, s: FloatArray, places: FloatArray, x: FloatArray) -> FloatArray:
        """Material frames (K, d, d) at s [m]: columns are the tangent and the section's axes.

        In a plane the second column is to the left. In space the roll about the tangent is
        interpolated between the nodes, whose states are `x` (N, coordinates) at `places` (N,) [m].
        """
        tangents = unit(self.at(s, 1))
        if self.d == 2:
            return np.stack([tangents, tangents[:, ::-1] * (-1.0, 1.0)], axis=2)
        y = Rotation.from_quat(Frame.interpolated(s, places, x)).apply([0.0, 1.0, 0.0])
        y = unit(y - (y * tangents).sum(axis=1, keepdims=True) * tangents)
        return np.stack([tangents, y, np.cross(tangents, y)], axis=2)
