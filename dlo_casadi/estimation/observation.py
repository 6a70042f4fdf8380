"""Measured points against the curve: feet, normals and the linear map from nodes to points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium import Pose
from dlo_casadi.rod.chain import Chain

FloatArray = NDArray[np.floating]


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

    @property
    def line(self) -> Centerline:
        """The sensor of the pose."""
        return Centerline(self.points, self.relative_std)


@dataclass(frozen=True)
class Centerline:
    """A sensor: points somewhere along the cable, compared across its tangent.

    The arc lengths s of their closest points on the curve are its own unknowns. There the normal
    distance does not change to first order with s, so that derivatives at fixed s are exact.

    Parameters
    ----------
    points : (K, 2) [m]
    weight : (K,)
        Relative standard deviations.
    """

    points: FloatArray
    weight: FloatArray

    def residual(self, curve: NodeCurve, s: FloatArray) -> FloatArray:
        """Normal distances (K,) [m], measured minus curve."""
        return np.asarray(((self.points - curve.at(s)) * curve.normals(s)).sum(axis=1))

    def residual_along(self, curve: NodeCurve, s: FloatArray, slopes: FloatArray) -> FloatArray:
        """Change (K, q) of the residual along directions of the curve (n + 1, 2 or 4, q)."""
        moved = curve.moved(s, slopes)
        return -np.einsum("kd,kdq->kq", curve.normals(s), moved)


# Polynomial coefficients (powers of u, weights) of the interpolants' derivatives by u.
_HERMITE = np.array(
    [
        [[1, 0, 0, 0], [0, 0, 1, 0], [-3, 3, -2, -1], [2, -2, 1, 1]],
        [[0, 0, 1, 0], [-6, 6, -4, -2], [6, -6, 3, 3], [0, 0, 0, 0]],
        [[-6, 6, -4, -2], [12, -12, 6, 6], [0, 0, 0, 0], [0, 0, 0, 0]],
    ],
    dtype=float,
)
_LINEAR = np.array(
    [
        [[1, 0, 0, 0], [-1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]],
        [[-1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]],
        [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]],
    ],
    dtype=float,
)


@dataclass(frozen=True)
class NodeCurve:
    """A curve given by its nodes and, of smooth elements, the slopes dr/ds there.

    Between nodes with slopes the curve is the cubic Hermite interpolant, which
    differs from an arc of curvature k by less than h^4 k^3 / 384; others are joined by chords.
    """

    length: float
    nodes: FloatArray
    slopes: FloatArray | None

    @classmethod
    def of(cls, length: float, z: FloatArray) -> Self:
        """Curve of places, and slopes where there are any, (n + 1, 2 or 4)."""
        return cls(length, z[:, :2], z[:, 2:4] if z.shape[1] == 4 else None)

    @property
    def n(self) -> int:
        """Number of elements."""
        return len(self.nodes) - 1

    def _local(self, s: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Element index (K,) and the fraction (K,) of its length at s [m]."""
        u = s * (self.n / self.length)
        e = np.minimum(u.astype(np.intp), self.n - 1)
        return e, u - e

    def weights(self, s: FloatArray, derivative: int = 0) -> tuple[NDArray[np.intp], FloatArray]:
        """Element index (K,) and weights (K, 4) of [r_e, r_(e+1), h t_e, h t_(e+1)] at s [m]."""
        e, u = self._local(s)
        h = self.length / self.n
        powers = u[:, None] ** np.arange(4)
        table = (_HERMITE if self.slopes is not None else _LINEAR)[derivative]
        return e, powers @ table / h**derivative

    @cached_property
    def _handles(self) -> FloatArray:
        """Per element [r_e, r_(e+1), h t_e, h t_(e+1)] (n, 4, 2)."""
        if self.slopes is None:
            zero = np.zeros((self.n, 2))
            return np.stack([self.nodes[:-1], self.nodes[1:], zero, zero], axis=1)
        slopes = self.slopes * (self.length / self.n)
        return np.stack([self.nodes[:-1], self.nodes[1:], slopes[:-1], slopes[1:]], axis=1)

    def frame(self, s: FloatArray, derivatives: int) -> list[FloatArray]:
        """Position (K, 2) [m] and its first derivatives by s at arc lengths s."""
        e, u = self._local(s)
        powers = u[:, None] ** np.arange(4)
        handles = self._handles[e]
        scale = self.n / self.length
        table = _HERMITE if self.slopes is not None else _LINEAR
        return [
            np.einsum("kw,kwd->kd", powers @ table[d], handles) * scale**d
            for d in range(derivatives + 1)
        ]

    def at(self, s: FloatArray, derivative: int = 0) -> FloatArray:
        """Positions (K, 2) [m] at arc lengths s, or derivatives by s."""
        return self.frame(s, derivative)[derivative]

    def moved(self, s: FloatArray, slopes: FloatArray) -> FloatArray:
        """Change (K, 2, q) [m] of positions at fixed s for one (n + 1, 2 or 4, q) of the curve."""
        e, w = self.weights(s)
        w = w[:, :, None, None]
        out = w[:, 0] * slopes[e, :2] + w[:, 1] * slopes[e + 1, :2]
        if self.slopes is not None:
            h = self.length / self.n
            out += h * (w[:, 2] * slopes[e, 2:] + w[:, 3] * slopes[e + 1, 2:])
        return np.asarray(out)

    def feet(self, points: FloatArray, guess: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] of the points' feet, by Newton steps from a guess.

        Solves t . (x - r(s)) = 0; a foot stays within [0, L].
        """
        s = guess.copy()
        limit = 0.5 * self.length / self.n
        for _ in range(12):
            position, t, bend = self.frame(s, 2)
            gap = points - position
            square = (t * t).sum(axis=1)
            curvature = np.maximum(square - (bend * gap).sum(axis=1), 0.2 * square)
            step = np.clip((t * gap).sum(axis=1) / curvature, -limit, limit)
            new = np.clip(s + step, 0.0, self.length)
            done = np.abs(new - s).max() < 1e-8 * self.length
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
    """Matrix (K, (n + 1) 2 or 4) of d(n . r(s)) by the curve's numbers, s and n fixed."""
    width = 2 if curve.slopes is None else 4
    unit = np.eye((curve.n + 1) * width).reshape((curve.n + 1, width, -1))
    return np.einsum("kd,kdq->kq", normals, curve.moved(s, unit))


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


def line_headings(measured: MeasuredPose, chain: Chain, places: FloatArray) -> FloatArray:
    """Headings (n_nodes,) [rad] of a measured line, unwrapped along the cable.

    Those of chords of some hundredths of the length; `places` (K,) [m] are the points' arc lengths.
    """
    line = [np.array(measured.pose.start)[None], measured.points]
    s = [np.array([0.0]), places]
    if measured.pose.end is not None:
        line.append(np.array(measured.pose.end)[None])
        s.append(np.array([chain.length]))
    points, at = np.concatenate(line), np.maximum.accumulate(np.concatenate(s))
    grid = np.linspace(0.0, at[-1], 31)
    coarse = np.stack([np.interp(grid, at, points[:, i]) for i in (0, 1)], axis=1)
    chords = np.diff(coarse, axis=0)
    headings = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
    if measured.pose.start_heading is not None:
        turns = np.round((measured.pose.start_heading - headings[0]) / (2 * np.pi))
        headings = headings + 2 * np.pi * turns
    return np.interp(chain.places, (grid[1:] + grid[:-1]) / 2, headings)


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
