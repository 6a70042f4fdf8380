"""Figures without a screen: sizes, colours and labels that all figures share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dlo_casadi.io.files import write_file
from dlo_casadi.session.outcome import Outcome, Stage, StageName

# Okabe and Ito's colours, which the colour-blind can tell apart.
BLACK, GREY = "#000000", "#6B6B6B"
ORANGE, SKY, GREEN = "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION = "#0072B2", "#D55E00"
HELD_OUT = "#CC79A7"  # poses that no fit saw
# By what name tables and charts have the RMS distance that the noise of points gives by itself.
NOISE_ALONE = "noise alone"

STAGE_LABELS: dict[StageName, str] = {
    "initial": "initial guess",
    "stiffness_only": "stiffness alone",
    "algorithm1": "Algorithm 1",
    "batch": "declared model, fitted",
    "closed": "with added effects",
}

_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.labelsize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "font.family": "DejaVu Sans",
    "text.parse_math": False,  # a name with two dollar signs is no formula
}
_DPI = 150


@contextmanager
def figure(
    path: Path, size: tuple[float, float], layout: Literal["constrained"] | None = "constrained"
) -> Iterator[Figure]:
    """Open a figure of a size [inch] and save it to a file when it is drawn."""
    with styled(size, layout) as drawing:
        yield drawing
        save_figure(path, drawing, _DPI)


def save_figure(path: Path, drawing: Figure, dpi: float) -> None:
    """Write a figure in the format of the file's ending, whole or not at all."""
    form, layout = path.suffix[1:], drawing.get_layout_engine()
    drawing.set_dpi(dpi)
    if layout is not None:
        # A figure that still has an engine is drawn twice: for its layout, and for the file.
        layout.execute(drawing)
        drawing.set_layout_engine(None)
    write_file(path, lambda stream: drawing.savefig(stream, format=form, dpi=dpi))


def drawn(drawing: Figure, dpi: float) -> NDArray[np.uint8]:
    """Pixels (H, W, 4; red, green, blue, opacity) of a figure without its background."""
    drawing.set_dpi(dpi)
    drawing.patch.set_alpha(0.0)
    canvas = FigureCanvasAgg(drawing)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


@contextmanager
def styled(
    size: tuple[float, float], layout: Literal["constrained"] | None = "constrained"
) -> Iterator[Figure]:
    """Open a figure of a size [inch], to be drawn in the style of all figures."""
    with mpl.rc_context(_STYLE):
        drawing = Figure(figsize=size, layout=layout)
        FigureCanvasAgg(drawing)
        yield drawing


def before_after(outcome: Outcome) -> tuple[Stage | None, Stage | None]:
    """The stages that a figure compares: the last one, and the one that it improves on.

    With effects added: the declared model fitted, and the model with the effects. Otherwise: the
    initial guess, and the declared model fitted.
    """
    with_shapes = [stage for stage in outcome.stages if stage.shapes]
    if not with_shapes:
        return None, None
    after = with_shapes[-1]
    name: StageName = "batch" if after.name == "closed" else "initial"
    before = next((stage for stage in with_shapes if stage.name == name), None)
    return (None if before is after else before), after


def label_of(stage: Stage, outcome: Outcome) -> str:
    """What to call a stage in a figure."""
    if stage.name == "closed" and outcome.effects:
        return "with " + " and ".join(effect["name"] for effect in outcome.effects)
    return STAGE_LABELS[stage.name]


def millimetres(value: float | None) -> str:
    """A length [m] as text in mm, with three digits; a dash for none."""
    return "-" if value is None else f"{1e3 * value:.3g} mm"
