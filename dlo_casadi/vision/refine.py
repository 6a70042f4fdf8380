"""Sub-pixel position across the cable, from its profile in the original photograph."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from dlo_casadi.vision.curve import SmoothCurve
from dlo_casadi.vision.view import Array, View

_BESIDE = 0.75  # how far a profile reaches beyond the cable's edges, in widths
_SKEW_PRIOR = 0.05  # of the cable's height: the light from one side is this uneven
_BOW_PRIOR = 1.0
_NOISE = 0.02  # of the cable's height
_LUMINANCE = np.array([0.114, 0.587, 0.299])  # blue, green, red


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
class EdgeShape:
    """How wide the cable is in the photograph, and how blurred its edges.

    Parameters
    ----------
    width, blur : scalar [m]
        Distance of the edges and standard deviation of their blur.
    """

    width: float
    blur: float


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
    shape : EdgeShape
        Width and blur common to all profiles.
    """

    offset: Array
    std: Array
    contrast: Array
    misfit: Array
    shape: EdgeShape


def sample_profiles(
    image: NDArray[np.float32], view: View, curve: SmoothCurve, t: Array, diameter: float
) -> Profiles:
    """Read the photograph along the normals of the curve.

    Profiles that leave the photograph are marked, and hold the colours of its border.
    """
    pixel = 1.0 / view.scale
    half = (0.5 * 1.25 + _BESIDE * 1.25) * diameter + 1.5 * pixel
    count = int(np.clip(2 * half / min(0.5 * pixel, diameter / 10), 24, 64))
    offset = np.linspace(-half, half, count)
    centre, normal = curve.position(t), curve.normal(t)
    points = centre[:, None, :] + offset[None, :, None] * normal[:, None, :]
    at = view.to_pixels(points.reshape(-1, 2)).reshape(len(t), count, 2)
    high, wide = view.shape
    inside = np.all((at >= 0) & (at <= [wide - 1, high - 1]), axis=(1, 2))
    values = cv2.remap(
        image, at.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return Profiles(t, offset, np.asarray(values, dtype=float), inside)


def average(profiles: Profiles, trusted: NDArray[np.bool_], along: float) -> Profiles:
    """Average trusted profiles along the curve, with a Gaussian of deviation `along` [m].

    That lowers the noise of the pixels and of their compression, and bends nothing, since the
    profiles follow the curve.
    """
    deviation = max(along / float(np.median(np.diff(profiles.t))), 0.1)
    weight = trusted.astype(float)
    total = gaussian_filter1d(weight, deviation, mode="constant")
    summed = gaussian_filter1d(
        profiles.values * weight[:, None, None], deviation, axis=0, mode="constant"
    )
    values = np.where(
        total[:, None, None] > 1e-3,
        summed / np.maximum(total, 1e-3)[:, None, None],
        profiles.values,
    )
    return Profiles(profiles.t, profiles.offset, values, profiles.inside)


def cable_direction(profiles: Profiles, trusted: NDArray[np.bool_], diameter: float) -> Array:
    """Weights of colours (3,) that separate the cable from its surroundings.

    Luminance, where it does: JPEG keeps colour at half the resolution, and smears it. Otherwise
    Fisher's direction,

        g ~ (C_cable + C_around)^-1 (mean_cable - mean_around)
    """
    values = profiles.values[trusted]
    core = values[:, np.abs(profiles.offset) < 0.3 * diameter].mean(axis=1)
    rim = np.abs(profiles.offset) > 0.8 * diameter
    around = values[:, rim].mean(axis=1)
    spread = np.cov((core - np.median(core, axis=0)).T) + np.cov(
        (values[:, rim].reshape(-1, 3) - np.repeat(around, rim.sum(), axis=0)).T
    )
    step = np.median(core - around, axis=0)
    spread += 4.0 * np.eye(3)
    fisher = np.linalg.solve(spread, step)
    grey_signal = abs(_LUMINANCE @ step) / np.sqrt(_LUMINANCE @ spread @ _LUMINANCE)
    fisher_signal = np.sqrt(fisher @ step)
    if grey_signal > 0.3 * fisher_signal:
        return _LUMINANCE
    return fisher / np.linalg.norm(fisher)


def edge_shape(
    profiles: Profiles, direction: Array, trusted: NDArray[np.bool_], diameter: float, blur: float
) -> EdgeShape:
    """Width and blur that leave the smallest residual on some fifty profiles.

    A cable only a few pixels wide tells the one from the other poorly, and needs not: the centre
    hardly depends on which of the two explains its profile.
    """
    rows = np.nonzero(trusted)[0]
    data = (profiles.values @ direction)[rows[:: max(1, len(rows) // 50)]]
    width = diameter
    for scale in (0.12, 0.05):
        trials = [
            (float(np.median(_fit_rows(profiles.offset, data, w, s, rounds=4).cost)), w, s)
            for w in width * (1 + scale * np.arange(-2, 3))
            for s in blur * (1 + 2 * scale * np.arange(-2, 3))
        ]
        _, width, blur = min(trials)
    return EdgeShape(width, blur)


def fit_profiles(
    profiles: Profiles, direction: Array, trusted: NDArray[np.bool_], shape: EdgeShape
) -> Crossings:
    """Fit the profile of a blurred cable to every cross-section.

    With x the offset, x0 the wanted centre, w the width, s the blur, Phi the normal distribution,

        f(x) = l (1 - A) + r B + (c_0 + c_1 y + c_2 y^2) (A - B),     y = (x - x0) / w
        A = Phi((x - x0 + w/2) / s),   B = Phi((x - x0 - w/2) / s)

    Each side has its own level, so that a shadow on one side does not pull the centre; the
    parabola takes up shading and a highlight. Its skew c_1 and the centre look alike on a thin
    cable; a weak prior on it leaves the decision to the edges where they are sharp enough to
    tell. The levels are linear and x0 is found by Gauss-Newton, all profiles at once.
    """
    data = profiles.values @ direction
    fit = _fit_rows(profiles.offset, data, shape.width, shape.blur)
    typical = float(np.median(fit.height[trusted]))
    return Crossings(
        fit.centre, fit.std, fit.height / typical, np.sqrt(fit.cost) / abs(typical), shape
    )


@dataclass(frozen=True)
class _RowFits:
    centre: Array
    std: Array
    height: Array
    cost: Array


def _fit_rows(x: Array, data: Array, width: float, blur: float, rounds: int = 6) -> _RowFits:
    """Gauss-Newton for all rows (K, M) at once; five levels and a centre each."""
    window = np.abs(x) <= (0.5 + _BESIDE) * width + blur
    x, data = x[window], data[:, window]
    centre = np.zeros(len(data))
    prior = np.diag([1e-9, 1e-9, 1e-9, (_NOISE / _SKEW_PRIOR) ** 2, (_NOISE / _BOW_PRIOR) ** 2])
    for _ in range(rounds):
        design, a_density, b_density = _design(x, centre, width, blur)
        turned = design.transpose(0, 2, 1)
        gram = turned @ design + prior
        levels = np.linalg.solve(gram, turned @ data[..., None])
        residual = data - (design @ levels)[..., 0]
        left, right, core, skew, bow = levels.transpose(1, 0, 2)
        slope = (left - core + 0.5 * skew - 0.25 * bow) * a_density
        slope += (core + 0.5 * skew + 0.25 * bow - right) * b_density
        slope -= (design @ np.linalg.solve(gram, turned @ slope[..., None]))[..., 0]
        size = np.maximum((slope**2).sum(axis=1), 1e-12)
        step = np.clip((slope * residual).sum(axis=1) / size, -0.3 * width, 0.3 * width)
        centre = np.clip(centre + step, -0.5 * width, 0.5 * width)
    cost = (residual**2).mean(axis=1)
    height = (core + bow / 12 - 0.5 * (left + right))[:, 0]
    return _RowFits(centre, np.sqrt(cost / size), height, cost)


def _design(x: Array, centre: Array, width: float, blur: float) -> tuple[Array, Array, Array]:
    """Columns (K, M, 5) of the linear levels, and the two edges' densities (K, M)."""
    y = x[None, :] - centre[:, None]
    a, b = (y + width / 2) / blur, (y - width / 2) / blur
    rise_a, rise_b = ndtr(a), ndtr(b)
    body = rise_a - rise_b
    share = y / width
    norm = 1.0 / (blur * np.sqrt(2 * np.pi))
    design = np.stack([1 - rise_a, rise_b, body, body * share, body * share**2], axis=2)
    return design, norm * np.exp(-0.5 * a * a), norm * np.exp(-0.5 * b * b)
