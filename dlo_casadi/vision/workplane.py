"""A weights picture of the cable's plane, coarse enough to find the cable quickly."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import Array, View

CABLE_PX = 6.0  # width of the cable in this picture
_MAX_PIXELS = 3.0e6
_MAX_ENLARGEMENT = 1.5
_LONGEST_SIDE = 32767
"""Pixels of one side of this picture at most: what `cv2.remap` takes."""

_LEAST_PIXELS = 8
"""Sides of a photograph, shrunk until the cable is CABLE_PX wide: below, nothing of it is left."""

_AROUND = 0.3  # of the length: how far beyond its reach other cables are looked for
_MARKER_MARGIN = 1.45  # of the marker: its white margin is one cell of six or more


@dataclass(frozen=True)
class ExpectedLine:
    """What is known of the cable's line in a plane before it is seen.

    Its length lies between `shortest` and `longest`: both are the cable's where that lies in the
    plane; in front of it the picture may show less (a part that points to the camera) or more (a
    near one). In space it may turn back sharply, as a bend seen from its side does, and pass in
    front of other things than the board.
    """

    start: Array  # (2,) [m]
    end: Array | None  # (2,) [m], None where it is free
    diameter: float  # [m]
    shortest: float  # [m]
    longest: float  # [m]
    in_space: bool = False

    @property
    def fixtures(self) -> dict[str, Array]:
        """Places (2,) [m] of the ends that are held, by their names."""
        held = {"start": self.start, "end": self.end}
        return {name: at for name, at in held.items() if at is not None}

    @property
    def typical(self) -> float:
        """Length [m] by which other lengths and areas are judged."""
        return 0.5 * (self.shortest + self.longest)

    def tips(self, points: Array) -> list[tuple[str, Array, Array, float]]:
        """Name and place of each fixture, the line's end there, and how far [m] that is off."""
        pairs = zip(self.fixtures.items(), points[[0, -1]], strict=False)
        return [(name, at, tip, float(np.linalg.norm(tip - at))) for (name, at), tip in pairs]


@dataclass(frozen=True)
class WorkPlane:
    """The part of the cable's plane that the cable can reach, at a known scale."""

    image: NDArray[np.uint8]  # (h, w, 3), rectified; rows run down, i.e. along -y
    pixel: float  # [m], side of one of its pixels
    origin: Array  # (2,) [m], board coordinates of the centre of its first pixel
    inside: NDArray[np.bool_]  # (h, w), inside the photograph and off the markers
    reachable: NDArray[np.bool_]  # (h, w), of that, near enough to the fixtures for the cable

    def to_board(self, at: Array) -> Array:
        """Points (K, 2) [m] of pixels (K, 2) of the working picture."""
        return self.origin + self.pixel * np.asarray(at, float) * [1.0, -1.0]

    def to_pixels(self, points: Array) -> Array:
        """Pixels (K, 2) of the working picture of points (K, 2) [m]."""
        return (points - self.origin) / self.pixel * [1.0, -1.0]


def rectify(image: NDArray[np.uint8], view: View, expected: ExpectedLine) -> WorkPlane:
    """Resample the photograph onto the cable's plane, where the cable is `CABLE_PX` wide.

    A cable of length L between two fixtures stays inside the ellipse |p - start| + |p - end| <= L;
    with a free end inside the disc |p - start| <= L. Both are widened a little, since the scale
    may be off. In a plane the picture goes on beyond, where a second cable is looked for.
    """
    height, width = image.shape[:2]
    start, end, diameter, length = expected.start, expected.end, expected.diameter, expected.longest
    reach = 1.08 * length + 2 * diameter
    centre, half = _reachable_box(start, end, reach)
    if not expected.in_space:
        half = half + _AROUND * length
    seen = _border(view)
    lower = np.maximum(centre - half, seen.min(axis=0))
    upper = np.minimum(centre + half, seen.max(axis=0))
    size = np.maximum(upper - lower, diameter)
    pixel = max(
        diameter / CABLE_PX,
        1.0 / (_MAX_ENLARGEMENT * view.scale),
        float(np.sqrt(size.prod() / _MAX_PIXELS)),
    )
    if not np.all(size / pixel < _LONGEST_SIDE):
        raise VisionError(
            f"what is seen of the cable's plane, {size[0]:.4g} x {size[1]:.4g} m for a cable of "
            f"{length:.4g} m, cannot be drawn: the scale of {view.scale:.4g} pixels per metre is "
            "not that of this photograph.\n"
            "  Try: board.marker_size, board.marker_centers, reference.points in metres?"
        )
    columns, rows = (np.ceil(size / pixel)).astype(int) + 1
    origin = np.array([lower[0], upper[1]])
    at = _sources(view, origin, pixel, int(rows), int(columns))
    inside = np.all((at >= 1) & (at <= [width - 2, height - 2]), axis=2)

    shrink = 1.0 / (view.scale * pixel)
    if shrink > 1.0 / 1.5:
        small, factor = image, 1.0
    else:
        factor = shrink
        if factor * min(height, width) < _LEAST_PIXELS:
            raise VisionError(
                f"a cable of {diameter:.4g} m in diameter would be {diameter * view.scale:.4g} "
                f"pixels wide in a photograph of {width} x {height}: too wide to be followed.\n"
                "  Try: cable.diameter in metres? board.marker_size, reference.points?"
            )
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    maps = ((at + 0.5) * factor - 0.5).astype(np.float32)
    flat = cv2.remap(small, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    inside &= ~_marker_mask(view, origin, pixel, int(rows), int(columns))
    x = origin[0] + pixel * np.arange(columns, dtype=np.float32)
    y = origin[1] - pixel * np.arange(rows, dtype=np.float32)[:, None]
    far = np.hypot(x - start[0], y - start[1])
    if end is not None:
        far = far + np.hypot(x - end[0], y - end[1])
    return WorkPlane(np.asarray(flat, np.uint8), pixel, origin, inside, inside & (far <= reach))


def _reachable_box(start: Array, end: Array | None, reach: float) -> tuple[Array, Array]:
    """Centre (2,) and half sides (2,) [m] of the box about all that the cable can reach.

    An ellipse with the foci +-c and the long half axis a has the half sides
    sqrt(a^2 - |c|^2 + c_i^2).
    """
    if end is None:
        return start, np.full(2, reach)
    focus = (end - start) / 2
    spare = max((reach / 2) ** 2 - float(focus @ focus), 0.0)
    return (start + end) / 2, np.sqrt(spare + focus**2)


def _border(view: View) -> Array:
    """Board coordinates (K, 2) [m] along the border of the photograph."""
    share = np.linspace(0.0, 1.0, 33)
    zero, one = np.zeros_like(share), np.ones_like(share)
    u, v = np.concatenate([share, one, share, zero]), np.concatenate([zero, share, one, share])
    return view.to_board(np.column_stack([u, v]) * [view.shape[1] - 1, view.shape[0] - 1])


def _marker_mask(
    view: View, origin: Array, pixel: float, rows: int, columns: int
) -> NDArray[np.bool_]:
    """Where the board's markers, with their white margin, are seen."""
    mask = np.zeros((rows, columns), np.uint8)
    for marker in view.markers:
        corners = (view.to_board(marker) - origin) / pixel * [1.0, -1.0]
        middle = corners.mean(axis=0)
        margin = middle + _MARKER_MARGIN * (corners - middle)
        cv2.fillConvexPoly(mask, np.round(margin).astype(np.int32), 1)
    return mask > 0


def _sources(view: View, origin: Array, pixel: float, rows: int, columns: int) -> Array:
    """Pixels (rows, columns, 2) of the photograph that the working picture shows.

    Computed on every eighth pixel and interpolated: the map bends by far less than a pixel there.
    """
    step = 8
    nodes_x = (np.arange(-1, columns // step + 2) + 0.5) * step - 0.5
    nodes_y = (np.arange(-1, rows // step + 2) + 0.5) * step - 0.5
    x, y = np.meshgrid(origin[0] + pixel * nodes_x, origin[1] - pixel * nodes_y)
    coarse = view.to_pixels(np.column_stack([x.ravel(), y.ravel()]))
    coarse = coarse.reshape(len(nodes_y), len(nodes_x), 2).astype(np.float32)
    fine = cv2.resize(coarse, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[step : step + rows, step : step + columns])
