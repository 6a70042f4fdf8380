"""Figures of poses: measured points on the predicted shapes, on pages of one scale."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from dlo_casadi.equilibrium.spread import EDGE
from dlo_casadi.report.arrows import forces_read
from dlo_casadi.report.canvas import (
    BLACK,
    BLUE,
    HELD_OUT,
    ORANGE,
    before_after,
    label_of,
    millimetres,
    save_figure,
    styled,
)
from dlo_casadi.report.figures_room import FORCE, STYLES, draw_marks, frame
from dlo_casadi.report.geometry import band_outline, magnified
from dlo_casadi.report.room import Room, around, rooms, seen
from dlo_casadi.session.outcome import Outcome, PoseInput, Stage

FloatArray = NDArray[np.floating]

_POSES_A_PAGE = 20
# A typical deviation is drawn about this share of the cable's length wide.
_VISIBLE = 0.02
_FACTORS = (1, 5, 10, 20, 50, 100)
# Sizes [inch] of a page: least width, width of a panel with what is beside it, tallest single row.
_NARROWEST, _PANEL, _TALLEST = 7.5, 3.1, 8.0
# Room [inch] for ticks and names of axes, the headline, the legend, titles of two lines, the edge.
_LEFT, _BOTTOM, _BESIDE = 0.8, 0.85, 0.3
_TOP, _LEGEND, _ABOVE, _EDGE = 0.95, 0.45, 0.45, 0.1


def draw_poses(folder: Path, outcome: Outcome) -> None:
    """Every pose: measured points and predictions, before and after, on pages of one scale."""
    poses = outcome.poses
    pages = math.ceil(len(poses) / _POSES_A_PAGE)
    for page in range(pages):
        name = "poses.png" if pages == 1 else f"poses_{page + 1}.png"
        shown = poses[page * _POSES_A_PAGE : (page + 1) * _POSES_A_PAGE]
        _draw_page(folder / name, outcome, shown)


def _draw_page(path: Path, outcome: Outcome, poses: Sequence[PoseInput]) -> None:
    lines = _shown_stages(outcome)
    rows, columns = _arranged(len(poses))
    factor = _magnification(outcome, outcome.config.cable.length)
    in_space = outcome.config.experiment.in_space
    standing = rooms(outcome.config, poses, [stage for stage, *_ in lines]) if in_space else []
    draw_forces = lines and not in_space
    arrows = forces_read(lines[-1][0], outcome.config.cable.length) if draw_forces else {}
    center, span = _common_frame(outcome, poses, arrows)
    if standing:
        span = standing[0].window
    size, spaces = _laid_out(rows, columns, float(span[1] / span[0]), ticks=not standing)
    # Asked where every tick and title ends, an engine would take as long as all the drawing.
    with styled(size, layout=None) as drawing:
        grid = drawing.subplots(
            rows, columns, squeeze=False, sharex=True, sharey=True, gridspec_kw=spaces
        )
        for axes, pose, room in zip_longest(grid.ravel()[: len(poses)], poses, standing):
            if room is not None:
                _draw_in_room(axes, outcome, pose, lines, factor, room)
                continue
            _draw_pose(axes, pose, lines, factor, np.asarray)
            for kind, arrow in arrows.get(pose.name, ()):
                axes.plot(*arrow.T, **STYLES[kind])
            axes.set_xlim(center[0] - span[0] / 2, center[0] + span[0] / 2)
            axes.set_ylim(center[1] - span[1] / 2, center[1] + span[1] / 2)
        for axes in grid.ravel()[len(poses) :]:
            axes.set_axis_off()
        if not standing:
            _label_grid(grid, len(poses))
            _make_room(grid)
        handles: list[Line2D | Patch] = [
            Line2D([], [], color=BLACK, marker=".", ls="none", ms=7, label="measured")
        ]
        handles += [
            Line2D([], [], color=color, ls=style, label=label_of(stage, outcome))
            for stage, color, style in lines
        ]
        boundary = outcome.config.experiment.boundary
        if standing and "clamped" in (boundary.start, boundary.end):
            handles += [
                Line2D([], [], **STYLES[f"axis-{name}"], label=f"clamp's {name}") for name in "xyz"
            ]
        if standing or outcome.measurement.readings:
            handles.append(Line2D([], [], color=FORCE, label="force on the ends"))
        if outcome.measurement.readings:
            handles.append(Line2D([], [], color=BLACK, ls=":", label="force as read"))
        if any(pose.role == "held_out" for pose in poses):
            handles.append(Patch(fc="white", ec=HELD_OUT, lw=2, label="held out of the fit"))
        drawing.legend(handles=handles, loc="lower center", ncols=len(handles))
        drawn = "" if factor == 1 else f"; deviations drawn {factor} times as large"
        if standing:
            drawn += f"; squares of {standing[0].square:g} mm"
        drawing.suptitle(
            f"{outcome.config.cable.name}: predicted from the end conditions alone\n"
            f"RMS distance to the measured points above each pose{drawn}",
            fontsize=11,
            y=1 - _EDGE / size[1],
        )
    save_figure(path, drawing)


def _laid_out(
    rows: int, columns: int, slope: float, *, ticks: bool
) -> tuple[tuple[float, float], dict[str, float]]:
    """Size [inch] of a page of panels `slope` times as high as wide, and the spaces about them."""
    left, bottom, beside = (_LEFT, _BOTTOM, _BESIDE) if ticks else (_EDGE, _LEGEND, _EDGE)
    width = max(_PANEL * columns, _NARROWEST)
    panel = (width - left - _EDGE - (columns - 1) * beside) / columns
    tall = slope * panel
    if rows == 1 and tall > _TALLEST:
        tall, width = _TALLEST, max(width - columns * (panel - _TALLEST / slope), _NARROWEST)
        panel = (width - left - _EDGE - (columns - 1) * beside) / columns
    height = _TOP + rows * tall + (rows - 1) * _ABOVE + bottom
    spaces = {
        "left": left / width,
        "right": 1 - _EDGE / width,
        "top": 1 - _TOP / height,
        "bottom": bottom / height,
        "wspace": beside / panel,
        "hspace": _ABOVE / tall,
    }
    return (width, height), spaces


def _label_grid(grid: NDArray[np.object_], count: int) -> None:
    """Name the axes at the left and below the lowest panels that are not empty."""
    columns = grid.shape[1]
    for axes in grid[-1]:
        axes.set_xlabel("x [m]")
    for axes in grid[:, 0]:
        axes.set_ylabel("y [m]")
    for column in range(columns):
        lowest = max(k for k in range(count) if k % columns == column)
        below = grid.ravel()[lowest]
        below.set_xlabel("x [m]")
        below.tick_params(labelbottom=True)


def _make_room(grid: NDArray[np.object_]) -> None:
    """Move all panels to the right where the ticks and the name of the first axis need it."""
    first = grid[0, 0]
    drawing = first.get_figure()
    first.apply_aspect()  # which moves it within its place
    taken = first.yaxis.get_tightbbox(drawing.canvas.get_renderer())
    missing = _EDGE - taken.x0 / drawing.dpi
    if missing > 0:
        places = first.get_gridspec()
        places.update(left=places.left + missing / drawing.get_figwidth())
        for axes in grid.ravel():
            axes.set_position(axes.get_subplotspec().get_position(drawing))


def _arranged(count: int) -> tuple[int, int]:
    """Rows and columns of a grid with few empty places, about as many of one as of the other."""
    if count <= 4:
        return 1, count

    def price(columns: int) -> tuple[int, int, int]:
        rows = math.ceil(count / columns)
        return (rows * columns - count, abs(rows - columns), -columns)

    columns = min((3, 4, 5, 6), key=price)
    return math.ceil(count / columns), columns


def _shown_stages(outcome: Outcome) -> list[tuple[Stage, str, str]]:
    """Stages drawn for each pose, with colour and line style."""
    before, after = before_after(outcome)
    lines = [(before, ORANGE, "--"), (after, BLUE, "-")]
    return [(stage, color, style) for stage, color, style in lines if stage is not None]


def _magnification(outcome: Outcome, size: float) -> int:
    """Factor on deviations that makes those of the stage before visible in a figure."""
    before, after = before_after(outcome)
    stage = before or after
    errors = [shape.rmse for shape in stage.shapes.values() if shape.rmse] if stage else []
    if not errors:
        return 1
    wanted = _VISIBLE * size / float(np.median(errors))
    return max(factor for factor in _FACTORS if factor == 1 or factor <= wanted)


def _draw_in_room(
    axes: Axes,
    outcome: Outcome,
    pose: PoseInput,
    lines: Sequence[tuple[Stage, str, str]],
    factor: int,
    room: Room,
) -> None:
    declared = next(item for item in outcome.config.experiment.poses if item.name == pose.name)
    shape = lines[-1][0].shapes.get(pose.name) if lines else None
    under, over = around(room, declared, pose.points, shape)
    frame(axes, room)
    draw_marks(axes, under)
    _draw_pose(axes, pose, lines, factor, lambda points: seen(room.points(points)))
    draw_marks(axes, over)


def _draw_pose(
    axes: Axes,
    pose: PoseInput,
    lines: Sequence[tuple[Stage, str, str]],
    factor: int,
    place: Callable[[FloatArray], FloatArray],
) -> None:
    last = lines[-1][0].shapes.get(pose.name) if lines else None
    elsewhere = last is not None and last.measured_branch is not None
    factor = 1 if elsewhere else factor  # so far off, larger deviations would leave the picture
    for stage, color, style in lines:
        shape = stage.shapes.get(pose.name)
        if shape is not None:
            axes.plot(*place(magnified(pose, shape, factor)).T, color=color, ls=style)
            spread = shape.spread if factor == 1 and stage is lines[-1][0] else None
            if spread is not None and spread.ndim == 1:
                outline = place(band_outline(shape.curve, EDGE * spread))
                axes.fill(*outline.T, color=color, alpha=0.2)
    if len(pose.points):
        shown = pose.points[:: max(1, len(pose.points) // 60)]
        axes.plot(*place(shown).T, ".", color=BLACK, ms=2.5)
    axes.set_aspect("equal")
    if last is not None:
        ends = place(last.curve[[0, -1]])
        axes.plot(*ends[0], "s", color=BLACK, ms=4)
        axes.plot(*ends[1], "o", color=BLACK, ms=4)
    title = pose.name
    if not len(pose.points):
        title += ": not read"
    elif last is None:
        title += ": no equilibrium"
    elif last.rmse is not None:
        title += f": {millimetres(last.rmse)}"
    if last is not None and not last.stable:
        title += ", unstable"
    if last is not None and last.measured_branch is not None:
        title += f"\n{millimetres(last.measured_branch.rmse)} on the measured branch; true size"
    axes.set_title(title)
    if pose.role == "held_out":
        axes.title.set_color(HELD_OUT)
        for spine in axes.spines.values():
            spine.set(visible=True, color=HELD_OUT, linewidth=2)


def _common_frame(
    outcome: Outcome,
    poses: Sequence[PoseInput],
    arrows: Mapping[str, Sequence[tuple[str, FloatArray]]],
) -> tuple[FloatArray, FloatArray]:
    """Middle and size [m] of a window that holds everything drawn."""
    drawn = [pose.points for pose in poses if len(pose.points)]
    for stage, _, _ in _shown_stages(outcome):
        drawn += [stage.shapes[pose.name].curve for pose in poses if pose.name in stage.shapes]
    drawn += [arrow for pose in poses for _, arrow in arrows.get(pose.name, ())]
    corners = np.concatenate(drawn) if drawn else np.zeros((1, 2))
    low, high = corners.min(axis=0), corners.max(axis=0)
    span = 1.08 * (high - low) + 0.02 * max(float((high - low).max()), 1e-3)
    # A slender window would leave no room for the axis: at least a third of the other side.
    span = np.maximum(span, span.max() / 3)
    return (low + high) / 2, span
