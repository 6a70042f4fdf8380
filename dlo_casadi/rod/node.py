"""The state of a node of the rod, which is changed by an increment, never by its coordinates."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.rod.quaternions import (
    components,
    conjugate,
    quaternion_product,
    rotated,
    same_sign,
    traced,
)

_CASADI = (ca.SX, ca.MX, ca.DM)

# Smallest curvature [1/m] distinguished from zero: the norm of two has no derivative at zero.
STRAIGHT = 1e-8


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
    def axes_of(x: ca.SX) -> ca.SX:
        """Axes of the material frame, the columns of a matrix (dimension, dimension)."""

    @staticmethod
    @abstractmethod
    def cross(turn: Any, vector: Any) -> Any:
        """Product of a turn (increment,) and a vector (dimension,), both in the frame's axes."""

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
    def axes_of(x: ca.SX) -> ca.SX:
        """The tangent, and the direction to its left."""
        c, s = ca.cos(x), ca.sin(x)
        return ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))

    @staticmethod
    def cross(turn: Any, vector: Any) -> Any:
        """Quarter turns to the left."""
        return ca.vertcat(-turn * vector[1], turn * vector[0])

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
        return unit(np.stack(turned, axis=-1))

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
    def axes_of(x: ca.SX) -> ca.SX:
        """Columns of the rotation matrix."""
        return ca.horzcat(*(rotated(x, ca.DM(axis)) for axis in np.eye(3)))

    @staticmethod
    def cross(turn: Any, vector: Any) -> Any:
        """Cross product."""
        return ca.cross(turn, vector)

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
