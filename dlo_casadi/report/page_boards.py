"""Charts of the page that show the board: where to photograph next, where the cable is pulled."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, DataRange1d, Model
from bokeh.plotting import figure

from dlo_casadi.report.geometry import measured_line
from dlo_casadi.report.page_canvas import AFTER, FAINT, INK, NEXT, empty_chart, hover
from dlo_casadi.session.outcome import Outcome


def _board(outcome: Outcome) -> figure:
    """The board with one scale on both axes, and the measured cables on it."""
    ends = [
        [point for point in (pose.start, pose.end) if point is not None]
        for pose in outcome.config.experiment.poses
    ]
    drawn = np.concatenate([*ends, *(pose.points for pose in outcome.poses if len(pose.points))])
    across, down = np.ptp(drawn, axis=0)
    chart = empty_chart(
        440,
        match_aspect=True,
        x_range=DataRange1d(range_padding=0.08),
        y_range=DataRange1d(range_padding=0.08),
        x_axis_label="x [m]",
        y_axis_label="y [m]",
    )
    chart.sizing_mode = "scale_width"
    chart.aspect_ratio = float(np.clip(across / max(down, 1e-9), 0.8, 1.8))
    measured = [pose for pose in outcome.poses if len(pose.points)]
    source = ColumnDataSource(
        {
            "x": [pose.points[:: max(1, len(pose.points) // 60), 0] for pose in measured],
            "y": [pose.points[:: max(1, len(pose.points) // 60), 1] for pose in measured],
            "pose": [pose.name for pose in measured],
        }
    )
    lines = chart.multi_line("x", "y", source=source, line_color="#9AA5B1", line_width=1.2)
    chart.add_tools(hover(("measured", "@pose"), renderers=[lines]))
    board = getattr(outcome.config.experiment.measurement, "board", None)
    if board is not None:
        centers = np.array(list(board.marker_centers.values()))
        chart.rect(
            centers[:, 0],
            centers[:, 1],
            board.marker_size,
            board.marker_size,
            fill_color="#C9D0D8",
            line_color=FAINT,
        )
    return chart


def next_pose_chart(outcome: Outcome) -> Model:
    """Where to hold the end in the next photograph, among those that were taken."""
    assert outcome.next_pose is not None
    chart = _board(outcome)
    poses = [pose for pose in outcome.config.experiment.poses if pose.end is not None]
    starts = np.unique(np.array([pose.start for pose in poses]), axis=0)
    ends = ColumnDataSource(
        {
            "x": [pose.end[0] for pose in poses if pose.end],
            "y": [pose.end[1] for pose in poses if pose.end],
            "pose": [pose.name for pose in poses],
        }
    )
    held = chart.scatter(
        "x",
        "y",
        source=ends,
        marker="circle",
        size=9,
        fill_color="white",
        line_color=INK,
        line_width=1.5,
    )
    chart.scatter(starts[:, 0], starts[:, 1], marker="square", size=11, color=INK)
    x, y = outcome.next_pose["end"]
    proposal = ColumnDataSource({"x": [x], "y": [y]})
    star = chart.scatter(
        "x", "y", source=proposal, marker="star", size=26, fill_color=NEXT, line_color="white"
    )
    chart.text(
        [x],
        [y],
        text=["next end"],
        x_offset=16,
        y_offset=-10,
        text_color=NEXT,
        text_font_size="14px",
        text_font_style="bold",
        background_fill_color="white",
        background_fill_alpha=0.85,
        padding=3,
    )
    chart.add_tools(
        hover(("end of", "@pose"), ("at", "(@x{0.000}, @y{0.000}) m"), renderers=[held]),
        hover(("next end", "(@x{0.000}, @y{0.000}) m"), renderers=[star]),
    )
    return chart


def pull_chart(outcome: Outcome) -> Model:
    """Where the cable is pulled, and how, in each fit pose."""
    load = outcome.unexplained
    assert load is not None
    names = load.get("poses") or [
        pose.name for pose in outcome.poses if pose.role == "fit" and len(pose.points)
    ]
    forces = np.array(load["force_per_pose"], dtype=float).reshape(-1, 2)
    largest = max(float(np.hypot(*forces.T).max(initial=0.0)), 1e-12)
    reach = 0.25 * outcome.config.cable.length / largest
    chart = _board(outcome)
    rows: list[dict[str, Any]] = []
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    for name, force in zip(names, forces, strict=False):
        line = measured_line(outcome, name)
        if line is None:
            continue
        places, points = line
        pulled = np.linspace(load["interval_95"][0], load["interval_95"][1], 9)
        parts.append(
            (np.interp(pulled, places, points[:, 0]), np.interp(pulled, places, points[:, 1]))
        )
        root = np.array([np.interp(load["position"], places, points[:, i]) for i in (0, 1)])
        tip = root + reach * force
        size = float(np.hypot(*force))
        rows.append(
            {
                "pose": name,
                "x0": root[0],
                "y0": root[1],
                "x1": tip[0],
                "y1": tip[1],
                "fx": force[0],
                "fy": force[1],
                "size": size,
                "angle": float(np.arctan2(force[1], force[0])) - np.pi / 2,
            }
        )
    chart.multi_line(
        [x for x, _ in parts],
        [y for _, y in parts],
        line_color=AFTER,
        line_width=6,
        line_cap="butt",
    )
    source = ColumnDataSource({key: [row[key] for row in rows] for key in rows[0]} if rows else {})
    if rows:
        shafts = chart.segment("x0", "y0", "x1", "y1", source=source, line_color=NEXT, line_width=2)
        heads = chart.scatter(
            "x1", "y1", source=source, marker="triangle", size=11, angle="angle", color=NEXT
        )
        chart.add_tools(
            hover(
                ("pose", "@pose"),
                ("force", "(@fx{0.000}, @fy{0.000}) N, @size{0.000} N"),
                renderers=[shafts, heads],
            )
        )
    return chart
