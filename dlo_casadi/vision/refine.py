"""Sub-pixel position across the cable, from its profile in the original photograph."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.special import erf

from dlo_casadi.vision.curve import SmoothCurve
from dlo_casadi.vision.view import Array, View

REACH = 1.25  # half of the profile's length, in diameters
_ITERATIONS = 8


@dataclass(frozen=True)
class Profiles:
    """Brightness across the cable.

    Parameters
    ----------
    t : (K,) [m]
        Where along the curve.
    offset : (M,) [m]
        Where across it, positive to the left.
    values : (K, M, 3)
        Colours, averaged along the curve.
    inside : (K,) bool
        The whole profile lies in the photograph.
    """

    t: Array
    offset: Array
    values: Array
    inside: NDArray[np.bool_]


@dataclass(frozen=True)
class Crossings:
    """Where the cable lies across each profile.

    Parameters
    ----------
    offset : (K,) [m]
        Centre of the cable relative to the curve.
    std : (K,) [m]
        From the noise of the profile.
    contrast : (K,)
        Height of the cable's step relative to the typical one: 1 on the cable, 0 beside it.
    misfit : (K,)
        Residual of the profile relative to that height.
    width : scalar [m]
        Width of the cable common to all profiles.
    """

    offset: Array
    std: Array
    contrast: Array
    misfit: Array
    width: float


def sample_profiles(
    image: NDArray[np.float32], view: View, curve: SmoothCurve, t: Array, diameter: float
) -> Profiles:
    """Read the photograph along the normals of the curve and average along it.

    The average runs over half a diameter (one standard deviation), which lowers the noise of the
    pixels and of their compression, and bends nothing: the profiles follow the curve.
    """
    pixel = 1.0 / view.scale
    half = REACH * diameter + pixel
    count = int(np.clip(2 * half / min(0.5 * pixel, diameter / 10), 24, 80))
    offset = np.linspace(-half, half, count)
    centre, normal = curve.position(t), curve.normal(t)
    points = centre[:, None, :] + offset[None, :, None] * normal[:, None, :]
    at = view.to_pixels(points.reshape(-1, 2)).reshape(len(t), count, 2)
    high, wide = view.shape
    inside = np.all((at >= 0) & (at <= [wide - 1, high - 1]), axis=(1, 2))
    values = np.asarray(
        cv2.remap(image, at.astype(np.float32), None, cv2.INTER_CUBIC), dtype=float
    ).reshape(len(t), count, 3)
    spacing = float(np.median(np.diff(t)))
    values = gaussian_filter1d(values, max(0.5 * diameter / spacing, 0.1), axis=0, mode="nearest")
    return Profiles(t, offset, values, inside)


def cable_direction(profiles: Profiles, trusted: NDArray[np.bool_], diameter: float) -> Array:
    """Direction of colour (3,) that separates the cable from its surroundings best (Fisher).

    g ~ (C_cable + C_around)^-1 (mean_cable - mean_around)
    """
    values = profiles.values[trusted]
    core = values[:, np.abs(profiles.offset) < 0.3 * diameter].mean(axis=1)
    rim = np.abs(profiles.offset) > 0.8 * diameter
    around = values[:, rim].mean(axis=1)
    spread = np.cov((core - np.median(core, axis=0)).T) + np.cov(
        (values[:, rim].reshape(-1, 3) - np.repeat(around, rim.sum(), axis=0)).T
    )
    direction = np.linalg.solve(spread + 4.0 * np.eye(3), np.median(core - around, axis=0))
    return direction / np.linalg.norm(direction)


def fit_profiles(profiles: Profiles, direction: Array, diameter: float, blur: float) -> Crossings:
    """Fit the profile of a blurred cable to every cross-section.

    With x the offset, x0 the wanted centre, w the width, s the blur, Phi the normal distribution,

        f(x) = left (1 - A) + right B + (c_0 + c_1 y + c_2 y^2) (A - B),   y = (x - x0) / w
        A = Phi((x - x0 + w/2) / s),   B = Phi((x - x0 - w/2) / s)

    Each side has its own level, so that a shadow on one side does not pull the centre; the
    parabola takes up a highlight. The levels are linear and x0 is found by Gauss-Newton, all
    profiles at once; w and s are common to all and found from the sum of the residuals.
    """
    data = profiles.values @ direction
    width, spread = diameter, blur
    fit = _fit_rows(profiles.offset, data, width, spread)
    good = profiles.inside & (fit.cost < np.median(fit.cost[profiles.inside]) * 3)
    rows = np.nonzero(good)[0]
    rows = rows[:: max(1, len(rows) // 60)]
    for scale in (0.12, 0.05):
        trials = [
            (float(np.sort(_fit_rows(profiles.offset, data[rows], w, s, 4).cost).sum()), w, s)
            for w in width * (1 + scale * np.arange(-2, 3))
            for s in spread * (1 + 2 * scale * np.arange(-2, 3))
        ]
        _, width, spread = min(trials)
    fit = _fit_rows(profiles.offset, data, width, spread)
    typical = np.median(fit.height[good])
    return Crossings(
        fit.centre,
        fit.std,
        fit.height / typical,
        np.sqrt(fit.cost) / abs(typical),
        width,
    )


@dataclass(frozen=True)
class _RowFits:
    centre: Array
    std: Array
    height: Array
    cost: Array


def _fit_rows(x: Array, data: Array, width: float, blur: float, rounds: int = 8) -> _RowFits:
    """Gauss-Newton for all rows (K, M) at once; six unknowns a row."""
    window = np.abs(x) <= width / 2 + 0.75 * width + blur
    x, data = x[window], data[:, window]
    rows = len(data)
    centre = np.zeros(rows)
    limit = 0.5 * width
    for _ in range(rounds):
        design, a_density, b_density = _design(x, centre, width, blur)
        gram = np.einsum("kmi,kmj->kij", design, design)
        gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(5)
        levels = np.linalg.solve(gram, np.einsum("kmi,km->ki", design, data)[..., None])[..., 0]
        residual = data - np.einsum("kmi,ki->km", design, levels)
        left, right = levels[:, :1], levels[:, 1:2]
        rim_a = levels[:, 2:3] - 0.5 * levels[:, 3:4] + 0.25 * levels[:, 4:5]
        rim_b = levels[:, 2:3] + 0.5 * levels[:, 3:4] + 0.25 * levels[:, 4:5]
        slope = (left - rim_a) * a_density + (rim_b - right) * b_density
        projected = np.linalg.solve(gram, np.einsum("kmi,km->ki", design, slope)[..., None])
        slope_free = slope - np.einsum("kmi,ki->km", design, projected[..., 0])
        size = np.maximum((slope_free**2).sum(axis=1), 1e-12)
        step = (slope_free * residual).sum(axis=1) / size
        centre = np.clip(centre + np.clip(step, -0.3 * width, 0.3 * width), -limit, limit)
    cost = (residual**2).mean(axis=1)
    height = levels[:, 2] + levels[:, 4] / 12 - 0.5 * (levels[:, 0] + levels[:, 1])
    return _RowFits(centre, np.sqrt(cost / size), height, cost)


def _design(x: Array, centre: Array, width: float, blur: float) -> tuple[Array, Array, Array]:
    """Columns (K, M, 5) of the linear levels, and the two edges' densities (K, M)."""
    y = x[None, :] - centre[:, None]
    a, b = (y + width / 2) / blur, (y - width / 2) / blur
    rise_a, rise_b = 0.5 * (1 + erf(a / np.sqrt(2))), 0.5 * (1 + erf(b / np.sqrt(2)))
    body = rise_a - rise_b
    share = y / width
    design = np.stack([1 - rise_a, rise_b, body, body * share, body * share**2], axis=2)
    norm = 1.0 / (blur * np.sqrt(2 * np.pi))
    return design, norm * np.exp(-0.5 * a * a), norm * np.exp(-0.5 * b * b)
