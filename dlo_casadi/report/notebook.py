"""Results as a notebook shows them: a few lines, a small table, one figure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from matplotlib.figure import Figure

from dlo_casadi.errors import counted
from dlo_casadi.report.canvas import (
    BLACK,
    BLUE,
    HELD_OUT,
    NOISE_ALONE,
    label_of,
    millimetres,
    styled,
)
from dlo_casadi.report.figures_room import draw_marks, frame
from dlo_casadi.report.json_report import all_warnings
from dlo_casadi.report.room import seen
from dlo_casadi.report.scene import scene_of
from dlo_casadi.report.terminal import prediction_rows
from dlo_casadi.report.text_findings import ON_BRANCH, predicted_share, verdict_lines
from dlo_casadi.report.text_parameters import describe
from dlo_casadi.session.outcome import Outcome

_POINTS = 40


def outcome_text(outcome: Outcome) -> str:
    """Cable, verdict, parameters and errors in a few lines."""
    name, lines = outcome.config.cable.name, verdict_lines(outcome)
    lines = [f"{name}: {lines[0]}", *lines[1:]]
    for parameter in _parameters(outcome):
        lines.append("  " + "  ".join(filter(None, parameter)))
    lines += ["  " + "  ".join(row) for row in _errors(outcome)]
    warnings = len(all_warnings(outcome))
    if warnings:
        lines.append(f"  {counted(warnings, 'warning')}: see .warnings")
    return "\n".join(lines)


def outcome_html(outcome: Outcome) -> str:
    """The same as a short table."""
    rows = [*_parameters(outcome), *_errors(outcome)]
    remarks = [*verdict_lines(outcome), *all_warnings(outcome)]
    return _table(outcome.config.cable.name, rows, remarks)


def outcome_figure(outcome: Outcome) -> Figure:
    """All poses in one frame: measured points, and the shapes predicted from their ends alone."""
    stage = outcome.stages[-1]
    with styled((7.0, 5.0)) as drawing:
        axes = drawing.subplots()
        room, _ = scene_of(outcome)
        draw_marks(axes, room.ground())
        for pose in outcome.poses:
            color = HELD_OUT if pose.role == "held_out" else BLUE
            shape = stage.shapes.get(pose.name)
            if shape is not None:
                axes.plot(*seen(room.points(shape.curve)).T, color=color, lw=1.4)
            if len(pose.points):
                shown = pose.points[:: max(1, len(pose.points) // _POINTS)]
                axes.plot(*seen(room.points(shown)).T, ".", color=BLACK, ms=2.5)
        axes.plot([], [], ".", color=BLACK, label="measured")
        axes.plot([], [], color=BLUE, label=label_of(stage, outcome))
        if any(pose.role == "held_out" for pose in outcome.poses):
            axes.plot([], [], color=HELD_OUT, label="held out of the fit")
        frame(axes, room)
        errors = ", ".join(f"{row[0]} {row[1]}" for row in _errors(outcome)[:2])
        axes.set_title(f"{outcome.config.cable.name}: {errors}")
        drawing.legend(loc="outside lower center", ncols=3)
    return drawing


def shape_text(shape: dict[str, Any]) -> str:
    """A predicted pose in a few lines."""
    lines = [f"{shape['cable']}: predicted shape"]
    return "\n".join([*lines, *(f"  {name}: {value}" for name, value in prediction_rows(shape))])


def shape_html(shape: dict[str, Any]) -> str:
    """The same as a short table."""
    return _table(f"{shape['cable']}: predicted shape", prediction_rows(shape))


def _parameters(outcome: Outcome) -> list[tuple[str, ...]]:
    """Name, value, interval and remark of each parameter of the last stage."""
    return [(name, *describe(estimate)) for name, estimate in outcome.stages[-1].parameters.items()]


def _errors(outcome: Outcome) -> list[tuple[str, ...]]:
    """RMS distance of the measured points from the predicted shapes, and by noise alone."""
    stage = outcome.stages[-1]
    rows = [("error of the fit", millimetres(stage.rmse_fit))]
    if stage.rmse_held_out is not None:
        share = predicted_share(outcome, stage)
        rows.append(("held out", millimetres(stage.rmse_held_out) + share))
    if stage.other_branch:
        both = (stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch)
        rows.append(
            (ON_BRANCH, ", ".join(millimetres(value) for value in both if value is not None))
        )
    measurement = outcome.measurement
    floor = (f"{NOISE_ALONE} ({measurement.std_source})", millimetres(measurement.noise_distance))
    return [*rows, floor]


def _table(title: str, rows: Iterable[Sequence[str]], remarks: Iterable[str] = ()) -> str:
    """HTML table with everything escaped; the remarks below it."""
    listed = [list(row) for row in rows]
    columns = max(map(len, listed))
    body = "".join(
        "<tr>"
        + "".join(f"<td>{escape(cell)}</td>" for cell in [*row, *[""] * (columns - len(row))])
        + "</tr>"
        for row in listed
    )
    below = "".join(f"<div>{escape(remark.strip())}</div>" for remark in remarks)
    return f"<div><b>{escape(title)}</b><table>{body}</table>{below}</div>"
