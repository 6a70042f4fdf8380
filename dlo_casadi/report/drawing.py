"""Drawing of one predicted pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.report.arrows import arrow
from dlo_casadi.report.canvas import BLACK, BLUE, GREY, VERMILLION, styled
from dlo_casadi.report.geometry import band_outline

# How far beyond the tip of an arrow its number stands, as a share of its length.
_LABEL = 0.2


def prediction_figure(shape: dict[str, Any]) -> Figure:
    """A predicted shape with the forces on its fixtures.

    Parameters
    ----------
    shape : dict
        As from `PredictedShape.as_dict`.
    """
    with styled((7.0, 6.0)) as drawing:
        _draw(drawing, shape)
    return drawing


def _draw(drawing: Figure, shape: dict[str, Any]) -> None:
    points = np.array(shape["points"])
    in_space = points.shape[1] == 3
    forces = {"start": np.array(shape["force_on_start"]), "end": np.array(shape["force_on_end"])}
    largest = max(float(np.linalg.norm(force)) for force in forces.values())
    span = float(np.ptp(points, axis=0).max())
    reach = 0.25 * span / max(largest, 1e-12)
    axes: Any = drawing.add_subplot(projection="3d" if in_space else None)
    if not in_space:
        band = band_outline(points, np.array(shape["band_90"]))
        axes.fill(*band.T, color=BLUE, alpha=0.15, lw=0, label="90 % of next hangings")
    axes.plot(*points.T, color=BLUE, lw=2.5, label="cable")
    if shape["other_side"] is not None:
        other = np.array(shape["other_side"]["points"])
        axes.plot(*other.T, "--", color=BLUE, lw=1.5, label="on the other side")
    for at, (side, force) in zip((points[0], points[-1]), forces.items(), strict=True):
        held = side == "start" or shape["end"] is not None
        if not held:
            continue
        marker = "s" if side == "start" else "o"
        axes.plot(*at[:, None], marker, color=BLACK, ms=7, label=side)
        size = float(np.linalg.norm(force))
        if size <= 1e-3 * largest or largest == 0:
            continue
        drawn = arrow(at, reach * force)
        axes.plot(*drawn.T, color=VERMILLION, lw=1.8)
        beyond = at + (1 + _LABEL) * reach * force
        paper = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5}
        number = axes.text(*beyond, f"{size:.3g} N", ha="center", va="center", bbox=paper)
        number.set_color(VERMILLION)
        axes.plot(*beyond[:, None], alpha=0)  # a text does not count for the axes' limits
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.12)
    axes.set(**{f"{axis}label": f"{axis} [m]" for axis in "xyz"[: points.shape[1]]})
    axes.plot([], [], color=VERMILLION, label="force of the cable on its fixtures")
    drawing.legend(loc="outside lower center", ncols=4)
    state = "stable" if shape["stable"] else "NOT stable"
    axes.set_title(
        f"energy {shape['energy']:.4g} J, smallest bend radius "
        f"{1e3 * shape['min_bend_radius']:.3g} mm, {state}",
        color=GREY if shape["stable"] else VERMILLION,
    )
    drawing.suptitle(f"{shape['cable']}: predicted shape", fontsize=12)
