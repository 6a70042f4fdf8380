"""What a node of the rod carries, and how it moves: by an increment, never by coordinates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]


class Node(ABC):
    """The state of a node: `coordinates` numbers that move by increments of `increment` numbers.

    Nothing outside this contract adds a step to coordinates or interpolates them.
    """

    coordinates: ClassVar[int]
    increment: ClassVar[int]
    dimension: ClassVar[int]

    @staticmethod
    @abstractmethod
    def retract(x: ca.SX, delta: ca.SX) -> ca.SX:
        """Coordinates (coordinates,) of the node moved by the increment (increment,) [rad]."""

    @staticmethod
    @abstractmethod
    def moved(x: FloatArray, delta: FloatArray) -> FloatArray:
        """`retract` of many nodes: (..., coordinates), (..., increment) -> (..., coordinates)."""

    @staticmethod
    @abstractmethod
    def difference(x: FloatArray, y: FloatArray) -> FloatArray:
        """Increments (..., increment) [rad] that move x to y, both (..., coordinates)."""

    @staticmethod
    @abstractmethod
    def interpolated(places: FloatArray, known: FloatArray, x: FloatArray) -> FloatArray:
        """Nodes x (..., k, coordinates) known at arc lengths (k,), at other arc lengths."""

    @staticmethod
    @abstractmethod
    def tangent(x: ca.SX) -> ca.SX:
        """Unit tangent (dimension,) of the cable at a node."""


class Heading(Node):
    """The direction of a planar cable: one angle against the board's x axis [rad]."""

    coordinates = 1
    increment = 1
    dimension = 2

    @staticmethod
    def retract(x: ca.SX, delta: ca.SX) -> ca.SX:
        """Add the angle."""
        return x + delta

    @staticmethod
    def moved(x: FloatArray, delta: FloatArray) -> FloatArray:
        """Add the angles."""
        return x + delta

    @staticmethod
    def difference(x: FloatArray, y: FloatArray) -> FloatArray:
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
