"""The centre-line of a cable in space as one photograph shows it, in pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label
from scipy.spatial import cKDTree

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.centerline import measure_line
from dlo_casadi.vision.curve import chord_length, normals
from dlo_casadi.vision.search import Workings
from dlo_casadi.vision.trace import FINE
from dlo_casadi.vision.view import Array, Viewpoint
from dlo_casadi.vision.workplane import ExpectedLine

_NEAREST = 0.2  # m: least distance from which a cable is photographed
_BESIDE = 1.6  # widths between two stretches below which they share an edge
_APART = 2.0  # widths along the line from which two places are different stretches
TIP = 4.0  # widths from a fixture beyond which a message names the line's end


@dataclass(frozen=True)
class ImageCurve:
    """The centre-line in one photograph, ordered from start to end.

    Parameters
    ----------
    viewpoint : Viewpoint
        Where the camera stands.
    pixels : (K, 2) [px]
        Middle of the cable's outline, as photographed.
    std : (K,) [px]
        Standard deviation of each across the line.
    whole : (K,) bool
        Both edges are seen; where not, another stretch of the cable lies beside or behind, and
        the pixel is only somewhere in their common outline.
    width : scalar [px]
        Distance of the two edges, the median along the line.
    width_std : scalar [px]
        Its scatter along the line.
    diameter : scalar [m]
        Of the cable, as declared.
    distance : scalar [m]
        Depth at which the picture was searched: between the fixtures.
    correlation : scalar [px]
        Length along the line over which neighbours share their errors, the integral of the
        correlation: pixels are averaged along the cable by a Gaussian.
    confidence : scalar in 0..1
        Share of the line inside the picture that was measured soundly.
    messages : tuple of str
        What a user should know.
    direction, blur : (3,), scalar [px]
        Colours by which the cable stands out, and the blur of its edges.
    """

    viewpoint: Viewpoint
    pixels: Array
    std: Array
    whole: NDArray[np.bool_]
    width: float
    width_std: float
    diameter: float
    distance: float
    correlation: float
    confidence: float
    messages: tuple[str, ...]
    direction: Array
    blur: float

    @property
    def spacing(self) -> float:
        """Distance [px] of neighbouring pixels, the median."""
        return float(np.median(np.linalg.norm(np.diff(self.pixels, axis=0), axis=1)))

    @property
    def rays(self) -> Array:
        """Undistorted rays (K, 2) of the pixels."""
        return self.viewpoint.rays(self.pixels)


def see_cable(
    image: NDArray[np.uint8],
    viewpoint: Viewpoint,
    *,
    start: ArrayLike,
    end: ArrayLike | None,
    diameter: float,
    length: float,
    workings: Workings | None = None,
) -> ImageCurve:
    """Find the cable in front of the board, order it from start to end, refine it to sub-pixel.

    The photograph is searched as the plane that faces the camera at the distance of the fixtures.

    Parameters
    ----------
    image : (H, W, 3) uint8
        The photograph, blue, green, red.
    viewpoint : Viewpoint
        Where the camera stands.
    start, end : (3,) [m]
        The fixtures in the board frame; `end` is None for a free end.
    diameter, length : scalar [m]
        Of the cable.
    workings : Workings, optional
        Is filled with what the steps have seen, also where one of them fails.

    Raises
    ------
    VisionError
        If no cable or more than one is found, or if it does not lead to the fixtures.
    """
    declared = [np.asarray(at, float) for at in (start, end) if at is not None]
    fixtures = viewpoint.in_camera(np.array(declared))
    if fixtures[:, 2].min() < _NEAREST:
        raise VisionError(
            f"a fixture would be {fixtures[:, 2].min():.2f} m before the camera. "
            "Try: start and end in metres and in the board frame, z out of the board?"
        )
    distance = float(fixtures[:, 2].mean())
    view = viewpoint.facing(distance)
    flat = viewpoint.flattened(declared, distance)
    expected = _expected_line(fixtures, flat, distance, length, diameter)
    line = measure_line(image, view, expected, workings or Workings())
    trace = line.trace
    pixel = 1.0 / view.scale
    width = trace.shape.width
    beside = other_stretches(trace.points, trace.t, width)
    hidden = np.isfinite(beside) & trace.inside
    step = np.median(np.diff(trace.t[line.kept]))
    every = max(1, round(step / np.median(np.diff(trace.t))))
    shared = np.nonzero(hidden)[0][::every]
    kept = np.sort(np.concatenate([line.kept[~hidden[line.kept]], shared]))
    pixels = view.to_pixels(trace.points[kept])
    tips = [
        f"the line in the photograph ends {away / pixel:.0f} px from where the {name} is declared"
        for name, _, _, away in expected.tips(trace.points[kept])
        if away > TIP * width
    ]
    return ImageCurve(
        viewpoint,
        pixels,
        np.where(hidden[kept], 0.5 * width, trace.std[kept]) / pixel,
        ~hidden[kept],
        width / pixel,
        trace.width_std / pixel,
        diameter,
        distance,
        FINE * np.sqrt(np.pi) * diameter / pixel,
        line.confidence,
        (*line.messages, *tips),
        trace.direction,
        trace.shape.blur / pixel,
    )


def _expected_line(
    fixtures: Array, flat: Array, distance: float, length: float, diameter: float
) -> ExpectedLine:
    """The line in the facing plane, and how long it may be there.

    At least the way between the fixtures there, or some diameters. At most the cable where it is
    nearest: half of what is not needed to reach from one fixture to the other can lead ahead.
    """
    if len(fixtures) == 1:
        nearest, shortest, end = fixtures[0, 2] - length, 0.0, None
    else:
        chord, end = float(np.linalg.norm(fixtures[1] - fixtures[0])), flat[1]
        ahead = 0.5 * np.sqrt(max(length**2 - chord**2, 0.0))
        nearest = fixtures[:, 2].min() - 0.5 * ahead
        shortest = float(np.linalg.norm(flat[1] - flat[0]))
    shortest = max(shortest, 10 * diameter)
    longest = max(length * distance / max(nearest, 0.5 * distance), length)
    return ExpectedLine(flat[0], end, diameter, shortest, longest, in_space=True)


def other_stretches(points: Array, t: Array, width: float) -> Array:
    """Where another stretch of a line lies beside each of its points.

    Of closely spaced points (K, 2) at lengths t (K,) along a line of the same units' `width`: the
    signed distance (K,) to the nearest other stretch, positive to the left; nan where there is none
    that shares an edge.
    """
    normal = normals(np.gradient(points, axis=0))
    pairs = cKDTree(points).query_pairs(_BESIDE * width, output_type="ndarray")
    here, there = np.vstack([pairs, pairs[:, ::-1]]).T
    other = np.abs(t[there] - t[here]) > _APART * width
    here, there = here[other], there[other]
    across = points[there] - points[here]
    offset = np.sum(across * normal[here], axis=1)
    along = across[:, 0] * normal[here, 1] - across[:, 1] * normal[here, 0]
    level = np.abs(along) < 1.5 * float(np.median(np.diff(t)))
    here, offset = here[level], offset[level]
    farthest_first = np.argsort(-np.abs(offset))
    beside = np.full(len(points), np.nan)
    beside[here[farthest_first]] = offset[farthest_first]
    return beside


def loops_either_way(curve: ImageCurve) -> list[ImageCurve]:
    """The curve as it was ordered, and with each of its loops run through the other way.

    Where a line meets itself, one photograph tells little of whether its two stretches cross or
    turn back: the loop between them may be in either order.
    """
    apart = np.linalg.norm(curve.pixels[:, None] - curve.pixels[None], axis=2)
    t = chord_length(curve.pixels)
    meets = (apart < curve.width) & (t[None] - t[:, None] > _APART * curve.width)
    labels, count = label(meets, np.ones((3, 3)))
    ways = [curve]
    for where in range(1, count + 1):
        i, j = np.unravel_index(np.where(labels == where, apart, np.inf).argmin(), apart.shape)
        order = np.arange(len(t))
        order[i + 1 : j] = order[i + 1 : j][::-1]
        pixels, std, whole = curve.pixels[order], curve.std[order], curve.whole[order]
        ways.append(replace(curve, pixels=pixels, std=std, whole=whole))
    return ways
