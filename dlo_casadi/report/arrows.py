"""Forces as arrows: one line each, in the plane or in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.session.outcome import Stage

FloatArray = NDArray[np.floating]

# An arrow's head, as a share of its length: how long and how wide.
_HEAD = (0.28, 0.1)
# The longest arrow in a plane, as a share of the cable's length.
_LONGEST = 1 / 5


def arrow(root: FloatArray, shaft: FloatArray) -> FloatArray:
    """One line (K, d) that draws an arrow from a root (d,) along a shaft (d,).

    Two barbs in a plane, four in space, where it is seen from anywhere.
    """
    size = max(float(np.linalg.norm(shaft)), 1e-12)
    if len(shaft) == 2:
        normals = [np.array([-shaft[1], shaft[0]])]
    else:
        across = np.cross(shaft, np.eye(3)[np.abs(shaft).argmin()])
        across *= size / max(float(np.linalg.norm(across)), 1e-12)
        normals = [across, np.cross(shaft, across) / size]
    tip, back = root + shaft, root + (1 - _HEAD[0]) * shaft
    sides = [sign * normal for sign in (1, -1) for normal in normals]
    barbs = [point for side in sides for point in (back + _HEAD[1] * side, tip)]
    return np.stack([root, tip, *barbs])


def forces_read(stage: Stage, length: float) -> dict[str, list[tuple[str, FloatArray]]]:
    """Arrows (K, 2) [m] of the forces that were read at the ends, by the poses in a plane.

    Beside each, and before it, what a sensor would show of the predicted force; the kinds are
    "force-read" and "force". All are drawn to one scale; `length` [m] is the cable's.
    """
    pairs = {
        name: [
            (shape.curve[k], shape.readings[f"{side}_force"])
            for k, side in ((0, "start"), (-1, "end"))
            if f"{side}_force" in shape.readings
        ]
        for name, shape in stage.shapes.items()
    }
    every = [force for own in pairs.values() for _, pair in own for force in pair]
    newton = _LONGEST * length / max(map(np.linalg.norm, every), default=1.0)
    return {
        name: [
            (kind, arrow(place, newton * force))
            for place, (known, model) in own
            for kind, force in (("force", model), ("force-read", known))
        ]
        for name, own in pairs.items()
    }
