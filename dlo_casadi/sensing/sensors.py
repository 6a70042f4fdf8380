"""Sensors: measurements of a pose, their residuals, derivatives and covariance.

A sensor's residual is measured minus predicted. Its own unknowns, such as the arc lengths of
points, follow from the curve (`located`); derivatives are taken with these unknowns fixed.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.arrays import FloatArray, chord_lengths, unit
from dlo_casadi.equilibrium.curve import NodeCurve, Observed, ObservedChange, across, chord_places
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.node import Node
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.sensing.noise import Count, NoiseModel

# Chord used for the direction of a measured line, as a share of its length: noise of 2 mm turns it
# by 0.03 rad on a line of 1 m.
_CHORD = 0.06


class Sensor(ABC):
    """One measurement of one pose: `per_point` residuals for each of its K points, in order.

    A measurement without points (K = 0) has R residuals.

    Attributes
    ----------
    points : (K, d) [m]
        As measured.
    weight : (K,)
        Relative standard deviations of the points.
    marked : bool
        Whether the arc lengths of all its points are known.
    correlation_length : float [m]
        Length over which the otherwise white errors of points are correlated.
    read : tuple of str
        Names of the forces and moments that it reads, see `ends.reaction_rows`.
    count : (K,) or one number for all
        Number of measured points of which each point is the mean.
    """

    points: FloatArray
    weight: FloatArray
    marked = False
    correlation_length: float = 0.0
    read: tuple[str, ...] = ()
    count: Count = 1.0

    @property
    @abstractmethod
    def per_point(self) -> int:
        """Number of residuals per point."""

    @property
    def kinds(self) -> NDArray[np.str_]:
        """Kind of each residual (R,): point [m], force [N] or moment [N m]."""
        return np.full(len(self.points) * self.per_point, "point")

    def beside(self, seen: Observed) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Measured and predicted readings by name; none by default."""
        return {}

    @property
    def together(self) -> FloatArray:
        """Errors (R, c) that its residuals share, of one std each; none by default."""
        return np.zeros((len(self.kinds), 0))

    def places(self, pose: HeldPose, length: float) -> FloatArray:
        """First guess of the points' arc lengths (K,) [m]: running chord length, scaled to L."""
        return chord_places(self.points, pose, length)

    @abstractmethod
    def located(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] at which the points are compared with this curve, near `places`."""

    @abstractmethod
    def nearest(self, curve: NodeCurve) -> FloatArray:
        """Arc lengths (K,) [m] of the points on a curve that may be far off, by global search."""

    @abstractmethod
    def components(self, curve: NodeCurve, places: FloatArray, moved: FloatArray) -> FloatArray:
        """Change (R, q) of the residual by displacements (K, d, q) [m] of the measured points."""

    @abstractmethod
    def residual(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Measured minus model (R,)."""

    @abstractmethod
    def linearized(
        self, seen: Observed, places: FloatArray, along: ObservedChange
    ) -> tuple[FloatArray, FloatArray]:
        """Residual (R,) and its change (R, q) along directions."""

    @abstractmethod
    def whitening(self, noise: NoiseModel, places: FloatArray) -> FloatArray:
        """Matrix W (R, R) with W cov W^T = 1."""


class _Known(Sensor):
    """A sensor with known arc lengths s (K,) [m] of its points on the cable."""

    s: FloatArray
    marked = True

    def places(self, pose: HeldPose, length: float) -> FloatArray:
        """The known arc lengths (K,) [m], of a cable that is not fed."""
        return self.s

    def located(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Places (K,) [m] of the known arc lengths on this curve."""
        return self.nearest(seen.curve)

    def nearest(self, curve: NodeCurve) -> FloatArray:
        """Places (K,) [m] of the known arc lengths on a curve."""
        return curve.places_of(self.s)


@dataclass(frozen=True)
class _Points(Sensor):
    """Points in the board's or the world's frame, compared with their places on the curve."""

    points: FloatArray
    weight: FloatArray
    count: Count = field(default=1.0, kw_only=True)

    def residual(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Measured minus model (R,) [m]."""
        gap = self.points - seen.curve.at(places)
        return self.components(seen.curve, places, gap[..., None])[:, 0]

    def linearized(
        self, seen: Observed, places: FloatArray, along: ObservedChange
    ) -> tuple[FloatArray, FloatArray]:
        """Residual (R,) [m] and its change (R, q) along directions."""
        gap = self.points - seen.curve.at(places)
        moved = -seen.curve.moved(places, along.curve, along.knots, marked=self.marked)
        both = self.components(seen.curve, places, np.dstack([gap, moved]))
        return both[:, 0], both[:, 1:]

    def whitening(self, noise: NoiseModel, places: FloatArray) -> FloatArray:
        """Matrix W (R, R) [1/m] with W cov W^T = 1; the errors of a point are independent."""
        own = noise.whitening(places, self.weight, count=self.count)
        return np.kron(own, np.eye(self.per_point))


@dataclass(frozen=True)
class Centerline(_Points):
    """Points somewhere along the cable, compared across its tangent: d - 1 residuals each.

    The arc lengths s of the points' projections onto the curve are the sensor's own unknowns. The
    distance is stationary in s there, so derivatives at fixed s are exact. In space the two normals
    at a point are those of the measured line, transported along it without twist, then turned by
    the smallest rotation onto the curve's tangent. When the curve moves they hardly roll, as they
    would if they were transported along the curve from its start.

    Parameters
    ----------
    points : (K, d) [m]
        In order from start to end.
    weight : (K,)
        Relative standard deviations.
    """

    @property
    def per_point(self) -> int:
        """Residuals of a point."""
        return self.points.shape[1] - 1

    def located(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] of the points' projections, near those given."""
        return seen.curve.projections(self.points, places)

    def components(self, curve: NodeCurve, places: FloatArray, moved: FloatArray) -> FloatArray:
        """Components along the normals, (K (d - 1), q)."""
        along = np.einsum("knd,kdq->knq", self.normals(curve, places), moved)
        return along.reshape((-1, moved.shape[2]))

    def normals(self, curve: NodeCurve, places: FloatArray) -> FloatArray:
        """Unit normals (K, d - 1, d) of the curve at the points' arc lengths."""
        t = curve.tangents(places)
        if len(t[0]) == 2:
            return across(t)
        line, pair = self._line
        opening = np.maximum(1 + (line * t).sum(axis=1), 1e-6)
        share = np.einsum("knd,kd->kn", pair, t) / opening[:, None]
        return np.asarray(pair - share[:, :, None] * (line + t)[:, None])

    @cached_property
    def _line(self) -> tuple[FloatArray, FloatArray]:
        """Unit tangents (K, 3) of the measured line, smoothed, and its normals (K, 2, 3)."""
        s = chord_lengths(self.points)
        ahead, behind = (
            np.stack([np.interp(s + way * s[-1], s, column) for column in self.points.T], axis=1)
            for way in (_CHORD / 2, -_CHORD / 2)
        )
        t = unit(ahead - behind)
        return t, across(t)

    def nearest(self, curve: NodeCurve) -> FloatArray:
        """Arc lengths (K,) [m] of the nearest places on the whole curve."""
        return curve.nearest(self.points)


@dataclass(frozen=True)
class Markers(_Known, _Points):
    """Points at known arc lengths, compared in all directions: d residuals each.

    Where the cable's length is estimated, arc lengths scale with it; where it is fed, they stay on
    the cable.

    Parameters
    ----------
    points : (K, d) [m]
    weight : (K,)
        Relative standard deviations.
    s : (K,) [m]
        Arc lengths from the start, of the declared length.
    """

    s: FloatArray

    @property
    def per_point(self) -> int:
        """Residuals of a point."""
        return self.points.shape[1]

    def components(self, curve: NodeCurve, places: FloatArray, moved: FloatArray) -> FloatArray:
        """All components, (K d, q)."""
        return moved.reshape((-1, moved.shape[2]))


def line_or_markers(
    points: FloatArray,
    weight: FloatArray | None = None,
    s: FloatArray | None = None,
    count: Count = 1.0,
) -> Centerline | Markers:
    """A line of points (K, d) [m], or markers where their arc lengths s (K,) [m] are known.

    `weight` (K,) is one by default.
    """
    weight = np.ones(len(points)) if weight is None else weight
    if s is None:
        return Centerline(points, weight, count=count)
    return Markers(points, weight, s, count=count)


@dataclass(frozen=True)
class Wrench(_Known):
    """Forces and moments on the fixtures, one residual per component: R residuals [N], [N m].

    Parameters
    ----------
    measured : dict
        Forces (dimension,) [N] and moments (increment,) [N m] of the cable on its fixtures, in
        world axes, moments about the fixture; named as in `ends.reaction_rows`.
    clips : int
        Number of clips of the pose.
    """

    measured: dict[str, FloatArray]
    node: type[Node]
    clips: int = 0
    per_point = 0
    points, weight, s = np.zeros((0, 1)), np.zeros(0), np.zeros(0)

    @property
    def read(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of what is measured."""
        return tuple(self.measured)

    @property
    def _rows(self) -> dict[str, slice]:
        """Slices of the measured components in the model's `readings`."""
        every = reaction_rows(self.node, self.clips)
        return {name: at for name, at in every.items() if name in self.measured}

    def beside(self, seen: Observed) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Measured and predicted values by name."""
        return {name: (self.measured[name], seen.readings[at]) for name, at in self._rows.items()}

    @property
    def kinds(self) -> NDArray[np.str_]:
        """Kind of each residual (R,): a force or a moment."""
        rows = self._rows.items()
        found = [np.full(x.stop - x.start, quantity_of(name).name) for name, x in rows]
        return np.concatenate(found)

    def components(self, curve: NodeCurve, places: FloatArray, moved: FloatArray) -> FloatArray:
        """Zeros (R, q): it measures no points."""
        return np.zeros((len(self.kinds), moved.shape[2]))

    def residual(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Measured minus model (R,)."""
        return np.concatenate([known - model for known, model in self.beside(seen).values()])

    def linearized(
        self, seen: Observed, places: FloatArray, along: ObservedChange
    ) -> tuple[FloatArray, FloatArray]:
        """Residual (R,) and its change (R, q) along directions."""
        change = -np.concatenate([along.readings[at] for at in self._rows.values()])
        return self.residual(seen, places), change

    def whitening(self, noise: NoiseModel, places: FloatArray) -> FloatArray:
        """Matrix W (R, R) with W cov W^T = 1; all components are independent."""
        return np.diag(noise.units(self.kinds) / noise.std)
