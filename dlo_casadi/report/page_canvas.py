"""What all charts of the page share: colours, an empty chart, what is told at the pointer."""

from __future__ import annotations

from typing import Any

from bokeh.models import HoverTool
from bokeh.plotting import figure

# Colours that the colour-blind can tell apart, each at least 4.5 to 1 against white.
BEFORE, AFTER, HELD_OUT, NEXT = "#B35A00", "#0067A3", "#8C3B6C", "#9E2A00"
INK, FAINT, GRID = "#1F2933", "#6B7280", "#E3E6EA"


def empty_chart(height: int, **options: Any) -> figure:
    """An empty chart as wide as its place, which neither drags nor swallows the scrolling."""
    chart = figure(
        height=height, sizing_mode="stretch_width", toolbar_location=None, tools="", **options
    )
    chart.outline_line_color = None
    chart.grid.grid_line_color = GRID
    chart.axis.axis_label_text_font_style = "normal"
    chart.axis.axis_label_text_font_size = "13px"
    chart.axis.major_label_text_font_size = "12px"
    for part in ("axis_label_text_color", "major_label_text_color"):
        setattr(chart.axis, part, INK)
    chart.axis.axis_line_color = FAINT
    chart.axis.major_tick_line_color = FAINT
    chart.axis.minor_tick_line_color = None
    return chart


def hover(*rows: tuple[str, str], renderers: list[Any], **options: Any) -> HoverTool:
    """Tell rows of a name and a value at the pointer."""
    return HoverTool(tooltips=list(rows), renderers=renderers, **options)
