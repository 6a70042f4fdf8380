"""The way of the fixtures: places and directions of the ends as functions of time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from dlo_casadi.arrays import BoolArray, FloatArray
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.quaternions import same_sign

# Time [s] over which a turn is taken for its rate.
_INSTANT = 1e-6
# Shortest distance in time of rows that tell a velocity, over that of the last two.
_EVEN = 0.4


@dataclass(frozen=True, eq=False)
class FixturePath:
    """Fixtures that move smoothly: cubic splines, twice differentiable, through given rows.

    Parameters
    ----------
    pose : HeldPose
        What rests, and all that does not move.
    moving : dict of CubicSpline or CubicHermiteSpline
        Of "start", "end" [m], "start_frame", "end_frame" (coordinates of a node), those that move.
    """

    pose: HeldPose
    moving: Mapping[str, Any]

    @classmethod
    def of(cls, pose: HeldPose, t: FloatArray, rows: Mapping[str, FloatArray]) -> FixturePath:
        """A path through rows (T, ...) at times t (T,) [s]; with one row a fixture rests."""
        rows = _continuous(rows)
        return cls(pose, {k: CubicSpline(t, x) for k, x in rows.items() if len(t) > 1})

    @classmethod
    def of_last(cls, pose: HeldPose, t: FloatArray, rows: Mapping[str, FloatArray]) -> FixturePath:
        """The same from the last time but one to the last, while rows arrive.

        A cubic between both rows; their velocities are those of parabolas through the rows until
        then, so that a way that goes on, row by row, has no jumps of velocity.
        """
        ends = {
            k: CubicHermiteSpline(t[-2:], x[-2:], [_rate(t[:-1], x[:-1]), _rate(t, x)])
            for k, x in _continuous(rows).items()
        }
        return cls(pose, ends)

    def rates(self, t: FloatArray, order: int) -> FloatArray:
        """Derivatives (T, 2, d) by time of the places of start and end; zero outside the rows."""
        found = np.zeros((len(t), 2, self.pose.node.dimension))
        for k, side in enumerate(("start", "end")):
            if (spline := self.moving.get(side)) is not None:
                inside = _inside(spline, t)
                found[inside, k] = spline(t[inside], order)
        return found

    def turning(self, t: FloatArray) -> FloatArray:
        """Rates of turning (T, 2 increment) [rad/s] of the fixtures about their own axes."""
        node, parts = self.pose.node, []
        for name in ("start_frame", "end_frame"):
            turns = np.zeros((len(t), node.increment))
            if (spline := self.moving.get(name)) is not None:
                inside = _inside(spline, t)
                frame = node.normalised(spline(t[inside]))
                ahead = node.normalised(spline(t[inside]) + _INSTANT * spline(t[inside], 1))
                turns[inside] = np.asarray(node.difference(frame, ahead)) / _INSTANT
            parts.append(turns)
        return np.hstack(parts)

    def at(self, t: float, cable: MovingCable) -> Fixtures:
        """The fixtures at a time [s]; before the first row and after the last they rest."""
        (pose,), (rates,) = self.declared(np.array([t]))
        return cable.fixtures(pose, *rates)

    def declared(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Declared poses (T, n_pose) at times; rates of the places, once and twice (T, 2, 2, d)."""
        node, d = self.pose.node, self.pose.node.dimension
        rates = np.stack([self.rates(t, 1), self.rates(t, 2)], axis=1)
        pose = np.tile(self.pose.vector, (len(t), 1))
        if self.moving:
            known = next(iter(self.moving.values())).x
            t = np.clip(t, known[0], known[-1])
        for k, (side, frame) in enumerate(zip(("start", "end"), self.pose.frames, strict=True)):
            if side in self.moving:
                pose[:, k * d : (k + 1) * d] = self.moving[side](t)
            at = 2 * d + k * node.coordinates
            spline = self.moving.get(f"{side}_frame")
            given = frame if spline is None else node.normalised(spline(t))
            pose[:, at : at + node.coordinates] = given
        return pose, rates


def _continuous(rows: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Rows whose quaternions have no jumps of sign."""
    turned = {k: same_sign(x) for k, x in rows.items() if k.endswith("frame") and x.shape[1] == 4}
    return {**rows, **turned}


def _rate(t: FloatArray, rows: FloatArray) -> FloatArray:
    """Rate of rows (T, k) at the last time, by a parabola; zero of a single row.

    Its rows are about as far apart as the last two: through uneven ones it overshoots.
    """
    chosen = [len(t) - 1]
    for k in range(len(t) - 2, -1, -1):
        if len(chosen) < 3 and t[chosen[-1]] - t[k] > _EVEN * (t[-1] - t[-2]):
            chosen.append(k)
    if len(chosen) == 1:
        return np.zeros(rows.shape[1])
    powers = np.vander(t[chosen] - t[-1], len(chosen), increasing=True)
    return np.asarray(np.linalg.solve(powers, rows[chosen])[1])


def _inside(spline: Any, t: FloatArray) -> BoolArray:
    return np.asarray((t >= spline.x[0]) & (t <= spline.x[-1]))
