"""What stands out from its surroundings, thinned to strands: lines cut wherever they branch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.vision.camera import Array, Flags, Picture

_SIGNIFICANT = 5.0  # standard deviations of the background's noise
_MAX_STRANDS = 60
_NARROWEST, _WIDEST = 0.4, 1.8  # of the cable's width


@dataclass(frozen=True)
class Contrast:
    """Difference of a picture from its local background, in units of the background's noise."""

    difference: NDArray[np.float32]  # (h, w, 3), (pixel - background) / noise, per channel
    reachable: Flags  # (h, w), pixels that count
    noise: Array  # (3,) [grey levels], robust standard deviation per channel


def local_contrast(image: Picture, reachable: Flags, width_px: float) -> Contrast:
    """Subtract the median over a window of four cable widths, which sees no cable.

    Slow changes of the light and steps at the rims of larger objects remain in the median and so
    cancel; a cable, whether darker, brighter or of another colour, does not.
    """
    background = cv2.medianBlur(image, 2 * round(2.0 * width_px) + 1)
    difference = image.astype(np.float32) - background.astype(np.float32)
    noise = np.maximum(1.4826 * np.median(np.abs(difference[reachable]), axis=0), 1.0)
    return Contrast(difference / noise.astype(np.float32), reachable, noise)


def candidate_maps(contrast: Contrast, area_px: float) -> Iterator[NDArray[np.float32]]:
    """Scalar pictures in which a cable of an area [px^2] may be bright, the likeliest first.

    The strongest pixels fall into a few directions of colour (dark, bright, orange, ...); each
    gives one picture, the difference projected on it. The last one is the plain size of the
    difference: it finds a cable that changes its colour on the way.
    """
    strength = np.linalg.norm(contrast.difference, axis=2)
    level = _upper_level(strength[contrast.reachable], 3.0 * area_px)
    strong = contrast.reachable & (strength > max(level, _SIGNIFICANT))
    vectors = contrast.difference[strong].astype(float)
    weight = strength[strong].astype(float)
    total = weight.sum()
    while weight.sum() > 0.1 * total > 0.0:
        units = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        direction = units[np.argmax(weight)]
        for _ in range(5):
            mean = (weight * (units @ direction > 0.8)) @ units
            direction = mean / np.linalg.norm(mean)
        alike = units @ direction > 0.7
        yield contrast.difference @ direction.astype(np.float32)
        vectors, weight = vectors[~alike], weight[~alike]
    yield strength


def thresholds(values: NDArray[np.float32], area_px: float) -> tuple[float, ...]:
    """Levels at which to cut the values of a candidate picture, from the area of a cable.

    The level P is exceeded by 0.4 of the cable's area, and so is typical of its core: its rim lies
    near P / 2. A higher cut parts it from a deep shadow, a lower one recovers a cable beside
    stronger objects.
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


def find_strands(mask: Flags, width_px: float) -> list[tuple[NDArray[np.intp], float]]:
    """Thin a mask (Zhang and Suen) and cut it into strands, longest first.

    A highlight along the cable is closed first. Parts of the wrong width, junctions and spurs
    shorter than the cable is wide are left out: whether the strands on both sides of a cut
    continue each other is decided by their directions, not by the pixels between them.

    Returns
    -------
    Column and row (K, 2) of the neighbouring pixels of each strand, in order, and the median width
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
    # Bodies wider than two cables are holders, occluders, markers: left out with a rim.
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, 2 * (2 * round(width_px) + 1,))
    filled[cv2.dilate(cv2.morphologyEx(filled, cv2.MORPH_OPEN, disc), square) > 0] = 0
    depth = cv2.distanceTransform(filled, cv2.DIST_L2, 5)
    lines = cv2.ximgproc.thinning(filled, thinningType=cv2.ximgproc.THINNING_ZHANGSUEN) > 0
    lines &= depth < _WIDEST / 2 * width_px + 0.5
    # Three or more lines meet where that many steps lead from off to on around a pixel: a corner of
    # a staircase has many neighbours but only two such steps.
    ring = [(0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0)]
    padded, (height, width) = np.pad(lines, 1), lines.shape
    around = np.array([padded[i : i + height, j : j + width] for i, j in ring])
    meeting = lines & (np.sum(~around & np.roll(around, -1, axis=0), axis=0) >= 3)
    lines &= cv2.dilate(meeting.astype(np.uint8), square) == 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        lines.astype(np.uint8), connectivity=8
    )
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


def _walk(pixels: NDArray[np.intp]) -> NDArray[np.intp]:
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
