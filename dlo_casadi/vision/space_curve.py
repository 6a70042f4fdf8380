"""Smooth curves in space, fitted to pixels of several photographs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.ndimage import find_objects, label

from dlo_casadi.arrays import FloatArray, chord_lengths, length_of, unit
from dlo_casadi.vision.camera import Picture, compare_pixels
from dlo_casadi.vision.centerline import FINE
from dlo_casadi.vision.image_curve import ImageCurve, other_stretches, places_along
from dlo_casadi.vision.profiles import (
    DEGREE,
    EdgeShape,
    find_edges,
    fit_curve,
    normals,
    sample_profiles,
)

_GRID = 401  # number of places along the curve in the search for the nearest to a pixel
_TANGENTIAL = 1e-5  # m: std of the prior on motions of a curve along itself, which are not visible
_HUBER = 3.0  # standard deviations beyond which a pixel is weighted less
# Trial spectral densities q of the third derivative, in L^2 for a curve of length L on 0 <= t <= 1:
# from a single bend of 0.3 L to waves of 300 L; then factors of the last one.
_WANDER, _WANDER_NEXT = np.logspace(-1.0, 5.0, 13), np.array([0.3, 0.6, 1.0, 1.7, 3.0])
# Maximum number of iterations, and largest step at convergence [m]: a quarter of the smallest std
# of a line from three photographs.
_LOOPS, _TOLERANCE = 15, 3e-5
_FINE = np.linspace(0.0, 1.0, 1001)  # closely spaced places along a line in space


@dataclass(frozen=True)
class SpaceCurve:
    """A cubic B-spline r(t), 0 <= t <= 1, with t close to arc length over the whole."""

    coefficients: FloatArray  # (n, 3) [m], in the board frame

    @property
    def knots(self) -> FloatArray:
        """Knots (n + 4,), evenly spaced."""
        n = len(self.coefficients)
        return np.asarray(np.arange(-DEGREE, n + 1) / (n - DEGREE))

    def design(self, t: FloatArray) -> FloatArray:
        """Basis functions (K, n) at t (K,)."""
        inside = np.clip(t, 0.0, 1.0 - 1e-12)
        if not len(t):
            return np.zeros((0, len(self.coefficients)))
        return np.asarray(BSpline.design_matrix(inside, self.knots, DEGREE).toarray())

    def position(self, t: FloatArray) -> FloatArray:
        """Points (K, 3) [m]."""
        return self.design(t) @ self.coefficients

    def tangent(self, t: FloatArray) -> FloatArray:
        """Give the unit tangents (K, 3)."""
        return unit(np.asarray(BSpline(self.knots, self.coefficients, DEGREE)(t, 1)))

    @property
    def length(self) -> float:
        """Arc length [m]."""
        return length_of(self.position(_FINE))

    def away_from(self, fixtures: FloatArray) -> FloatArray:
        """Distances [m] of its ends from the fixtures: one of the start alone, or both."""
        ends = self.position(np.array([0.0, 1.0]))[: len(fixtures)]
        return np.asarray(np.linalg.norm(ends - fixtures, axis=1))

    def evenly(self) -> "SpaceCurve":
        """Give the same curve with t proportional to its arc length."""
        s = chord_lengths(self.position(_FINE))
        at = np.interp(_FINE * s[-1], s, _FINE)
        even = np.linalg.lstsq(self.design(_FINE), self.position(at), rcond=None)[0]
        return SpaceCurve(np.asarray(even, float))


@dataclass(frozen=True)
class CurveFit:
    """A curve, its covariance, and the place on it of each pixel."""

    curve: SpaceCurve
    covariance: FloatArray  # (n, 3, n, 3) [m^2] of its coefficients, across the curve
    params: tuple[FloatArray, ...]  # (K,), t of each photograph's pixels; nan where not of it
    residuals: tuple[FloatArray, ...]  # (K,) [px], distances across the projected curve, or nan
    surprise: float  # -2 log of the marginal likelihood, up to a constant: compares hypotheses

    @property
    def places(self) -> list[FloatArray]:
        """Places (K, 3) [m] of the pixels of each photograph; nan where not of the curve."""
        return [
            np.where(np.isfinite(t)[:, None], self.curve.position(np.nan_to_num(t)), np.nan)
            for t in self.params
        ]

    def std(self, t: FloatArray) -> FloatArray:
        """Largest standard deviation (K,) [m], in any direction across the curve, at t."""
        basis = self.curve.design(t)
        at = np.einsum("ka,aibj,kb->kij", basis, self.covariance, basis, optimize=True)
        return np.sqrt(np.maximum(np.linalg.eigvalsh(at)[:, -1], 0.0))


def first_curve(points: FloatArray, along: FloatArray, spans: int) -> SpaceCurve:
    """Smooth curve of `spans` polynomials through points (P, 3) [m], `along` it in this order."""
    n = spans + DEGREE
    basis = SpaceCurve(np.zeros((n, 3))).design((along - along[0]) / (along[-1] - along[0]))
    rough = np.diff(np.eye(n), 3, axis=0)
    # a residual costs as much as a wave of three spans of the same amplitude
    normal = basis.T @ basis + len(points) / n * rough.T @ rough
    return SpaceCurve(np.asarray(np.linalg.solve(normal, basis.T @ points), float)).evenly()


def fit_curve_to_images(
    curves: Sequence[ImageCurve], first: SpaceCurve, params: Sequence[FloatArray] | None = None
) -> CurveFit:
    """Fit a curve to its pixels in all photographs.

        minimise  sum (n . (pi(r(t_k)) - u_k) / s_k)^2 + sum_v d_v^T C_v^-1 d_v
                  + 1/q integral |r'''|^2 dt

    over the coefficients of r and small motions d_v of each camera (Gauss-Newton): n is the normal
    of the projected curve, t_k the nearest place on it, C_v the covariance of the camera's pose.
    Where one photograph shows the curve along an epipolar line, the others determine it. s_k is
    larger for pixels with common errors. The prior, a white third derivative of spectral density
    q, makes gaps as smooth as the rest of the curve; q maximises the marginal likelihood. Pixels
    far off are weighted less (Huber).

    The image of `first` must be within some pixels of the right place. `params` are approximate
    places on it of each photograph's pixels; by default the nearest ones, in order.

    References
    ----------
    Wahba, Spline Models for Observational Data, 1990: smoothing splines as Gaussian processes.
    """
    curve, n, m = first, len(first.coefficients), len(curves)
    grid = np.linspace(0.0, 1.0, _GRID)
    params = list(params or [places_along(seen, curve.position(grid)) for seen in curves])
    # Pixels a distance h apart whose errors are correlated over the length c to either side (the
    # integral of the correlation from 0 on) are each worth h / (2 c) independent ones.
    shared = [max(2 * seen.correlation / max(seen.spacing, 1e-6), 1.0) for seen in curves]
    motions = np.zeros((m, 6))
    rigid = [np.linalg.inv(seen.viewpoint.covariance) for seen in curves]
    prior = block_diag(np.zeros((3 * n, 3 * n)), *rigid)
    # c^T K c = integral |r'''|^2 dt, constant within a span
    third = np.diff(np.eye(n), 3, axis=0)
    bending = np.kron(third.T @ third * (n - DEGREE) ** 5, np.eye(3))
    rough = np.asarray(block_diag(bending, np.zeros((6 * m, 6 * m))), float)
    wander = _WANDER * curve.length**2
    for loop in range(_LOOPS):
        # Rows that fix the curve's motion along itself, which no photograph shows.
        t = np.linspace(0.0, 1.0, 3 * n)
        still = curve.design(t)[:, :, None] * curve.tangent(t)[:, None, :] / _TANGENTIAL
        rows = [np.hstack([still.reshape(3 * n, -1), np.zeros((3 * n, 6 * m))])]
        errors, residuals = [np.zeros(3 * n)], []
        for v, seen in enumerate(curves):
            params[v], error, by_curve, by_motion = _linearise(curve, seen, motions[v], params[v])
            residuals.append(error)
            used = np.isfinite(error)
            whole = np.zeros((len(by_curve), 3 * n + 6 * m))
            whole[:, : 3 * n] = by_curve
            whole[:, 3 * n + 6 * v : 3 * n + 6 * v + 6] = by_motion
            std = seen.std[used] * np.sqrt(shared[v])
            scaled = error[used] / std
            weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(np.abs(scaled), 1e-9)))
            rows.append(whole * (weight / std)[:, None])
            errors.append(scaled * weight)
        A, e = np.vstack(rows), np.concatenate(errors)
        x = np.concatenate([curve.coefficients.ravel(), motions.ravel()])
        surprise, q, step, factor = _solve(A, e, x, rough, prior, wander)
        wander = q * _WANDER_NEXT
        x = x + step
        change = SpaceCurve(step[: 3 * n].reshape(n, 3))
        moved = float(np.abs(change.position(_FINE)).max())
        motions = x[3 * n :].reshape(m, 6)
        curve = SpaceCurve(x[: 3 * n].reshape(n, 3)).evenly()
        if loop > 2 and moved < _TOLERANCE:
            break
    covariance = cho_solve(factor, np.eye(len(x)))[: 3 * n, : 3 * n].reshape(n, 3, n, 3)
    return CurveFit(curve, covariance, tuple(params), tuple(residuals), surprise)


def _solve(
    A: FloatArray,
    e: FloatArray,
    x: FloatArray,
    rough: FloatArray,
    prior: FloatArray,
    wander: FloatArray,
) -> tuple[float, float, FloatArray, tuple[FloatArray, bool]]:
    """Gauss-Newton step with the most likely of the densities `wander`.

    Returns -2 log p, q, dx and the factor of H:
    -2 log p(e | q) = |e - A dx|^2 + x^T (P + K / q) x + log det(H) + m log q, with the normal
    matrix H = A^T A + P + K / q and m the rank of K across the curve.
    """
    n = int(np.count_nonzero(np.diag(rough))) // 3
    fixed, gradient = A.T @ A + prior, A.T @ e - prior @ x
    trials = []
    for q in wander.tolist():
        factor = cho_factor(fixed + rough / q)
        step = cho_solve(factor, gradient - rough @ x / q)
        y = x + step
        surprise = np.sum((e - A @ step) ** 2) + y @ prior @ y + y @ rough @ y / q
        surprise += 2.0 * np.log(np.diag(factor[0])).sum() + 2 * (n - DEGREE) * np.log(q)
        trials.append((float(surprise), q, step, factor))
    return min(trials, key=lambda trial: trial[0])


def _linearise(
    curve: SpaceCurve, seen: ImageCurve, motion: FloatArray, t: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Nearest places (K,) on the projected curve, from near ones t; nan beyond its ends.

    Then the residuals (K,) [px] across it, nan where there is no place, and minus the derivatives
    of the others by coefficients (k, 3 n) and motions (k, 6).
    """
    camera, t, error = seen.viewpoint.moved(motion), t.copy(), np.full(len(t), np.nan)
    for _ in range(2):
        used = np.nonzero(np.isfinite(t))[0]
        pixels, slopes = camera.project(curve.position(t[used]))
        tangent = np.einsum("kij,kj->ki", slopes, curve.tangent(t[used])) * curve.length
        off = np.sum((seen.pixels[used] - pixels) * tangent, axis=1)
        step = off / np.maximum(np.sum(tangent**2, axis=1), 1e-9)
        moved = t[used] + np.clip(step, -2.0 / _GRID, 2.0 / _GRID)
        t[used] = np.where((moved >= 0.0) & (moved <= 1.0), moved, np.nan)
    used = np.nonzero(np.isfinite(t))[0]
    basis, points, tangents = curve.design(t[used]), curve.position(t[used]), curve.tangent(t[used])
    error[used], slopes = compare_pixels(camera, seen.pixels[used], points, tangents, seen.diameter)
    by_shift = -slopes @ camera.rotation.T
    turned = points @ camera.rotation.T + camera.translation - motion[3:]
    by_curve = (basis[:, :, None] * -slopes[:, None, :]).reshape(len(points), -1)
    return t, error, by_curve, np.hstack([np.cross(turned, by_shift), by_shift])


def measure_shared_outlines(
    fit: CurveFit, curves: list[ImageCurve], images: list[Picture]
) -> tuple[CurveFit, list[ImageCurve]]:
    """Measure parts of the line that share an outline in a photograph, given the rest of it.

    They cross in it if that makes the line in space more likely; then they are measured once more
    with the sides of that line.
    """
    shared = []
    for curve in curves:
        pixels = curve.viewpoint.to_pixels(fit.curve.position(_FINE))
        beside = other_stretches(pixels, chord_lengths(pixels), curve.width)
        shared.append(bool(np.isfinite(beside).any()))
    if not any(shared):
        return fit, curves

    def measure(crossed: bool | None, guess: CurveFit) -> tuple[CurveFit, list[ImageCurve]]:
        seen, params = list(curves), list(guess.params)
        for v in np.flatnonzero(shared):
            seen[v], params[v] = see_beside(
                images[v], curves[v], guess.curve, fit.params[v], crossed
            )
        return fit_curve_to_images(seen, guess.curve, params), seen

    either = [measure(crossed, fit)[0] for crossed in (False, True)]
    return measure(None, min(either, key=lambda found: found.surprise))


def see_beside(
    image: Picture,
    seen: ImageCurve,
    line: SpaceCurve,
    params_seen: FloatArray,
    crossed: bool | None,
) -> tuple[ImageCurve, FloatArray]:
    """Measure parts of the line that share an outline, given the side of each of them.

    An outline of width W contains two parts of the width w, known from the rest of the line and
    the distance from the camera: their middles are (W - w) / 2 to either side of its own.

    `params_seen` (K,) are the places of the pixels on the line, nan where they do not belong to it.
    `crossed` says whether two parts change sides where their outline is narrowest, or keep the
    sides that they have where it is widest; None takes the sides of the line.

    Returns
    -------
    The curve in the photograph, in the order of the line, and the places of its pixels.
    """
    params, curve = _FINE, line.position(_FINE)
    viewpoint, distance = seen.viewpoint, seen.distance
    view = viewpoint.facing(distance)
    pixel = 1.0 / view.scale
    at, flat = viewpoint.in_camera(curve), viewpoint.flattened(curve, distance)
    t = chord_lengths(flat)
    beside = other_stretches(flat, t, seen.width * pixel)
    hidden = np.isfinite(beside)
    depth = float(np.median(at[~hidden, 2])) if not hidden.all() else distance
    width = seen.width * pixel * depth / at[:, 2]
    usual = float(width.mean())
    keep = seen.whole & np.isfinite(params_seen)
    keep &= ~(np.interp(params_seen, params, hidden.astype(float)) > 0.5)
    pixels, std, places = [seen.pixels[keep]], [seen.std[keep]], [params_seen[keep]]
    bright = image.astype(np.float32)
    spacing = pixel * seen.spacing
    for (run,) in find_objects(label(hidden)[0]):
        if np.ptp(t[run]) < usual or len(t[run]) < 4:
            continue
        middle = flat[run] + 0.5 * beside[run, None] * normals(np.gradient(flat[run], axis=0))
        middles = fit_curve(t[run], middle, np.ones(len(middle)), usual, 0.3 * usual)
        profiles = sample_profiles(bright, view, middles, t[run], usual)
        smooth = profiles.average(profiles.inside, FINE * usual)
        both = EdgeShape(usual + float(np.abs(beside[run]).max()), seen.blur * pixel)
        found = find_edges(smooth, seen.direction, both)
        apart = np.maximum(found.width - width[run], 0.0)
        side = np.sign(beside[run])  # side of the other part: 1 to the left
        if crossed is not None:
            widest_last = abs(beside[run][-1]) > abs(beside[run][0])
            side = np.full(len(side), side[-1 if widest_last else 0])
            narrowest = int(np.argmin(apart))
            beyond = slice(None, narrowest) if widest_last else slice(narrowest, None)
            side[beyond] *= -1 if crossed else 1
        offset = (found.offset - 0.5 * side * apart)[:, None]
        points = middles(t[run]) + offset * normals(middles(t[run], 1))
        good = profiles.inside & (np.abs(apart - np.abs(beside[run])) < 0.5 * usual)
        good &= np.diff(np.floor(t[run] / spacing), prepend=-1.0) > 0
        if not good.any():
            continue
        pixels.append(view.to_pixels(points[good]).reshape(-1, 2))
        # Both the outline and the rest of the line give the distance of the two.
        doubt = 0.5 * float(np.sqrt(np.mean((apart - np.abs(beside[run]))[good] ** 2))) / pixel
        told = np.sqrt(np.median(seen.std) ** 2 + (0.5 * seen.width_std) ** 2 + doubt**2)
        std.append(np.full(int(good.sum()), told))
        places.append(params[run][good])
    along = np.concatenate(places)
    order = np.argsort(along, kind="stable")
    pixels_again, std_again = np.vstack(pixels)[order], np.concatenate(std)[order]
    whole = np.ones(len(order), bool)
    return replace(seen, pixels=pixels_again, std=std_again, whole=whole), along[order]
