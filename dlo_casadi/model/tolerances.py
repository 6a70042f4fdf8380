"""How well is known what a configuration declares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.rod.node import Node

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Tolerances:
    """How well the declared values are known, one standard deviation."""

    length: float = 5e-4
    end: float = 2e-4
    heading: float = 1e-2
    scale: float = 3e-4
    rotation: float = 5e-3
    roll: float = 1.0
    camera_rotation: float = 2e-3
    camera_translation: float = 1e-3
    force_bias: float = 0.02
    moment_bias: float = 2e-3

    def deviation(self, node: type[Node]) -> FloatArray:
        """Standard deviations of a pose's deviations, see `deviation_names`; pulls are free."""
        turn = self.heading if node.increment == 1 else self.rotation
        sizes = (self.end, turn, np.inf)
        counts = (node.dimension, 2 * node.increment, node.dimension)
        return np.repeat(sizes, counts)
