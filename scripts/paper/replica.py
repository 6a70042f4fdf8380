"""The experiment again: the printed parameters as truth, the twelve poses, a camera's noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.estimation.prediction import Prediction, predict_poses
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.sensing.noise import NoiseModel
from paper import published
from paper.content import rms

FloatArray = NDArray[np.floating]

# Quadratic elements on this mesh are within 1e-8 m of the limit.
TRUTH_MESH = 80
# The camera's picture [px], and the share of it that the scene fills.
PICTURE = (1280, 720)
FILLED = 0.85
# A thinned line lies on whole pixels: 1 / sqrt(12) px RMS. Rendered photographs show that a part
# of the error wanders over centimetres.
PIXEL_ERROR = 12**-0.5
CORRELATED_SHARE, CORRELATION_LENGTH = 0.3, 0.02
POINTS = 200
# Where shapes are compared.
PLACES = np.linspace(0.0, published.LENGTH, 201)


@dataclass(frozen=True)
class Replica:
    """A cable, what a camera sees of it, and its true shapes.

    Parameters
    ----------
    name : str
    stiffness : float [N m^2]
        True.
    guess : CableData
        With the stiffness that a fit starts from.
    theta_0 : (9,) [rad]
        True rest angles of ten links.
    measured : tuple of MeasuredPose
        All are fit poses.
    truth : (m, 201, 2) [m]
        Shapes without noise at `PLACES`.
    pixel, std : float [m]
    """

    name: str
    stiffness: float
    guess: CableData
    theta_0: FloatArray
    measured: tuple[MeasuredPose, ...]
    truth: FloatArray
    pixel: float
    std: float

    def without(self, held_out: Sequence[int]) -> tuple[MeasuredPose, ...]:
        """Measured poses, some of them held out."""
        return tuple(replace(item, held_out=k in held_out) for k, item in enumerate(self.measured))

    def errors(self, predictions: Sequence[Prediction | None]) -> FloatArray:
        """RMSE and STD of each pose against the true shape (m, 2) [m]; NaN where none is found.

        Of the distances of the true points to the predicted shape, over the cable's length.
        """
        rows = []
        for points, found in zip(self.truth, predictions, strict=True):
            if found is None:
                rows.append([np.nan, np.nan])
                continue
            distances = found.curve.distances(points)
            rows.append([rms(distances), float(distances.std())])
        return np.array(rows)


def true_shapes(stiffness: float, angles: FloatArray, mesh: int = TRUTH_MESH) -> list[NodeCurve]:
    """Curves of the twelve poses on the fine mesh, for the rest angles of ten links."""
    model = CableModel(published.cable(stiffness), n=mesh, element="quadratic")
    rest = published.RestShape(angles).on(model)
    found = predict_poses(model, model.nominal, rest, published.poses())
    return [item.curve for item in found if item is not None]


def pixel_of(curves: Sequence[NodeCurve]) -> float:
    """Size of a pixel [m]: all shapes of the session lie in one picture of a fixed camera."""
    points = np.concatenate([curve.nodes for curve in curves])
    extent = points.max(axis=0) - points.min(axis=0)
    return float((extent / (FILLED * np.array(PICTURE))).max())


def make(
    name: str, stiffness: float, guess: float, angles: FloatArray, mesh: int = TRUTH_MESH
) -> Replica:
    """Simulate the session of a cable with a stiffness and a first guess of it [N m^2]."""
    curves = true_shapes(stiffness, angles, mesh)
    pixel = pixel_of(curves)
    std = PIXEL_ERROR * pixel
    noise = NoiseModel(std, CORRELATED_SHARE, CORRELATION_LENGTH, "gaussian")
    s = np.linspace(0.01, 0.99, POINTS) * published.LENGTH
    factor = np.linalg.cholesky(noise.covariance(s, np.ones(POINTS)))
    rng = np.random.default_rng(0)
    measured = tuple(
        MeasuredPose.of_points(pose, curve.at(s) + factor @ rng.standard_normal((POINTS, 2)))
        for pose, curve in zip(published.poses(), curves, strict=True)
    )
    truth = np.array([curve.at(PLACES) for curve in curves])
    return Replica(name, stiffness, published.cable(guess), angles, measured, truth, pixel, std)


# A stiffness of a fifth of the weight's m g L^2: gravity bends the cable by centimetres.
REVEALING = 0.2 * published.MASS * 9.81 * published.LENGTH**2


def all_three() -> tuple[Replica, Replica, Replica]:
    """Three sessions in the same poses.

    The paper's stiffness, guessed right; one that shows, guessed three times too stiff; and, as a
    control, the paper's stiffness with a cable that is straight at rest.
    """
    bent, straight = published.rest_angles(), np.zeros(published.LINKS - 1)
    return (
        make("stiff", published.STIFFNESS, published.STIFFNESS, bent),
        make("revealing", REVEALING, 3 * REVEALING, bent),
        make("straight", published.STIFFNESS, published.STIFFNESS, straight),
    )
