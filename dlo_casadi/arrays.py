"""Types of arrays, and vectorized geometry."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product along the last axis (..., 3); for a few vectors faster than `numpy.cross`."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., ahead] * b[..., behind] - a[..., behind] * b[..., ahead])


def unit(vectors: FloatArray) -> NDArray[np.float64]:
    """Vectors (..., d) divided by their lengths; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def chord_lengths(points: FloatArray) -> NDArray[np.float64]:
    """Lengths (K,) along a polyline from its first point to each of its points (K, d)."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def length_of(points: FloatArray) -> float:
    """Length of a polyline through points (K, d)."""
    return float(chord_lengths(points)[-1])


def root_of(covariance: FloatArray) -> FloatArray:
    """Square root F (n, n) with F F^T = covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
