"""Smooth curves in a picture, and the sub-pixel position across them from its profiles."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.sparse import csr_array, diags_array

from dlo_casadi.arrays import BoolArray, FloatArray, unit
from dlo_casadi.vision.camera import View

_LUMINANCE = np.array([0.114, 0.587, 0.299])  # blue, green, red
_BESIDE = 2.2  # blurs beyond the edge: where the surroundings begin
_BODY = 0.4  # widths: half of the middle part that has the cable's own level
_LOCAL = 2.0  # diameters along the cable over which steps are averaged
# Widths along the cable, to either side, of constant illumination. Beside a card that hides part
# of a rendered cable, lines on a board are 0.93 mm off with 2, 0.73 mm with 5, 0.69 mm with 12.
_LIT = 5.0
_INNER = 0.15  # of the width: nearer to the middle both sides look alike
_CLEAR = 1.3  # blurs inside an edge where nine tenths of the step are reached
_MOST_SHADE = 0.5  # of the step: largest difference due to shading
_FAINT = 0.3  # of the usual step: the smallest step of the cable
_BARE = 0.35  # share of the cable's width free of highlights
DEGREE = 3  # of all splines


def normals(steps: FloatArray) -> FloatArray:
    """Unit vectors (K, 2) to the left of steps (K, 2)."""
    return unit(steps)[:, ::-1] * [-1.0, 1.0]


def fit_curve(
    t: FloatArray, points: FloatArray, weights: FloatArray, knot: float, smooth: float
) -> BSpline:
    """Fit a cubic smoothing spline r(t).

        minimise  sum_k w_k |r(t_k) - p_k|^2  +  W (smooth / knot)^4 sum_i |D^2 c_i|^2

    with knots every `knot` metres, second differences D^2 of the coefficients c, and W the sum of
    the weights per coefficient. In gaps the penalty alone determines the curve.

    `t` (K,) [m] increases along the points (K, 2) [m]; the weights (K,) are inverse variances up to
    a factor. Wavelengths (over 2 pi) well below `smooth` are smoothed away.
    """
    lower, upper = float(t[0]), float(t[-1])
    count = max(1, round((upper - lower) / knot))
    step = (upper - lower) / count
    knots = lower + step * np.arange(-DEGREE, count + DEGREE + 1)
    inside = np.clip(t, lower, upper - 1e-12 * (upper - lower))
    basis = csr_array(BSpline.design_matrix(inside, knots, DEGREE))
    size = basis.shape[1]
    weighted = csr_array(diags_array(weights) @ basis)
    rough = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(size - 2, size))
    penalty = (smooth / step) ** 4 * max(float(weights.sum()), 1e-12) / size
    normal = csr_array(basis.T @ weighted + penalty * (rough.T @ rough))
    banded = np.array([np.pad(normal.diagonal(k), (k, 0)) for k in range(DEGREE, -1, -1)])
    banded[-1] += 1e-12 * banded[-1].max()
    coefficients = solveh_banded(banded, np.asarray(weighted.T @ points))
    return BSpline(knots, coefficients, DEGREE)


@dataclass(frozen=True)
class Profiles:
    """Brightness across the cable."""

    t: FloatArray  # (K,) [m], where along the curve
    offset: FloatArray  # (M,) [m], where across it, positive to the left
    values: FloatArray  # (K, M, 3), colours
    inside: BoolArray  # (K,), the cable and its edges lie in the photograph

    def core_and_rim(self, diameter: float) -> tuple[FloatArray, FloatArray]:
        """Colours (K, 3) of the cable in each profile, and those (K, R, 3) of its surroundings."""
        core = self.values[:, np.abs(self.offset) < 0.3 * diameter].mean(axis=1)
        return core, self.values[:, np.abs(self.offset) > 0.8 * diameter]

    def average(self, trusted: BoolArray, along: float) -> "Profiles":
        """Average trusted profiles along the curve by a Gaussian; its std is `along` [m].

        That reduces the noise of pixels and compression without a bias by curvature, since the
        profiles follow the curve.
        """
        deviation = max(along / float(np.median(np.diff(self.t))), 0.1)
        weight = trusted.astype(float)
        total = gaussian_filter1d(weight, deviation, mode="constant")[:, None, None]
        weighted = self.values * weight[:, None, None]
        summed = gaussian_filter1d(weighted, deviation, axis=0, mode="constant")
        values = np.where(total > 1e-3, summed / np.maximum(total, 1e-3), self.values)
        return replace(self, values=values)


@dataclass(frozen=True)
class EdgeShape:
    """Width of the cable in the photograph, and blur of its edges."""

    width: float = 0.0  # [m], distance of the two edges
    blur: float = 0.0  # [m], standard deviation of an edge's blur


@dataclass(frozen=True)
class Crossings:
    """Where the cable lies across each profile."""

    offset: FloatArray  # (K,) [m], middle between the two edges, relative to the curve
    width: FloatArray  # (K,) [m], distance of the two edges
    rise: FloatArray  # (K,) [m], blur of the edges, as a standard deviation
    height: FloatArray  # (K,) [grey levels], step from the surroundings to the cable


def sample_profiles(
    image: NDArray[np.float32], view: View, curve: BSpline, t: FloatArray, diameter: float
) -> Profiles:
    """Read the photograph along the normals of the curve.

    Profiles that leave the photograph are marked, and have the colours of its border.
    """
    pixel, (high, wide) = 1.0 / view.scale, view.shape
    half = 1.2 * diameter + 3 * pixel
    count = int(np.clip(2 * half / min(0.5 * pixel, diameter / 10), 24, 64))
    offset = np.linspace(-half, half, count)
    centre, normal = curve(t), normals(curve(t, 1))
    points = centre[:, None, :] + offset[None, :, None] * normal[:, None, :]
    at = view.to_pixels(points.reshape(-1, 2)).reshape(len(t), count, 2)
    needed = np.abs(offset) < 0.5 * diameter + 2.5 * pixel
    inside = np.all((at[:, needed] >= 0) & (at[:, needed] <= [wide - 1, high - 1]), axis=(1, 2))
    values = cv2.remap(
        image, at.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return Profiles(t, offset, np.asarray(values, dtype=float), inside)


def cable_direction(profiles: Profiles, trusted: BoolArray, diameter: float) -> FloatArray:
    """Weights of colours (3,) that separate the cable from its surroundings.

    Luminance if it does: JPEG stores colour at half the resolution. Otherwise Fisher's direction,

        g ~ (C_cable + C_around)^-1 (mean_cable - mean_around)
    """
    core, rim = (part[trusted] for part in profiles.core_and_rim(diameter))
    around = rim.mean(axis=1)
    scatter = np.cov((rim - around[:, None]).reshape(-1, 3).T)
    spread = np.cov((core - np.median(core, axis=0)).T) + scatter
    step = np.median(core - around, axis=0)
    spread += 4.0 * np.eye(3)
    fisher = np.linalg.solve(spread, step)
    grey_signal = abs(_LUMINANCE @ step) / np.sqrt(_LUMINANCE @ spread @ _LUMINANCE)
    fisher_signal = np.sqrt(fisher @ step)
    return _LUMINANCE if grey_signal > 0.3 * fisher_signal else fisher / np.linalg.norm(fisher)


def local_directions(
    profiles: Profiles, direction: FloatArray, trusted: BoolArray, diameter: float
) -> FloatArray:
    """Weights of colours (K, 3) for a cable that passes in front of different surroundings.

    Where the step from the surroundings to the cable, smoothed along it, is less than half of the
    usual one in the common direction g, or reversed, its own direction is taken, scaled to the
    usual step h:

        g_k = h d_k / |d_k|^2,  d_k the step in all colours
    """
    core, rim = profiles.core_and_rim(diameter)
    deviation = _LOCAL * diameter / float(np.median(np.diff(profiles.t)))
    step = gaussian_filter1d(core - rim.mean(axis=1), deviation, axis=0, mode="nearest")
    usual = float(np.median((step @ direction)[trusted]))
    size = np.sum(step**2, axis=1)
    other = (step @ direction / usual < 0.5) & (size > (_FAINT * usual) ** 2)
    own = usual * step / np.maximum(size, 1e-9)[:, None]
    return np.where(other[:, None], own, direction)


def find_edges(
    profiles: Profiles, direction: FloatArray, shape: EdgeShape, lit_aside: bool = False
) -> Crossings:
    """Find both edges of every profile, and the middle between them.

    The direction (3,) or (K, 3) weights the colours. An edge is where the brightness is half-way
    between the cable and its surroundings on the same side and close by: a shadow beside the cable
    changes the level of one side, not the place of the edge. Instead of one crossing, the mean over
    all levels from 1/4 to 3/4 is used. With q the share of the way from surroundings (0) to cable
    (1), and Q(x) the largest q from x outwards, which ignores a highlight wherever it lies,

        x_edge = integral_0^out clip(2 Q(x) - 1/2, 0, 1) dx

    The cable's level is the one that differs most from the surroundings, over a third of it; with
    `lit_aside` it is another one on the side that is turned to the light: by half the median
    difference of places that mirror each other, which passes over a highlight.
    """
    weights = np.broadcast_to(direction, (len(profiles.t), 3))
    data = np.einsum("kmc,kc->km", profiles.values, weights)
    near = max(1, round(2 * _LIT * shape.width / float(np.median(np.diff(profiles.t)))))
    centre = np.zeros(len(data))
    out = 0.5 * shape.width + _BESIDE * shape.blur
    reach = np.linspace(0.0, out, 64)
    step = reach[1]
    body = max(2, int(_BODY * shape.width / step))
    clear = (reach > _INNER * shape.width) & (reach < 0.5 * shape.width - _CLEAR * shape.blur)
    for _ in range(3):
        left = _interpolate(profiles.offset, data, centre[:, None] - reach)
        right = _interpolate(profiles.offset, data, centre[:, None] + reach)
        beside = [side[:, -3:].mean(axis=1) for side in (left, right)]
        around = 0.5 * (beside[0] + beside[1])
        core = _own_level(np.hstack([left[:, :body], right[:, :body]]), around)
        tilt = np.zeros(len(data))
        if lit_aside and clear.any():
            shade = 0.5 * np.median(right[:, clear] - left[:, clear], axis=1)
            shade[np.abs(shade) > _MOST_SHADE * np.abs(core - around)] = 0.0
            tilt = median_filter(shade, size=near, mode="nearest")
        to_left, left_blur = _mean_crossing(left, core - tilt, beside[0], step)
        to_right, right_blur = _mean_crossing(right, core + tilt, beside[1], step)
        move = np.clip(0.5 * (to_right - to_left), -0.3 * shape.width, 0.3 * shape.width)
        centre = np.clip(centre + move, -0.5 * shape.width, 0.5 * shape.width)
    return Crossings(centre, to_left + to_right, 0.5 * (left_blur + right_blur), core - around)


def edge_shape(
    profiles: Profiles, direction: FloatArray, trusted: BoolArray, first: EdgeShape
) -> EdgeShape:
    """Width and blur that are typical of the trusted profiles, from a first guess of both."""
    shape = first
    for _ in range(2):
        found = find_edges(profiles, direction, shape)
        width = float(np.clip(np.median(found.width[trusted]), 0.4 * first.width, None))
        rise = float(np.clip(np.median(found.rise[trusted]), 0.5 * first.blur, 0.5 * first.width))
        shape = EdgeShape(min(width, 1.4 * first.width), rise)
    return shape


def _own_level(body: FloatArray, around: FloatArray) -> FloatArray:
    """Level (K,) of the cable in the middle of each profile (K, P), without any highlight.

    Whether it is darker or brighter than its surroundings is the same for all profiles, and judged
    in the outer thirds of the body, which a highlight seldom reaches.
    """
    half = body.shape[1] // 2
    outer = np.hstack([body[:, half // 2 : half], body[:, half + half // 2 :]])
    brighter = np.median(outer.mean(axis=1) - around) > 0
    return np.asarray(np.quantile(body, 1 - _BARE if brighter else _BARE, axis=1))


def _mean_crossing(
    side: FloatArray, core: FloatArray, around: FloatArray, step: float
) -> tuple[FloatArray, FloatArray]:
    """Distance (K,) [m] from the middle to the edge of one side (K, M), and its blur (K,) [m].

    The levels 1/4 and 3/4 of a blurred step are 1.35 standard deviations apart.
    """
    height = core - around
    height = np.where(np.abs(height) < 3.0, np.copysign(3.0, height), height)
    share = (side - around[:, None]) / height[:, None]
    share = np.maximum.accumulate(share[:, ::-1], axis=1)[:, ::-1]
    inner = step * np.clip(4 * share - 2, 0, 1).sum(axis=1)  # levels from 1/2 to 3/4
    outer = step * np.clip(4 * share - 1, 0, 1).sum(axis=1)  # levels from 1/4 to 1/2
    return 0.5 * (inner + outer), np.maximum(outer - inner, 0.0) / 0.69


def _interpolate(x: FloatArray, data: FloatArray, at: FloatArray) -> FloatArray:
    """Values (K, P) of rows of data (K, M), sampled evenly at x (M,), at places (K, P)."""
    place = np.clip((at - x[0]) / (x[1] - x[0]), 0, len(x) - 1.001)
    left = place.astype(int)
    share = place - left
    rows = np.arange(len(data))[:, None]
    return data[rows, left] * (1 - share) + data[rows, left + 1] * share
