"""How fixtures move from one pose to another: splines, smooth to the third derivative.

Each coordinate of a place or of a turn goes from a to b in the time T,

    x(t) = a + (b - a) s(t / T) + sum_j theta_j B_j(t / T)

with B-splines B_j of fifth order that vanish at both ends with three derivatives; s is their sum
from the middle of the last ones, so that speed, acceleration and jerk begin and end with zero.
Turns are rotation vectors about the axes of the first pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.motion.sensitivities import Numbers
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.system import MovingCable

DEGREE = 5
# Coefficients that are fixed at each end: place, speed, acceleration and jerk.
_FIXED = 4
# Intervals of the splines: nine free coefficients for each coordinate, two for each of four modes.
INTERVALS = 12
# Turn [rad] or distance [lengths] below which a coordinate rests.
_RESTS = 1e-9
# Points of Gauss in each interval, exact for the effort.
_GAUSS = 3


class Part(NamedTuple):
    """A place or a direction of a fixture that moves: its side (0 start, 1 end), from, to."""

    side: int
    turns: bool
    first: FloatArray
    last: FloatArray

    @property
    def name(self) -> str:
        """Key of the coordinates in a table."""
        return ("start", "end")[self.side] + ("_frame" if self.turns else "")


@dataclass(frozen=True, eq=False)
class Course:
    """Where fixtures are at each time, by coefficients theta (C intervals - 3,).

    Parameters
    ----------
    before, after : HeldPose
    duration : float [s]
    parts : tuple of Part
        What moves.
    """

    before: HeldPose
    after: HeldPose
    duration: float
    parts: tuple[Part, ...]

    @classmethod
    def between(cls, before: HeldPose, after: HeldPose, duration: float) -> Course:
        """The course whose places and directions move that differ between both poses."""
        node, parts = before.node, []
        for side in (0, 1):
            places = [np.array(getattr(x, ("start", "end")[side]) or ()) for x in (before, after)]
            place = Part(side, False, *places)
            rotations = [node.rotations(x.frames[side][None])[0] for x in (before, after)]
            turn = (rotations[0].inv() * rotations[1]).as_rotvec()
            if node.increment == 1:
                turn = after.frames[side] - before.frames[side]
            for part in (place, Part(side, True, np.zeros_like(turn), turn)):
                if np.abs(part.last - part.first).max(initial=0.0) > _RESTS:
                    parts.append(part)
        return cls(before, after, duration, tuple(parts))

    # ---- coordinates -----------------------------------------------------------------------------

    @cached_property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """First and last values (C,) of the coordinates."""
        first, last = ([getattr(part, x) for part in self.parts] for x in ("first", "last"))
        return np.concatenate(first), np.concatenate(last)

    @property
    def count(self) -> int:
        """Number of coordinates."""
        return len(self.ends[0])

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.count * self._free

    @property
    def _free(self) -> int:
        return INTERVALS + DEGREE - 2 * _FIXED

    @cached_property
    def _splines(self) -> BSpline:
        inner = np.linspace(0.0, 1.0, INTERVALS + 1)
        knots = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])
        return BSpline(knots, np.eye(INTERVALS + DEGREE), DEGREE)

    def weights(self, t: FloatArray | float, order: int = 0) -> tuple[FloatArray, FloatArray]:
        """Derivatives (...,) of s, and (..., free) of the splines, by time at times t."""
        u = np.clip(np.asarray(t, dtype=float) / self.duration, 0.0, 1.0)
        rows = self._splines(u, order) / self.duration**order
        if order:
            outside = (np.asarray(t) < 0) | (np.asarray(t) > self.duration)
            rows = np.where(outside[..., None], 0.0, rows)
        return rows[..., -_FIXED:].sum(axis=-1), rows[..., _FIXED:-_FIXED]

    def values(self, theta: FloatArray, t: FloatArray | float, order: int = 0) -> FloatArray:
        """Coordinates (..., C), or their derivatives by time."""
        step, rows = self.weights(t, order)
        first, last = self.ends
        way = step[..., None] * (last - first) + rows @ theta.reshape(self.count, -1).T
        return np.asarray(way + first if order == 0 else way)

    @property
    def columns(self) -> list[list[int]]:
        """Numbers of the coordinates of each part."""
        return [[int(x) for x in own] for own in self.parts_of(np.arange(float(self.count)))]

    def parts_of(self, values: FloatArray) -> list[FloatArray]:
        """Coordinates (..., C) of each part."""
        edges = np.cumsum([len(part.first) for part in self.parts])[:-1]
        return np.split(values, edges, axis=-1)

    # ---- effort ----------------------------------------------------------------------------------

    @cached_property
    def effort(self) -> tuple[FloatArray, FloatArray, float]:
        """H (size, size), g (size,) and c: the integral of the jerk's square is q(theta).

        q = theta' H theta / 2 + g' theta + c, relative to that of least jerk. A turn of one radian
        counts as much as the longest way of a place.
        """
        nodes, weights = np.polynomial.legendre.leggauss(_GAUSS)
        edges = np.arange(INTERVALS)[:, None]
        t = ((edges + (nodes + 1) / 2) / INTERVALS).ravel() * self.duration
        w = np.tile(weights / 2 / INTERVALS, INTERVALS)
        step, rows = self.weights(t, 3)
        own = rows.T @ (w[:, None] * rows)
        first, last = self.ends
        scale = self._scales**-2
        linear = np.outer(scale * (last - first), rows.T @ (w * step))
        constant = float((scale * (last - first) ** 2).sum() * (w @ step**2))
        hessian = np.kron(np.diag(scale), own)
        rows = linear.ravel()
        least = constant - float(rows @ np.linalg.solve(hessian, rows))
        return 2 * hessian / least, 2 * rows / least, constant / least

    @cached_property
    def _scales(self) -> FloatArray:
        """What counts as much of each coordinate (C,): one metre, or a turn [rad]."""
        own = [np.linalg.norm(x.last - x.first) for x in self.parts if not x.turns]
        longest = max(own, default=0.0) or 1.0
        turn = 1.0 / longest if any(own) else 1.0
        return np.concatenate([np.full(len(x.first), turn if x.turns else 1.0) for x in self.parts])

    @cached_property
    def least_jerk(self) -> FloatArray:
        """Coefficients (size,) of least effort."""
        hessian, linear, _ = self.effort
        return -np.linalg.solve(hessian, linear)

    # ---- for the equations of motion -------------------------------------------------------------

    def fixtures(self, cable: MovingCable, theta: FloatArray, t: float) -> Fixtures:
        """The fixtures at a time; they rest before 0 and after the duration."""
        pose, d = self.before.vector, cable.d
        rates = np.zeros((2, 2, d))
        orders = [self.parts_of(self.values(theta, t, k)) for k in range(3)]
        for part, *values in zip(self.parts, *orders, strict=True):
            if part.turns:
                c = cable.model.node.coordinates
                at = slice(2 * d + c * part.side, 2 * d + c * (part.side + 1))
                pose[at] = self._frames(part, values[0][None])[0]
            else:
                pose[d * part.side : d * (part.side + 1)] = values[0]
                rates[:, part.side] = values[1:]
        return cable.fixtures(pose, *rates)

    def _frames(self, part: Part, turns: FloatArray) -> FloatArray:
        """Frames (N, coordinates) of a part at turns (N, increment)."""
        first = self.before.frames[part.side]
        if turns.shape[1] == 1:
            return first + turns
        rotations = Rotation.from_quat(first) * Rotation.from_rotvec(turns)
        return np.asarray(rotations.as_quat())

    def numbers(self, cable: MovingCable, theta: FloatArray, t: float) -> Numbers:
        """Derivatives of what the cable is given by theta."""
        b, d, q = cable.b, cable.d, self.size
        turns, moved = np.zeros((2 * b, q)), np.zeros((3, 2, d, q))
        values = self.parts_of(self.values(theta, t))
        rows = [self.weights(t, order)[1] for order in range(3)]
        columns = self.columns
        for part, value, own in zip(self.parts, values, columns, strict=True):
            for k, coordinate in enumerate(own):
                at = slice(coordinate * self._free, (coordinate + 1) * self._free)
                if part.turns:
                    by = _right_jacobian(value)[:, k] if b > 1 else np.ones(1)
                    turns[b * part.side : b * (part.side + 1), at] = np.outer(by, rows[0])
                else:
                    moved[:, part.side, k, at] = rows
        p, rest = np.zeros((len(cable.p), q)), np.zeros((*cable.numbers[1].shape, q))
        return Numbers(p, rest, turns, *moved)

    # ---- tables ----------------------------------------------------------------------------------

    def rows_of(self, values: FloatArray) -> dict[str, FloatArray]:
        """Rows by name of coordinates (N, C)."""
        parts = zip(self.parts, self.parts_of(values), strict=True)
        return {part.name: self._frames(part, x) if part.turns else x for part, x in parts}


def _right_jacobian(turn: FloatArray) -> FloatArray:
    """Turn about the body's own axes by a change of a rotation vector (3, 3)."""
    size = float(np.linalg.norm(turn))
    x, y, z = turn
    around = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if size < 1e-6:
        return np.asarray(np.eye(3) - around / 2)
    first, second = (1 - np.cos(size)) / size**2, (size - np.sin(size)) / size**3
    return np.asarray(np.eye(3) - first * around + second * around @ around)
