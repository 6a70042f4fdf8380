"""Photographs in the report: reduced ones for the page, and ones with all lines drawn over them."""

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray
from PIL import Image

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.files import make_folder, write_file
from dlo_casadi.report.canvas import STAGE_LINES
from dlo_casadi.report.words import compared
from dlo_casadi.session.outcome import Outcome, PoseInput
from dlo_casadi.show.style import styled
from dlo_casadi.show.text import millimetres
from dlo_casadi.vision import read_image

# Size [bytes] of all photographs of a page; as base64 text they take a third more.
PHOTOGRAPHS = 3_000_000
_WIDEST = 1280  # px
_NARROWEST = 320  # px
_QUALITIES = (82, 70, 55)
# Sizes [px] of a drawn photograph: the largest, the narrowest with its legend, the legend's height.
_LARGEST, _LEGEND, _STRIP = (1200, 900), 640, 56
_DPI = 100


def photograph_of(path: Path, budget: int) -> tuple[str, int, int] | None:
    """Read a photograph as a small JPEG in a data URI, with its true width and height [px].

    Parameters
    ----------
    budget : int
        Largest size [bytes] of the JPEG; quality is reduced first, then width.

    None where the file cannot be read.
    """
    try:
        pixels = read_image(path)[..., ::-1]
    except MeasurementError:
        return None
    height, width = pixels.shape[:2]
    whole = Image.fromarray(np.ascontiguousarray(pixels))
    wide = float(min(_WIDEST, width))
    while True:
        size = (round(wide), max(1, round(wide * height / width)))
        small = (
            whole if size == whole.size else whole.resize(size, Image.Resampling.LANCZOS, None, 2)
        )
        for quality in _QUALITIES:
            buffer = io.BytesIO()
            small.save(buffer, "JPEG", quality=quality)
            if buffer.tell() <= budget:
                break
        if buffer.tell() <= budget or wide <= _NARROWEST:
            break
        wide = max(_NARROWEST, min(0.8, 0.95 * (budget / buffer.tell()) ** 0.5) * wide)
    text = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f"data:image/jpeg;base64,{text}", width, height


def write_overlays(folder: Path, outcome: Outcome) -> None:
    """Draw a JPEG for each pose with a photograph into a new folder, if there is any."""
    if any(pose.image is not None for pose in outcome.poses):
        make_folder(folder)
    for pose in outcome.poses:
        if pose.image is not None and pose.to_pixels is not None:
            try:
                image = read_image(pose.image)[..., ::-1]
            except MeasurementError:  # deleted since it was measured
                continue
            _draw_overlay(folder / f"{pose.name}.jpg", image, pose, outcome)


def _draw_overlay(path: Path, image: NDArray[np.uint8], pose: PoseInput, outcome: Outcome) -> None:
    """Draw the part of a photograph (H, W, 3; red, green, blue) that holds the cable."""
    lines = []
    for kind, label, stage in compared(outcome):
        shape = stage.shapes.get(pose.name)
        if shape is not None:
            label += "" if shape.rmse is None else f", {millimetres(shape.rmse)}"
            lines.append((np.asarray(pose.to_pixels(shape.curve)), kind, label))
    measured = np.zeros((0, 2)) if pose.pixels is None else pose.pixels
    (left, top), (right, bottom) = _window(image, [measured, *(line[0] for line in lines)])
    zoom = min(_LARGEST[0] / (right - left), _LARGEST[1] / (bottom - top))
    width, height = round((right - left) * zoom), round((bottom - top) * zoom)
    part = Image.fromarray(image[top:bottom, left:right]).resize(
        (width, height), Image.Resampling.BILINEAR
    )
    whole = max(width, _LEGEND)
    with styled((whole / _DPI, (height + _STRIP) / _DPI), layout=None) as drawing:
        share = _STRIP / (height + _STRIP)
        axes = drawing.add_axes(((1 - width / whole) / 2, share, width / whole, 1 - share))
        axes.set_axis_off()
        axes.plot(*measured.T, ".", color="white", ms=4.2)
        axes.plot(*measured.T, ".", color="black", ms=2.2, label="measured")
        for line, kind, label in lines:
            axes.plot(*line.T, color="white", lw=2.6, alpha=0.6)
            axes.plot(*line.T, **STAGE_LINES[kind], lw=1.5, label=label)
        axes.set_xlim(left - 0.5, right - 0.5)
        axes.set_ylim(bottom - 0.5, top - 0.5)
        role = "held out" if pose.role == "held_out" else "fit"
        drawing.legend(
            loc="lower center", ncols=3, fontsize=9, frameon=False, title=f"{pose.name} ({role})"
        )
        drawing.set_dpi(_DPI)
        drawing.patch.set_alpha(0.0)
        canvas = FigureCanvasAgg(drawing)
        canvas.draw()
        over = Image.fromarray(np.asarray(canvas.buffer_rgba()))
    # Matplotlib takes longer for a photograph than for all the lines over it.
    page = Image.new("RGB", over.size, "white")
    page.paste(part, ((whole - width) // 2, 0))
    page.paste(over, mask=over)
    write_file(path, lambda stream: page.save(stream, "JPEG", quality=88))


def _window(
    image: NDArray[np.uint8], lines: Sequence[FloatArray]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Corners (left, top), (right, bottom) [px] of a window around all lines, with a margin."""
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
