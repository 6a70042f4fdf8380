"""Standard deviations of what a session declares."""

from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.cable_model import CableModel

# Standard deviation [declared lengths] of the free length of a cable that slides through an end,
# where the line that was measured tells it: twice what a gap of a percent at both ends hides.
FREE = 0.02


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of the declared values."""

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
    clip: float = 2e-4
    slip: float = 5e-4
    obstacle: float = 5e-4
    delay: float | None = None

    def deviation(self, model: CableModel) -> FloatArray:
        """Standard deviations of a model's `deviation_names`; infinite for unknown forces."""
        node, free = model.node, FREE * model.cable.length
        sizes = (self.end, getattr(self, node.tolerance), np.inf, free, self.clip)
        d = node.dimension
        return np.repeat(sizes, (d, 2 * node.increment, d, 1, d * len(model.clips)))
