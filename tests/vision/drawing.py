"""Pictures of a cable drawn with numpy, sharp to a small part of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter1d
from scipy.spatial import cKDTree

from dlo_casadi.vision import View, from_reference

SCALE = 500.0  # px/m
CORNER = np.array([100.0, 100.0])  # pixel of the board's origin


def square_view(shape):
    """View from straight ahead: the origin at CORNER, SCALE px/m."""
    points = np.array([[0.0, 0.0], [0.4, 0.0]])
    pixels = CORNER + SCALE * points * [1, -1]
    view = from_reference(pixels, points, shape)
    assert isinstance(view, View)
    return view


def to_pixels(points):
    return CORNER + SCALE * np.asarray(points) * [1, -1]


def distance(points, shape, farthest):
    """Distance [px] of each pixel from a polyline; infinite where it is `farthest` or more."""
    line = to_pixels(points)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    s = np.concatenate([[0], np.cumsum(steps)])
    fine = np.linspace(0, s[-1], int(10 * s[-1]))
    dense = np.column_stack([np.interp(fine, s, line[:, i]) for i in (0, 1)])
    away = np.full(shape, np.inf)
    v, u = near(line, shape, farthest)
    away[v, u] = cKDTree(dense).query(np.column_stack([u, v]), distance_upper_bound=farthest)[0]
    return away


def near(line, shape, farthest):
    """Rows and columns of all pixels, and of some more, nearer than `farthest` to a line (K, 2)."""
    band = np.zeros(shape, np.uint8)
    wide = int(np.ceil(2 * farthest)) + 5
    cv2.polylines(band, [np.round(line).astype(np.int32)], False, 1, wide)
    return np.nonzero(band)


def draw(
    points,
    *,
    width_px=6.0,
    shape=(420, 560),
    cable=(40, 40, 40),
    board=(190, 185, 180),
    highlight=0.0,
    shadow=0.0,
    blur=0.7,
    motion=0,
    noise=1.0,
    gradient=0.0,
    onto=None,
):
    """Draw a cable of `width_px` along points (K, 2) [m]; colours are blue, green, red."""
    picture = np.ones((*shape, 3)) * np.array(board, float) if onto is None else onto.astype(float)
    if gradient:
        picture = picture * (1 + gradient * np.linspace(-1, 1, shape[1])[None, :, None])
    if shadow:
        aside = np.asarray(points) + 1.2 * width_px / SCALE * np.array([0.8, -0.6])
        beside = distance(aside, shape, 0.5 + width_px / 2)
        dark = gaussian_filter(np.clip(0.5 + width_px / 2 - beside, 0, 1), 0.25 * width_px)
        picture = picture * (1 - shadow * dark[..., None])
    away = distance(points, shape, 0.5 + width_px / 2)
    cover = np.clip(0.5 + width_px / 2 - away, 0, 1)[..., None]
    body = (
        np.array(cable, float) + highlight * np.exp(-((away / (0.15 * width_px)) ** 2))[..., None]
    )
    picture = picture * (1 - cover) + body * cover
    if blur:
        picture = gaussian_filter(picture, (blur, blur, 0))
    if motion:
        picture = uniform_filter1d(picture, motion, axis=1)
    picture = picture + noise * np.random.default_rng(0).standard_normal(picture.shape)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def arc(length=0.6, turn=2.2, heading=-1.2, count=400, start=(0.2, -0.2)):
    """Points (count, 2) [m] of a curve whose curvature grows along it."""
    s = np.linspace(0, length, count)
    angle = heading + turn * (s / length) ** 1.5
    step = length / (count - 1)
    middle = 0.5 * (angle[1:] + angle[:-1])
    moves = step * np.column_stack([np.cos(middle), np.sin(middle)])
    return np.array(start) + np.concatenate([[[0, 0]], np.cumsum(moves, axis=0)])


def normal_distance_px(points, truth):
    """Distance [px] of points (K, 2) [m] from the polyline truth [m]."""
    s = np.linspace(0, 1, len(truth))
    fine = np.linspace(0, 1, 20 * len(truth))
    dense = np.column_stack([np.interp(fine, s, np.asarray(truth)[:, i]) for i in (0, 1)])
    return SCALE * cKDTree(dense).query(points)[0]
