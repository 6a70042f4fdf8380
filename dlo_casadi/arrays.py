"""Types of arrays, and vectorized geometry."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]
ComplexArray = NDArray[np.complexfloating]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


# Longest text of one value, and most items of one value, in a `Brief`.
_LONGEST, _MOST = 60, 8


class Brief:
    """A dataclass in one line: arrays by their shapes, many items by their number or names.

    For a dataclass of `repr=False`, which would otherwise print all that it holds.
    """

    def __repr__(self) -> str:
        kept: Any = self
        shown = ((x.name, getattr(self, x.name)) for x in fields(kept) if x.repr)
        inside = ", ".join(f"{name}={_brief(x)}" for name, x in shown if x is not None)
        return f"{type(self).__name__}({inside})"


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<array {value.shape}>"
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return f"{{{', '.join(value)}}}" if len(value) <= _MOST else f"<{len(value)} items>"
    if isinstance(value, float):
        return f"{value:.4g}"
    if is_dataclass(value):
        return f"<{type(value).__name__}>"
    text = repr(value) if not isinstance(value, tuple | list | dict) or len(value) <= _MOST else ""
    return text if text and len(text) <= _LONGEST and "\n" not in text else _counted(value)


def _counted(value: Any) -> str:
    items = f" of {len(value)}" if hasattr(value, "__len__") else ""
    return f"<{type(value).__name__}{items}>"


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product along the last axis (..., 3); for a few vectors faster than `numpy.cross`."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., ahead] * b[..., behind] - a[..., behind] * b[..., ahead])


def unit(vectors: FloatArray) -> NDArray[np.float64]:
    """Vectors (..., d) divided by their lengths; zero vectors stay zero."""
    squares = (vectors * vectors).sum(axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(np.sqrt(squares), 1e-300))


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
