"""Drawing of one predicted pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.report.canvas import BLACK, BLUE, GREY, VERMILLION, figure, styled
from dlo_casadi.report.geometry import band_outline

_SIZE = (7.0, 6.0)
# Room for the number at the tip of an arrow, as a share of the drawing.
_LABEL = 0.12


def draw_prediction(path: Path, shape: dict[str, Any]) -> None:
    """Draw a predicted shape with the forces on its fixtures into a file.

    Parameters
    ----------
    shape : dict
        As from `PredictedShape.as_dict`.
    """
    with figure(path, _SIZE) as drawing:
        _draw(drawing, shape)


def prediction_figure(shape: dict[str, Any]) -> Figure:
    """The same as a figure."""
    with styled(_SIZE) as drawing:
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
        tip = at + reach * force
        if in_space:
            axes.quiver(*at, *(tip - at), color=VERMILLION, lw=1.8, arrow_length_ratio=0.15)
            axes.text(*tip, f"{size:.3g} N", color=VERMILLION)
            continue
        arrow = {"arrowstyle": "-|>", "color": VERMILLION, "lw": 1.8}
        axes.annotate("", xy=(tip[0], tip[1]), xytext=(at[0], at[1]), arrowprops=arrow)
        axes.annotate(
            f"{size:.3g} N",
            xy=(tip[0], tip[1]),
            xytext=(8 * force[0] / size, 10 * force[1] / size),
            textcoords="offset points",
            color=VERMILLION,
            ha="left" if force[0] > 0 else "right",
            va="bottom" if force[1] > 0 else "top",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )
        # Annotations do not count for the axes' limits: keep room for the arrow and its number.
        room = _LABEL * max(span, reach * largest) * force / size
        axes.plot(*np.transpose([tip, tip + room]), alpha=0)
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
