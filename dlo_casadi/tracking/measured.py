"""What was measured in a pose: residuals in units of the noise, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose
from dlo_casadi.equilibrium.curve import Observed, ObservedChange
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.ends import reaction_rows
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.rod.supports import place_problem
from dlo_casadi.sensing.noise import correlation

# Share of the noise of a line that is correlated, if any is; the rest keeps close points apart.
_SHARE = 0.99


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is measured.

    Parameters
    ----------
    point : float [m]
        Of one coordinate of a point.
    force, moment : float or None [N, N m]
        Of one component of a reading; None if readings are not used.
    along : float [m]
        Distance along a line at which errors of its points are correlated by 1/e; 0 if they are
        independent. Markers are.
    """

    point: float
    force: float | None = None
    moment: float | None = None
    along: float = 0.0


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured in a pose, at known places of the cable.

    Parameters
    ----------
    points : (K, d) [m]
    s : (K,) [m]
        Their arc lengths on the cable if they are `marked`, else their places on the last curve.
    marked : bool
        Whether these were measured, too; else only distances across the cable count.
    readings, rows, std : (r,)
        Components of forces and moments, their rows in `Observed.readings`, and their noise.
    noise : Noise
    mixed : (K, K) or None
        L of the correlations L L^T of errors along a line.
    """

    points: FloatArray
    s: FloatArray
    marked: bool
    readings: FloatArray
    rows: list[int]
    std: FloatArray
    noise: Noise
    mixed: FloatArray | None = None

    @classmethod
    def of(cls, pose: Pose, model: CableModel, noise: Noise) -> Measured:
        """Measurements of a pose; points without arc lengths have no places yet."""
        d = model.node.dimension
        points = np.zeros((0, d)) if pose.points is None else np.asarray(pose.points, dtype=float)
        if points.shape[1] != d:
            raise DloError(f"points: ({d},) each belongs here, found {points.shape[1]} coordinates")
        known = reaction_rows(model.node, len(model.clips))
        values: list[float] = []
        rows: list[int] = []
        std: list[float] = []
        for name, found in pose.readings.items():
            size = getattr(noise, quantity_of(name).name)
            if size is None:
                continue
            values += [float(x) for x in np.atleast_1d(found)]
            rows += range(known[name].start, known[name].stop)
            std += [size] * (known[name].stop - known[name].start)
        if len(values) != len(rows):
            raise DloError(f"readings: {len(rows)} components belong here, found {len(values)}")
        s = np.zeros(len(points)) if pose.at is None else np.asarray(pose.at, dtype=float)
        if pose.at is not None:
            each = (place_problem(float(x), model.cable.length, model.loose) for x in s)
            for text in filter(None, each):
                raise DloError(f"at: {text}.\n  Try: arc lengths from the start, in metres")
        readings = np.array(values), rows, np.array(std)
        return cls(points, s, pose.at is not None, *readings, noise)

    @property
    def size(self) -> int:
        """Number of measured numbers."""
        points, d = self.points.shape
        return points * (d if self.marked else d - 1) + len(self.rows)

    def on(self, seen: Observed) -> Measured:
        """The same with the places of its points on a curve, if they are not known."""
        if self.marked or not len(self.points):
            return self
        s, mixed = seen.curve.nearest(self.points), self.mixed
        if mixed is None and self.noise.along:
            apart = np.abs(s[:, None] - s) / self.noise.along
            alike = _SHARE * correlation("exponential", apart) + (1 - _SHARE) * np.eye(len(s))
            mixed = np.linalg.cholesky(alike)
        return replace(self, s=s, mixed=mixed)

    def _places(self, seen: Observed) -> FloatArray:
        """Places (K,) [m] of its points on a curve."""
        return seen.curve.places_of(self.s) if self.marked else self.s

    def _across(self, seen: Observed, moved: FloatArray) -> FloatArray:
        """Displacements (K, d, q), or of a line those across it (K, d - 1, q)."""
        if self.marked or not len(self.points):
            return moved
        return np.asarray(np.einsum("knd,kdq->knq", seen.curve.normals(self.s), moved))

    def _rows(self, seen: Observed, moved: FloatArray) -> FloatArray:
        """Displacements (K, d, q) as rows (., q) with independent errors of one."""
        rows = self._across(seen, moved) / self.noise.point
        if self.mixed is not None:
            flat = rows.reshape(len(rows), -1)
            rows = solve_triangular(self.mixed, flat, lower=True).reshape(rows.shape)
        return np.asarray(rows.reshape(-1, moved.shape[2]))

    def rms(self, seen: Observed) -> float:
        """Root mean square [m] of a coordinate's distance from its prediction."""
        gap = (self.points - seen.curve.at(self._places(seen)))[..., None]
        return float(np.sqrt(np.square(self._across(seen, gap)).mean())) if gap.size else 0.0

    def off(self, seen: Observed) -> FloatArray:
        """Measured minus predicted (R,), in units of the noise."""
        gap = (self.points - seen.curve.at(self._places(seen)))[..., None]
        felt = (self.readings - seen.readings[self.rows]) / self.std if self.rows else np.zeros(0)
        return np.concatenate([self._rows(seen, gap)[:, 0], felt])

    def along(self, seen: Observed, change: ObservedChange) -> FloatArray:
        """Derivatives (R, q) of what is predicted, in units of the noise."""
        known = change.curve, change.knots
        moved = seen.curve.moved(self._places(seen), *known, marked=self.marked)
        rows = self._rows(seen, moved)
        if not self.rows:
            return rows
        return np.vstack([rows, change.readings[self.rows] / self.std[:, None]])

    def alike(self, seen: Observed, std: float) -> FloatArray:
        """Derivatives (R, d) by shifts of all points alike, of this standard deviation [m]."""
        d = self.points.shape[1]
        if not std:
            return np.zeros((self.size, 0))
        shift = np.broadcast_to(std * np.eye(d), (len(self.points), d, d))
        return np.vstack([self._rows(seen, shift), np.zeros((len(self.rows), d))])
