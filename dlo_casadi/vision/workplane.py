"""A coarse picture of the cable's plane, and the strands of high contrast in it."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray, unit
from dlo_casadi.errors import VisionError
from dlo_casadi.vision.camera import Picture, View

CABLE_PX = 6.0  # width of the cable in this picture
_MAX_PIXELS = 3.0e6
_MAX_ENLARGEMENT = 1.5
_LONGEST_SIDE = 32767  # largest side of this picture in pixels, a limit of `cv2.remap`
# Smallest side of a photograph in pixels, after shrinking until the cable is CABLE_PX wide.
_LEAST_PIXELS = 8
_MARKER_MARGIN = 1.45  # size of a marker with its white margin (a cell of six or more), relative
_SIGNIFICANT = 5.0  # standard deviations of the background's noise
_MAX_STRANDS = 60
_NARROWEST, _WIDEST = 0.4, 1.8  # of the cable's width


@dataclass(frozen=True)
class KnownCable:
    """Known data of a cable for its search in a photograph."""

    start: ArrayLike
    """Fixture (2,) or (3,) [m] in the board frame."""
    end: ArrayLike | None
    """The other fixture; None for a free end."""
    diameter: float  # [m]
    length: float  # [m]

    @property
    def fixtures(self) -> FloatArray:
        """Places (1, d) or (2, d) [m] of the ends that are held."""
        return np.array([at for at in (self.start, self.end) if at is not None], float)


@dataclass(frozen=True)
class Scene:
    """Options of the search: possible surroundings, and shapes of the line."""

    around: float  # of the length: distance beyond its reach within which other cables are sought
    good: float  # cost per length of a cable that is visible nearly from fixture to fixture
    turn: float  # cost of a turn between strands, in diameters per rad^2
    short: float  # diameters: longest gap in which a turn may lie anywhere
    sharpest: tuple[float, float]  # [rad], largest turn between strands, and that in a short gap
    varied: bool  # whether the background varies along it, and it may go forth and back


ALONG_BOARD = Scene(0.3, -0.7, 2.0, 1.5, (2.5, 1.0), varied=False)
"""Close to the board, and all of it in one plane."""

BEFORE_BOARD = Scene(0.0, -0.9, 0.5, 6.0, (np.inf, np.inf), varied=True)
"""It may turn back sharply, as a bend seen from its side does, and pass in front of other things
than the board. Its length in the picture is not known beforehand: more of it must be seen."""


@dataclass(frozen=True)
class ExpectedLine:
    """Known data of the cable's line for its search in a plane.

    Its length is between `shortest` and `longest`. Both are that of a cable in the plane; in front
    of it the line may be shorter (a part that points to the camera) or longer (a near one).
    """

    fixtures: FloatArray  # (1, 2) or (2, 2) [m], the start, and the end unless that is free
    diameter: float  # [m]
    shortest: float  # [m]
    longest: float  # [m]
    scene: Scene

    @property
    def typical(self) -> float:
        """Length [m], the scale of other lengths and areas."""
        return 0.5 * (self.shortest + self.longest)

    def tips(self, points: FloatArray) -> list[tuple[str, FloatArray, FloatArray, float]]:
        """Name and place of each fixture, the line's end there, and their distance [m]."""
        ends = zip(("start", "end"), self.fixtures, points[[0, -1]], strict=False)
        return [(name, at, tip, float(np.linalg.norm(tip - at))) for name, at, tip in ends]


@dataclass(frozen=True)
class WorkPlane:
    """The part of the cable's plane that the cable can reach, at a known scale."""

    image: Picture  # (h, w, 3), rectified; rows run down, i.e. along -y
    pixel: float  # [m], side of one of its pixels
    origin: FloatArray  # (2,) [m], board coordinates of the centre of its first pixel
    inside: BoolArray  # (h, w), inside the photograph and off the markers
    reachable: BoolArray  # (h, w), inside, and near enough to the fixtures for the cable

    def to_board(self, at: FloatArray) -> FloatArray:
        """Points (K, 2) [m] of pixels (K, 2) of the working picture."""
        return self.origin + self.pixel * np.asarray(at, float) * [1.0, -1.0]

    def to_pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (K, 2) of the working picture of points (K, 2) [m]."""
        return (points - self.origin) / self.pixel * [1.0, -1.0]


def rectify(image: Picture, view: View, expected: ExpectedLine) -> WorkPlane:
    """Resample the photograph onto the cable's plane, where the cable is `CABLE_PX` wide.

    A cable of length L between two fixtures stays inside the ellipse |p - start| + |p - end| <= L,
    whose half sides are sqrt(a^2 - |c|^2 + c_i^2), with the foci +-c and the long half axis a. With
    a free end it stays inside the disc |p - start| <= L. Both are widened a little, since the scale
    may be wrong. The picture is larger if a second cable is searched for.
    """
    height, width = image.shape[:2]
    fixtures, diameter, length = expected.fixtures, expected.diameter, expected.longest
    reach = 1.08 * length + 2 * diameter
    focus = (fixtures[-1] - fixtures[0]) / 2
    spare = max((reach / len(fixtures)) ** 2 - float(focus @ focus), 0.0)
    half = np.sqrt(spare + focus**2) + expected.scene.around * length
    centre = (fixtures[0] + fixtures[-1]) / 2
    share = np.linspace(0.0, 1.0, 33)
    seen = np.stack(np.meshgrid(share, share), axis=2) * [width - 1, height - 1]
    border = view.to_board(seen)
    lower = np.maximum(centre - half, border.min(axis=0))
    upper = np.minimum(centre + half, border.max(axis=0))
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
    columns, rows = ((np.ceil(size / pixel)).astype(int) + 1).tolist()
    origin = np.array([lower[0], upper[1]])
    at = _sources(view, origin, pixel, rows, columns)
    inside = np.all((at >= 1) & (at <= [width - 2, height - 2]), axis=2)

    small, factor = image, 1.0 / (view.scale * pixel)
    if factor > 1.0 / 1.5:
        factor = 1.0
    elif factor * min(height, width) < _LEAST_PIXELS:
        raise VisionError(
            f"a cable of {diameter:.4g} m in diameter would be {diameter * view.scale:.4g} "
            f"pixels wide in a photograph of {width} x {height}: too wide to be followed.\n"
            "  Try: cable.diameter in metres? board.marker_size, reference.points?"
        )
    else:
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    maps = ((at + 0.5) * factor - 0.5).astype(np.float32)
    flat = cv2.remap(small, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    markers = np.zeros(inside.shape, np.uint8)
    for marker in view.markers:
        corners = (view.to_board(marker) - origin) / pixel * [1.0, -1.0]
        middle = corners.mean(axis=0)
        margin = middle + _MARKER_MARGIN * (corners - middle)
        cv2.fillConvexPoly(markers, np.round(margin).astype(np.int32), 1)
    inside &= markers == 0
    x = origin[0] + pixel * np.arange(columns, dtype=np.float32)
    y = origin[1] - pixel * np.arange(rows, dtype=np.float32)[:, None]
    far = np.sum([np.hypot(x - at[0], y - at[1]) for at in fixtures], axis=0)
    return WorkPlane(np.asarray(flat, np.uint8), pixel, origin, inside, inside & (far <= reach))


def _sources(view: View, origin: FloatArray, pixel: float, rows: int, columns: int) -> FloatArray:
    """Pixels (rows, columns, 2) of the photograph for each pixel of the working picture.

    Computed on every eighth pixel and interpolated: the map is nearly linear between them.
    """
    step = 8
    nodes_x = (np.arange(-1, columns // step + 2) + 0.5) * step - 0.5
    nodes_y = (np.arange(-1, rows // step + 2) + 0.5) * step - 0.5
    x, y = np.meshgrid(origin[0] + pixel * nodes_x, origin[1] - pixel * nodes_y)
    coarse = view.to_pixels(np.column_stack([x.ravel(), y.ravel()]))
    coarse = coarse.reshape(len(nodes_y), len(nodes_x), 2).astype(np.float32)
    fine = cv2.resize(coarse, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[step : step + rows, step : step + columns])


@dataclass(frozen=True)
class Contrast:
    """Difference of a picture from its local background, in units of the background's noise."""

    plane: WorkPlane
    difference: NDArray[np.float32]  # (h, w, 3), (pixel - background) / noise, per channel
    noise: FloatArray  # (3,) [grey levels], robust standard deviation per channel


def local_contrast(plane: WorkPlane, width_px: float) -> Contrast:
    """Subtract the median over a window of four cable widths, which a cable does not change.

    Slow changes of the light and steps at the edges of larger objects are in the median and cancel;
    a cable does not, whether it is darker, brighter or of another colour.
    """
    background = cv2.medianBlur(plane.image, 2 * round(2.0 * width_px) + 1)
    difference = plane.image.astype(np.float32) - background.astype(np.float32)
    noise = np.maximum(1.4826 * np.median(np.abs(difference[plane.reachable]), axis=0), 1.0)
    return Contrast(plane, difference / noise.astype(np.float32), noise)


def candidate_maps(contrast: Contrast, area_px: float) -> Iterator[NDArray[np.float32]]:
    """Scalar pictures in which a cable of an area [px^2] may be bright, the likeliest first.

    The strongest pixels fall into a few directions of colour (dark, bright, orange, ...); each
    gives one picture, the difference projected on it. The last one is the plain size of the
    difference: it finds a cable that changes its colour on the way.
    """
    strength = np.linalg.norm(contrast.difference, axis=2)
    level = _upper_level(strength[contrast.plane.reachable], 3.0 * area_px)
    strong = contrast.plane.reachable & (strength > max(level, _SIGNIFICANT))
    vectors = contrast.difference[strong].astype(float)
    weight = strength[strong].astype(float)
    total = weight.sum()
    while weight.sum() > 0.1 * total > 0.0:
        units = unit(vectors)
        direction = units[np.argmax(weight)]
        for _ in range(5):
            mean = (weight * (units @ direction > 0.8)) @ units
            direction = mean / np.linalg.norm(mean)
        alike = units @ direction > 0.7
        yield contrast.difference @ direction.astype(np.float32)
        vectors, weight = vectors[~alike], weight[~alike]
    yield strength


def thresholds(values: NDArray[np.float32], area_px: float) -> tuple[float, ...]:
    """Thresholds of a candidate picture, from the area of a cable.

    The level P is exceeded in 0.4 of the cable's area and so is typical of its core; its edge is
    near P / 2. A higher threshold separates it from a deep shadow, a lower one recovers a cable
    beside stronger objects.
    """
    core = _upper_level(values, 0.4 * area_px)
    cuts = (0.5 * core, 0.75 * core, 0.3 * core)
    return tuple(max(cut, _SIGNIFICANT) for cut in cuts if core > _SIGNIFICANT)


def _upper_level(values: NDArray[np.float32], area: float) -> float:
    """Value that is exceeded in `area` pixels; zero where nothing significant is left."""
    high = values[values > _SIGNIFICANT]
    rank = int(max(area, 1))
    if high.size < rank:
        return 0.0
    return float(np.partition(high, high.size - rank)[high.size - rank])


def find_strands(mask: BoolArray, width_px: float) -> list[tuple[IntArray, float]]:
    """Thin a mask (Zhang and Suen) and cut it into strands, longest first.

    A highlight along the cable is closed first. Parts of the wrong width, junctions, and spurs
    shorter than the cable's width are left out: directions, not the pixels between, decide whether
    the strands on both sides of a cut continue each other.

    Returns for each strand the column and row (K, 2) of its pixels, in order, and the median width
    [px] of the mask about it.
    """
    whole = mask.astype(np.uint8) * 255
    x, y, wide, high = cv2.boundingRect(whole)
    if wide == 0:
        return []
    x, y = max(x - 2, 0), max(y - 2, 0)
    part = whole[y : y + high + 4, x : x + wide + 4]
    core = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    square = np.ones((3, 3), np.uint8)
    filled = cv2.morphologyEx(part, cv2.MORPH_CLOSE, core)
    # Bodies wider than two cables (holders, occluders, markers) are left out with a margin.
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, 2 * (2 * round(width_px) + 1,))
    filled[cv2.dilate(cv2.morphologyEx(filled, cv2.MORPH_OPEN, disc), square) > 0] = 0
    depth = cv2.distanceTransform(filled, cv2.DIST_L2, 5)
    lines = cv2.ximgproc.thinning(filled, thinningType=cv2.ximgproc.THINNING_ZHANGSUEN) > 0
    lines &= depth < _WIDEST / 2 * width_px + 0.5
    # At a junction of three or more lines there are as many steps from off to on around a pixel. A
    # corner of a staircase has many neighbours, but only two such steps.
    ring = [(0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0)]
    padded, (height, width) = np.pad(lines, 1), lines.shape
    around = np.array([padded[i : i + height, j : j + width] for i, j in ring])
    meeting = lines & (np.sum(~around & np.roll(around, -1, axis=0), axis=0) >= 3)
    lines &= cv2.dilate(meeting.astype(np.uint8), square) == 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats(lines.astype(np.uint8))
    large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= width_px]
    large.sort(key=lambda i: -stats[i, cv2.CC_STAT_AREA])
    strands = []
    for label in large[:_MAX_STRANDS]:
        left, top, wide, high = stats[label, :4]
        rows, columns = np.nonzero(labels[top : top + high, left : left + wide] == label)
        points = _walk(np.column_stack([columns + left, rows + top]))
        strand_px = 2 * float(np.median(depth[points[:, 1], points[:, 0]]))
        if strand_px > _NARROWEST * width_px:
            strands.append((points + np.array([x, y]), strand_px))
    return strands


def _walk(pixels: IntArray) -> IntArray:
    """Order the pixels (K, 2) of an unbranched 8-connected line from one end to the other."""
    places = {(x, y) for x, y in pixels.tolist()}
    steps = [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)]

    def neighbours(p: tuple[int, int]) -> list[tuple[int, int]]:
        return [(p[0] + i, p[1] + j) for i, j in steps if (p[0] + i, p[1] + j) in places]

    line = [min((p for p in places if len(neighbours(p)) == 1), default=min(places))]
    places.discard(line[0])
    while following := neighbours(line[-1]):
        line.append(following[0])
        places.discard(following[0])
    return np.array(line)
