"""Figures of all poses in one scene: where the cable is pulled, where to hold it next."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dlo_casadi.report.canvas import (
    BLACK,
    VERMILLION,
    WIDTH,
    dot,
    headline,
    styled,
)
from dlo_casadi.report.figures_room import STYLES, draw_marks, frame
from dlo_casadi.report.room import Mark, Room
from dlo_casadi.report.scene import Board, next_marks, pull_marks, scene_of
from dlo_casadi.session.outcome import Outcome


def unexplained_figure(outcome: Outcome) -> Figure:
    """Where the cable is pulled, and how, in each fit pose."""
    load = outcome.unexplained
    assert load is not None
    low, high = load.interval
    size = float(np.linalg.norm(load.force))
    handles = [
        _line_of("taken", "measured"),
        _line_of("pulled", f"pulled at {low:.3f} to {high:.3f} m (95 %)"),
        _line_of("pull", f"force in each pose, on average {size:.3g} N"),
    ]
    said = "unexplained, pulled by something that is not in the model"
    return _scene_figure(outcome, pull_marks, handles, said)


def next_pose_figure(outcome: Outcome) -> Figure:
    """Where to hold the end in the next pose, among those that were taken."""
    handles = [
        _line_of("taken", "measured"),
        dot("next end", "P", VERMILLION),
        dot("starts", "s", BLACK),
        dot("ends", "o", BLACK),
    ]
    return _scene_figure(outcome, next_marks, handles, "which pose to measure next")


def _scene_figure(
    outcome: Outcome,
    marks: Callable[[Outcome, Room | Board], list[Mark]],
    handles: list[Line2D],
    said: str,
) -> Figure:
    with styled((WIDTH, 4.6)) as drawing:
        place, under = scene_of(outcome)
        axes = drawing.subplots()
        draw_marks(axes, [*under, *marks(outcome, place)])
        frame(axes, place)
        drawing.legend(handles=handles, loc="outside lower center", ncols=1 + len(handles) // 4)
        headline(drawing, f"{outcome.config.cable.name}: {said}")
    return drawing


def _line_of(kind: str, label: str) -> Line2D:
    return Line2D([], [], **STYLES[kind], label=label)
