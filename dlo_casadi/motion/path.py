"""The way of the fixtures: places and directions of the ends as functions of time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.motion.state import Fixtures
from dlo_casadi.motion.system import MovingCable
from dlo_casadi.rod.quaternions import same_sign

# Time [s] over which a turn is taken for its rate.
_INSTANT = 1e-6


@dataclass(frozen=True, eq=False)
class FixturePath:
    """Fixtures that move smoothly: cubic splines, twice differentiable, through given rows.

    Parameters
    ----------
    pose : HeldPose
        What rests, and all that does not move.
    moving : dict of CubicSpline
        Of "start", "end" [m], "start_frame", "end_frame" (coordinates of a node), those that move.
    """

    pose: HeldPose
    moving: Mapping[str, Any]

    @classmethod
    def of(cls, pose: HeldPose, t: FloatArray, rows: Mapping[str, FloatArray]) -> FixturePath:
        """A path through rows (T, ...) at times t (T,) [s]; with one row a fixture rests."""
        rows = {
            k: same_sign(x) if k.endswith("frame") and x.shape[1] == 4 else x
            for k, x in rows.items()
        }
        return cls(pose, {k: CubicSpline(t, x) for k, x in rows.items() if len(t) > 1})

    def rates(self, t: float, order: int) -> FloatArray:
        """Derivatives (2, d) by time of the places of start and end; zero outside the rows."""
        found = np.zeros((2, self.pose.node.dimension))
        for k, side in enumerate(("start", "end")):
            spline = self.moving.get(side)
            if spline is not None and spline.x[0] <= t <= spline.x[-1]:
                found[k] = spline(t, order)
        return found

    def turning(self, t: float) -> FloatArray:
        """Rates of turning (2 increment,) [rad/s] of the fixtures about their own axes."""
        node, parts = self.pose.node, []
        for name in ("start_frame", "end_frame"):
            spline = self.moving.get(name)
            if spline is None or not spline.x[0] <= t <= spline.x[-1]:
                parts.append(np.zeros(node.increment))
                continue
            frame = node.normalised(spline(t))
            ahead = node.normalised(spline(t) + _INSTANT * spline(t, 1))
            parts.append(np.asarray(node.difference(frame, ahead)) / _INSTANT)
        return np.concatenate(parts)

    def at(self, t: float, cable: MovingCable) -> Fixtures:
        """The fixtures at a time [s]; before the first row and after the last they rest."""
        pose, rates = self.declared(t)
        return cable.fixtures(pose, *rates)

    def declared(self, t: float) -> tuple[FloatArray, FloatArray]:
        """The declared pose (n_pose,) at a time; rates of the places, once and twice (2, 2, d)."""
        node, d = self.pose.node, self.pose.node.dimension
        pose, rates = self.pose.vector, np.array([self.rates(t, 1), self.rates(t, 2)])
        frames = dict(zip(("start_frame", "end_frame"), self.pose.frames, strict=True))
        if self.moving:
            known = next(iter(self.moving.values())).x
            t = float(np.clip(t, known[0], known[-1]))
        for k, side in enumerate(("start", "end")):
            if side in self.moving:
                pose[k * d : (k + 1) * d] = self.moving[side](t)
            if (name := f"{side}_frame") in self.moving:
                frames[name] = node.normalised(self.moving[name](t))
            at = 2 * d + k * node.coordinates
            pose[at : at + node.coordinates] = frames[name]
        return pose, rates
