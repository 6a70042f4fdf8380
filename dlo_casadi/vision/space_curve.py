"""Smooth curves in space through what several photographs show of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from dlo_casadi.vision.correspondence import places_along
from dlo_casadi.vision.curve import chord_length, length_of
from dlo_casadi.vision.image_curve import ImageCurve
from dlo_casadi.vision.outline import compare_pixels
from dlo_casadi.vision.view import Array, Viewpoint

_DEGREE = 3
_GRID = 401  # places along the curve among which a pixel's nearest is searched
_TANGENTIAL = 1e-5  # m: std of the prior that holds a curve along itself, which no picture shows
_HUBER = 3.0  # standard deviations beyond which a pixel counts less
# Spectral densities q of the third derivative that are tried, in L^2, where a curve of length L has
# 0 <= t <= 1: from a bow of 0.3 L to waves of 300 L; afterwards those near the last.
_WANDER, _WANDER_NEXT = np.logspace(-1.0, 5.0, 13), np.array([0.3, 0.6, 1.0, 1.7, 3.0])
_LOOPS, _SETTLED = 15, 3e-5  # m: a quarter of the smallest std of a line from three photographs


@dataclass(frozen=True)
class SpaceCurve:
    """A cubic B-spline r(t), 0 <= t <= 1, with t close to arc length over the whole."""

    coefficients: Array  # (n, 3) [m], in the board frame

    def design(self, t: Array) -> Array:
        """Basis functions (K, n) at t (K,)."""
        return _design(t, len(self.coefficients))

    def position(self, t: Array) -> Array:
        """Points (K, 3) [m]."""
        return self.design(t) @ self.coefficients

    def tangent(self, t: Array) -> Array:
        """Give the unit tangents (K, 3)."""
        slope = np.asarray(BSpline(_knots(len(self.coefficients)), self.coefficients, 3)(t, 1))
        return slope / np.linalg.norm(slope, axis=1, keepdims=True)

    @property
    def length(self) -> float:
        """Arc length [m]."""
        return length_of(self.position(_fine()))

    def away_from(self, fixtures: Sequence[Array]) -> Array:
        """Distances [m] of its ends from the fixtures: one of the start alone, or both."""
        ends = self.position(np.array([0.0, 1.0]))[: len(fixtures)]
        return np.asarray(np.linalg.norm(ends - np.array(fixtures), axis=1))

    def evenly(self) -> SpaceCurve:
        """Give the same curve with t proportional to its arc length."""
        grid = _fine()
        s = chord_length(self.position(grid))
        at = np.interp(grid * s[-1], s, grid)
        even = np.linalg.lstsq(self.design(grid), self.position(at), rcond=None)[0]
        return SpaceCurve(np.asarray(even, float))


@dataclass(frozen=True)
class CurveFit:
    """A curve, how well it is known, and where on it each pixel lies."""

    curve: SpaceCurve
    covariance: Array  # (n, 3, n, 3) [m^2] of its coefficients, across the curve
    params: tuple[Array, ...]  # (K,) of each photograph's pixels; nan where not of the curve
    residuals: tuple[Array, ...]  # (K,) [px], distances across the projected curve; nan there
    surprise: float  # -2 log of the marginal likelihood, up to a constant: compares hypotheses

    @property
    def places(self) -> list[Array]:
        """Places (K, 3) [m] of the pixels of each photograph; nan where it does not belong."""
        places = []
        for params in self.params:
            known = np.isfinite(params)
            places.append(np.full((len(params), 3), np.nan))
            places[-1][known] = self.curve.position(params[known])
        return places

    def std(self, t: Array) -> Array:
        """Largest standard deviation (K,) [m], in any direction across the curve, at t."""
        basis = self.curve.design(t)
        at = np.einsum("ka,aibj,kb->kij", basis, self.covariance, basis, optimize=True)
        return np.sqrt(np.maximum(np.linalg.eigvalsh(at)[:, -1], 0.0))


def first_curve(points: Array, along: Array, spans: int) -> SpaceCurve:
    """Smooth curve of `spans` polynomials through points (P, 3) [m], `along` it in this order."""
    t = (along - along[0]) / (along[-1] - along[0])
    n = spans + _DEGREE
    basis, rough = _design(t, n), np.diff(np.eye(n), 3, axis=0)
    # a point weighs as much as a wave of three spans that is as high as it is off
    normal = basis.T @ basis + len(points) / n * rough.T @ rough
    return SpaceCurve(np.asarray(np.linalg.solve(normal, basis.T @ points), float)).evenly()


def fit_curve_to_images(
    curves: Sequence[ImageCurve], first: SpaceCurve, params: Sequence[Array] | None = None
) -> CurveFit:
    """Move a curve onto what all photographs show of it.

        minimise  sum (n . (pi(r(t_k)) - u_k) / s_k)^2 + sum_v d_v^T C_v^-1 d_v
                  + 1/q integral |r'''|^2 dt

    over the coefficients of r and small motions d_v of each camera (Gauss-Newton): n is the normal
    of the projected curve, t_k the nearest place on it, C_v the covariance of the camera's pose. So
    a place where one photograph shows the curve along an epipolar line is left to the others. s_k
    counts pixels that share their errors as fewer. The prior, a white third derivative of spectral
    density q, fills gaps as smoothly as the rest of the curve is; q has the largest marginal
    likelihood. Pixels far off count less (Huber).

    The curve `first` must be seen within some pixels of the right place. `params` tell about where
    on it the pixels of each photograph lie; the nearest places, in order, if not given.

    References
    ----------
    Wahba, Spline Models for Observational Data, 1990: smoothing splines as Gaussian processes.
    """
    curve, n, m = first, len(first.coefficients), len(curves)
    grid = np.linspace(0.0, 1.0, _GRID)
    params = list(params or [places_along(seen, curve.position(grid)) for seen in curves])
    motions = np.zeros((m, 6))
    whitened = [_independent_std(seen) for seen in curves]
    rigid = [np.linalg.inv(seen.viewpoint.covariance) for seen in curves]
    prior = block_diag(np.zeros((3 * n, 3 * n)), *rigid)
    rough = block_diag(_roughness(n), np.zeros((6 * m, 6 * m)))
    wander = _WANDER * curve.length**2
    for loop in range(_LOOPS):
        still = np.hstack([_along_itself(curve), np.zeros((3 * n, 6 * m))])
        rows, errors, residuals = [still], [np.zeros(3 * n)], []
        for v, (seen, std) in enumerate(zip(curves, whitened, strict=True)):
            camera = moved_camera(seen.viewpoint, motions[v])
            params[v] = _nearest(curve, seen, camera, params[v])
            by_curve, by_motion, error = _linearise(curve, seen, camera, motions[v], params[v])
            residuals.append(error)
            used = np.isfinite(error)
            whole = np.zeros((len(by_curve), 3 * n + 6 * m))
            whole[:, : 3 * n] = by_curve
            whole[:, 3 * n + 6 * v : 3 * n + 6 * v + 6] = by_motion
            scaled = error[used] / std[used]
            weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(np.abs(scaled), 1e-9)))
            rows.append(whole * (weight / std[used])[:, None])
            errors.append(scaled * weight)
        A, e = np.vstack(rows), np.concatenate(errors)
        x = np.concatenate([curve.coefficients.ravel(), motions.ravel()])
        solved = _solve(A, e, x, rough, prior, wander)
        wander = solved.q * _WANDER_NEXT
        x = x + solved.step
        moved = float(np.abs(_design(_fine(), n) @ solved.step[: 3 * n].reshape(n, 3)).max())
        motions = x[3 * n :].reshape(m, 6)
        curve = SpaceCurve(x[: 3 * n].reshape(n, 3)).evenly()
        if loop > 2 and moved < _SETTLED:
            break
    covariance = cho_solve(solved.factor, np.eye(len(x)))[: 3 * n, : 3 * n].reshape(n, 3, n, 3)
    return CurveFit(curve, covariance, tuple(params), tuple(residuals), solved.surprise)


class _Step(NamedTuple):
    """A Gauss-Newton step under a prior."""

    step: Array
    factor: tuple[Array, bool]
    surprise: float
    q: float


def _solve(A: Array, e: Array, x: Array, rough: Array, prior: Array, wander: Array) -> _Step:
    """Gauss-Newton step with the likeliest of the densities `wander`.

    -2 log p(e | q) = |e - A dx|^2 + x^T (P + K / q) x + log det(H) + m log q, with the normal
    matrix H = A^T A + P + K / q and m the rank of K across the curve.
    """
    n = int(np.count_nonzero(np.diag(rough))) // 3
    fixed, gradient = A.T @ A + prior, A.T @ e - prior @ x

    def step_of(q: float) -> _Step:
        factor = cho_factor(fixed + rough / q)
        step = cho_solve(factor, gradient - rough @ x / q)
        y = x + step
        surprise = np.sum((e - A @ step) ** 2) + y @ prior @ y + y @ rough @ y / q
        surprise += 2.0 * np.log(np.diag(factor[0])).sum() + 2 * (n - _DEGREE) * np.log(q)
        return _Step(step, factor, float(surprise), q)

    return min(map(step_of, wander.tolist()), key=lambda found: found.surprise)


def _along_itself(curve: SpaceCurve) -> Array:
    """Rows (3 n, 3 n) that hold a curve where it is along itself, where no photograph does."""
    t = np.linspace(0.0, 1.0, 3 * len(curve.coefficients))
    rows = curve.design(t)[:, :, None] * curve.tangent(t)[:, None, :] / _TANGENTIAL
    return rows.reshape(len(t), -1)


def _linearise(
    curve: SpaceCurve, seen: ImageCurve, camera: Viewpoint, motion: Array, t: Array
) -> tuple[Array, Array, Array]:
    """Residuals (K,) [px] across the projected curve, nan where no place t is known.

    Before them minus their slopes, of the others, by coefficients (k, 3 n) and motions (k, 6).
    """
    error, used = np.full(len(t), np.nan), np.isfinite(t)
    basis, points, tangents = curve.design(t[used]), curve.position(t[used]), curve.tangent(t[used])
    error[used], slopes = compare_pixels(camera, seen.pixels[used], points, tangents, seen.diameter)
    by_shift = -slopes @ camera.rotation.T
    turned = points @ camera.rotation.T + camera.translation - motion[3:]
    by_curve = (basis[:, :, None] * -slopes[:, None, :]).reshape(len(points), -1)
    return by_curve, np.hstack([np.cross(turned, by_shift), by_shift]), error


def moved_camera(viewpoint: Viewpoint, motion: Array) -> Viewpoint:
    """Turn the board by the rotation vector w and shift it by d in the camera's frame."""
    turn = Rotation.from_rotvec(motion[:3]).as_matrix()
    return replace(
        viewpoint,
        rotation=turn @ viewpoint.rotation,
        translation=turn @ viewpoint.translation + motion[3:],
    )


def _nearest(curve: SpaceCurve, seen: ImageCurve, camera: Viewpoint, t: Array) -> Array:
    """Nearest places on the projected curve, from near ones; nan beyond its ends."""
    t = t.copy()
    for _ in range(2):
        used = np.nonzero(np.isfinite(t))[0]
        pixels, slopes = camera.project(curve.position(t[used]))
        tangent = np.einsum("kij,kj->ki", slopes, curve.tangent(t[used])) * curve.length
        off = np.sum((seen.pixels[used] - pixels) * tangent, axis=1)
        step = off / np.maximum(np.sum(tangent**2, axis=1), 1e-9)
        moved = t[used] + np.clip(step, -2.0 / _GRID, 2.0 / _GRID)
        t[used] = np.where((moved >= 0.0) & (moved <= 1.0), moved, np.nan)
    return t


def _independent_std(seen: ImageCurve) -> Array:
    """Standard deviations (K,) [px] of independent pixels that tell as much.

    Pixels a distance h apart whose errors are correlated over the length c (the integral of the
    correlation, on both sides) are worth h / (2 c) independent ones.
    """
    return seen.std * np.sqrt(max(2.0 * seen.correlation / max(seen.spacing, 1e-6), 1.0))


def _roughness(n: int) -> Array:
    """K (3 n, 3 n): c^T K c = integral |r'''|^2 dt, constant within a span."""
    third = np.diff(np.eye(n), 3, axis=0)
    return np.asarray(np.kron(third.T @ third * (n - _DEGREE) ** 5, np.eye(3)), float)


def _knots(n: int) -> Array:
    return np.asarray(np.arange(-_DEGREE, n + 1) / (n - _DEGREE))


def _design(t: Array, n: int) -> Array:
    if not len(t):
        return np.zeros((0, n))
    inside = np.clip(t, 0.0, 1.0 - 1e-12)
    return np.asarray(BSpline.design_matrix(inside, _knots(n), _DEGREE).toarray())


def _fine() -> NDArray[np.float64]:
    return np.linspace(0.0, 1.0, 1001)
