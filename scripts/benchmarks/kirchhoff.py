"""Kirchhoff's equations of a rod, from the literature: nothing here is the package's own.

    r' = R e_x,   R' = R [k]_x,   n' = -f,   m' = -k x m - e_x x R^T n,   m = B (k - k_0)

n in the world, k and m in the material frame R, a unit quaternion (x, y, z, w). Lengths are over
the rod's length, forces and moments over its bending stiffness. Antman, Nonlinear Problems of
Elasticity, 2005, chapter 8.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.floating]

AXIS = np.array([1.0, 0.0, 0.0])
# Parts of the state (13,): place, quaternion, force in the world, moment in the material frame.
PLACE, FRAME, FORCE, MOMENT = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)


@dataclass(frozen=True)
class Rod:
    """A rod of length 1 and bending stiffness 1, or m of them.

    Parameters
    ----------
    stiffness : (3,) or (m, 3)
        Against twist, and bending about both axes.
    load : (3,) or (m, 3)
        Weight of the whole rod.
    rest : callable
        Twist and curvatures at rest: of one rod at arc lengths (k,) -> (k, 3), of m at one (m, 3).
    """

    stiffness: FloatArray
    load: FloatArray
    rest: Callable[[Any], FloatArray]

    def strain(self, s: FloatArray | float, y: FloatArray) -> FloatArray:
        """Twist and curvatures (..., 3) of states (..., 13)."""
        return self.rest(s) + y[..., MOMENT] / self.stiffness

    def rates(self, s: FloatArray | float, y: FloatArray) -> FloatArray:
        """Derivatives (..., 13) by s of states (..., 13) at arc lengths s."""
        k, turn = self.strain(s, y), _matrices(y[..., FRAME])
        vector, w = y[..., 3:6], y[..., 6:7]
        frame = np.concatenate(
            [w * k + _cross(vector, k), -(vector * k).sum(-1, keepdims=True)], axis=-1
        )
        moment = -_cross(k, y[..., MOMENT]) - _cross(AXIS, _into(turn, y[..., FORCE]))
        load = np.broadcast_to(-self.load, k.shape)
        return np.concatenate([turn[..., 0], frame / 2, load, moment], axis=-1)

    def twist(self, s: FloatArray, y: FloatArray) -> float:
        """Of the whole rod [turns], from states (k, 13) at arc lengths (k,)."""
        return float(np.trapezoid(self.strain(s, y)[:, 0], s)) / (2 * np.pi)

    def energy(self, s: FloatArray, y: FloatArray) -> float:
        """Of bending, twist and weight, the start at height zero."""
        density = (y[:, MOMENT] ** 2 / self.stiffness).sum(axis=1) / 2 - y[:, PLACE] @ self.load
        return float(np.trapezoid(density, s))


def _matrices(q: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of quaternions; of length one only to first order."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _into(turn: FloatArray, v: FloatArray) -> FloatArray:
    """R^T v."""
    return (np.swapaxes(turn, -1, -2) @ v[..., None])[..., 0]


def _hat(v: FloatArray) -> FloatArray:
    """Matrices (..., 3, 3) of the cross product with v."""
    out = np.zeros((*v.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = np.moveaxis(v, -1, 0)
    return out - np.swapaxes(out, -1, -2)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return (_hat(a) @ b[..., None])[..., 0]


# ---- two ends given: SciPy's collocation ------------------------------------------------------


@dataclass(frozen=True)
class Ends:
    """Place and frame of the end; the start lies at zero in the frame `first`."""

    first: Rotation
    place: FloatArray
    last: Rotation

    def missed(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """The 13 conditions."""
        x, y, z, w = self.last.as_quat()
        by = np.array([[w, z, -y, -x], [-z, w, x, -y], [y, -x, w, -z]])
        at_start = [start[PLACE], start[FRAME] - self.first.as_quat()]
        return np.concatenate([*at_start, end[PLACE] - self.place, by @ end[FRAME]])


def solved(rod: Rod, ends: Ends, s: FloatArray, y: FloatArray, tolerance: float) -> Any | None:
    """SciPy's solution for a shape held so, from states (13, k) at s (k,); None where it fails."""
    with np.errstate(all="ignore"):
        found = solve_bvp(
            lambda at, states: rod.rates(at, states.T).T,
            ends.missed,
            s,
            y,
            tol=tolerance,
            max_nodes=4000,
        )
    return found if found.success else None


def from_an_arc(rod: Rod, ends: Ends, side: float, tolerance: float, steps: int = 12) -> Any | None:
    """As `solved`, from an arc over the chord that is at rest and weighs nothing.

    The arc bulges to a `side` [rad] about the chord. Load, rest shape and both end frames go evenly
    to those wanted, the frames by the shorter way; None where that fails.
    """
    chord = float(np.linalg.norm(ends.place))
    half = brentq(lambda a: np.sin(a) - chord * a, 1e-6, np.pi)
    along, _ = Rotation.align_vectors([ends.place / chord], [AXIS])
    s = np.linspace(0.0, 1.0, 41)
    angle = half * (1 - 2 * s)
    plane = along * Rotation.from_rotvec(side * AXIS)
    frames = plane * Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))
    x, _, _, w = (frames[0].inv() * ends.first).as_quat()
    roll = Rotation.from_rotvec(2 * np.arctan2(x, w) * AXIS)
    bend = roll.inv().apply([0.0, 0.0, -2 * half])
    frames = frames * roll
    gaps = [
        (frame.inv() * clamp).as_rotvec()
        for frame, clamp in ((frames[0], ends.first), (frames[-1], ends.last))
    ]
    y = np.zeros((len(s), 13))
    points = [np.sin(half) - np.sin(angle), np.cos(angle) - np.cos(half), 0 * s]
    y[:, PLACE] = plane.apply(np.stack(points, axis=1) / (2 * half))
    y[:, FRAME] = same_sign(frames.as_quat())
    y = y.T
    for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
        moved = [Rotation.from_rotvec(share * gap) for gap in gaps]
        there = Rod(
            rod.stiffness,
            share * rod.load,
            lambda at, share=share: (1 - share) * bend + share * rod.rest(at),
        )
        held = Ends(frames[0] * moved[0], ends.place, frames[-1] * moved[1])
        found = solved(there, held, s, y, tolerance if share == 1.0 else 1e-3)
        if found is None:
            return None
        s, y = found.x, found.y
    return found


def same_sign(q: FloatArray) -> FloatArray:
    """Quaternions (k, 4) with signs such that neighbours have a positive product."""
    flips = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


# ---- the start given: Jacobi's condition -------------------------------------------------------


def shot(
    rod: Rod, y: FloatArray, steps: int = 400
) -> tuple[tuple[FloatArray, FloatArray], FloatArray, NDArray[np.intp]]:
    """States reached from starts (m, 13), their variations, and their conjugate points.

    Runge and Kutta's method of fourth order on the equations and on their variation: of place and
    turn (body axes) at s by force and moment at the start. Where this 6 x 6 matrix is singular, s
    is conjugate to 0; a shape between clamps is a minimum if and only if there is none in (0, 1].
    Bretl and McCarthy, Int. J. Robotics Research 33 (2014).

    Returns
    -------
    (m, 13), (m, 13)
        In the middle and at the end.
    (m, 6, 6)
        The matrix there: rows of place and turn, columns of force (world) and moment.
    (m,) int
        Number of conjugate points after the first tenth.
    """
    h, m = 1.0 / steps, len(y)
    v = np.zeros((m, 9, 6))
    force = np.tile(np.eye(3, 6), (m, 1, 1))
    v[:, 6:] = np.eye(3, 6, 3)
    middle, sign, count = y, np.zeros(m), np.zeros(m, dtype=np.intp)
    for i in range(steps):
        s = i * h
        slopes: list[tuple[FloatArray, FloatArray]] = []
        for c in (0.0, 0.5, 0.5, 1.0):
            y1 = y + c * h * slopes[-1][0] if slopes else y
            v1 = v + c * h * slopes[-1][1] if slopes else v
            slopes.append((rod.rates(s + c * h, y1), _varied(rod, s + c * h, y1, v1, force)))
        y = y + h / 6 * sum(k * one[0] for k, one in zip((1, 2, 2, 1), slopes, strict=True))
        v = v + h / 6 * sum(k * one[1] for k, one in zip((1, 2, 2, 1), slopes, strict=True))
        if 2 * (i + 1) == steps:
            middle = y
        if s + h < 0.1:
            continue
        matrix = v[:, :6] / np.abs(v[:, :6]).max(axis=2, keepdims=True)
        now = np.linalg.slogdet(matrix)[0]
        count += (sign != 0) & (now != sign)
        sign = now
    return (middle, y), v[:, :6], count


def _varied(rod: Rod, s: float, y: FloatArray, v: FloatArray, force: FloatArray) -> FloatArray:
    """Derivatives (m, 9, 6) by s of variations of place, turn and moment."""
    turn, k = _matrices(y[:, FRAME]), rod.strain(s, y)
    eta, moment = v[:, 3:6], v[:, 6:]
    pull = _hat(_into(turn, y[:, FORCE])) @ eta + np.swapaxes(turn, 1, 2) @ force
    bend = moment / rod.stiffness[..., None]
    return np.concatenate(
        [
            -turn @ _hat(AXIS) @ eta,
            bend - _hat(k) @ eta,
            _hat(y[:, MOMENT]) @ bend - _hat(k) @ moment - _hat(AXIS) @ pull,
        ],
        axis=1,
    )
