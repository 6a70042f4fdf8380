"""Axes in words: exchanged and mirrored ones, and those of clamps."""

from collections.abc import Sequence
from itertools import permutations, product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config import Pose

# Usual descriptions of exchanged axes in a plane: measured (x, y) is read as the given pair.
_IN_A_PLANE = {
    "x, -y": "y pointing down instead of up",
    "-x, y": "x pointing left instead of right",
    "y, x": "x and y exchanged",
    "-x, -y": "the picture turned by 180 degrees",
    "y, -x": "the picture turned by 90 degrees counter-clockwise",
    "-y, x": "the picture turned by 90 degrees clockwise",
}
# Largest difference (Frobenius norm) of a rotation from exchanged axes that describe it: 0.3 rad.
NEAR_AXES = 0.3 * np.sqrt(2)


def exchanges(d: int) -> list[FloatArray]:
    """All signed permutations of d axes, the identity first."""
    return [
        np.diag(signs) @ np.eye(d)[list(order)]
        for order in permutations(range(d))
        for signs in product((1.0, -1.0), repeat=d)
    ]


def listed(values: Any, form: str = ".3f") -> str:
    """Format one number, or numbers (n,), for a message."""
    return ", ".join(format(x, form) for x in np.atleast_1d(values))


def read_as(axes: FloatArray) -> str:
    """The components that are read as x, y, z if axes (d, d) are exchanged, such as y, -x."""
    signs = ("-" if row.min() < 0 else "" for row in axes)
    return ", ".join(
        sign + "xyz"[int(np.abs(row).argmax())] for sign, row in zip(signs, axes, strict=True)
    )


def named(axes: FloatArray) -> str:
    """Describe what may have happened to points whose axes are exchanged."""
    names, read = "xyz"[: len(axes)], read_as(axes)
    if read in _IN_A_PLANE:
        return _IN_A_PLANE[read]
    hand = ", mirrored (a left-handed frame)" if np.linalg.det(axes) < 0 else ""
    up = " (y up in one, z up in the other?)" if np.all(np.diag(axes[1:, ::-1])) else ""
    return f"the points read as {', '.join(names)} = {read}{hand}{up}"


def axes_of(value: float | Sequence[float]) -> FloatArray:
    """Axes (d, d) of a clamp in columns, x along the cable, from a heading [rad] or quaternion."""
    if isinstance(value, float | int):
        c, s = np.cos(value), np.sin(value)
        return np.array([[c, -s], [s, c]])
    return np.asarray(Rotation.from_quat(value).as_matrix())


def clamp_axes(pose: Pose, side: str) -> FloatArray | None:
    """Axes (d, d) of a pose's clamp, see `axes_of`; None where there is none."""
    values = getattr(pose, f"{side}_heading"), getattr(pose, f"{side}_orientation")
    return next((axes_of(value) for value in values if value is not None), None)
