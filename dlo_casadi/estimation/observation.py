"""A measured pose: its end conditions, and what its sensors say of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from dlo_casadi.equilibrium import Pose
from dlo_casadi.estimation.curve import NodeCurve
from dlo_casadi.estimation.noise import NoiseModel
from dlo_casadi.estimation.sensors import Centerline, Markers, Observed, ObservedChange, Sensor

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class MeasuredPose:
    """One pose with what was measured of it: the residuals of its sensors, one after the other.

    Parameters
    ----------
    pose : Pose
        End conditions as declared.
    sensors : tuple of Sensor
        Empty if the pose could not be read.
    held_out : bool
        Whether the pose is kept for the final test.
    line : (M, d) [m], optional
        The cable's line that the sensors show together, where their points are no line by
        themselves; without points where they show none.
    """

    pose: Pose
    sensors: tuple[Sensor, ...] = ()
    held_out: bool = False
    line: FloatArray | None = None

    @classmethod
    def of_points(
        cls,
        pose: Pose,
        points: FloatArray,
        weight: FloatArray | None = None,
        held_out: bool = False,
        s: FloatArray | None = None,
    ) -> Self:
        """A pose with one line of points (K, d) [m], or markers where arc lengths s are known.

        Without points the pose could not be read. `weight` (K,) is one by default.
        """
        if not len(points):
            return cls(pose, (), held_out)
        weight = np.ones(len(points)) if weight is None else weight
        sensor = Centerline(points, weight) if s is None else Markers(points, weight, s)
        return cls(pose, (sensor,), held_out)

    @property
    def readable(self) -> bool:
        """Whether there is anything to compare with."""
        return len(self.sensors) > 0

    @property
    def has_line(self) -> bool:
        """Whether it is known where in space points of the cable lie."""
        return self.readable and (self.line is None or len(self.line) > 0)

    @cached_property
    def traced(self) -> MeasuredPose:
        """The same pose with its line alone; about where its points lie if they show none."""
        if self.line is None:
            return self
        line = self.line if len(self.line) else self.points
        return MeasuredPose.of_points(self.pose, line, held_out=self.held_out)

    @cached_property
    def points(self) -> FloatArray:
        """All measured points (K, d) [m]."""
        if not self.sensors:
            return np.zeros((0, len(self.pose.start)))
        return np.concatenate([sensor.points for sensor in self.sensors])

    @cached_property
    def relative_std(self) -> FloatArray:
        """Relative standard deviation of each point (K,)."""
        return np.concatenate([sensor.weight for sensor in self.sensors])

    @cached_property
    def point_of(self) -> NDArray[np.intp]:
        """Index (R,) of the point to which each residual belongs."""
        per_point = [np.full(len(x.points), x.per_point) for x in self.sensors]
        return np.repeat(np.arange(len(self.points)), np.concatenate(per_point))

    @property
    def slices(self) -> list[tuple[Sensor, slice, slice]]:
        """Each sensor that has points, which of the points and which of the residuals are its."""
        out, point, row = [], 0, 0
        for sensor in self.sensors:
            count, rows = len(sensor.points), len(sensor.points) * sensor.per_point
            out.append((sensor, slice(point, point + count), slice(row, row + rows)))
            point, row = point + count, row + rows
        return out

    def slow_rows(self, modes: FloatArray) -> FloatArray:
        """Displacements (K, count) along the cable, in each of the residuals' directions.

        Beside them what the residuals of a sensor share.
        """
        blocks = [
            np.hstack([np.kron(modes[points], np.eye(x.per_point)), _scaled(x.together)])
            for x, points, _ in self.slices
        ]
        return blocks[0] if len(blocks) == 1 else np.asarray(block_diag(*blocks))

    def _parts(self, per_point: FloatArray) -> list[FloatArray]:
        """Values of the points (K, ...), sensor by sensor."""
        return np.split(per_point, np.cumsum([len(x.points) for x in self.sensors])[:-1])

    def places(self, length: float) -> FloatArray:
        """First guess of the points' arc lengths (K,) [m], without a curve."""
        return np.concatenate([sensor.places(self.pose, length) for sensor in self.sensors])

    def located(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] at which the points are compared with this curve."""
        parts = zip(self.sensors, self._parts(places), strict=True)
        return np.concatenate([sensor.located(seen, s) for sensor, s in parts])

    def components(self, curve: NodeCurve, places: FloatArray, moved: FloatArray) -> FloatArray:
        """What the residual has of displacements (K, d, q) [m] of the points: (R, q)."""
        parts = zip(self.sensors, self._parts(places), self._parts(moved), strict=True)
        return np.concatenate([sensor.components(curve, s, way) for sensor, s, way in parts])

    def residual(self, seen: Observed, places: FloatArray) -> FloatArray:
        """Measured minus model (R,)."""
        parts = zip(self.sensors, self._parts(places), strict=True)
        return np.concatenate([sensor.residual(seen, s) for sensor, s in parts])

    def residual_along(
        self, seen: Observed, places: FloatArray, along: ObservedChange
    ) -> FloatArray:
        """Change (R, q) of the residual along directions."""
        parts = zip(self.sensors, self._parts(places), strict=True)
        return np.concatenate([sensor.residual_along(seen, s, along) for sensor, s in parts])

    def whitening(self, noise: NoiseModel, places: FloatArray) -> FloatArray:
        """Matrix W (R, R) with W cov W^T = 1; sensors are independent."""
        parts = zip(self.sensors, self._parts(places), strict=True)
        blocks = [sensor.whitening(noise, s) for sensor, s in parts]
        return blocks[0] if len(blocks) == 1 else np.asarray(block_diag(*blocks))

    def nearest(self, curve: NodeCurve) -> FloatArray:
        """Arc lengths (K,) [m] at which the points belong on a curve that may be far off."""
        return np.concatenate([sensor.nearest(curve) for sensor in self.sensors])

    def distances(self, curve: NodeCurve) -> FloatArray:
        """Distance [m] of each point of the line from where a curve has it.

        Of photographs that show none together: of each pixel, across its line of sight.
        """
        if not self.has_line:
            return self.misses(curve)
        item = self.traced
        return np.linalg.norm(item.points - curve.at(item.nearest(curve)), axis=1)

    def misses(self, curve: NodeCurve) -> FloatArray:
        """Size (K,) [m] of the residuals of each point of a sensor."""
        residual = self.residual(Observed(curve, np.zeros(0)), self.nearest(curve))
        return np.sqrt(np.bincount(self.point_of, residual**2))

    def weighing(self, weight: FloatArray) -> Self:
        """The same pose with other relative standard deviations (K,) of its points."""
        parts = zip(self.sensors, self._parts(weight), strict=True)
        return replace(self, sensors=tuple(sensor.weighing(w) for sensor, w in parts))


def _scaled(columns: FloatArray) -> FloatArray:
    """Columns (R, c) whose largest entry is one."""
    return columns / np.abs(columns).max(axis=0, initial=1e-300)
