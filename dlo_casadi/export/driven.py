"""Fixtures that move, as controls of joints that drive them along."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self, get_args

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import DloError
from dlo_casadi.rod.node import Node

# Smallest way [m] or turn [rad] that is a motion.
_RESTS = 1e-9
# Largest second angle [rad] of three successive turns: at a right angle the third is the first.
_GIMBAL = 1.4
_Order = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]
_ORDERS: tuple[_Order, ...] = get_args(_Order)


class Carriage(NamedTuple):
    """The joints of a fixture: slides along the world's axes, then turns about its own.

    axes : str, of the turns in their order; places (T, 3) [m] and angles (T, 3) [rad] are changes
    from the first row.
    """

    places: FloatArray
    axes: str
    angles: FloatArray

    @property
    def turns(self) -> bool:
        """Whether the fixture turns at all."""
        return bool(np.ptp(self.angles, axis=0).max() > _RESTS)


@dataclass(frozen=True, eq=False)
class Driven:
    """Fixtures at equal steps of time.

    Parameters
    ----------
    step : float [s]
    carriages : dict of Carriage
        Of "start" and "end", those that move.
    """

    step: float
    carriages: dict[str, Carriage]

    @classmethod
    def of(cls, node: type[Node], step: float, poses: FloatArray) -> Self:
        """From rows (T, n_pose) of declared poses.

        Raises DloError if nothing moves, or if a fixture turns too far about two axes.
        """
        d, c, found = node.dimension, node.coordinates, {}
        for k, side in enumerate(("start", "end")):
            places = np.zeros((len(poses), 3))
            places[:, :d] = poses[:, k * d : (k + 1) * d] - poses[0, k * d : (k + 1) * d]
            frames = node.rotations(poses[:, 2 * d + k * c : 2 * d + (k + 1) * c])
            carriage = Carriage(places, *_angles(side, frames[:1].inv() * frames))
            if carriage.turns or np.abs(places).max() > _RESTS:
                found[side] = carriage
        if not found:
            raise DloError("motion: no fixture moves in it")
        return cls(step, found)

    @property
    def names(self) -> list[str]:
        """Names of the joints, in order."""
        rows = [
            [*(f"{side}_{x}" for x in "xyz"), *(f"{side}_turn_{x}" for x in one.axes * one.turns)]
            for side, one in self.carriages.items()
        ]
        return [name for own in rows for name in own]

    def controls(self, rate: float) -> FloatArray:
        """What to ask of the joints (T, J), so that they follow without lag.

        A joint with the inertia m, held by the stiffness m rate^2 and the damping 2 m rate, obeys
        q'' + 2 rate q' + rate^2 q = rate^2 u: asked is u = q + 2 q' / rate + q'' / rate^2.
        """
        rows = [np.hstack([x.places, x.angles][: 1 + x.turns]) for x in self.carriages.values()]
        q = np.hstack(rows)
        spline = CubicSpline(self.step * np.arange(len(q)), q)
        t = spline.x
        return np.asarray(q + 2 / rate * spline(t, 1) + spline(t, 2) / rate**2)


def _angles(side: str, turned: Rotation) -> tuple[str, FloatArray]:
    """Axes and angles (T, 3) of three successive turns, in the order farthest from gimbal lock."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an order in gimbal lock is not taken
        found = [(turned.as_euler(axes), axes.lower()) for axes in _ORDERS]
    angles, axes = min(found, key=lambda item: np.abs(item[0][:, 1]).max())
    if np.abs(angles[:, 1]).max() > _GIMBAL:
        raise DloError(
            f"motion: the {side} turns by more than {_GIMBAL} rad about each of its axes.\n"
            "  Try: two motions, one after the other"
        )
    return axes, np.unwrap(angles, axis=0)
