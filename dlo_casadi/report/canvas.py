"""Figures without a screen: what all share, and how one becomes a file or a part of a page."""

from __future__ import annotations

import io
import re
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from dlo_casadi.io.files import write_file
from dlo_casadi.session.outcome import Outcome, Stage, StageName

# Colours that the colour-blind can tell apart, each at least 4.5 to 1 against white.
BLACK, GREY = "#1F2933", "#6B7280"
ORANGE, BLUE, GREEN, VERMILLION = "#B35A00", "#0067A3", "#00805A", "#9E2A00"
HELD_OUT = "#8C3B6C"  # poses that no fit saw
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
# Width [inch] of a chart: on a telephone its letters are still as large as that of a footnote.
WIDTH = 4.8
_SVG = "http://www.w3.org/2000/svg"


def save_figure(path: Path, drawing: Figure, dpi: float = 150) -> None:
    """Write a figure in the format of the file's ending, whole or not at all."""
    with mpl.rc_context(_STYLE):
        _lay_out(drawing, dpi)
        write_file(path, lambda stream: drawing.savefig(stream, format=path.suffix[1:], dpi=dpi))


def inline_svg(drawing: Figure, name: str) -> str:
    """A figure as a part of a page, where several stand side by side.

    Of an artist with a gid, the gid becomes the id of its group, and its label is what the browser
    tells at the pointer. All other ids are made of the `name` of the chart.
    """
    text = io.StringIO()
    with mpl.rc_context(_STYLE | {"svg.fonttype": "none", "svg.hashsalt": name}):
        _lay_out(drawing, 72)
        drawing.savefig(text, format="svg", metadata={"Date": None})
    root = ET.fromstring(text.getvalue())
    for unwanted in root[:2]:  # metadata, and a style that would be one of the whole page
        root.remove(unwanted)
    root.attrib = {"viewBox": root.attrib["viewBox"]}
    told = {item.get_gid(): str(item.get_label()) for item in drawing.findobj() if item.get_gid()}
    defined = {node.get("id") for part in root.iter(f"{{{_SVG}}}defs") for node in part.iter()}
    for node in root.iter():
        if node.get("id") in told:
            title = ET.Element(f"{{{_SVG}}}title")
            title.text = told[node.get("id")]
            node.insert(0, title)
        elif node.get("id") not in defined:
            node.attrib.pop("id", None)
        if "d" in node.attrib:
            node.set("d", re.sub(r"(\.\d\d)\d+", r"\1", node.attrib["d"]))
    ET.register_namespace("", _SVG)
    ET.register_namespace("xlink", "http://www.w3.org/1999/xlink")
    return ET.tostring(root, encoding="unicode")


def _lay_out(drawing: Figure, dpi: float) -> None:
    """Lay a figure out once: one that still has an engine is drawn twice each time."""
    drawing.set_dpi(dpi)
    layout = drawing.get_layout_engine()
    if layout is not None:
        layout.execute(drawing)
        drawing.set_layout_engine(None)


def headline(drawing: Figure, text: str) -> None:
    """Write what a figure shows above it, in lines that are no wider than it."""
    letters = int(12 * drawing.get_figwidth())
    drawing.suptitle(textwrap.fill(text, letters, break_on_hyphens=False), fontsize=11)


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


# A stage that is compared: "before" or "after", what to call it, and the stage.
Compared = tuple[str, str, Stage]


def compared(outcome: Outcome) -> list[Compared]:
    """The stages of `before_after` that there are."""
    stages = zip(("before", "after"), before_after(outcome), strict=True)
    return [(kind, label_of(stage, outcome), stage) for kind, stage in stages if stage is not None]


def label_of(stage: Stage, outcome: Outcome) -> str:
    """What to call a stage in a figure."""
    if stage.name == "closed" and outcome.effects:
        return "with " + " and ".join(effect.name for effect in outcome.effects)
    return STAGE_LABELS[stage.name]


def millimetres(value: float | None) -> str:
    """A length [m] as text in mm, with three digits; a dash for none."""
    return "-" if value is None else f"{1e3 * value:.3g} mm"


def dot(label: str, marker: str, color: str, fill: str = "") -> Line2D:
    """A marker in a legend."""
    fill = fill or ("white" if marker == "D" else color)
    return Line2D([], [], ls="none", ms=7, marker=marker, color=color, mfc=fill, label=label)
