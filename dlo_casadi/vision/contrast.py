"""What stands out from its own surroundings, and in which colour."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.vision.view import Array

_SIGNIFICANT = 5.0  # standard deviations of the background's noise


@dataclass(frozen=True)
class Contrast:
    """Difference of a picture from its local background, in units of the background's noise."""

    difference: NDArray[np.float32]  # (h, w, 3), (pixel - background) / noise, per channel
    reachable: NDArray[np.bool_]  # (h, w), pixels that count
    noise: Array  # (3,) [grey levels], robust standard deviation per channel


def local_contrast(
    image: NDArray[np.uint8], reachable: NDArray[np.bool_], width_px: float
) -> Contrast:
    """Subtract the median over a window of four cable widths, which sees no cable.

    Slow changes of the light and steps at the rims of larger objects remain in the median and so
    cancel; a cable, whether darker, brighter or of another colour, does not.
    """
    window = 2 * round(2.0 * width_px) + 1
    background = cv2.medianBlur(image, window)
    difference = image.astype(np.float32) - background.astype(np.float32)
    sample = difference[reachable]
    noise = np.maximum(1.4826 * np.median(np.abs(sample), axis=0), 1.0)
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
