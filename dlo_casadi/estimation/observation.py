"""Measured points against the curve: feet, normals and the linear map from nodes to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.chain import Chain
from dlo_casadi.equilibrium import Pose

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class MeasuredPose:
    """One pose with its measured centre-line.

    Parameters
    ----------
    pose : Pose
        End conditions as declared.
    points : (K, 2) [m]
        Ordered from start to end; empty if the pose could not be read.
    weight : (K,)
        Relative standard deviation of each point; ones by default.
    held_out : bool
        Whether the pose is kept for the final test.
    """

    pose: Pose
    points: FloatArray
    weight: FloatArray | None = None
    held_out: bool = False

    @property
    def relative_std(self) -> FloatArray:
        """Relative standard deviation of each point (K,)."""
        return np.ones(len(self.points)) if self.weight is None else self.weight

    @property
    def readable(self) -> bool:
        """Whether there are points to compare with."""
        return len(self.points) > 0


@dataclass(frozen=True)
class NodeCurve:
    """A curve given by the model's observation vector z: nodes and, for arcs, slopes dr/ds.

    Between the nodes of a chain of arcs the curve is the cubic Hermite interpolant, which
    differs from an arc of curvature k by less than h^4 k^3 / 384; links are straight.
    """

    length: float
    nodes: FloatArray
    slopes: FloatArray | None

    @classmethod
    def of(cls, chain: Chain, z: FloatArray) -> NodeCurve:
        """Unpack the observation vector z of a chain."""
        table = z.reshape((-1, chain.n + 1)).T
        return cls(chain.length, table[:, :2], table[:, 2:4] if table.shape[1] == 4 else None)

    @property
    def n(self) -> int:
        """Number of elements."""
        return len(self.nodes) - 1

    def weights(self, s: FloatArray, derivative: int = 0) -> tuple[NDArray[np.intp], FloatArray]:
        """Element index (K,) and weights (K, 4) of [r_e, r_(e+1), h t_e, h t_(e+1)] at s [m]."""
        h = self.length / self.n
        e = np.clip((s / h).astype(int), 0, self.n - 1)
        u = s / h - e
        if self.slopes is None:
            zero = np.zeros_like(u)
            rows = {
                0: (1 - u, u, zero, zero),
                1: (-1 + zero, 1 + zero, zero, zero),
                2: (zero, zero, zero, zero),
            }[derivative]
        else:
            rows = {
                0: (
                    2 * u**3 - 3 * u**2 + 1,
                    -2 * u**3 + 3 * u**2,
                    u**3 - 2 * u**2 + u,
                    u**3 - u**2,
                ),
                1: (
                    6 * u**2 - 6 * u,
                    -6 * u**2 + 6 * u,
                    3 * u**2 - 4 * u + 1,
                    3 * u**2 - 2 * u,
                ),
                2: (12 * u - 6, -12 * u + 6, 6 * u - 4, 6 * u - 2),
            }[derivative]
        return e, np.stack(rows, axis=1) / h**derivative

    def at(self, s: FloatArray, derivative: int = 0) -> FloatArray:
        """Positions (K, 2) [m] at arc lengths s, or derivatives by s."""
        e, w = self.weights(s, derivative)
        out = w[:, :1] * self.nodes[e] + w[:, 1:2] * self.nodes[e + 1]
        if self.slopes is not None:
            h = self.length / self.n
            out += h * (w[:, 2:3] * self.slopes[e] + w[:, 3:4] * self.slopes[e + 1])
        return out

    def feet(self, points: FloatArray, guess: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] of the points' feet, by Newton steps from a guess.

        Solves t . (x - r(s)) = 0; a foot stays within [0, L].
        """
        s = guess.copy()
        limit = 0.5 * self.length / self.n
        for _ in range(12):
            gap = points - self.at(s)
            t, bend = self.at(s, 1), self.at(s, 2)
            curvature = np.maximum((t * t).sum(1) - (bend * gap).sum(1), 0.2 * (t * t).sum(1))
            step = np.clip((t * gap).sum(1) / curvature, -limit, limit)
            new = np.clip(s + step, 0.0, self.length)
            done = np.abs(new - s).max() < 1e-9 * self.length
            s = new
            if done:
                break
        return s

    def nearest(self, points: FloatArray, per_element: int = 8) -> FloatArray:
        """Arc lengths (K,) [m] of the nearest places on the whole curve."""
        grid = np.linspace(0.0, self.length, self.n * per_element + 1)
        line = self.at(grid)
        square = ((points[:, None, :] - line[None]) ** 2).sum(-1)
        return self.feet(points, grid[square.argmin(axis=1)])

    def normals(self, s: FloatArray) -> FloatArray:
        """Unit normals (K, 2), to the left of the direction of travel."""
        t = self.at(s, 1)
        t = t / np.hypot(t[:, 0], t[:, 1])[:, None]
        return np.stack([-t[:, 1], t[:, 0]], axis=1)

    def distances(self, points: FloatArray) -> FloatArray:
        """Distance (K,) [m] of each point to the nearest place on the curve."""
        return np.hypot(*(points - self.at(self.nearest(points))).T)


def normal_rows(curve: NodeCurve, s: FloatArray, normals: FloatArray) -> FloatArray:
    """Matrix (K, len(z)) of d(n . r(s))/dz at fixed places and normals."""
    e, w = curve.weights(s)
    size = curve.n + 1
    k = np.arange(len(s))
    rows = np.zeros((len(s), size * (2 if curve.slopes is None else 4)))
    h = curve.length / curve.n
    for axis in (0, 1):
        rows[k, axis * size + e] = w[:, 0] * normals[:, axis]
        rows[k, axis * size + e + 1] = w[:, 1] * normals[:, axis]
        if curve.slopes is not None:
            rows[k, (2 + axis) * size + e] = h * w[:, 2] * normals[:, axis]
            rows[k, (2 + axis) * size + e + 1] = h * w[:, 3] * normals[:, axis]
    return rows


def chord_places(measured: MeasuredPose, length: float) -> FloatArray:
    """First guess of the points' arc lengths (K,) [m]: running chord length, scaled to L.

    Chords across gaps are shorter than the cable; between two fixtures the whole is scaled.
    """
    start = np.array(measured.pose.start)
    line = [start[None], measured.points]
    if measured.pose.end is not None:
        line.append(np.array(measured.pose.end)[None])
    polyline = np.concatenate(line)
    steps = np.hypot(*np.diff(polyline, axis=0).T)
    # Noise lengthens a dense polyline: chords over several points are what counts.
    s = _denoised_length(polyline, steps)
    places = s[1 : len(measured.points) + 1]
    if measured.pose.end is not None:
        places = places * (length / s[-1])
    return np.clip(places, 0.0, length)


def _denoised_length(polyline: FloatArray, steps: FloatArray) -> FloatArray:
    """Cumulative length of the polyline smoothed over about 1/50 of itself."""
    total = steps.sum()
    s = np.concatenate([[0.0], np.cumsum(steps)])
    width = max(total / 50, 1e-12)
    knots = np.linspace(0.0, total, 51)
    kernel = np.exp(-0.5 * ((knots[:, None] - s[None]) / (0.5 * width)) ** 2)
    norm = kernel.sum(axis=1, keepdims=True)
    smooth = np.where(norm > 1e-9, kernel @ polyline / np.maximum(norm, 1e-9), np.nan)
    straight = np.stack([np.interp(knots, s, polyline[:, i]) for i in (0, 1)], axis=1)
    smooth = np.where(np.isfinite(smooth), smooth, straight)
    smooth[0], smooth[-1] = polyline[0], polyline[-1]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(smooth, axis=0).T))])
    return np.interp(s, knots, arc)
