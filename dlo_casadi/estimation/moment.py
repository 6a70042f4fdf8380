"""Moment against curvature: straight from a measured shape, and as a model has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import make_lsq_spline

from dlo_casadi.errors import EstimationError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of

FloatArray = NDArray[np.floating]

LEAST_POINTS = 10
# Degree and largest number of parts of the measured curve: its curvature is a cubic spline of eight
# coefficients, of fewer where there are fewer than two points for each coefficient of the curve.
DEGREE, MOST_PARTS = 5, 5
# Points of the integrals, and places of the result.
FINE = 1000
PLACES = 100


@dataclass(frozen=True)
class MomentCurve:
    """Bending moment [N m] and curvature >= 0 [1/m] at arc lengths s [m], all (K,)."""

    s: FloatArray
    curvature: FloatArray
    moment: FloatArray


def measured_moment_curve(
    points: FloatArray,
    length: float,
    weight: float,
    gravity: tuple[float, ...],
    s: FloatArray | None = None,
) -> MomentCurve:
    """Moment against curvature of a cable with a free end, without any law of its section.

        kappa(s) = |dt/ds|,   n = (dt/ds) / kappa,   a(s) = int_s^L (r(q) - r(s)) dq
        M(s) = (a . t) (f . n) - (a . n) (f . t),   f = w g / |g|

    M is the moment of what hangs beyond s, in the plane of the tangent t and the normal n in which
    the cable bends there: positive where the weight bends the cable the way it is bent. The curve
    r is a quintic spline between the first point and the last, fitted to the points by least
    squares; what lies beyond the last point is taken as straight.

    Parameters
    ----------
    points : (K, d) [m]
        From the clamp towards the free end, at least 10 points; d = 2 or 3.
    length : float [m]
    weight : float [N/m]
    gravity : (d,) [m/s^2]
        Its direction counts.
    s : (K,) [m], optional
        Arc lengths of the points where they are known; by default chords between all of them, the
        whole cable together.

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
    if s is None:
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        s = np.concatenate([[0.0], np.cumsum(steps)])
        s *= length / s[-1]  # chords of noisy points add up to more than the cable
    parts = min(MOST_PARTS, len(points) // 2 - DEGREE)
    knots = np.pad(np.linspace(s[0], s[-1], max(parts, 1) + 1), DEGREE, mode="edge")
    spline = make_lsq_spline(s, points, knots, DEGREE)
    fine = np.linspace(s[0], s[-1], FINE)
    curve, velocity, acceleration = (spline(fine, k) for k in range(3))
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    tangent = velocity / speed
    bend = acceleration - (acceleration * tangent).sum(axis=1, keepdims=True) * tangent
    bend /= speed**2
    curvature = np.linalg.norm(bend, axis=1)
    normal = bend / np.maximum(curvature, 1e-300)[:, None]
    force = weight * np.array(gravity) / np.linalg.norm(gravity)
    tip = length - s[-1]
    whole = cumulative_trapezoid(curve[::-1], fine, axis=0, initial=0)[::-1]
    whole += tip * (curve[-1] + tip / 2 * tangent[-1])
    beyond = whole - (length - fine)[:, None] * curve
    moment = (beyond * tangent).sum(axis=1) * (normal @ force)
    moment -= (beyond * normal).sum(axis=1) * (tangent @ force)
    kept = slice(None, None, FINE // PLACES)
    return MomentCurve(fine[kept], curvature[kept], moment[kept])


def law_of(model: CableModel, p: FloatArray, bend: FloatArray) -> FloatArray:
    """Moments (K,) [N m] that a model's section answers to bends (K,) [1/m] with.

    Laws that depend on the place count with the middle of the cable.
    """
    return np.array([float(lagrangian_of(model).section_moment(value, p)) for value in bend])
