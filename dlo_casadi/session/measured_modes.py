"""Modes of a recorded cable: as its motion tells them, and predicted from still shapes alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dlo_casadi.arrays import Brief, FloatArray
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.estimation.prediction import uncertainty_of
from dlo_casadi.estimation.recording import held_by
from dlo_casadi.estimation.result import Fit
from dlo_casadi.motion.modes_at_rest import ModesAtRest
from dlo_casadi.sensing.measured_motion import MeasuredMotion

# Modes that are reported, and points along the cable.
_COUNT, _POINTS = 3, 41


@dataclass(frozen=True, repr=False)
class MeasuredModes(Brief):
    """Small motions about the shape in which the cable hangs at the end of a recording.

    Parameters
    ----------
    motion : str
        Name of the recording.
    frequencies, frequency_std : (M,) [Hz]
        Of the model that is fitted to the motions, too.
    damping_ratios, damping_ratio_std : (M,)
    predicted, predicted_std : (M,) [Hz]
        Of the model that is fitted to still shapes alone: its mass, stiffness and rest shape tell
        frequencies without a motion.
    points : (K, d) [m]
        The shape.
    shapes : (M, K, d)
        Displacements; the largest is 1.
    """

    motion: str
    frequencies: FloatArray
    frequency_std: FloatArray
    damping_ratios: FloatArray
    damping_ratio_std: FloatArray
    predicted: FloatArray
    predicted_std: FloatArray
    points: FloatArray
    shapes: FloatArray

    def as_rows(self) -> list[dict[str, Any]]:
        """A mapping for each mode, in SI units."""

        def pair(values: FloatArray, std: FloatArray, k: int) -> dict[str, float]:
            return {"value": float(values[k]), "std": float(std[k])}

        return [
            {
                "frequency_hz": pair(self.frequencies, self.frequency_std, k),
                "damping_ratio": pair(self.damping_ratios, self.damping_ratio_std, k),
                "predicted_hz": pair(self.predicted, self.predicted_std, k),
                "of": self.motion,
            }
            for k in range(len(self.frequencies))
        ]


def measured_modes(
    still: Fit, moving: Fit, motions: Sequence[MeasuredMotion]
) -> MeasuredModes | None:
    """Modes at the end of a recording, of a held-out one if there is one.

    None if no shape at rest is found there. `still`: of still shapes alone; `moving`: of both.
    """
    motion = next((one for one in motions if one.held_out), motions[0])
    s = np.linspace(0.0, moving.model.cable.length, _POINTS)
    try:
        found, before = _modes_of(moving, motion), _modes_of(still, motion)
    except EquilibriumError:
        return None
    numbers, std = found.numbers(), found.std(uncertainty_of(moving))
    points, shapes = found.displacements(s)
    return MeasuredModes(
        motion.name,
        numbers[0],
        std[0],
        numbers[1],
        std[1],
        before.numbers()[0],
        before.std(uncertainty_of(still))[0],
        points,
        shapes,
    )


def _modes_of(fit: Fit, motion: MeasuredMotion) -> ModesAtRest:
    """Those of a fit, with the fixtures where the recording ends."""
    pose, rest = held_by(motion.held_at(-1)), fit.rest_now
    found = solve_equilibrium(fit.model, fit.p, rest, pose)
    return ModesAtRest(fit.model, fit.p, rest, found, pose, _COUNT)
