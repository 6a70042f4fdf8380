"""The picture of one shape: the cable, and what it does to its fixtures."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.arrays import FloatArray
from dlo_casadi.show import style

# Shares of a shape's extent: the longest arrow, how far a number stands from its arrow's tip, and
# the half width of a band that can be seen beside the line.
_LONGEST, _BEYOND, _VISIBLE = 0.25, 0.1, 0.008


def draw_shape(
    points: FloatArray,
    forces: Mapping[str, FloatArray],
    *,
    clips: Mapping[str, tuple[FloatArray, FloatArray]],
    band: FloatArray | None,
    other: FloatArray | None,
    obstacles: Sequence[FloatArray] = (),
    touching: Sequence[tuple[FloatArray, FloatArray]] = (),
    title: str,
    remark: str,
    alarming: bool,
) -> Figure:
    """Draw a shape (K, d) [m] with the forces (d,) [N] on its ends "start" and "end".

    `clips` are the places (d,) [m] of clips and the forces on them, by their names.
    `band` (K,) [m] are half widths about a shape in a plane, `other` (K, d) [m] is the shape on
    the other side. `obstacles` are lines (n, d) [m] that show them; `touching` are stretches (n, d)
    [m] of the cable that touch one, n odd, and the forces on it.
    """
    ends = {"start": (points[0], "s"), "end": (points[-1], "o")}
    drawn: list[tuple[str | None, FloatArray, str, FloatArray]]
    drawn = [(name, *ends[name], force) for name, force in forces.items()]
    drawn += [(name, place, "D", force) for name, (place, force) in clips.items()]
    drawn += [(None, stretch[len(stretch) // 2], "", force) for stretch, force in touching]
    largest = max(float(np.linalg.norm(force)) for *_, force in drawn)
    extent = float(np.ptp(points, axis=0).max())
    reach = _LONGEST * extent / max(largest, 1e-12)
    with style.styled((7.0, 6.0)) as drawing:
        axes: Any = drawing.add_subplot(projection="3d" if points.shape[1] == 3 else None)
        if band is not None:
            outline = style.band_outline(points, band)
            label = "90 % of repeats" if band.max() > _VISIBLE * extent else None
            axes.fill(*outline.T, color=style.BLUE, alpha=0.15, lw=0, label=label)
        for lines, look, label in (
            (obstacles, style.OBSTACLE, "obstacle"),
            ([stretch for stretch, _ in touching], style.CONTACT, "in contact"),
        ):
            for k, line in enumerate(lines):
                axes.plot(*line.T, **look, label=None if k else label)
        axes.plot(*points.T, color=style.BLUE, lw=2.5, label="cable")
        if other is not None:
            axes.plot(*other.T, "--", color=style.BLUE, lw=1.5, label="on the other side")
        for side, at, marker, force in drawn:
            axes.plot(*at[:, None], marker, color=style.BLACK, ms=7, label=side)
            size = float(np.linalg.norm(force))
            if size <= 1e-3 * largest or largest == 0:
                continue
            axes.plot(*style.arrow(at, reach * force).T, color=style.VERMILLION, lw=1.8)
            tip, along = at + reach * force, _BEYOND * extent * force / size
            paper = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5}
            number = axes.text(
                *(tip + along), f"{size:.3g} N", ha="center", va="center", bbox=paper
            )
            number.set_color(style.VERMILLION)
            axes.plot(
                *(tip + 2 * along)[:, None], alpha=0
            )  # a text does not count for the axes' limits
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.12)
        axes.set(**{f"{axis}label": f"{axis} [m]" for axis in "xyz"[: points.shape[1]]})
        held = "fixtures and obstacles" if touching else "the fixtures"
        axes.plot([], [], color=style.VERMILLION, label=f"force on {held}")
        few = other is None and len(clips) < 2 and not obstacles
        drawing.legend(loc="outside lower center", ncols=5 if few else 3)
        axes.set_title(remark, color=style.VERMILLION if alarming else style.GREY)
        drawing.suptitle(title, fontsize=12)
    return drawing
