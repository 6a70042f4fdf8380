"""Moment against curvature: straight from a measured shape, and as a model has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares

from dlo_casadi.errors import EstimationError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.model.rest_curvature import RestCurvature

FloatArray = NDArray[np.floating]

LEAST_POINTS = 10
# Coefficients of the measured curvature, points of the integrals, and places of the result.
COEFFICIENTS = 8
FINE = 1000
PLACES = 100


@dataclass(frozen=True)
class MomentCurve:
    """Bending moment [N m] and curvature [1/m] at arc lengths s [m], all (K,)."""

    s: FloatArray
    curvature: FloatArray
    moment: FloatArray


def measured_moment_curve(
    points: FloatArray, length: float, weight: float, gravity: tuple[float, ...]
) -> MomentCurve:
    """Moment against curvature of a cable with a free end, without any law of its section.

        M(s) = w int_s^L ((r(t) - r(s)) x g / |g|) dt,   kappa(s) = d heading / ds

    from a curve whose curvature is a cubic spline, fitted to the points by least squares.

    Parameters
    ----------
    points : (K, 2) [m]
        Centre-line from the clamp to the free end, at least 10 points.
    length : float [m]
    weight : float [N/m]
    gravity : (float, float) [m/s^2]
        Its direction counts.

    Raises
    ------
    EstimationError
        If there are too few points.

    References
    ----------
    The cantilever test as evaluated by Broberg et al., Composites Part B 260 (2023).
    """
    if len(points) < LEAST_POINTS:
        raise EstimationError(
            f"a moment curve needs at least {LEAST_POINTS} points, got {len(points)}"
        )
    steps = np.hypot(*np.diff(points, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    along *= length / along[-1]  # chords of noisy points add up to more than the cable
    fine = np.linspace(0.0, length, FINE)
    basis = RestCurvature(length, COEFFICIENTS)
    turn = cumulative_trapezoid(basis.basis(fine), fine, axis=0, initial=0)

    def shape(unknowns: FloatArray) -> FloatArray:
        """Curve (FINE, 2) from the start (2), its heading, and the curvature's coefficients."""
        heading = unknowns[2] + turn @ unknowns[3:]
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        return unknowns[:2] + cumulative_trapezoid(tangent, fine, axis=0, initial=0)

    def gap(unknowns: FloatArray) -> FloatArray:
        curve = shape(unknowns)
        seen = [np.interp(along, fine, column) for column in curve.T]
        return np.concatenate([seen[0] - points[:, 0], seen[1] - points[:, 1]])

    toward = points[len(points) // 10] - points[0]
    guess = np.concatenate([points[0], [np.arctan2(toward[1], toward[0])], np.zeros(COEFFICIENTS)])
    unknowns = least_squares(gap, guess, x_scale="jac").x
    curve = shape(unknowns)
    force = weight * np.array(gravity) / np.linalg.norm(gravity)
    # Moment about s of what hangs beyond: int_s^L r dt x force - (L - s) r(s) x force.
    beyond = curve[:, 0] * force[1] - curve[:, 1] * force[0]
    whole = cumulative_trapezoid(beyond[::-1], fine, initial=0)[::-1]
    moment = whole - (length - fine) * beyond
    s = fine[:: FINE // PLACES]
    curvature = basis.basis(s) @ unknowns[3:]
    moment = moment[:: FINE // PLACES]
    return MomentCurve(s, curvature, moment)


def law_of(model: CableModel, p: FloatArray, bend: FloatArray) -> FloatArray:
    """Moments (K,) [N m] that a model's section answers to bends (K,) [1/m] with.

    Laws that depend on the place count with the middle of the cable.
    """
    return np.array([float(lagrangian_of(model).section_moment(value, p)) for value in bend])
