"""A quick fit of a few poses on a coarse mesh: what shapes tell before anything is trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import fit_model
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import BENDING_STIFFNESS
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.declared import declared_model
from dlo_casadi.session.measure import conditions
from dlo_casadi.session.outcome import PoseInput

FloatArray = NDArray[np.floating]

# Elements of a mesh that shows how a cable hangs.
MESH = 12
# Coefficients of the rest curvature, and noise over the length: effects that are missing are
# below it.
_REST, _FAITHFUL = 4, 2e-3
_DECADES = (0, -1, 1)
# Stiffness over weight is known if its relative standard deviation is below this: units are told
# where forces are five times off.
_SIZED = 0.5


def some(read: Sequence[PoseInput], most: int) -> Sequence[PoseInput]:
    """At most so many poses, evenly picked."""
    return read[:: max(1, -(-len(read) // most))]


def posed(config: Config, inputs: Sequence[PoseInput]) -> list[MeasuredPose]:
    """Points of poses with their declared end conditions."""
    declared = {pose.name: pose for pose in config.experiment.poses}
    return [
        MeasuredPose.of_points(conditions(declared[item.name]), item.points, s=item.s)
        for item in inputs
    ]


def coarse_fit(config: Config, inputs: Sequence[PoseInput], gravity: Sequence[float]) -> Fit | None:
    """Fit of the declared cable without effects under some gravity [m/s^2]; None if none is found.

    It takes all inputs, whatever their role.
    """
    model = declared_model(config).model
    model = replace(model, gravity=tuple(gravity), effects=(), priors={}, n=MESH, n_rest=_REST)
    noise = _FAITHFUL * config.cable.length
    try:
        return fit_model(model, posed(config, inputs), Tolerances(), noise, decades=_DECADES)
    except EstimationError:
        return None


def tells_weight(fit: Fit) -> bool:
    """Whether the shapes tell stiffness over weight."""
    return bool(fit.std(BENDING_STIFFNESS) < _SIZED * fit.value(BENDING_STIFFNESS))
