"""The state of a node of the rod, which is changed by an increment, never by its coordinates."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import wraps
from math import factorial
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit

_CASADI = (ca.SX, ca.MX, ca.DM)

# Coefficients of sin(x) / x in powers of x^2: error 2e-15 at x = 0.65, 3e-14 at pi/4.
SINE = tuple((-1) ** k / factorial(2 * k + 1) for k in range(7))

# Smallest curvature [1/m] distinguished from zero: the norm of two has no derivative at zero.
STRAIGHT = 1e-8


def traced(function: Callable[..., ca.SX]) -> Callable[..., ca.SX]:
    """The same function of SX; it runs once for each size of its arguments, then is copied.

    An operator of Python on SX takes 20 us, the copy of an operation 0.1 us. Numbers may stand
    beside SX; with MX, or without any SX, the function itself is called.
    """
    known: dict[tuple[tuple[int, int], ...], ca.Function] = {}

    @wraps(function)
    def copied(*arguments: Any) -> ca.SX:
        symbolic = any(isinstance(x, ca.SX) for x in arguments)
        if not symbolic or any(isinstance(x, ca.MX) for x in arguments):
            return function(*arguments)
        given = [x if isinstance(x, ca.SX) else ca.SX(x) for x in arguments]
        sizes = tuple(x.shape for x in given)
        if sizes not in known:
            symbols = [ca.SX.sym("x", *size) for size in sizes]
            known[sizes] = ca.Function("traced", symbols, [function(*symbols)])
        return ca.SX(known[sizes](*given))

    return copied


class Node(ABC):
    """The state of a node: `coordinates` numbers, changed by increments of `increment` numbers.

    Only this contract adds a step to coordinates or interpolates them.

    Attributes
    ----------
    coordinates, increment, dimension : int
        Size of a node's state, of its increment, and of a position.
    axes, turns : tuple of str
        Names of the components of a position, and of an increment.
    strains, curvatures : tuple of str
        Names of the components of a strain, each with a rest value; the last of them are the
        curvatures.
    about : tuple of str
        Axes of the section about which a joint turns, one for each strain.
    identity : tuple of float
        Coordinates of the node whose tangent is the world's x axis.
    where : str
        Where such a cable lies, in words.
    direction, tolerance : str
        Names in a session for the direction of a clamp, and for its tolerance.
    columns : tuple of str
        Suffixes of the names of a table's columns with that direction.
    branches : tuple of str
        Branches that a pose may name: which way the cable turns from start to end.
    twists : bool
        Whether the cable twists. Frames of clamps leave the number of turns open: a pose gives it
        separately as `turns`.
    sides : int
        Number of directions, evenly spaced around the chord, in which a first guess of a span
        bulges; the first is along gravity.
    """

    coordinates: ClassVar[int]
    increment: ClassVar[int]
    dimension: ClassVar[int]
    axes: ClassVar[tuple[str, ...]]
    turns: ClassVar[tuple[str, ...]]
    strains: ClassVar[tuple[str, ...]]
    curvatures: ClassVar[tuple[str, ...]]
    about: ClassVar[tuple[str, ...]]
    identity: ClassVar[tuple[float, ...]]
    where: ClassVar[str]
    direction: ClassVar[str]
    tolerance: ClassVar[str]
    columns: ClassVar[tuple[str, ...]]
    branches: ClassVar[tuple[str, ...]]
    twists: ClassVar[bool]
    sides: ClassVar[int]

    @staticmethod
    @abstractmethod
    def moved(x: Any, delta: Any) -> Any:
        """Nodes (..., coordinates) moved by increments (..., increment) [rad].

        For arrays, or for expressions of one node; likewise `difference` and `to_world`.
        """

    @staticmethod
    def excess(x: Any) -> Any:
        """Squares of the nodes' lengths minus one, for nodes whose length is not part of the state.

        (..., 1) for nodes (..., coordinates); (n, 1) for an expression (coordinates, n). Headings
        have no such length.
        """
        return type(x)(0, 1) if isinstance(x, _CASADI) else x[..., :0]

    @staticmethod
    def normalised(x: Any) -> Any:
        """Nodes of any length, as for `excess`, scaled to that of a node; zeros stay zero."""
        return x

    @staticmethod
    @abstractmethod
    def rotations(x: FloatArray) -> Rotation:
        """Material frames of nodes (..., coordinates): of headings, turned about z."""

    @staticmethod
    @abstractmethod
    def declared(x: FloatArray) -> Any:
        """A node (coordinates,) in the form in which a pose declares the direction of a clamp."""

    @staticmethod
    def bend(curvatures: ca.SX) -> ca.SX:
        """Bend (1, k) [1/m] of k sections from its components: signed in a plane, else smooth."""
        return curvatures

    @staticmethod
    @abstractmethod
    def difference(x: Any, y: Any) -> Any:
        """Increments (..., increment) [rad] from x to y; for headings, whole turns included."""

    @staticmethod
    @abstractmethod
    def interpolated(places: FloatArray, known: FloatArray, x: FloatArray) -> FloatArray:
        """Nodes x (..., k, coordinates) known at arc lengths (k,), at other arc lengths."""

    @staticmethod
    @abstractmethod
    def tangent(x: ca.SX) -> ca.SX:
        """Unit tangent (dimension,) of the cable at a node."""

    @staticmethod
    @abstractmethod
    def middle(x: ca.SX, y: ca.SX) -> ca.SX:
        """Node half-way between two that are close to each other."""

    @staticmethod
    @abstractmethod
    def to_world(x: Any, moments: Any) -> Any:
        """Moments (..., increment) about the axes of nodes (..., coordinates), in world axes."""

    @classmethod
    @abstractmethod
    def same(cls, x: FloatArray, y: FloatArray, tolerance: float) -> bool:
        """Whether two rows of nodes (n_nodes, coordinates) are one shape, to a tolerance [rad]."""

    @classmethod
    def turning(cls, x: FloatArray) -> FloatArray:
        """Angles (...) [rad] by which shapes (..., n_nodes, coordinates) turn from start to end.

        In a plane: the difference of the headings. In space: the twist about the cable's axis.
        """
        return np.asarray(cls.difference(x[..., :-1, :], x[..., 1:, :])[..., 0].sum(axis=-1))


class Heading(Node):
    """The direction of a planar cable: one angle against the board's x axis [rad]."""

    coordinates = 1
    increment = 1
    dimension = 2
    axes = ("x", "y")
    turns = ("heading",)
    strains = ("k",)
    curvatures = ("k",)
    about = ("z",)
    identity = (0.0,)
    where = "in a plane"
    direction = "heading"
    tolerance = "heading"
    columns = ("heading_rad",)
    branches = ("ccw", "cw")
    twists = False
    sides = 2

    @staticmethod
    def moved(x: Any, delta: Any) -> Any:
        """Add the angles."""
        return x + delta

    @staticmethod
    def rotations(x: FloatArray) -> Rotation:
        """Turned about z."""
        return Rotation.from_rotvec(x * [0.0, 0.0, 1.0])

    @staticmethod
    def declared(x: FloatArray) -> float:
        """The angle [rad]."""
        return float(x[0])

    @staticmethod
    def difference(x: Any, y: Any) -> Any:
        """Angles from x to y, whole turns included."""
        return y - x

    @staticmethod
    def interpolated(places: FloatArray, known: FloatArray, x: FloatArray) -> FloatArray:
        """Linear in between, constant beyond."""
        rows = [np.interp(places, known, row) for row in x.reshape((-1, len(known)))]
        return np.array(rows).reshape((*x.shape[:-2], len(places), 1))

    @staticmethod
    def tangent(x: ca.SX) -> ca.SX:
        """(cos phi, sin phi)."""
        return ca.vertcat(ca.cos(x), ca.sin(x))

    @staticmethod
    def middle(x: ca.SX, y: ca.SX) -> ca.SX:
        """Mean of the angles."""
        return (x + y) / 2

    @staticmethod
    def to_world(x: Any, moments: Any) -> Any:
        """In a plane a moment is the same about any axes."""
        return moments

    @classmethod
    def same(cls, x: FloatArray, y: FloatArray, tolerance: float) -> bool:
        """Compare up to full turns of the whole cable."""
        gap = cls.difference(x, y)
        return bool(np.abs(gap - 2 * np.pi * np.round(gap.mean() / (2 * np.pi))).max() < tolerance)


class Frame(Node):
    """The material frame of a cable in space: a unit quaternion (x, y, z, w), its x axis forward.

    Increments are about the frame's own axes, by the Cayley map

        q -> q * (delta / 2, 1) / sqrt(1 + |delta|^2 / 4)

    which is a rotation by 2 atan(|delta| / 2): the exponential map to second order, smooth
    everywhere, and rational. Quaternions of neighbouring nodes keep the same sign.

    References
    ----------
    Simo and Vu-Quoc, Comput. Methods Appl. Mech. Eng. 58 (1986); Cayley map: Iserles et al., Acta
    Numerica 9 (2000).
    """

    coordinates = 4
    increment = 3
    dimension = 3
    axes = ("x", "y", "z")
    turns = ("rotation_x", "rotation_y", "rotation_z")
    strains = ("twist", "k_y", "k_z")
    curvatures = ("k_y", "k_z")
    about = ("x", "y", "z")
    identity = (0.0, 0.0, 0.0, 1.0)
    where = "in space"
    direction = "orientation"
    tolerance = "rotation"
    columns = ("qx", "qy", "qz", "qw")
    branches = ()
    twists = True
    sides = 4

    @staticmethod
    def moved(x: Any, delta: Any) -> Any:
        """Turn about the frames' own axes."""
        if isinstance(x, _CASADI):
            return _frame_moved(x, delta)
        turned = quaternion_product(components(x), (*components(delta / 2), 1.0))
        return unit(np.stack(np.broadcast_arrays(*turned), axis=-1))

    @staticmethod
    def excess(x: Any) -> Any:
        """Squared lengths of the quaternions minus one."""
        if isinstance(x, _CASADI):
            return ca.sum1(x**2).T - 1
        return (x**2).sum(axis=-1, keepdims=True) - 1

    @staticmethod
    def normalised(x: Any) -> Any:
        """Unit quaternions."""
        if isinstance(x, _CASADI):
            size: Any = ca.sqrt(ca.sum1(x**2))
            return x / ca.repmat(size, Frame.coordinates, 1)
        return unit(x)

    @staticmethod
    def rotations(x: FloatArray) -> Rotation:
        """The frames themselves."""
        return Rotation.from_quat(x)

    @staticmethod
    def declared(x: FloatArray) -> tuple[float, ...]:
        """The quaternion (x, y, z, w)."""
        return tuple(x.tolist())

    @staticmethod
    def bend(curvatures: ca.SX) -> ca.SX:
        """Norm of the components, rounded off below STRAIGHT."""
        return ca.sqrt(ca.sum1(curvatures**2) + STRAIGHT**2)

    @staticmethod
    def difference(x: Any, y: Any) -> Any:
        """2 tan(angle / 2) about the axis of the rotation from x to y, in the frame x."""
        if isinstance(x, _CASADI):
            return _frame_difference(x, y)
        *vector, w = quaternion_product(conjugate(components(x)), components(y))
        # Half a turn has an infinite increment; it is limited to a very long one.
        w = np.where(np.abs(w) < 1e-12, np.where(w < 0, -1e-12, 1e-12), w)
        return np.stack([2 * v / w for v in vector], axis=-1)

    @staticmethod
    def interpolated(places: FloatArray, known: FloatArray, x: FloatArray) -> FloatArray:
        """Spherical interpolation between nodes, constant beyond.

        The nodes before and after a clip may carry quaternions of different signs.
        """
        x = same_sign(x)
        k = np.clip(np.searchsorted(known, places, side="right") - 1, 0, len(known) - 2)
        u = np.clip((places - known[k]) / (known[k + 1] - known[k]), 0.0, 1.0)
        first, last = x[..., k, :], x[..., k + 1, :]
        cosine = np.clip((first * last).sum(axis=-1), -1.0, 1.0)
        angle = np.maximum(np.arccos(cosine), 1e-12)
        weights = [np.sin((1 - u) * angle), np.sin(u * angle)]
        out = weights[0][..., None] * first + weights[1][..., None] * last
        return unit(out)

    @staticmethod
    def tangent(x: ca.SX) -> ca.SX:
        """The x axis of the frame."""
        return rotated(x, ca.DM([1.0, 0.0, 0.0]))

    @staticmethod
    def middle(x: ca.SX, y: ca.SX) -> ca.SX:
        """Normalised mean of the quaternions."""
        return (x + y) / ca.norm_2(x + y)

    @staticmethod
    def to_world(x: Any, moments: Any) -> Any:
        """Rotate by the frames."""
        if isinstance(x, _CASADI):
            return rotated(x, moments)
        return Rotation.from_quat(x).apply(moments)

    @classmethod
    def same(cls, x: FloatArray, y: FloatArray, tolerance: float) -> bool:
        """Compare up to signs of quaternions and a roll of the whole cable about its axis."""
        gap = cls.difference(x, y)
        gap[:, 0] -= gap[:, 0].mean()
        return bool(np.abs(gap).max() < tolerance)


@traced
def _frame_moved(x: ca.SX, delta: ca.SX) -> ca.SX:
    """`Frame.moved` of expressions."""
    half = [part / 2 for part in ca.vertsplit(delta)]
    turned = quaternion_product(ca.vertsplit(x), (*half, 1.0))
    return ca.vertcat(*turned) * (1 / ca.sqrt(1 + sum((h * h for h in half), start=ca.SX(0))))


@traced
def _frame_difference(x: ca.SX, y: ca.SX) -> ca.SX:
    """`Frame.difference` of expressions."""
    *vector, w = quaternion_product(conjugate(ca.vertsplit(x)), ca.vertsplit(y))
    return ca.vertcat(*(2 * v / w for v in vector))


NODES: dict[int, type[Node]] = {node.dimension: node for node in (Heading, Frame)}


def components(x: FloatArray) -> FloatArray:
    """Components of vectors, which are the last axis of an array."""
    return np.moveaxis(x, -1, 0)


def quaternion_product(p: Any, q: Any) -> tuple[Any, Any, Any, Any]:
    """Components (x, y, z, w) of the product p q: of numbers, arrays or expressions."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


def same_sign(x: FloatArray) -> FloatArray:
    """Quaternions (..., n, 4) with signs such that neighbours have a positive product."""
    flips = np.where((x[..., 1:, :] * x[..., :-1, :]).sum(axis=-1) < 0, -1.0, 1.0)
    signs = np.concatenate([np.ones_like(x[..., :1, 0]), np.cumprod(flips, axis=-1)], axis=-1)
    return np.asarray(x * signs[..., None])


def conjugate(q: Any) -> tuple[Any, Any, Any, Any]:
    """Components of the inverse of a unit quaternion."""
    x, y, z, w = q
    return (-x, -y, -z, w)


@traced
def rotated(q: Any, vector: Any) -> ca.SX:
    """Vector (3,) turned by the unit quaternion q: v + 2 w (u x v) + 2 u x (u x v)."""
    u, w = q[:3], q[3]
    once = 2 * ca.cross(u, vector)
    return vector + w * once + ca.cross(u, once)


@traced
def rotation(vector: ca.SX) -> ca.SX:
    """Unit quaternion (x, y, z, w) of a rotation vector (3,) [rad] of less than 1.7 rad."""
    half = vector / 2
    axis = series(SINE, ca.sumsqr(half)) * half
    return ca.vertcat(axis, ca.sqrt(1 - ca.sumsqr(axis)))


def series(coefficients: Sequence[float], y: ca.SX) -> ca.SX:
    """Sum of coefficients times powers of y, smooth in x for y = x^2."""
    total = ca.SX(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = coefficient + y * total
    return total
