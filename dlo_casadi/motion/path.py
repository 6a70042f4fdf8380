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

    def at(self, t: float, cable: MovingCable) -> Fixtures:
        """The fixtures at a time [s]."""
        node, d = self.pose.node, self.pose.node.dimension
        pose, rates = self.pose.vector, np.zeros((2, 2, d))
        frames = dict(zip(("start_frame", "end_frame"), self.pose.frames, strict=True))
        for k, side in enumerate(("start", "end")):
            if side in self.moving:
                spline = self.moving[side]
                pose[k * d : (k + 1) * d] = spline(t)
                rates[:, k] = spline(t, 1), spline(t, 2)
            if (name := f"{side}_frame") in self.moving:
                frames[name] = node.normalised(self.moving[name](t))
            at = 2 * d + k * node.coordinates
            pose[at : at + node.coordinates] = frames[name]
        return cable.fixtures(pose, *rates)
