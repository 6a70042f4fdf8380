"""Unit quaternions (x, y, z, w) and rotation vectors: of numbers, arrays and expressions."""

from collections.abc import Callable, Sequence
from functools import wraps
from math import factorial
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray

# Coefficients of sin(x) / x in powers of x^2: error 2e-15 at x = 0.65, 3e-14 at pi/4.
SINE = tuple((-1) ** k / factorial(2 * k + 1) for k in range(7))


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


def components(x: FloatArray) -> FloatArray:
    """Components of vectors, which are the last axis of an array."""
    return x.transpose(x.ndim - 1, *range(x.ndim - 1))


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
