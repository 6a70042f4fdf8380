"""Sections of cables that bend more easily one way than the other."""

import numpy as np


def principal(ratio: float, angle: float) -> np.ndarray:
    """Stiffness matrix about y and z, over that about the first axis."""
    first, second = (np.array([np.cos(a), np.sin(a)]) for a in (angle, angle + np.pi / 2))
    return np.outer(first, first) + ratio * np.outer(second, second)
