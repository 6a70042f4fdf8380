"""Figures pose by pose: measured points on predicted shapes and photographs, use of each limit."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from PIL import Image

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.limits import LimitCheck
from dlo_casadi.equilibrium.spread import EDGE
from dlo_casadi.errors import MeasurementError
from dlo_casadi.io.files import make_folder, write_file
from dlo_casadi.report import canvas
from dlo_casadi.report.scene import Room, Scene, beside, scene_of, scenes_of, seen
from dlo_casadi.report.tables import error_rows
from dlo_casadi.report.words import ComparedStage, compared, label_of, missing
from dlo_casadi.session.outcome import Outcome, PoseInput
from dlo_casadi.show import style
from dlo_casadi.show.text import millimetres
from dlo_casadi.vision import read_image

_POSES_A_PAGE = 20
# Approximate number of points drawn per measured line: on a page of poses, and in one frame.
_POINTS, _POINTS_IN_ONE = 60, 40
# Width at which a typical deviation is drawn, as a share of the cable's length.
_VISIBLE = 0.02
_FACTORS = (1, 5, 10, 20, 50, 100)
# Sizes [inch] of a page: smallest width, width of a panel with its margin, tallest single row.
_NARROWEST, _PANEL, _TALLEST = 7.5, 3.1, 8.0
# Height [inch] of the space above each panel, and of that above and below all panels.
_ABOVE, _AROUND = 0.15, 1.4
# Width [inch] of an entry of the legend.
_ENTRY = 1.9
# Sizes [px] of a drawn photograph: the largest, the narrowest with its legend, the legend's height.
_LARGEST, _LEGEND, _STRIP = (1200, 900), 640, 56
_DPI = 100


# ---- pages of poses ----------------------------------------------------------------------------


def draw_poses(folder: Path, outcome: Outcome) -> None:
    """Draw every pose on pages of one scale: measured points and predictions, before and after."""
    poses = outcome.poses
    pages = math.ceil(len(poses) / _POSES_A_PAGE)
    for page in range(pages):
        name = "poses.png" if pages == 1 else f"poses_{page + 1}.png"
        shown = poses[page * _POSES_A_PAGE : (page + 1) * _POSES_A_PAGE]
        style.save_figure(folder / name, _page(outcome, shown))


def _page(outcome: Outcome, poses: Sequence[PoseInput]) -> Figure:
    config, stages = outcome.config, compared(outcome)
    scenes, marks = scenes_of(config, poses, [item.stage for item in stages])
    room = scenes[0] if isinstance(scenes[0], Room) else None
    if room is None:
        shapes = [item.stage.shapes.get(pose.name) for item in stages for pose in poses]
        center, span = _window(
            [pose.points for pose in poses if len(pose.points)]
            + [shape.curve for shape in shapes if shape is not None]
            + [mark.points for _, over in marks for mark in over]
        )
    else:
        center, span = np.zeros(2), room.window
    factor = _magnification(stages, config.cable.length)
    rows, columns = _arranged(len(poses))
    with style.styled(_page_size(rows, columns, float(span[1] / span[0]))) as drawing:
        grid = drawing.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        shown = zip(grid.flat, poses, scenes, marks, strict=False)
        for axes, pose, scene, (under, over) in shown:
            if room is not None:
                canvas.frame(axes, scene)
            canvas.draw_marks(axes, under)
            _draw_pose(axes, pose, stages, factor, scene)
            canvas.draw_marks(axes, over)
            axes.set_xlim(center[0] - span[0] / 2, center[0] + span[0] / 2)
            axes.set_ylim(center[1] - span[1] / 2, center[1] + span[1] / 2)
        for axes in grid.flat[len(poses) :]:
            axes.set_axis_off()
        if room is None:
            for axes in grid[:, 0]:
                axes.set_ylabel("y [m]")
            for axes in grid.flat[max(0, len(poses) - columns) : len(poses)]:
                axes.set_xlabel("x [m]")
                axes.tick_params(labelbottom=True)
        handles = _legend_of(outcome, poses, stages)
        abreast = min(len(handles), int(drawing.get_figwidth() / _ENTRY))
        drawing.legend(handles=handles, loc="outside lower center", ncols=abreast)
        said = "" if factor == 1 else f"; deviations drawn {factor} times as large"
        said += "" if room is None else f"; squares of {room.square:g} mm"
        drawing.suptitle(
            f"{config.cable.name}: predicted from the end conditions alone\n"
            f"RMS distance to the measured points above each pose{said}",
            fontsize=11,
        )
    return drawing


def _legend_of(
    outcome: Outcome, poses: Sequence[PoseInput], stages: Sequence[ComparedStage]
) -> list[Line2D | Patch]:
    experiment, readings = outcome.config.experiment, outcome.measurement.readings
    handles: list[Line2D | Patch] = [
        canvas.line_of("measured", color=style.BLACK, marker=".", ls="none", ms=7),
        *(canvas.line_of(label, **canvas.STAGE_LINES[kind]) for kind, label, _ in stages),
    ]
    if experiment.in_space and experiment.boundary.directed:
        handles += [
            canvas.line_of(f"clamp's {name}", **canvas.STYLES[f"axis-{name}"]) for name in "xyz"
        ]
    if experiment.clips:
        handles.append(canvas.dot("clip", "D", style.BLACK))
    last = stages[-1].stage if stages else None
    touching = last is not None and any(shape.contacts for shape in last.shapes.values())
    if experiment.surfaces or (last is not None and last.surfaces):
        handles.append(canvas.line_of("obstacle", **canvas.STYLES["obstacle"]))
    if touching:
        handles.append(canvas.line_of("in contact", **canvas.STYLES["contact"]))
    if experiment.in_space or readings or touching:
        on = {
            "the ends": experiment.in_space or readings,
            "clips": experiment.clips,
            "obstacles": touching,
        }
        where = " and ".join(name for name, there in on.items() if there)
        handles.append(canvas.line_of(f"force on {where}", color=style.FORCE))
    if readings:
        handles.append(canvas.line_of("force as read", color=style.BLACK, ls=":"))
    if any(pose.role == "held_out" for pose in poses):
        handles.append(Patch(fc="white", ec=style.HELD_OUT, lw=2, label="held out of the fit"))
    return handles


def _draw_pose(
    axes: Axes, pose: PoseInput, stages: Sequence[ComparedStage], factor: int, scene: Scene
) -> None:
    def place(points: FloatArray) -> FloatArray:
        return seen(scene.points(points))

    last = stages[-1].stage.shapes.get(pose.name) if stages else None
    elsewhere = last is not None and last.measured_branch is not None
    factor = 1 if elsewhere else factor  # enlarged, such large deviations would leave the picture
    for kind, _, stage in stages:
        shape = stage.shapes.get(pose.name)
        if shape is not None:
            magnified = factor != 1 and len(pose.points)
            curve = beside(pose, shape, factor) if magnified else shape.curve
            axes.plot(*place(curve).T, **canvas.STAGE_LINES[kind])
            spread = shape.spread if factor == 1 and stage is stages[-1].stage else None
            if spread is not None and spread.ndim == 1:
                outline = place(style.band_outline(shape.curve, EDGE * spread))
                axes.fill(*outline.T, color=canvas.STAGE_LINES[kind]["color"], alpha=0.2)
    if len(pose.points):
        shown = pose.points[:: max(1, len(pose.points) // _POINTS)]
        axes.plot(*place(shown).T, ".", color=style.BLACK, ms=2.5)
    axes.set_aspect("equal")
    title = pose.name
    if last is not None:
        ends = place(last.curve[[0, -1]])
        axes.plot(*ends[0], "s", color=style.BLACK, ms=4)
        axes.plot(*ends[1], "o", color=style.BLACK, ms=4)
    if last is None or not len(pose.points):
        title += f": {missing(pose)}"
    elif last.rmse is not None:
        title += f": {millimetres(last.rmse)}"
    if last is not None and not last.stable:
        title += ", unstable"
    if last is not None and last.measured_branch is not None:
        title += f"\n{millimetres(last.measured_branch.rmse)} on the measured branch; true size"
    axes.set_title(title)
    if pose.role == "held_out":
        axes.title.set_color(style.HELD_OUT)
        for spine in axes.spines.values():
            spine.set(visible=True, color=style.HELD_OUT, linewidth=2)


def _magnification(stages: Sequence[ComparedStage], size: float) -> int:
    """Factor that makes the deviations of the stage "before" visible in a figure."""
    shapes = stages[0].stage.shapes.values() if stages else ()
    errors = [shape.rmse for shape in shapes if shape.rmse]
    if not errors:
        return 1
    wanted = _VISIBLE * size / float(np.median(errors))
    return max(factor for factor in _FACTORS if factor == 1 or factor <= wanted)


def _window(lines: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Middle and size [m] of a window that contains all lines (K, 2)."""
    corners = np.concatenate(lines) if lines else np.zeros((1, 2))
    low, high = corners.min(axis=0), corners.max(axis=0)
    span = 1.08 * (high - low) + 0.02 * max(float((high - low).max()), 1e-3)
    # A slender window would leave no room for the axis: its short side is at least a third.
    span = np.maximum(span, span.max() / 3)
    return (low + high) / 2, span


def _page_size(rows: int, columns: int, slope: float) -> tuple[float, float]:
    """Size [inch] of a page of panels that are about `slope` times as high as wide."""
    width = max(_PANEL * columns, _NARROWEST)
    tall = slope * width / columns
    if rows == 1 and tall > _TALLEST:
        width, tall = max(width * _TALLEST / tall, _NARROWEST), _TALLEST
    return width, rows * (tall + _ABOVE) + _AROUND


def _arranged(count: int) -> tuple[int, int]:
    """Rows and columns of a nearly square grid with few empty places."""
    if count <= 4:
        return 1, count

    def price(columns: int) -> tuple[int, int, int]:
        rows = math.ceil(count / columns)
        return (rows * columns - count, abs(rows - columns), -columns)

    columns = min((3, 4, 5, 6), key=price)
    return math.ceil(count / columns), columns


# ---- photographs under all lines ---------------------------------------------------------------


def write_overlays(folder: Path, outcome: Outcome) -> None:
    """Draw a JPEG for each pose with a photograph into a new folder, if there is any."""
    if any(pose.image is not None for pose in outcome.poses):
        make_folder(folder)
    for pose in outcome.poses:
        if pose.image is not None and pose.to_pixels is not None:
            try:
                image = read_image(pose.image)[..., ::-1]
            except MeasurementError:  # deleted since it was measured
                continue
            _draw_overlay(folder / f"{pose.name}.jpg", image, pose, outcome)


def _draw_overlay(path: Path, image: NDArray[np.uint8], pose: PoseInput, outcome: Outcome) -> None:
    """Draw the part of a photograph (H, W, 3; red, green, blue) that holds the cable."""
    lines = []
    for kind, label, stage in compared(outcome):
        shape = stage.shapes.get(pose.name)
        if shape is not None:
            label += "" if shape.rmse is None else f", {millimetres(shape.rmse)}"
            lines.append((np.asarray(pose.to_pixels(shape.curve)), kind, label))
    measured = np.zeros((0, 2)) if pose.pixels is None else pose.pixels
    (left, top), (right, bottom) = _cut_out(image, [measured, *(line[0] for line in lines)])
    zoom = min(_LARGEST[0] / (right - left), _LARGEST[1] / (bottom - top))
    width, height = round((right - left) * zoom), round((bottom - top) * zoom)
    part = Image.fromarray(image[top:bottom, left:right]).resize(
        (width, height), Image.Resampling.BILINEAR
    )
    whole = max(width, _LEGEND)
    with style.styled((whole / _DPI, (height + _STRIP) / _DPI), layout=None) as drawing:
        share = _STRIP / (height + _STRIP)
        axes = drawing.add_axes(((1 - width / whole) / 2, share, width / whole, 1 - share))
        axes.set_axis_off()
        axes.plot(*measured.T, ".", color="white", ms=4.2)
        axes.plot(*measured.T, ".", color="black", ms=2.2, label="measured")
        for line, kind, label in lines:
            axes.plot(*line.T, color="white", lw=2.6, alpha=0.6)
            axes.plot(*line.T, **canvas.STAGE_LINES[kind], lw=1.5, label=label)
        axes.set_xlim(left - 0.5, right - 0.5)
        axes.set_ylim(bottom - 0.5, top - 0.5)
        role = "held out" if pose.role == "held_out" else "fit"
        drawing.legend(
            loc="lower center", ncols=3, fontsize=9, frameon=False, title=f"{pose.name} ({role})"
        )
        drawing.set_dpi(_DPI)
        drawing.patch.set_alpha(0.0)
        painter = FigureCanvasAgg(drawing)
        painter.draw()
        over = Image.fromarray(np.asarray(painter.buffer_rgba()))
    # Matplotlib takes longer for a photograph than for all the lines over it.
    page = Image.new("RGB", over.size, "white")
    page.paste(part, ((whole - width) // 2, 0))
    page.paste(over, mask=over)
    write_file(path, lambda stream: page.save(stream, "JPEG", quality=88))


def _cut_out(
    image: NDArray[np.uint8], lines: Sequence[FloatArray]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Corners (left, top), (right, bottom) [px] of a window around all lines, with a margin."""
    size = np.array([image.shape[1], image.shape[0]])
    drawn = np.concatenate(lines)
    drawn = np.clip(drawn[np.isfinite(drawn).all(axis=1)], 0, size - 1)
    if not len(drawn):
        return (0, 0), (int(size[0]), int(size[1]))
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    margin = 0.12 * float((high - low).max()) + 8
    low = np.maximum(np.floor(low - margin), 0).astype(int)
    high = np.minimum(np.ceil(high + margin), size).astype(int)
    return (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))


# ---- in one frame ------------------------------------------------------------------------------


def outcome_figure(outcome: Outcome) -> Figure:
    """All poses in one frame: measured points, and the shapes predicted from their ends alone."""
    stage, (scene, _) = outcome.stages[-1], scene_of(outcome)
    errors = ", ".join(f"{name} {value}" for name, value in error_rows(outcome)[:2])
    squares = f"; squares of {scene.square:g} mm" if isinstance(scene, Room) else ""
    with canvas.chart(outcome, errors + squares, 5.0, width=7.0) as (drawing, (axes,)):
        canvas.draw_marks(axes, scene.ground())
        for pose in outcome.poses:
            color = style.HELD_OUT if pose.role == "held_out" else style.BLUE
            shape = stage.shapes.get(pose.name)
            if shape is not None:
                axes.plot(*seen(scene.points(shape.curve)).T, color=color, lw=1.4)
            if len(pose.points):
                shown = pose.points[:: max(1, len(pose.points) // _POINTS_IN_ONE)]
                axes.plot(*seen(scene.points(shown)).T, ".", color=style.BLACK, ms=2.5)
        axes.plot([], [], ".", color=style.BLACK, label="measured")
        axes.plot([], [], color=style.BLUE, label=label_of(stage, outcome))
        if any(pose.role == "held_out" for pose in outcome.poses):
            axes.plot([], [], color=style.HELD_OUT, label="held out of the fit")
        canvas.frame(axes, scene)
        drawing.legend(loc="outside lower center", ncols=3)
    return drawing


# Share of a limit -> colour: pale while far from it, dark red at and beyond the limit.
_USED = LinearSegmentedColormap.from_list(
    "used", [(0.0, "#E8EEF3"), (0.5, "#F2D9A0"), (0.8, "#E08A2B"), (1.0, style.VERMILLION)]
)
_COLORS = {"pass": style.GREEN, "risk": style.ORANGE, "fail": style.VERMILLION}


def limits_figure(outcome: Outcome) -> Figure:
    """One row per limit and pose: the cable from start to end, coloured by its use of the limit."""
    checks = sorted(outcome.limits, key=lambda item: item.quantity)
    names = list(dict.fromkeys(item.quantity for item in checks))
    gaps = {item: k + names.index(item.quantity) for k, item in enumerate(checks)}
    height = 1.8 + 0.22 * (len(checks) + len(names))
    length = outcome.config.cable.length
    said = "how much of each limit is used, how likely it is violated"
    with canvas.chart(outcome, said, height) as (drawing, (axes,)):
        for item, row in gaps.items():
            _draw_row(axes, item, -row, length)
        labels = [f"{item.label}  {item.pose}" for item in checks]
        axes.set_yticks([-row for row in gaps.values()], labels, fontsize=8)
        axes.set_ylim(-max(gaps.values()) - 0.7, 0.7)
        axes.set_xlim(-0.03 * length, 1.03 * length)
        axes.set_xlabel("from start to end [m]")
        axes.grid(visible=False)
        scale = ScalarMappable(Normalize(0.0, 1.0), _USED)
        bar = drawing.colorbar(scale, ax=axes, location="bottom", aspect=40, pad=0.02)
        bar.set_label("share of the limit", fontsize=8)
    return drawing


def _draw_row(axes: Axes, item: LimitCheck, y: float, length: float) -> None:
    """Draw the cable of a pose as a bar, or its fixtures as dots; at the right the probability."""
    used = np.clip(item.used, 0.0, 1.0)
    if item.quantity in ("force", "moment"):
        axes.plot([0.0, length], [y, y], color="#E3E3E3", lw=1, zorder=1)
        axes.scatter(item.s, np.full(len(used), y), c=_USED(used), s=45, marker="s", zorder=2)
    else:
        ends = np.stack([item.s, np.full(len(used), y)], axis=1)
        parts = np.stack([ends[:-1], ends[1:]], axis=1)
        colors = _USED((used[:-1] + used[1:]) / 2)
        axes.add_collection(LineCollection(list(parts), colors=colors, lw=8, capstyle="butt"))
    axes.plot(item.at, y, "o", mfc="none", mec=style.BLACK, ms=9, mew=1.2, zorder=3)
    axes.annotate(
        item.chance,
        (1.0, y),
        xycoords=("axes fraction", "data"),
        xytext=(4, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        color=_COLORS[item.verdict],
    )
