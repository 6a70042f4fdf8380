"""Photographs with the measured line and the predictions drawn over them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.files import make_folder, write_file
from dlo_casadi.report.canvas import (
    BLUE,
    ORANGE,
    before_after,
    drawn,
    label_of,
    millimetres,
    styled,
)
from dlo_casadi.session.outcome import Outcome, PoseInput
from dlo_casadi.vision import read_image

_LARGEST = (1200, 900)  # px
_NARROWEST = 640  # px, room for the legend
_STRIP = 56  # px, for the legend below
_DPI = 100


def write_overlays(folder: Path, outcome: Outcome) -> None:
    """Draw one JPEG for each pose with a photograph, if there is any, into a new folder."""
    if any(pose.image is not None for pose in outcome.poses):
        make_folder(folder)
    for pose in outcome.poses:
        if pose.image is not None and pose.to_pixels is not None:
            try:
                image = read_image(pose.image)[..., ::-1]
            except MeasurementError:  # gone since it was measured
                continue
            draw_overlay(folder / f"{pose.name}.jpg", image, pose, outcome)


def draw_overlay(path: Path, image: NDArray[np.uint8], pose: PoseInput, outcome: Outcome) -> None:
    """Draw the part of a photograph (H, W, 3; red, green, blue) that holds the cable."""
    before, after = before_after(outcome)
    lines = []
    for stage, color, style in ((before, ORANGE, "--"), (after, BLUE, "-")):
        shape = None if stage is None else stage.shapes.get(pose.name)
        if stage is not None and shape is not None:
            label = label_of(stage, outcome)
            label += "" if shape.rmse is None else f", {millimetres(shape.rmse)}"
            lines.append((np.asarray(pose.to_pixels(shape.curve)), color, style, label))
    measured = np.zeros((0, 2)) if pose.pixels is None else pose.pixels
    (left, top), (right, bottom) = _window(image, [measured, *(line[0] for line in lines)])
    zoom = min(_LARGEST[0] / (right - left), _LARGEST[1] / (bottom - top))
    width, height = round((right - left) * zoom), round((bottom - top) * zoom)
    part = Image.fromarray(image[top:bottom, left:right]).resize(
        (width, height), Image.Resampling.BILINEAR
    )
    whole = max(width, _NARROWEST)
    with styled((whole / _DPI, (height + _STRIP) / _DPI), layout=None) as drawing:
        share = _STRIP / (height + _STRIP)
        axes = drawing.add_axes(((1 - width / whole) / 2, share, width / whole, 1 - share))
        axes.set_axis_off()
        axes.plot(*measured.T, ".", color="white", ms=4.2)
        axes.plot(*measured.T, ".", color="black", ms=2.2, label="measured")
        for line, color, style, label in lines:
            axes.plot(*line.T, color="white", lw=2.6, alpha=0.6)
            axes.plot(*line.T, color=color, ls=style, lw=1.5, label=label)
        axes.set_xlim(left - 0.5, right - 0.5)
        axes.set_ylim(bottom - 0.5, top - 0.5)
        role = "held out" if pose.role == "held_out" else "fit"
        drawing.legend(
            loc="lower center", ncols=3, fontsize=9, frameon=False, title=f"{pose.name} ({role})"
        )
        over = Image.fromarray(drawn(drawing, _DPI))
    # Matplotlib takes longer to draw a photograph than all that lies over it.
    page = Image.new("RGB", over.size, "white")
    page.paste(part, ((whole - width) // 2, 0))
    page.paste(over, mask=over)
    write_file(path, lambda stream: page.save(stream, "JPEG", quality=88))


def _window(
    image: NDArray[np.uint8], lines: Sequence[NDArray[np.floating]]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Corners (left, top), (right, bottom) [px] of a window about all lines, with a margin."""
    size = np.array([image.shape[1], image.shape[0]])
    drawn = np.concatenate(lines)
    drawn = np.clip(drawn[np.isfinite(drawn).all(axis=1)], 0, size - 1)
    if not len(drawn):
        return (0, 0), (int(size[0]), int(size[1]))
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    margin = 0.12 * float((high - low).max()) + 8
    low = np.maximum(np.floor(low - margin), 0).astype(int)
    high = np.minimum(np.ceil(high + margin), size).astype(int)
    return (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))
