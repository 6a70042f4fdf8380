"""Axes of frames: how they may have been exchanged, in words, and those of clamps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.config import Pose

FloatArray = NDArray[np.floating]

# Usual words for what can have happened to axes in a plane: measured -> declared.
FRAMES: dict[str, FloatArray] = {
    "y pointing down instead of up": np.array([[1.0, 0.0], [0.0, -1.0]]),
    "x pointing left instead of right": np.array([[-1.0, 0.0], [0.0, 1.0]]),
    "x and y exchanged": np.array([[0.0, 1.0], [1.0, 0.0]]),
    "the picture turned by 180 degrees": np.array([[-1.0, 0.0], [0.0, -1.0]]),
    "the picture turned by 90 degrees counter-clockwise": np.array([[0.0, 1.0], [-1.0, 0.0]]),
    "the picture turned by 90 degrees clockwise": np.array([[0.0, -1.0], [1.0, 0.0]]),
}


def exchanges(d: int) -> list[FloatArray]:
    """All ways to exchange and turn round the axes of d dimensions, none first."""
    return [
        np.diag(signs) @ np.eye(d)[list(order)]
        for order in permutations(range(d))
        for signs in product((1.0, -1.0), repeat=d)
    ]


def named(axes: FloatArray) -> str:
    """What can have happened to the points where axes are exchanged."""
    for what, known in FRAMES.items():
        if np.array_equal(axes, known):
            return what
    names = "xyz"[: len(axes)]
    read = [("-" if row.min() < 0 else "") + names[int(np.abs(row).argmax())] for row in axes]
    hand = ", mirrored (a left-handed frame)" if np.linalg.det(axes) < 0 else ""
    up = " (y up in one, z up in the other?)" if np.all(np.diag(axes[1:, ::-1])) else ""
    return f"the points read as {', '.join(names)} = {', '.join(read)}{hand}{up}"


def axes_of(value: float | Sequence[float]) -> FloatArray:
    """Axes (d, d) of a clamp in columns, x along the cable; of a heading [rad] or a quaternion."""
    if isinstance(value, float | int):
        c, s = np.cos(value), np.sin(value)
        return np.array([[c, -s], [s, c]])
    return np.asarray(Rotation.from_quat(value).as_matrix())


def clamp_axes(pose: Pose, side: str) -> FloatArray | None:
    """Axes (d, d) of a pose's clamp, see `axes_of`; None where there is none."""
    values = getattr(pose, f"{side}_heading"), getattr(pose, f"{side}_orientation")
    return next((axes_of(value) for value in values if value is not None), None)
