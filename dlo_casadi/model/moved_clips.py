"""Clips that slip along the cable or turn: inputs on both sides, for central differences."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.stacked import Inputs

# Step of the differences by slips, relative to the length, and by turns [rad].
_STEP = 1e-6


def moved_clips(
    model: CableModel, given: Inputs, p: FloatArray, *, turned: bool = True
) -> Iterator[tuple[FloatArray, tuple[Inputs, Inputs]]]:
    """Central differences by slips and turns of clips: rates (m, q), and both inputs.

    `p` (m, n_parameters, q): directions. Without `turned` those by slips alone.
    """
    slips, turns = functions_of(model).clip_slopes
    for k in np.flatnonzero(slips.any(axis=0) | (turned & turns.any(axis=(0, 2)))):
        step = _STEP * (model.cable.length if slips[:, k].any() else 1.0)
        unit = step * np.eye(given.p.shape[1])[k]
        both = (replace(given, p=given.p + unit), replace(given, p=given.p - unit))
        if p[:, k].any():
            yield p[:, k] / (2 * step), both
