"""A rod of straight segments in IPOPT, which shares nothing with the package but CasADi.

    min sum_i h_i / 2 (k_i - k0_i)^T diag(GJ, EI, EI) (k_i - k0_i) + weight
    s.t. sum_i h t_i = end - start,   |q_i| = 1,   k_i = 2 vec(conj(q_i) q_(i+1)) / h_i

Each segment has a unit quaternion q (x, y, z, w) whose first axis is its direction t. A clamp is
one more frame, half a segment away; of a swivel that frame may roll.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.floating]

# Energy, over the stiffness by the length, below which two solutions are one equilibrium.
SAME = 1e-6
X = np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Ends:
    """Where a rod is held: places (3,) [m], and frames of clamps (quaternions) or None.

    `turns`: twist by which the end clamp is turned beyond the frames without twist, to half a turn.
    """

    start: FloatArray
    end: FloatArray
    frames: tuple[FloatArray, FloatArray] | None = None
    turns: float = 0.0


@dataclass(frozen=True)
class SegmentRod:
    """A rod: length [m], weight (3,) [N] of it all, stiffnesses [N m^2], rest curvature [1/m].

    `rest`: (2, n) about the axes y and z in the middle of each of n segments. `rolls`: whether the
    rod may roll in the clamp of its start, of its end.
    """

    length: float
    weight: FloatArray
    bending: float
    torsion: float
    rest: FloatArray
    clamped: bool = False
    rolls: tuple[bool, bool] = (False, False)

    @property
    def _n(self) -> int:
        return self.rest.shape[1]

    @cached_property
    def _solver(self) -> ca.Function:
        n, h = self._n, self.length / self._n
        q, clamps, chord = ca.SX.sym("q", 4, n), ca.SX.sym("clamps", 4, 2), ca.SX.sym("chord", 3)
        tangents = [_direction(q[:, i]) for i in range(n)]
        places = (np.arange(n) + 0.5) * h
        joints = [(q[:, i], q[:, i + 1], h, (i + 1) * h) for i in range(n - 1)]
        rolled, half = [clamps[:, 0], clamps[:, 1]], ca.SX.sym("half_roll", sum(self.rolls))
        for own, side in zip(ca.vertsplit(half), np.flatnonzero(self.rolls), strict=False):
            rolled[side] = _rolled(rolled[side], own)
        if self.clamped:
            joints.append((rolled[0], q[:, 0], h / 2, h / 4))
            joints.append((q[:, -1], rolled[1], h / 2, self.length - h / 4))
        energy = ca.SX(0)
        for first, last, width, place in joints:
            rest = [0.0, *(np.interp(place, places, row) for row in self.rest)]
            bend = 2 * _conjugate_product(first, last) / width - ca.DM(rest)
            energy += width / 2 * (self.torsion * bend[0] ** 2 + self.bending * ca.sumsqr(bend[1:]))
        for i, tangent in enumerate(tangents):  # the weight of all beyond hangs on each segment
            energy -= (n - i - 0.5) / n * h * ca.dot(ca.DM(self.weight), tangent)
        reached = sum(tangents, ca.SX.zeros(3)) * h - chord
        units = ca.sum1(q**2).T - 1
        problem = {
            "x": ca.vertcat(ca.vec(q), half),
            "p": ca.vertcat(ca.vec(clamps), chord),
            "f": energy / self._scale,
            "g": ca.vertcat(reached / self.length, units),
        }
        options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        options |= {"ipopt.tol": 1e-10, "ipopt.max_iter": 300}
        return ca.nlpsol("rod", "ipopt", problem, options)

    @property
    def _scale(self) -> float:
        return self.bending / self.length

    def shape(self, ends: Ends, starts: int, gap: float) -> FloatArray | None:
        """Nodes (n + 1, 3) of the lowest of the equilibria found from several starts.

        None if none is found twice, or if another one is less than `gap` EI / L above it.
        """
        found = [one for k in range(starts) if (one := self._from(ends, k / starts)) is not None]
        found.sort(key=lambda one: one[0])
        if len(found) < 2 or found[1][0] - found[0][0] > SAME:
            return None
        others = [energy for energy, _ in found if energy - found[0][0] > SAME]
        if others and others[0] - found[0][0] < gap:
            return None
        steps = Rotation.from_quat(found[0][1]).apply(X) * self.length / self._n
        return ends.start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def energy(self, ends: Ends, starts: int) -> float:
        """Least energy [J] of the equilibria found from several starts; infinite without any."""
        found = [one for k in range(starts) if (one := self._from(ends, k / starts)) is not None]
        return min((energy for energy, _ in found), default=np.inf) * self._scale

    def _from(self, ends: Ends, side: float) -> tuple[float, FloatArray] | None:
        """Energy over its scale and quaternions, from an arc bulging to a side [turns]."""
        chord, u = ends.end - ends.start, (np.arange(self._n) + 0.5) / self._n
        ratio = float(np.linalg.norm(chord)) / self.length
        half = float(np.interp(-ratio, *_arcs()))
        along, _ = Rotation.align_vectors([chord], [X])
        frames = along * Rotation.from_rotvec(2 * np.pi * side * X)
        frames = frames * Rotation.from_rotvec(np.outer(half * (1 - 2 * u), [0.0, 0.0, 1.0]))
        clamps = np.zeros((2, 4))
        if ends.frames is None:
            # The roll about the axis goes round another way than the arc about its chord.
            frames = frames * Rotation.from_rotvec(2 * np.pi * 3 * side * X)
        else:
            both = [Rotation.from_quat(frame) for frame in ends.frames]
            for k in np.flatnonzero(self.rolls):  # begins without twist
                x, _, _, w = (frames[-k].inv() * both[k]).as_quat()
                both[k] = both[k] * Rotation.from_rotvec(-2 * np.arctan2(x, w) * X)
            first, last = both
            x, _, _, w = (frames[0].inv() * first).as_quat()
            begin = 2 * np.arctan2(x, w)
            x, _, _, w = (frames[-1].inv() * last).as_quat()
            left = 2 * np.arctan2(x, w) - begin
            left += 2 * np.pi * np.round(ends.turns - left / (2 * np.pi))
            frames = frames * Rotation.from_rotvec(np.outer(begin + left * u, X))
        q = frames.as_quat()
        q = q * np.cumprod(np.where((q * np.roll(q, 1, axis=0)).sum(1) < 0, -1, 1))[:, None]
        if ends.frames is not None:
            clamps = np.array([first.as_quat(), last.as_quat()])
            clamps *= np.sign((clamps * q[[0, -1]]).sum(1))[:, None]
        x0 = np.append(q.ravel(), np.zeros(sum(self.rolls)))
        found = self._solver(x0=x0, p=[*clamps.ravel(), *chord], lbg=0.0, ubg=0.0)
        if not self._solver.stats()["success"]:
            return None
        return float(found["f"]), np.array(found["x"])[: q.size].reshape(-1, 4)

    def points(self, nodes: FloatArray, s: FloatArray) -> FloatArray:
        """Points (K, 3) at arc lengths on the smooth curve through the nodes."""
        return np.asarray(CubicSpline(np.linspace(0.0, self.length, len(nodes)), nodes)(s))


def _direction(q: ca.SX) -> ca.SX:
    x, y, z, w = q[0], q[1], q[2], q[3]
    return ca.vertcat(w**2 + x**2 - y**2 - z**2, 2 * (x * y + w * z), 2 * (x * z - w * y))


def _rolled(q: ca.SX, half: ca.SX) -> ca.SX:
    """A frame rolled about its first axis by twice that angle [rad]."""
    s, c = ca.sin(half), ca.cos(half)
    return ca.vertcat(
        q[3] * s + q[0] * c, q[1] * c + q[2] * s, q[2] * c - q[1] * s, q[3] * c - q[0] * s
    )


def _conjugate_product(a: ca.SX, b: ca.SX) -> ca.SX:
    """Vector part of conj(a) b."""
    return a[3] * b[:3] - b[3] * a[:3] - ca.cross(a[:3], b[:3])


def _arcs() -> tuple[FloatArray, FloatArray]:
    """Minus chord over length, and half the turning angle, of circular arcs."""
    half = np.linspace(1e-3, np.pi, 500)
    return -np.sin(half) / half, half
