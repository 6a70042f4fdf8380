"""A measured pose: its end conditions and the measurements of its sensors."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.equilibrium.curve import (
    NodeCurve,
    Observed,
    ObservedChange,
    between,
    denoised_length,
)
from dlo_casadi.equilibrium.measured_line import marked_ends
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.rod.ends import fed_ends
from dlo_casadi.sensing.noise import NoiseModel
from dlo_casadi.sensing.sensors import Centerline, Markers, Sensor, Wrench, line_or_markers


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """One measured pose. Its residual stacks those of its sensors.

    Parameters
    ----------
    pose : HeldPose
        End conditions as declared.
    sensors : tuple of Sensor
        Those of points first; empty if the pose could not be read. A pose may have readings alone.
    held_out : bool
        Whether the pose is kept for the final test.
    line : Centerline or Markers, optional
        Measured points of the cable used to report distances, if they are not those of the
        sensors: the common line of photographs, without points if there is none; or all points if
        the sensors have means of them.
    least : float [m]
        Standard deviation below which no noise is estimated: what a photograph's pixels leave.
    """

    pose: HeldPose
    sensors: tuple[Sensor, ...] = ()
    held_out: bool = False
    line: Centerline | Markers | None = None
    least: float = 0.0

    @classmethod
    def of_points(
        cls,
        pose: HeldPose,
        points: FloatArray,
        weight: FloatArray | None = None,
        held_out: bool = False,
        s: FloatArray | None = None,
    ) -> Self:
        """A pose with one line of points (K, d) [m], or with markers at known arc lengths s.

        A pose without points is unreadable. `weight` (K,) is one by default.
        """
        if not len(points):
            return cls(pose, (), held_out)
        return cls(pose, (line_or_markers(points, weight, s),), held_out)

    def with_readings(self, readings: Mapping[str, Sequence[float]]) -> Self:
        """The same pose with wrench measurements, named as in `ends.reaction_rows`."""
        if not readings:
            return self
        known = {name: np.array(value, dtype=float) for name, value in readings.items()}
        wrench = Wrench(known, self.pose.node, len(self.pose.clips))
        return replace(self, sensors=(*self.sensors, wrench))

    @property
    def readable(self) -> bool:
        """Whether the pose has any measurements."""
        return len(self.sensors) > 0

    @property
    def has_points(self) -> bool:
        """Whether any sensor shows its shape; otherwise it has readings alone, or nothing."""
        return len(self.points) > 0

    @property
    def has_line(self) -> bool:
        """Whether there are measured points in the frame of the poses, not only pixels."""
        return self.has_points and (self.line is None or len(self.line.points) > 0)

    @cached_property
    def traced(self) -> "MeasuredPose":
        """The same pose with its line alone; without a line, with approximate places of points."""
        if self.line is None:
            return self
        line = self.line if self.has_line else line_or_markers(self.points)
        return MeasuredPose(self.pose, (line,), self.held_out)

    @cached_property
    def points(self) -> FloatArray:
        """All measured points (K, d) [m]."""
        found = [sensor.points for sensor in self.sensors if len(sensor.points)]
        return np.concatenate(found) if found else np.zeros((0, len(self.pose.start)))

    @cached_property
    def relative_std(self) -> FloatArray:
        """Relative standard deviation of each point (K,)."""
        return np.concatenate([sensor.weight for sensor in self.sensors])

    @property
    def relative_white(self) -> FloatArray:
        """Relative standard deviations of white errors; they are smaller for means of points."""
        return np.concatenate([sensor.weight / np.sqrt(sensor.count) for sensor in self.sensors])

    @property
    def n_residuals(self) -> int:
        """Number R of residuals."""
        return len(self.kinds)

    @cached_property
    def point_of(self) -> IntArray:
        """Index of the point of each residual; residuals of points come first."""
        per_point = [np.full(len(x.points), x.per_point) for x in self.sensors]
        return np.repeat(np.arange(len(self.points)), np.concatenate(per_point))

    @cached_property
    def kinds(self) -> NDArray[np.str_]:
        """Kind of each residual (R,): point [m], force [N] or moment [N m]."""
        return np.concatenate([sensor.kinds for sensor in self.sensors])

    @property
    def on_points(self) -> BoolArray:
        """Whether each residual (R,) belongs to a point; the others belong to wrenches."""
        return np.asarray(self.kinds == "point")

    @property
    def reactions(self) -> tuple[str, ...]:
        """Names of the measured forces and moments on the fixtures, see `ends.reaction_rows`."""
        return tuple(name for x in self.sensors for name in x.read)

    def readings_beside(self, seen: Observed) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Measured and predicted wrenches by name."""
        return {name: both for x in self.sensors for name, both in x.beside(seen).items()}

    @property
    def slices(self) -> list[tuple[Sensor, slice, slice]]:
        """Each sensor of points with the slices of its points and of its residuals."""
        out, point, row = [], 0, 0
        for sensor in self.sensors:
            count, rows = len(sensor.points), len(sensor.kinds)
            if count:
                out.append((sensor, slice(point, point + count), slice(row, row + rows)))
            point, row = point + count, row + rows
        return out

    def along(self, residual: FloatArray) -> list[FloatArray]:
        """Residuals (R,) of points as series along the cable: each component of each sensor."""
        return [
            series
            for sensor, _, rows in self.slices
            for series in residual[rows].reshape((-1, sensor.per_point)).T
        ]

    def slow_rows(self, modes: FloatArray) -> FloatArray:
        """Residuals (R, c) of displacement modes (K, count), in each direction of the residuals.

        Further columns are the errors shared by the residuals of a sensor, and one mode for each
        residual that belongs to no point.
        """
        blocks = []
        for x, points, _ in self.slices:
            shared = x.together / np.abs(x.together).max(axis=0, initial=1e-300)
            blocks.append(np.hstack([np.kron(modes[points], np.eye(x.per_point)), shared]))
        if others := int((~self.on_points).sum()):
            blocks.append(np.eye(others))
        return blocks[0] if len(blocks) == 1 else np.asarray(block_diag(*blocks))

    def _each(self, *per_point: FloatArray) -> Iterator[tuple[Any, ...]]:
        """Each sensor with its part of arrays over all points (K, ...)."""
        ends = np.cumsum([len(x.points) for x in self.sensors])[:-1]
        return zip(self.sensors, *(np.split(values, ends) for values in per_point), strict=True)

    def places(self, length: float, fed: tuple[bool, bool] = (False, False)) -> FloatArray:
        """First guess of the points' places (K,) [m] on a curve, without one.

        `fed`: whether the cable is fed through its start, through its end.
        """
        found = [sensor.places(self.pose, length) for sensor in self.sensors]
        if any(fed):
            ends = self.ends(length, fed)
            each = zip(self.sensors, found, strict=True)
            found = [between(s, ends, length) if x.marked else s for x, s in each]
        return np.concatenate(found)

    def fed_as_seen(self, length: float, fed: tuple[bool, bool]) -> Self:
        """The same pose with the free length that its points show, see `ends`."""
        low, high = self.ends(length, fed) if self.has_points else (0.0, length)
        return replace(self, pose=replace(self.pose, free_length=high - low))

    def ends(self, length: float, fed: tuple[bool, bool]) -> tuple[float, float]:
        """First guess of the arc lengths [m] of both ends on a cable that is `fed`."""
        (line,), pose = self.traced.sensors[:1], self.pose
        if isinstance(line, Markers):
            return marked_ends(line.points, line.s, pose, length, fed)
        return fed_ends(float(denoised_length(pose.joined(line.points))[-1]), length, fed)

    def located(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] at which the points are compared with this curve."""
        return np.concatenate([x.located(seen, s) for x, s in self._each(places)])

    def components(self, curve: NodeCurve, places: FloatArray, moved: FloatArray) -> FloatArray:
        """Change (R, q) of the residual by displacements (K, d, q) [m] of the measured points."""
        parts = self._each(places, moved)
        return np.concatenate([x.components(curve, s, way) for x, s, way in parts])

    def residual(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Measured minus model (R,)."""
        return np.concatenate([x.residual(seen, s) for x, s in self._each(places)])

    def linearized(
        self, seen: Observed, places: FloatArray, along: ObservedChange
    ) -> tuple[FloatArray, FloatArray]:
        """Residual (R,) and its change (R, q) along directions."""
        found = [x.linearized(seen, s, along) for x, s in self._each(places)]
        residual, change = (np.concatenate(part) for part in zip(*found, strict=True))
        return residual, change

    def whitening(self, noise: NoiseModel, places: FloatArray) -> FloatArray:
        """Matrix W (R, R) with W cov W^T = 1; sensors are independent."""
        blocks = [x.whitening(noise, s) for x, s in self._each(places)]
        return blocks[0] if len(blocks) == 1 else np.asarray(block_diag(*blocks))

    def nearest(self, curve: NodeCurve) -> FloatArray:
        """Arc lengths (K,) [m] of the points on a curve that may be far off, by global search."""
        return np.concatenate([sensor.nearest(curve) for sensor in self.sensors])

    def distances(self, curve: NodeCurve) -> FloatArray:
        """Distance [m] of each point of the line from its place on a curve.

        For photographs without a common line: distance of each pixel, across its line of sight.
        """
        if not self.has_line:
            return self.misses(curve)
        item = self.traced
        return np.linalg.norm(item.points - curve.at(item.nearest(curve)), axis=1)

    @property
    def noise_distances(self) -> FloatArray:
        """Expected RMS of `distances` (K,) to the true curve, over the noise of a coordinate."""
        item = self.traced if self.has_line else self
        return np.sqrt(np.bincount(item.point_of, item.relative_std[item.point_of] ** 2))

    def misses(self, curve: NodeCurve) -> FloatArray:
        """Norm (K,) [m] of the residuals of each point."""
        if not self.has_points:
            return np.zeros(0)
        seen, places = Observed(curve, np.zeros(0)), self.nearest(curve)
        rows = [sensor.residual(seen, places[points]) for sensor, points, _ in self.slices]
        return np.sqrt(np.bincount(self.point_of, np.concatenate(rows) ** 2))

    def misread(self, seen: Observed, noise: NoiseModel) -> FloatArray:
        """Errors of the wrenches, converted to metres by `NoiseModel.units`; empty if none."""
        rows = [x.residual(seen, np.zeros(0)) for x in self.sensors if not len(x.points)]
        kinds = self.kinds[~self.on_points]
        return np.concatenate([np.zeros(0), *rows]) * noise.units(kinds)
