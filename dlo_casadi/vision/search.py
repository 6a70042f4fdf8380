"""Find the cable coarsely: the chain of strands that fits its width, length and fixtures best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from dlo_casadi.errors import VisionError
from dlo_casadi.vision.contrast import candidate_maps, local_contrast, thresholds
from dlo_casadi.vision.ordering import Chain, order_strands
from dlo_casadi.vision.strands import find_strands
from dlo_casadi.vision.view import Array
from dlo_casadi.vision.workplane import WorkPlane

_GOOD = -0.7  # cost per length of a cable that is seen from fixture to fixture
_LEAST = 0.25  # share of the length that must be seen
_TWIN = 0.5  # a second strand this long, relative to the cable, is a second cable


@dataclass(frozen=True)
class Finding:
    """The best chain, and the strands of the same picture that it does not use.

    Parameters
    ----------
    chain : Chain
        The cable, coarsely.
    others : tuple of (K, 2) [m]
        Strands left over.
    """

    chain: Chain
    others: tuple[Array, ...]


def find_cable(
    plane: WorkPlane, *, start: Array, end: Array | None, diameter: float, length: float
) -> Finding:
    """Try the candidate pictures in turn and keep the chain of least cost.

    Raises
    ------
    VisionError
        If no chain shows a quarter of the cable, or if a second strand is as long as half of it.
    """
    width_px = diameter / plane.pixel
    area_px = length * diameter / plane.pixel**2
    if plane.reachable.sum() < 2 * area_px * _LEAST:
        raise VisionError(
            "no cable found: almost nothing of the place that it can reach is in the picture. "
            "Try: start, end and length in metres and in the board frame?"
        )
    contrast = local_contrast(plane.image, plane.reachable, width_px)
    best: Finding | None = None
    longest = 0.0
    for candidate in candidate_maps(contrast, area_px):
        for cut in thresholds(candidate, area_px):
            found = find_strands(candidate > cut, width_px)
            lines = [_smooth(plane.to_board(strand.points), width_px) for strand in found]
            lines = [line for line in lines if len(line) > 2]
            longest = max([longest, *(_length(line) for line in lines)])
            chain = order_strands(lines, start=start, end=end, diameter=diameter, length=length)
            if chain is not None and (best is None or chain.cost < best.chain.cost):
                used = set(chain.used)
                rest = tuple(line for i, line in enumerate(lines) if i not in used)
                best = Finding(chain, rest)
        if best is not None and best.chain.cost < _GOOD * length:
            break
    if best is None or best.chain.supported < _LEAST * length:
        raise VisionError(_nothing(plane, contrast.noise, best, longest, diameter, length))
    twins = [_length(line) for line in best.others if _length(line) > _TWIN * length]
    if twins:
        raise VisionError(
            f"two cables: beside the strand of {best.chain.supported:.3f} m there is another of "
            f"{max(twins):.3f} m and of the same width and colour (the cable is {length:g} m "
            "long). Try: leave one cable in the picture, or cover the other."
        )
    return best


def _smooth(line: Array, width_px: float) -> Array:
    """Take the staircase out of a line of pixels; its ends stay."""
    smooth = gaussian_filter1d(line, 0.5 * width_px, axis=0, mode="nearest")
    return smooth[1:-1:2]


def _length(line: Array) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _nothing(
    plane: WorkPlane,
    noise: NDArray[np.float64],
    best: Finding | None,
    longest: float,
    diameter: float,
    length: float,
) -> str:
    """Say what was seen instead of a cable."""
    seen = plane.image[plane.reachable]
    mean = float(seen.mean())
    if mean < 15:
        light = f"the picture is too dark (mean brightness {mean:.0f} of 255): try more light. "
    elif mean > 245:
        light = f"the picture is overexposed (mean brightness {mean:.0f} of 255): try less light. "
    else:
        light = ""
    if best is None:
        what = (
            f"the longest line of its width that begins near a fixture is none of {longest:.3f} m"
        )
        what = f"the longest line of about its width is {longest:.3f} m long"
    else:
        what = (
            f"the best chain of lines shows {best.chain.supported:.3f} m of {length:g} m, "
            f"the longest single line is {longest:.3f} m"
        )
    return (
        f"no cable found: {light}{what} (wanted: {1e3 * diameter:.1f} mm wide; noise "
        f"{noise.mean():.1f} grey levels). Try: is the cable in the picture and in focus? start, "
        "end, length and diameter right? a background of another brightness or colour?"
    )
