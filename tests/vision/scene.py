"""A cable in front of a board, drawn from several places with numpy."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from drawing import near
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from dlo_casadi.vision import Board, Camera

SHAPE = (720, 960)
# k1, k2, p1, p2, k3, then rational, thin prism, tilted sensor: 20 px in a corner
LENS = [0.3, 0.1, 5e-4, -3e-4, 0.02, 0.4, 0.2, 0.02, 5e-4, 1e-3, -5e-4, 2e-4, 0.01, -0.015]
CAMERA = Camera(np.array([[810.0, 0.0, 470.0], [0.0, 806.0, 366.0], [0.0, 0.0, 1.0]]), LENS)
BOARD = Board(
    "DICT_5X5_100",
    0.06,
    0.0,
    {10: (-0.3, 0.25), 11: (0.35, 0.28), 12: (0.4, -0.3), 13: (-0.3, -0.3)},
)
DIAMETER = 0.008


def stand(center, target=(0.05, 0.0, 0.1), roll=0.0):
    """Rotation and translation of a camera at `center` [m] that looks at `target`."""
    ahead = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    turn = np.array(
        [[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]]
    )
    rotation = turn @ rotation
    return rotation, -rotation @ np.asarray(center, float)


PLACES = {
    "left": stand((-0.65, 0.1, 0.95), roll=0.05),
    "ahead": stand((0.1, -0.1, 1.2), roll=-0.1),
    "right": stand((0.8, 0.25, 0.8)),
}


def bow(count=2001):
    """Points (count, 3) [m] of a cable that sags and comes forward."""
    u = np.linspace(0.0, 1.0, count)
    x = -0.25 + 0.55 * u
    y = 0.1 - 0.8 * u * (1 - u) + 0.05 * u
    z = 0.08 + 0.12 * np.sin(np.pi * u) ** 2 - 0.04 * np.sin(3 * np.pi * u)
    return np.stack([x, y, z], axis=1)


def loop(count=2001):
    """Points (count, 3) [m] of a cable with a turn about an axis across the board."""
    u = np.linspace(0.0, 1.0, count)
    angle = 2 * np.pi * np.clip((u - 0.25) / 0.5, 0.0, 1.0)
    bump = np.sin(np.pi * u)
    x = -0.2 + 0.5 * u + 0.09 * np.sin(angle)
    y = 0.1 - 0.15 * bump + 0.09 * (np.cos(angle) - 1.0)
    z = 0.08 + 0.16 * u + 0.04 * bump
    smooth = np.stack([x, y, z], axis=1)
    return np.stack(
        [gaussian_filter(smooth[:, i], count / 40, mode="nearest") for i in range(3)], 1
    )


def length_of(points):
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


@cache
def _rays():
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    return CAMERA.undistort(np.column_stack([u.ravel(), v.ravel()]))


@cache
def background(where, grey=185.0, twice=()):
    """Picture (H, W) of the board: every pixel from sixteen places in it.

    `twice` are markers (number, (x, y)) beside those of the board.
    """
    rotation, translation = PLACES[where]
    plane = np.linalg.inv(np.column_stack([rotation[:, :2], translation]))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD.dictionary))
    half = 4.5 / 7 * BOARD.marker_size

    def light(rays):
        across, up, depth = plane @ np.vstack([rays.T, np.ones(len(rays))])
        x, y = across / depth, up / depth
        inside = (np.abs(x - 0.05) < 0.5) & (np.abs(y) < 0.45)
        seen = np.where(inside, grey, 0.45 * grey)
        for number, center in [*BOARD.marker_centers.items(), *twice]:
            cells = cv2.aruco.generateImageMarker(dictionary, number, 7)
            cells = np.pad(cells, 1, constant_values=255)
            on = np.nonzero((np.abs(x - center[0]) < half) & (np.abs(y - center[1]) < half))
            column = ((x[on] - center[0] + half) / half * 4.5).astype(int)
            row = ((half - y[on] + center[1]) / half * 4.5).astype(int)
            seen[on] = 10.0 + 0.92 * cells[row, column]
        return seen

    rays = _rays().reshape(*SHAPE, 2)
    picture = light(_rays()).reshape(SHAPE)
    edge = maximum_filter(picture, 3) != minimum_filter(picture, 3)  # elsewhere all are alike
    middle, right, down = (a[edge] for a in (rays, *np.gradient(rays, axis=(1, 0))))
    parts = [-0.375, -0.125, 0.125, 0.375]
    picture[edge] = np.mean([light(middle + i * right + j * down) for i in parts for j in parts], 0)
    return picture


def photograph(points, where, *, cable=(40, 60, 190), diameter=DIAMETER, blur=0.6, noise=1.5, **of):
    """Picture (H, W, 3) uint8 of a cable through points (K, 3) [m], its shadow on the board.

    A pixel shows the cable where its ray passes the axis nearer than the radius.
    """
    rotation, translation = PLACES[where]
    at = points @ rotation.T + translation
    flat = at[:, :2] / at[:, 2:]
    pixels = CAMERA.distort(flat)
    shadow_points = points + points[:, 2:] * np.array([0.35, -0.5, -1.0])
    shadow = shadow_points @ rotation.T + translation

    def cover(line, depth, soft):
        radii = 0.5 * CAMERA.focal * diameter / depth
        farthest = float(radii.max()) + 0.5 * soft
        v, u = near(line, SHAPE, farthest)
        away, nearest = cKDTree(line).query(np.stack([u, v], 1), distance_upper_bound=farthest)
        radius, covered = np.append(radii, 0.0)[nearest], np.zeros(SHAPE)
        covered[v, u] = np.clip((0.5 * soft + radius - away) / soft, 0.0, 1.0)
        return covered

    dark = cover(CAMERA.distort(shadow[:, :2] / shadow[:, 2:]), shadow[:, 2], 6.0)
    board = background(where, **of) * (1.0 - 0.25 * dark)
    body = cover(pixels, at[:, 2], 1.0)[..., None]
    picture = board[..., None] * (1.0 - body) + np.asarray(cable, float) * body
    picture = gaussian_filter(picture, (blur, blur, 0))
    picture += noise * np.random.default_rng(0).standard_normal(picture.shape)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)
