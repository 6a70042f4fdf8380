"""Handles of a segment: both nodes' places and tangents, and their derivatives in motion.

Between two nodes places are cubic Hermite polynomials of z = (r_0, h t_0, r_1, h t_1), so that
velocities and kinetic energy are those of a beam's element.

References
----------
Przemieniecki, Theory of Matrix Structural Analysis, 1968.
"""

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.rod.node import Node

# Mass matrix of the handles of a beam of unit mass and length.
MASSES = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]])
MASSES = MASSES / 420
# Powers of u in the weights of the handles in the place at u.
HERMITE = np.array([[1, 0, -3, 2], [0, 1, -2, 1], [0, 0, 3, -2], [0, 0, -1, 1]], dtype=float)


def hermite(u: ca.SX | float, derivative: int = 0) -> ca.SX:
    """Weights (4,) of the handles in the place at u of a segment, or in its derivative by u."""
    if derivative:
        return ca.mtimes(ca.DM(HERMITE), ca.vertcat(0, 1, 2 * u, 3 * u**2))
    return ca.mtimes(ca.DM(HERMITE), ca.vertcat(1, u, u**2, u**3))


def between(z: FloatArray, u: FloatArray) -> FloatArray:
    """Places (..., K, d) from handles (..., K, 4, d) of their segments, at shares u (K,)."""
    weights = np.vander(u, 4, increasing=True) @ HERMITE.T
    return np.asarray(np.einsum("kw,...kwd->...kd", weights, z))


class TurningNode:
    """A node's tangent t in motion, with derivatives by its turn and by body rates.

        t' = R (w x e_x),   t'' = R (alpha x e_x + w x (w x e_x))

    Attributes
    ----------
    axes : (dimension, dimension)
        R, by columns.
    tangent, rate, acceleration : (dimension,)
    by_turn, rate_by_turn, acceleration_by_turn : (dimension, increment)
        Derivatives by a turn about the node's own axes; the first is also that of the rate by w,
        and of the acceleration by alpha.
    acceleration_by_rate : (dimension, increment)
    """

    def __init__(self, node: type[Node], x: ca.SX, w: ca.SX, alpha: ca.SX) -> None:
        b, d, cross = node.increment, node.dimension, node.cross
        ahead, axes = ca.SX(ca.DM.eye(d)[:, 0]), node.axes_of(x)
        self.node, self.axes, self.w = node, axes, w
        self._units = [ca.SX(ca.DM.eye(b)[:, k]) for k in range(b)]
        once = cross(w, ahead)
        twice = cross(alpha, ahead) + cross(w, once)
        self.tangent, self.rate, self.acceleration = axes[:, 0], axes @ once, axes @ twice
        self.by_turn = axes @ self.columns(ahead)
        self.rate_by_turn = axes @ self.columns(once)
        self.acceleration_by_turn = axes @ self.columns(twice)
        around = self._columns(lambda unit: cross(w, cross(unit, ahead)))
        self.acceleration_by_rate = self.rate_by_turn + axes @ around

    def _columns(self, of: Callable[[ca.SX], ca.SX]) -> ca.SX:
        return ca.sparsify(ca.horzcat(*map(of, self._units)))

    def columns(self, vector: ca.SX) -> ca.SX:
        """Products of unit turns with a vector, both in the node's axes (dimension, increment)."""
        return self._columns(lambda unit: self.node.cross(unit, vector))


class Handles:
    """Handles (4 dimension,) of a segment as a function of its nodes' turns and places.

    Attributes
    ----------
    z, rate, acceleration : (4 dimension,) [m, m/s, m/s^2]
    by_place : (4 dimension, 2 increment + 2 dimension)
        Derivative by both nodes' turns, then places: of z, of the rate by velocities, and of the
        acceleration by accelerations.
    rate_by_place, acceleration_by_place, acceleration_by_rate : likewise
    """

    def __init__(
        self, nodes: Sequence[TurningNode], h: ca.SX, r: ca.SX, v: ca.SX, a: ca.SX
    ) -> None:
        first, last = nodes
        self.nodes, self.h, d = nodes, h, first.node.dimension

        def stacked(places: ca.SX, of_first: ca.SX, of_last: ca.SX) -> ca.SX:
            return ca.vertcat(places[:d], h * of_first, places[d:], h * of_last)

        def matrix(of_first: ca.SX, of_last: ca.SX, places: float) -> ca.SX:
            b = first.node.increment
            both, unit = ca.SX(4 * d, 2 * b + 2 * d), places * ca.SX.eye(d)
            both[d : 2 * d, :b], both[3 * d :, b : 2 * b] = h * of_first, h * of_last
            if places:
                both[:d, 2 * b : 2 * b + d], both[2 * d : 3 * d, 2 * b + d :] = unit, unit
            return ca.sparsify(both)

        self.z = stacked(r, first.tangent, last.tangent)
        self.rate = stacked(v, first.rate, last.rate)
        self.acceleration = stacked(a, first.acceleration, last.acceleration)
        self.by_place = matrix(first.by_turn, last.by_turn, 1.0)
        self.rate_by_place = matrix(first.rate_by_turn, last.rate_by_turn, 0.0)
        turned = (first.acceleration_by_turn, last.acceleration_by_turn)
        self.acceleration_by_place = matrix(*turned, 0.0)
        spun = (first.acceleration_by_rate, last.acceleration_by_rate)
        self.acceleration_by_rate = matrix(*spun, 0.0)

    def turned_force(self, force: ca.SX) -> ca.SX:
        """Derivative by a turn of the rows of turns of a force (4 dimension,) on the handles.

        The rows are h (e_k x e_x) . R^T F; the matrix is (2 increment, 2 increment).
        """
        parts, rows = ca.vertsplit(force, self.nodes[0].node.dimension), []
        for node, own in zip(self.nodes, parts[1::2], strict=True):
            ahead = ca.SX(ca.DM.eye(own.numel())[:, 0])
            rows.append(-self.h * node.columns(ahead).T @ node.columns(node.axes.T @ own))
        return ca.diagcat(*rows)
