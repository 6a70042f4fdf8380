"""A curve through nodes, projections of points onto it, and predicted measurements of a pose."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from typing import Self

import numpy as np

from dlo_casadi.arrays import FloatArray, IntArray, chord_lengths, cross, unit
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.assembly import Assembly

_NEWTON_STEPS = 12
# Coefficients (powers of u, weights) of the interpolants.
_HERMITE = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [-3, 3, -2, -1], [2, -2, 1, 1]], dtype=float)
_LINEAR = np.array([[1, 0, 0, 0], [-1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)


def interpolant(*, smooth: bool) -> FloatArray:
    """Weights (4, 4) of both nodes, then of h dr/ds at both, by powers of u."""
    return _HERMITE if smooth else _LINEAR


@dataclass(frozen=True)
class NodeCurve:
    """A curve given by its nodes and, for smooth elements, the derivatives dr/ds there.

    With derivatives the curve is the cubic Hermite interpolant, which differs from an arc of
    curvature k by less than h^4 k^3 / 384; without them it consists of chords.

    `knots` (n + 1,) [m]: arc lengths of the nodes on the cable, to which dr/ds belong, if some are
    moved to clips or the cable is fed; else None: even ones from 0 to `length`. Places on the curve
    are arc lengths of what is between its ends, scaled to `length`.
    """

    length: float
    nodes: FloatArray
    slopes: FloatArray | None
    knots: FloatArray | None = None

    @classmethod
    def of(cls, length: float, z: FloatArray, knots: FloatArray | None = None) -> Self:
        """Curve from rows of places, or of places and dr/ds: (n + 1, d or 2 d), d = 2 or 3."""
        if z.shape[1] < 4:
            return cls(length, z, None, knots)
        d = z.shape[1] // 2
        return cls(length, z[:, :d], z[:, d:], knots)

    def places_of(self, s: FloatArray) -> FloatArray:
        """Places (K,) [m] of arc lengths s on the cable, see `knots`."""
        return s if self.knots is None else between(s, self.knots[[0, -1]], self.length)

    def along(self, length: float) -> Self:
        """The same curve by arc lengths of a cable of another length [m]."""
        if self.knots is not None or self.slopes is None:
            return replace(self, length=length)
        return replace(self, length=length, slopes=self.slopes * (self.length / length))

    @property
    def numbers(self) -> FloatArray:
        """Nodes and dr/ds as one array (n + 1, d or 2 d)."""
        return self.nodes if self.slopes is None else np.hstack([self.nodes, self.slopes])

    @property
    def n(self) -> int:
        """Number of elements."""
        return len(self.nodes) - 1

    @property
    def d(self) -> int:
        """Number of coordinates of a point: 2 or 3."""
        return self.nodes.shape[1]

    @cached_property
    def grid(self) -> FloatArray:
        """Arc lengths [m] of eight places per element, the candidates of `nearest`."""
        return np.linspace(0.0, self.length, 8 * self.n + 1)

    @property
    def _table(self) -> FloatArray:
        return interpolant(smooth=self.slopes is not None)

    def _local(self, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Element index (K,) and the fraction (K,) of its length at s [m]."""
        if self.knots is None:
            u = s * (self.n / self.length)
            e = np.minimum(np.maximum(u.astype(np.intp), 0), self.n - 1)
            return e, u - e
        at = self.knots[0] + s * self._between
        e = np.searchsorted(self.knots[1:-1], at, side="right")
        return e, (at - self.knots[e]) / self._sizes[e]

    @cached_property
    def _sizes(self) -> FloatArray:
        """Arc lengths (n,) [m] of the elements on the cable."""
        if self.knots is None:
            return np.full(self.n, self.length / self.n)
        return np.diff(self.knots)

    @property
    def _between(self) -> float:
        """Arc length between the ends over `length`."""
        return 1.0 if self.knots is None else float(self.knots[-1] - self.knots[0]) / self.length

    @cached_property
    def _polynomials(self) -> FloatArray:
        """Coefficients (4, d, n) of the positions in each element, by powers of u."""
        slopes, h = self.nodes if self.slopes is None else self.slopes, self._sizes[:, None]
        handles = [self.nodes[:-1], self.nodes[1:], slopes[:-1] * h, slopes[1:] * h]
        return np.ascontiguousarray((self._table @ np.stack(handles, axis=1)).transpose(1, 2, 0))

    def frame(self, s: FloatArray, derivatives: int) -> list[FloatArray]:
        """Position (K, d) [m] and its first derivatives by s, at most two, at arc lengths s."""
        e, u = self._local(s)
        once, by_u, square, cube = self._polynomials.take(e, axis=2)
        found, scale = [((cube * u + square) * u + by_u) * u + once], self._between / self._sizes[e]
        if derivatives > 0:
            found.append(scale * ((3 * cube * u + 2 * square) * u + by_u))
        if derivatives > 1:
            found.append(2 * scale**2 * (3 * cube * u + square))
        return [one.T for one in found]

    def at(self, s: FloatArray, derivative: int = 0) -> FloatArray:
        """Positions (K, d) [m] at arc lengths s, or derivatives by s."""
        return self.frame(s, derivative)[derivative]

    def moved(
        self,
        s: FloatArray,
        change: FloatArray,
        knots: FloatArray | None = None,
        *,
        marked: bool = False,
    ) -> FloatArray:
        """Change (K, d, q) [m] at fixed s, from the change (n + 1, d or 2 d, q) of `numbers`.

        Also from the change (n + 1, q) [m] of the `knots`; or, if `marked`, the change of the
        points of the cable that are at s now.
        """
        e, u = self._local(s)
        w = (np.vander(u, 4, increasing=True) @ self._table)[:, :, None, None]
        out = w[:, 0] * change[e, : self.d] + w[:, 1] * change[e + 1, : self.d]
        h = self._sizes[e][:, None, None]
        if self.slopes is not None:
            out += h * (w[:, 2] * change[e, self.d :] + w[:, 3] * change[e + 1, self.d :])
        if knots is not None and self.knots is not None:
            share = (s / self.length)[:, None]
            goes = 0.0 if marked else (1 - share) * knots[0] + share * knots[-1]
            longer = knots[e + 1] - knots[e]
            passed = (goes - knots[e] - u[:, None] * longer) / self._between
            out += self.at(s, 1)[..., None] * passed[:, None]
            if self.slopes is not None:
                first, last = self.slopes[e][..., None], self.slopes[e + 1][..., None]
                out += (w[:, 2] * first + w[:, 3] * last) * longer[:, None]
        return np.asarray(out)

    def followed(
        self, guess: FloatArray, step: Callable[[FloatArray], FloatArray], tolerance: float
    ) -> FloatArray:
        """Arc lengths (K,) [m] after Newton steps from a guess, within [0, L].

        No step is longer than half an element; the last is below `tolerance` times the length. If
        the curve is not finite, which may happen in a fit, the guess is returned.
        """
        s, limit = guess.copy(), 0.5 * self.length / self.n
        for _ in range(_NEWTON_STEPS):
            change = step(s)
            change = np.where(np.isnan(change), 0.0, np.minimum(np.maximum(change, -limit), limit))
            new = np.minimum(np.maximum(s + change, 0.0), self.length)
            done = np.abs(new - s).max() < tolerance * self.length
            s = new
            if done:
                break
        return s

    def projections(self, points: FloatArray, guess: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] of the points' projections, by Newton steps from a guess.

        Solves t . (x - r(s)) = 0; a projection stays within [0, L].
        """

        def step(s: FloatArray) -> FloatArray:
            position, t, bend = self.frame(s, 2)
            gap = points - position
            square = (t * t).sum(axis=1)
            curvature = np.maximum(square - (bend * gap).sum(axis=1), 0.2 * square)
            return np.asarray((t * gap).sum(axis=1) / curvature)

        return self.followed(guess, step, 1e-8)

    def nearest(self, points: FloatArray) -> FloatArray:
        """Arc lengths (K,) [m] of the nearest places on the whole curve."""
        line = self.at(self.grid)
        # Squared distances minus the squared norms of the points.
        square = (line**2).sum(axis=1) - 2 * points @ line.T
        return self.projections(points, self.grid[square.argmin(axis=1)])

    def tangents(self, s: FloatArray) -> FloatArray:
        """Unit tangents (K, d) at arc lengths s [m]."""
        return unit(self.at(s, 1))

    def normals(self, s: FloatArray) -> FloatArray:
        """Unit normals (K, d - 1, d), see `across`."""
        return across(self.tangents(s))

    def distances(self, points: FloatArray) -> FloatArray:
        """Distance (K,) [m] of each point to the nearest place on the curve."""
        return np.linalg.norm(points - self.at(self.nearest(points)), axis=1)


def between(s: FloatArray, ends: Sequence[float] | FloatArray, length: float) -> FloatArray:
    """Arc lengths s on a cable as shares of what is between its `ends` (2,) [m], times a length."""
    return np.asarray((s - ends[0]) * (length / (ends[1] - ends[0])))


def across(t: FloatArray) -> FloatArray:
    """Unit normals (K, d - 1, d) of tangents (K, d); in the plane, to their left.

    In space the pair of normals is transported from each point to the next without twist.
    """
    if t.shape[1] == 2:
        return np.stack([-t[:, 1], t[:, 0]], axis=1)[:, None]
    first = np.eye(3)[np.abs(t).argmin(axis=1)]
    first = first - (first * t).sum(axis=1, keepdims=True) * t
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = cross(t, first)
    # The first normal of each point, carried to the next by the smallest rotation.
    before, ahead, near = first[:-1], t[1:], 1 + (t[:-1] * t[1:]).sum(axis=1)
    share = (ahead * before).sum(axis=1) / np.maximum(near, 1e-12)
    carried = before - share[:, None] * (t[:-1] + ahead)
    turn = np.arctan2((carried * second[1:]).sum(axis=1), (carried * first[1:]).sum(axis=1))
    angle = np.concatenate([[0.0], np.cumsum(turn)])[:, None]
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * first + sin * second, cos * second - sin * first], axis=1)


def chord_places(points: FloatArray, pose: HeldPose, length: float) -> FloatArray:
    """First guess of the points' arc lengths (K,) [m]: running chord length, scaled to L.

    Chords are shorter than the cable across gaps: with two fixtures, they are scaled to L.
    """
    # Noise lengthens a dense polyline, so lengths are those of a smoothed one.
    s = denoised_length(pose.joined(points))
    places = s[1 : len(points) + 1]
    if pose.end is not None:
        places = places * (length / s[-1])
    return np.clip(places, 0.0, length)


def denoised_length(polyline: FloatArray) -> FloatArray:
    """Cumulative length of the polyline smoothed over about 1/50 of itself."""
    s = chord_lengths(polyline)
    total = np.linalg.norm(np.diff(polyline, axis=0), axis=1).sum()
    width = max(total / 50, 1e-12)
    knots = np.linspace(0.0, total, 51)
    kernel = np.exp(-0.5 * ((knots[:, None] - s[None]) / (0.5 * width)) ** 2)
    norm = kernel.sum(axis=1, keepdims=True)
    smooth = np.where(norm > 1e-9, kernel @ polyline / np.maximum(norm, 1e-9), np.nan)
    straight = np.stack([np.interp(knots, s, column) for column in polyline.T], axis=1)
    smooth = np.where(np.isfinite(smooth), smooth, straight)
    smooth[0], smooth[-1] = polyline[0], polyline[-1]
    return np.interp(s, knots, chord_lengths(smooth))


@dataclass(frozen=True)
class Observed:
    """Predicted measurements of one pose: its curve, and `readings` (n_reactions,) [N, N m].

    Readings are the forces and moments on the fixtures as sensors measure them, see
    `ends.reaction_rows`.
    """

    curve: NodeCurve
    readings: FloatArray


@dataclass(frozen=True)
class ObservedChange:
    """Change of an `Observed` along q directions.

    `curve` (n + 1, d or 2 d, q), `readings` (n_reactions, q); `knots` (n + 1, q) [m] of the curve,
    where nodes are moved to clips, or the cable is fed.
    """

    curve: FloatArray
    readings: FloatArray
    knots: FloatArray | None = None


def curves_of(found: Assembly, rows: FloatArray | None = None) -> list[NodeCurve]:
    """Measured curves of m shapes; `rows`: their `Assembly.curve` if it is known."""
    length = found.model.cable.length
    knots = found.clipped.places if found.model.moves_nodes else repeat(None)
    rows = found.curve() if rows is None else rows
    return [NodeCurve.of(length, z, own) for z, own in zip(rows, knots, strict=False)]
