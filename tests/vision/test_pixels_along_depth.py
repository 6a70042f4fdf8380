"""A cable that runs along its depth turns sharply in a picture: no pixel is taken there."""

from pathlib import Path

import numpy as np
import pytest
import scene
from scene import BOARD, CAMERA, DIAMETER, length_of, photograph, stand
from scipy.interpolate import CubicSpline

from dlo_casadi.arrays import unit
from dlo_casadi.sensing.pixels import ViewInput, bent_within_average, pixel_std, pixels_of
from dlo_casadi.vision import KnownCable, compare_pixels, measure_views

# Two places from which a part of the cable is seen nearly end on.
SEEN_FROM = {"a": ((0.499, -0.1596, 0.994), -0.06), "b": ((0.6574, -0.2354, 0.7596), -0.085)}


def coming_forward(count=2001):
    """Points (count, 3) [m] of a cable that comes towards these places and goes back."""
    u = np.linspace(0.0, 1.0, count)
    x = -0.25 + 0.5 * u + 0.06 * np.sin(2 * np.pi * u + 2.2825)
    y = 0.1 - 0.6215 * u * (1 - u) + 0.05 * np.sin(1.9808 * np.pi * u)
    z = 0.1 + 0.183 * np.sin(1.4037 * np.pi * u + 0.3673) ** 2
    return np.stack([x, y, z], axis=1)


@pytest.fixture(scope="module")
def views():
    points = coming_forward()
    with pytest.MonkeyPatch.context() as patch:
        places = {name: stand(center, roll=roll) for name, (center, roll) in SEEN_FROM.items()}
        patch.setattr(scene, "PLACES", places)
        scene.background.cache_clear()
        pictures = {name: photograph(points, name) for name in places}
        scene.background.cache_clear()
    cable = KnownCable(tuple(points[0]), tuple(points[-1]), DIAMETER, length_of(points))
    found = measure_views(pictures, BOARD, CAMERA, cable)
    return [
        ViewInput(name, Path(name), seen, found.places[name]) for name, seen in found.curves.items()
    ]


def off_by_std(pixels, std):
    """Errors (K,) of a sensor's pixels over their std, without those of the camera's pose."""
    points = coming_forward()
    curve, grid = CubicSpline(np.linspace(0.0, 1.0, len(points)), points), np.linspace(0, 1, 4001)
    line, tangents = curve(grid), unit(curve(grid, 1))
    seen = pixels.viewpoint.to_pixels(line)
    at = np.linalg.norm(pixels.pixels[:, None] - seen[None], axis=2).argmin(axis=1)
    off, _ = compare_pixels(
        pixels.viewpoint, pixels.pixels, line[at], tangents[at], pixels.diameter
    )
    weight = 1 / (pixels.weight * std)
    ways, left = pixels.by_camera * weight[:, None], pixels.size * off * weight
    pose = np.linalg.lstsq(
        np.vstack([5 * ways, np.eye(6)]), np.append(5 * left, np.zeros(6)), rcond=None
    )[0]
    return left - ways @ pose


def test_errors_stay_within_their_std_where_the_picture_turns(views):
    """Elsewhere they are a tenth of it; where the line turned back they were up to 2.7 times it."""
    std = pixel_std(views)
    for view in views:
        pixels = pixels_of(view, std, on_line=True)
        assert np.abs(off_by_std(pixels, std)).max() < 1.5


def test_where_the_line_turns_back_within_the_average_no_pixel_is_used(views):
    bends = [bent_within_average(view.seen) / view.seen.std for view in views]
    for view, bend in zip(views, bends, strict=True):
        kept = pixels_of(view, pixel_std(views), on_line=True).pixels
        at = np.abs(view.seen.pixels[:, None] - kept[None]).sum(axis=2).argmin(axis=0)
        assert bend[at].max() < 1.5 < bend[20:-20].max()
