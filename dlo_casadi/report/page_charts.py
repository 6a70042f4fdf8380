"""Charts of the page: errors, residuals, rest curvature, boards. The browser draws them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from bokeh.embed import json_item
from bokeh.layouts import column
from bokeh.models import (
    BoxAnnotation,
    ColumnDataSource,
    FixedTicker,
    Model,
    PrintfTickFormatter,
    Range1d,
    Span,
    TapTool,
)
from bokeh.plotting import figure

from dlo_casadi.report.canvas import before_after, label_of
from dlo_casadi.report.geometry import directions, residual_along, residual_range, rest_about
from dlo_casadi.report.page_boards import next_pose_chart, pull_chart
from dlo_casadi.report.page_canvas import AFTER, BEFORE, FAINT, HELD_OUT, INK, empty_chart, hover
from dlo_casadi.report.text_findings import cross_validated
from dlo_casadi.session.outcome import Outcome, Stage
from dlo_casadi.thresholds import NORMAL_95

_BAND = "#E8EEF3"
# Errors beyond these are drawn at the edge of an axis [mm].
_LEAST_MM, _MOST_MM = 1e-9, 1e9
_SYMBOLS = {"fit": "circle", "cross-validated": "diamond", "held out": "square"}


def charts(outcome: Outcome) -> dict[str, str]:
    """Charts for which there is something to draw, as JSON by the name of their place."""
    drawn: dict[str, Model] = {"chart-errors": errors_chart(outcome)}
    if any(stage.shapes for stage in outcome.stages):
        drawn["chart-poses"] = poses_chart(outcome)
        drawn["chart-residuals"] = residuals_chart(outcome)
        drawn["chart-rest"] = rest_chart(outcome)
    in_space = outcome.config.experiment.in_space  # there the board is a room, and no chart
    if outcome.next_pose is not None and not in_space:
        drawn["chart-next"] = next_pose_chart(outcome)
    if outcome.unexplained is not None and not in_space:
        drawn["chart-pull"] = pull_chart(outcome)
    return {name: json.dumps(json_item(model)) for name, model in drawn.items()}


# ---- errors ------------------------------------------------------------------------------------


def errors_chart(outcome: Outcome) -> Model:
    """Errors of the stages as points on a logarithmic scale, beside that of noise alone."""
    validated = cross_validated(outcome)
    rows: list[tuple[str, str, float]] = []
    for stage in outcome.stages:
        values = {
            "fit": stage.rmse_fit,
            "cross-validated": validated.get(stage.name),
            "held out": stage.rmse_held_out,
        }
        label = label_of(stage, outcome)
        rows += [(label, kind, 1e3 * value) for kind, value in values.items() if value]
    labels = [label_of(stage, outcome) for stage in outcome.stages]
    floor = 1e3 * outcome.measurement.noise_distance
    chart = empty_chart(
        70 + 42 * len(labels),
        y_range=labels[::-1],
        x_axis_type="log",
        x_range=_log_range([value for *_, value in rows] + [floor]),
        x_axis_label="RMS distance [mm]",
    )
    _plain_numbers(chart)
    chart.ygrid.grid_line_color = None
    chart.add_layout(Span(location=floor, dimension="height", line_color=INK, line_dash="dashed"))
    shift = {"fit": 0.18, "cross-validated": 0.0, "held out": -0.18}
    for kind, symbol in _SYMBOLS.items():
        own = [(label, value) for label, k, value in rows if k == kind]
        source = ColumnDataSource(
            {
                "stage": [label for label, _ in own],
                "value": [value for _, value in own],
                "y": [(label, shift[kind]) for label, _ in own],
                "kind": [kind] * len(own),
            }
        )
        drawn = chart.scatter("value", "y", source=source, marker=symbol, size=11, **_filled(kind))
        chart.add_tools(
            hover(("stage", "@stage"), ("error", "@value{0.0000} mm (@kind)"), renderers=[drawn])
        )
    return chart


def _filled(kind: str) -> dict[str, Any]:
    color = HELD_OUT if kind == "held out" else AFTER
    fill = "white" if kind == "cross-validated" else color
    return {"line_color": color, "fill_color": fill, "line_width": 2}


def _log_range(values: list[float]) -> Range1d:
    """Range of a logarithmic axis [mm] that leaves room on both sides; finite in any case."""
    known = [min(max(value, _LEAST_MM), _MOST_MM) for value in values if 0 < value < np.inf]
    return Range1d(min(known, default=0.1) / 1.6, max(known, default=10.0) * 1.6)


def _plain_numbers(chart: figure) -> None:
    """Numbers such as 0.1 and 0.5 along a logarithmic axis, not powers of ten."""
    low, high = chart.x_range.start, chart.x_range.end
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    steps = (1,) if high / low > 300 else (1, 3) if high / low > 30 else (1, 2, 5)
    chart.xaxis.ticker = FixedTicker(
        ticks=[float(f"{step * tens:.0e}") for tens in decades for step in steps]
    )
    chart.xaxis.formatter = PrintfTickFormatter(format="%g")


def poses_chart(outcome: Outcome) -> Model:
    """Error of every pose, before and after; a pose is chosen by a click."""
    before, after = before_after(outcome)
    names = [pose.name for pose in outcome.poses]
    floor = 1e3 * outcome.measurement.noise_distance
    found: list[tuple[Stage, str, str, list[float]]] = []
    for stage, color, marker in ((before, BEFORE, "triangle"), (after, AFTER, "circle")):
        if stage is not None:
            known = {name: shape.rmse for name, shape in stage.shapes.items() if shape.rmse}
            errors = [1e3 * known.get(name, np.nan) for name in names]
            found.append((stage, color, marker, errors))
    chart = empty_chart(
        70 + 24 * max(3, len(names)),
        y_range=names[::-1],
        x_axis_type="log",
        x_range=_log_range([*(e for *_, errors in found for e in errors), floor]),
        x_axis_label="RMS distance [mm]",
    )
    _plain_numbers(chart)
    chart.add_layout(Span(location=floor, dimension="height", line_color=INK, line_dash="dashed"))
    roles = ["held out" if pose.role == "held_out" else "fit" for pose in outcome.poses]
    if len(found) == 2:
        chart.segment(found[0][3], names, found[1][3], names, line_color=FAINT, line_width=1.5)
    drawn: list[Any] = []
    for stage, color, marker, errors in found:
        source = ColumnDataSource(
            {
                "pose": names,
                "role": roles,
                "value": errors,
                "stage": [label_of(stage, outcome)] * len(names),
                "fill": ["white" if role == "held out" else color for role in roles],
            },
            name=f"errors-{len(drawn)}",
        )
        drawn.append(
            chart.scatter(
                "value",
                "pose",
                source=source,
                marker=marker,
                size=10,
                line_color=color,
                line_width=2,
                fill_color="fill",
                nonselection_alpha=1.0,
                nonselection_fill_alpha=1.0,
            )
        )
    chart.add_tools(
        hover(("pose", "@pose (@role)"), ("error", "@value{0.0000} mm (@stage)"), renderers=drawn),
        TapTool(renderers=drawn),
    )
    return chart


# ---- residuals ---------------------------------------------------------------------------------


def residuals_chart(outcome: Outcome) -> Model:
    """Residual along the arc in noise units, before and after, of all poses and of a chosen one."""
    across = Range1d(0.0, outcome.config.cable.length)
    parts = []
    before, after = before_after(outcome)
    for kind, stage, color in (("before", before, BEFORE), ("after", after, AFTER)):
        if stage is None:
            continue
        own = Range1d(*residual_range(stage, outcome.measurement.std))
        for direction in directions(outcome):
            chart = empty_chart(
                230 if kind == "before" else 260,
                x_range=across,
                y_range=own,
                title=f"{kind}: {label_of(stage, outcome)}{direction and f', along {direction}'}",
                y_axis_label="residual [noise std]",
            )
            chart.title.text_color = INK
            chart.title.text_font_size = "13px"
            chart.add_layout(
                BoxAnnotation(
                    bottom=-2,
                    top=2,
                    fill_color=_BAND,
                    fill_alpha=1.0,
                    level="underlay",
                    line_color=None,
                )
            )
            chart.add_layout(Span(location=0, dimension="width", line_color=FAINT))
            _residual_lines(chart, kind, stage, outcome, color, direction)
            parts.append(chart)
    if parts:
        parts[-1].xaxis.axis_label = "arc length from the start s [m]"
    return column(parts, sizing_mode="stretch_width")


def _residual_lines(
    chart: figure, kind: str, stage: Stage, outcome: Outcome, color: str, direction: str
) -> None:
    """All poses thin, and a source that the page fills with the chosen one."""
    shapes = [stage.shapes.get(pose.name) for pose in outcome.poses]
    empty, noise = np.zeros(0, dtype=np.float32), outcome.measurement.std
    suffix = "-z" if direction == "z" else ""
    all_poses = ColumnDataSource(
        {
            "s": [empty if x is None else x.s.astype(np.float32) for x in shapes],
            "r": [
                empty if x is None else (residual_along(x, direction) / noise).astype(np.float32)
                for x in shapes
            ],
            "pose": [pose.name for pose in outcome.poses],
            "role": ["held out" if p.role == "held_out" else "fit" for p in outcome.poses],
            "dash": [[5, 3] if p.role == "held_out" else [] for p in outcome.poses],
        },
        name=f"all-{kind}{suffix}",
    )
    thin = chart.multi_line(
        "s", "r", source=all_poses, line_color=FAINT, line_alpha=0.55, line_dash="dash"
    )
    chosen = ColumnDataSource({"s": [], "r": []}, name=f"chosen-{kind}{suffix}")
    chart.line("s", "r", source=chosen, line_color="white", line_width=5)
    chart.line("s", "r", source=chosen, line_color=color, line_width=2.5)
    points = chart.scatter("s", "r", source=chosen, size=4, fill_color=color, line_color=None)
    chart.add_tools(
        hover(
            ("pose", "@pose (@role)"),
            ("s", "$snap_x{0.000} m"),
            ("residual", "$snap_y{0.0} std"),
            renderers=[thin],
            line_policy="nearest",
        ),
        hover(("s", "@s{0.000} m"), ("residual", "@r{0.00} std"), renderers=[points]),
    )


# ---- rest curvature ----------------------------------------------------------------------------


def rest_chart(outcome: Outcome) -> Model:
    """Rest curvature of the last stage with its band, and of the fit that it improves on."""
    across = Range1d(0.0, outcome.config.cable.length)
    parts = [_rest_chart(outcome, across, direction) for direction in directions(outcome)]
    return parts[0] if len(parts) == 1 else column(parts, sizing_mode="stretch_width")


def _rest_chart(outcome: Outcome, across: Range1d, direction: str) -> figure:
    before, after = before_after(outcome)
    what = direction and f" k_{direction}"
    chart = empty_chart(
        280,
        x_range=across,
        x_axis_label="arc length from the start s [m]",
        y_axis_label=f"rest curvature{what} [1/m]",
    )
    chart.add_layout(Span(location=0, dimension="width", line_color=FAINT))
    if before is not None and before.name == "batch":
        rest = rest_about(before, direction)
        chart.line(rest.s, rest.value, line_color=BEFORE, line_dash="dashed", line_width=2)
    if after is not None:
        rest = rest_about(after, direction)
        source = ColumnDataSource(
            {
                "s": rest.s,
                "value": rest.value,
                "low": rest.value - NORMAL_95 * rest.std,
                "high": rest.value + NORMAL_95 * rest.std,
            }
        )
        chart.varea("s", "low", "high", source=source, fill_color=AFTER, fill_alpha=0.22)
        drawn = chart.line("s", "value", source=source, line_color=AFTER, line_width=2.5)
        chart.add_tools(
            hover(
                ("s", "@s{0.000} m"),
                (f"rest curvature{what}", "@value{0.000} 1/m"),
                ("95 % band", "@low{0.000} to @high{0.000}"),
                renderers=[drawn],
                mode="vline",
            )
        )
    return chart
