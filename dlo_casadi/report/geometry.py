"""Lines that figures and the page draw: deviations enlarged, measured lines with their ends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.session.outcome import Outcome, PoseInput, RestCurvatureEstimate, Stage
from dlo_casadi.session.pose_shape import PoseShape

FloatArray = NDArray[np.floating]


def magnified(pose: PoseInput, shape: PoseShape, factor: int) -> FloatArray:
    """The predicted curve, its distance from the measured points multiplied."""
    if factor == 1 or not len(pose.points):
        return shape.curve
    return beside(pose, shape, factor)


def beside(pose: PoseInput, shape: PoseShape, factor: float = 1.0) -> FloatArray:
    """Points (K, d) [m] of the prediction beside the measured ones, distances multiplied."""
    return np.asarray(pose.points - factor * shape.gap)


def band_outline(curve: FloatArray, half_width: FloatArray) -> FloatArray:
    """Outline (2 M, 2) [m] of a band of half widths (M,) [m] about a planar curve (M, 2)."""
    tangent = np.gradient(curve, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-300)
    side = half_width[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    return np.concatenate([curve + side, (curve - side)[::-1]])


def directions(outcome: Outcome) -> tuple[str, ...]:
    """Names of the directions across a cable: in a plane there is one, which needs none."""
    return ("y", "z") if outcome.config.experiment.in_space else ("",)


def residual_along(shape: PoseShape, direction: str) -> FloatArray:
    """Residual (K,) [m] in one of the `directions`."""
    return shape.residual[:, "yz".index(direction)] if direction else shape.residual


def residual_range(stage: Stage, noise: float) -> tuple[float, float]:
    """From where to where residuals are drawn, in standard deviations `noise` [m] of them.

    Beyond 95 % of the noise, and all residuals; of poses that were measured in another equilibrium
    than the predicted one, which are off by a hundred times as much, only where all are.
    """
    shown = [shape.residual for shape in stage.shapes.values() if len(shape.residual)]
    near = [
        shape.residual
        for shape in stage.shapes.values()
        if len(shape.residual) and shape.measured_branch is None
    ]
    values = np.concatenate([part.ravel() for part in near or shown or [np.zeros(1)]])
    low, high = min(values.min() / noise, -2.0), max(values.max() / noise, 2.0)
    return low - 0.08 * (high - low), high + 0.08 * (high - low)


def rest_about(stage: Stage, direction: str) -> RestCurvatureEstimate:
    """Rest curvature (M,) about one of the `directions`; in a plane that about its normal."""
    rest = stage.rest_curvature
    if not direction:
        return rest
    k = "yz".index(direction)
    return RestCurvatureEstimate(rest.s, rest.value[k], rest.std[k])


def measured_line(outcome: Outcome, name: str) -> tuple[FloatArray, FloatArray] | None:
    """Measured points of a pose between its fixtures with their places along the cable [m]."""
    measured = next((pose for pose in outcome.poses if pose.name == name), None)
    declared = next((p for p in outcome.config.experiment.poses if p.name == name), None)
    if measured is None or declared is None or not len(measured.points):
        return None
    parts = [np.array([declared.start]), measured.points]
    if declared.end is not None:
        parts.append(np.array([declared.end]))
    points = np.concatenate(parts)
    places = np.concatenate([[0.0], np.cumsum(np.hypot.reduce(np.diff(points, axis=0), axis=1))])
    if declared.end is not None:
        places *= outcome.config.cable.length / places[-1]
    return places, points
