"""The style of all figures, drawn without a screen, and how a figure becomes a file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from dlo_casadi.arrays import FloatArray, unit
from dlo_casadi.io.files import write_file

# Colours that the colour-blind can distinguish, each with contrast 4.5 to 1 or more on white.
BLACK, GREY = "#1F2933", "#6B7280"
ORANGE, BLUE, GREEN, VERMILLION = "#B35A00", "#0067A3", "#00805A", "#9E2A00"
HELD_OUT = "#8C3B6C"  # poses not used in any fit
FORCE = "#6A3D9A"
# Lines of obstacles, and of the stretches of a cable that touch them.
OBSTACLE: dict[str, Any] = {"color": "#A08A6A", "lw": 0.9}
CONTACT: dict[str, Any] = {"color": "#C2571A", "lw": 4.0, "alpha": 0.6, "solid_capstyle": "butt"}
STYLE: dict[Any, Any] = {
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
    "text.parse_math": False,  # a name with two dollar signs is not a formula
}
# Length and width of an arrow's head, relative to the arrow's length.
_HEAD = (0.28, 0.1)


@contextmanager
def styled(
    size: tuple[float, float], layout: Literal["constrained"] | None = "constrained"
) -> Iterator[Figure]:
    """Open a figure of a size [inch], to be drawn in the style of all figures."""
    with mpl.rc_context(STYLE):
        # Text is a little wider at other resolutions than that of the layout.
        engine = ConstrainedLayoutEngine(w_pad=0.08) if layout else None
        drawing = Figure(figsize=size, layout=engine)
        FigureCanvasAgg(drawing)
        yield drawing


def save_figure(path: Path, drawing: Figure, dpi: float = 150) -> None:
    """Write a figure in the format of the file's extension, completely or not at all."""
    with mpl.rc_context(STYLE):
        lay_out(drawing, dpi)
        write_file(path, lambda stream: drawing.savefig(stream, format=path.suffix[1:], dpi=dpi))


def lay_out(drawing: Figure, dpi: float) -> None:
    """Lay a figure out once: with a layout engine left it would be drawn twice each time."""
    drawing.set_dpi(dpi)
    layout = drawing.get_layout_engine()
    if layout is not None:
        layout.execute(drawing)
        drawing.set_layout_engine(None)


def arrow(root: FloatArray, shaft: FloatArray) -> FloatArray:
    """Return one line (K, d) that draws an arrow from a root (d,) along a shaft (d,).

    It has two barbs in a plane and four in space, visible from any side.
    """
    size = max(float(np.linalg.norm(shaft)), 1e-12)
    if len(shaft) == 2:
        normals = [np.array([-shaft[1], shaft[0]])]
    else:
        across = np.cross(shaft, np.eye(3)[np.abs(shaft).argmin()])
        across *= size / max(float(np.linalg.norm(across)), 1e-12)
        normals = [across, np.cross(shaft, across) / size]
    tip, back = root + shaft, root + (1 - _HEAD[0]) * shaft
    sides = [sign * normal for sign in (1, -1) for normal in normals]
    barbs = [point for side in sides for point in (back + _HEAD[1] * side, tip)]
    return np.stack([root, tip, *barbs])


def band_outline(curve: FloatArray, half_width: FloatArray) -> FloatArray:
    """Outline (2 M, 2) [m] of a band of half widths (M,) [m] about a planar curve (M, 2)."""
    tangent = unit(np.gradient(curve, axis=0))
    side = half_width[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    return np.concatenate([curve + side, (curve - side)[::-1]])
