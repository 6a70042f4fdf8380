"""Photographs with the measured line and the predictions drawn over them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dlo_casadi.errors import MeasurementError
from dlo_casadi.outcome import Outcome, PoseInput
from dlo_casadi.report.canvas import BLUE, ORANGE, before_after, label_of, millimetres
from dlo_casadi.vision import read_image

_WIDEST = 1280  # px
_DPI = 100


def write_overlays(folder: Path, outcome: Outcome) -> None:
    """Draw one JPEG for each pose with a photograph into a new folder."""
    folder.mkdir()
    for pose in outcome.poses:
        if pose.image is not None and pose.to_pixels is not None:
            try:
                image = read_image(pose.image)[..., ::-1]
            except MeasurementError:  # gone since it was measured
                continue
            draw_overlay(folder / f"{pose.name}.jpg", image, pose, outcome)


def draw_overlay(path: Path, image: NDArray[np.uint8], pose: PoseInput, outcome: Outcome) -> None:
    """Draw one photograph (H, W, 3; red, green, blue) with its measured and predicted lines."""
    shrink = max(1, int(np.ceil(image.shape[1] / _WIDEST)))
    small = image[::shrink, ::shrink]
    height, width = small.shape[:2]
    strip = 34  # px, for the legend below
    drawing = Figure(figsize=(width / _DPI, (height + strip) / _DPI), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(drawing)
    axes = drawing.add_axes((0, strip / (height + strip), 1, height / (height + strip)))
    axes.imshow(small, interpolation="nearest", aspect="auto")
    axes.set_axis_off()

    if pose.pixels is not None and len(pose.pixels):
        points = pose.pixels / shrink
        axes.plot(*points.T, ".", color="white", ms=3.2)
        axes.plot(*points.T, ".", color="black", ms=1.6, label="measured")
    before, after = before_after(outcome)
    for stage, color, style in ((before, ORANGE, "--"), (after, BLUE, "-")):
        shape = None if stage is None else stage.shapes.get(pose.name)
        if stage is None or shape is None:
            continue
        line = np.asarray(pose.to_pixels(shape.curve)) / shrink
        label = label_of(stage, outcome)
        if shape.rmse is not None:
            label += f", {millimetres(shape.rmse)}"
        axes.plot(*line.T, color="white", lw=2.6, alpha=0.6)
        axes.plot(*line.T, color=color, ls=style, lw=1.5, label=label)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    role = "held out" if pose.role == "held_out" else "fit"
    drawing.legend(loc="lower right", ncols=3, fontsize=10, frameon=False, borderaxespad=0.2)
    drawing.text(0.008, 10 / (height + strip), f"{pose.name} ({role})", fontsize=10)
    drawing.savefig(path, dpi=_DPI, pil_kwargs={"quality": 88})
