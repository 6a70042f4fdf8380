"""Types of arrays, and the cross product of a few vectors."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product along the last axis (..., 3); on a few vectors faster than `numpy.cross`."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., ahead] * b[..., behind] - a[..., behind] * b[..., ahead])
