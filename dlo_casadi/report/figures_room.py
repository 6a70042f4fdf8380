"""Marks in a figure: on a board, or in a room that is seen from a corner."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from matplotlib.axes import Axes

from dlo_casadi.report.canvas import BLACK, BLUE, GREY, VERMILLION
from dlo_casadi.report.room import Mark, Room, seen
from dlo_casadi.report.scene import Board

FORCE = "#6A3D9A"
STYLES: dict[str, dict[str, Any]] = {
    "grid": {"color": "#E3E3E3", "lw": 0.6},
    "shadow": {"color": "#9AA5B1", "lw": 1.0},
    "plumb": {"color": "#9AA5B1", "lw": 0.8, "ls": ":"},
    "world": {"color": GREY, "lw": 0.9},
    "weight": {"color": GREY, "lw": 0.9},
    "force": {"color": FORCE, "lw": 1.2},
    "force-read": {"color": BLACK, "lw": 1.0, "ls": ":"},
    "taken": {"color": "#9AA5B1", "lw": 1.2},
    "pulled": {"color": BLUE, "lw": 5, "solid_capstyle": "butt"},
    "pull": {"color": VERMILLION, "lw": 1.6},
    "next": {"color": VERMILLION, "lw": 2.2},
    "next-letter": {"color": VERMILLION, "fontsize": 10},
    "letter": {"color": GREY, "fontsize": 7},
    "marker": {"color": "#C9D0D8", "lw": 1.0},
    "axis-x": {"color": "#D0103A", "lw": 1.2},
    "axis-y": {"color": "#00805A", "lw": 1.2},
    "axis-z": {"color": "#3A3AD6", "lw": 1.2},
    "fixture start": {"color": BLACK, "marker": "s", "ms": 3, "markevery": [0]},
    "fixture end": {"color": BLACK, "marker": "o", "ms": 3, "markevery": [0]},
}


def draw_marks(axes: Axes, marks: Iterable[Mark]) -> None:
    """Draw what stands in a room or lies on a board."""
    for mark in marks:
        points = seen(mark.points)
        if mark.label:
            axes.text(
                points[0, 0],
                points[0, 1],
                mark.label,
                **STYLES[mark.kind],
                ha="center",
                va="center",
                bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 0.5},
            )
        elif mark.kind in STYLES:
            axes.plot(*points.T, **STYLES[mark.kind])


def frame(axes: Axes, place: Room | Board) -> None:
    """Show all of a room, without ticks: the floor's squares tell its size; or of a board."""
    if place.window is None:
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        return
    width, height = place.window / 2
    axes.set(xlim=(-width, width), ylim=(-height, height), xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set_aspect("equal")
