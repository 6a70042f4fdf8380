"""Shapes predicted from the end conditions alone, and their distance from what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.assembly import Given
from dlo_casadi.equilibrium import Equilibrium, Pose, solve_equilibrium
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.estimation.observation import MeasuredPose, NodeCurve
from dlo_casadi.model import CableModel

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Prediction:
    """One pose predicted without its measurement.

    Parameters
    ----------
    equilibrium : Equilibrium
    curve : NodeCurve
        As the camera would see it.
    rest : (n_cells,) [1/m]
        Rest curvature that the pose finds.
    """

    equilibrium: Equilibrium
    curve: NodeCurve
    rest: FloatArray


def predict_poses(
    model: CableModel, p: FloatArray, rest: FloatArray, poses: Sequence[Pose]
) -> list[Prediction | None]:
    """Predict poses in the order in which they are taken; None where there is no equilibrium.

    Of several equilibria the stable one of lowest energy, unless the pose names a branch.

    Parameters
    ----------
    p : (n_parameters,)
    rest : (n_cells,) [1/m]
        Before the first pose.
    """
    out: list[Prediction | None] = []
    for pose in poses:
        try:
            eq = solve_equilibrium(model, p, rest, pose)
        except EquilibriumError:
            out.append(None)
            continue
        shapes, given = eq.shapes, Given.of(p, rest, pose.vector[None])
        z = model.assembly.curve(shapes, given)[0]
        out.append(Prediction(eq, NodeCurve.of(model.cable.length, z), rest))
        if model.has_state:
            rest = model.assembly.state_after(shapes, given)[0][0]
    return out


def rms_distance(
    predictions: Sequence[Prediction | None],
    measured: Sequence[MeasuredPose],
    held_out: bool,
) -> float | None:
    """Root mean square distance [m] of all measured points of one role to the predictions.

    None if there are no points of that role, or one of its poses could not be predicted.
    """
    squares = []
    for prediction, item in zip(predictions, measured, strict=True):
        if item.held_out is not held_out or not item.readable:
            continue
        if prediction is None:
            return None
        squares.append(prediction.curve.distances(item.points) ** 2)
    if not squares:
        return None
    return float(np.sqrt(np.concatenate(squares).mean()))
