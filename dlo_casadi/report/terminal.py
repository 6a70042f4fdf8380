"""Tables for the terminal: what was found, how well, what is not known, and how long it took."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from dlo_casadi.errors import counted
from dlo_casadi.report.canvas import NOISE_ALONE, label_of, millimetres
from dlo_casadi.report.json_report import all_warnings
from dlo_casadi.report.text_findings import (
    CANDIDATE_ORDER,
    cross_validated,
    finding_of,
    p_value_note,
    stage_rows,
    timing_rows,
    verdict_lines,
)
from dlo_casadi.report.text_parameters import (
    describe,
    fixed_rows,
    footnotes,
    nuisance_rows,
    rest_rows,
    vector,
)
from dlo_casadi.session.outcome import Outcome, ReadingErrors
from dlo_casadi.session.pose_shape import BranchShape

# Distances [m] that the table of a prediction shows.
_SHOWN = 5e-6


def print_summary(console: Console, outcome: Outcome) -> None:
    """Print all that a user should see at the end of a run."""
    console.print(summary(outcome))


def summary(outcome: Outcome) -> RenderableType:
    """Everything that a user should see at the end of a run."""
    parts: list[RenderableType] = [
        "",
        _heading(outcome),
        parameter_table(outcome),
        *(Text("  " + line) for line in footnotes(outcome)),
        "",
        error_table(outcome),
        "",
        *(Text(line) for line in verdict_lines(outcome)),
    ]
    warnings = all_warnings(outcome)
    if warnings:
        parts.append("")
        parts += [Text.assemble(("warning: ", "bold yellow"), text) for text in warnings]
    parts += ["", timing_table(outcome)]
    return Group(*parts)


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)


def _heading(outcome: Outcome) -> Text:
    m = outcome.measurement
    noise = f"noise std {millimetres(m.std)} ({m.std_source})"
    if m.correlation_length > 0:
        noise += f", correlated over {millimetres(m.correlation_length)}"
    declared = m.poses_held_out + len(m.held_out_missing)
    held_out = f"{m.poses_held_out} held out"
    if m.held_out_missing:
        held_out = f"{m.poses_held_out} of {declared} held out"
    text = (
        f"{counted(m.poses_fit, 'fit pose')}, {held_out}, {counted(m.points, 'point')}; {noise}; "
        f"{counted(outcome.discretization.n, outcome.discretization.element)}, "
        f"mesh error {millimetres(outcome.discretization.error)}"
    )
    return Text.assemble((outcome.config.cable.name, "bold"), ": ", text)


# ---- parameters --------------------------------------------------------------------------------


def parameter_table(outcome: Outcome) -> Table:
    """Fitted parameters of the last stage with their units, and what was kept fixed."""
    table = _table(f"Parameters ({label_of(outcome.stages[-1], outcome)})")
    for column in ("parameter", "value", "95 % interval", ""):
        table.add_column(column, no_wrap=bool(column))
    for name, estimate in outcome.stages[-1].parameters.items():
        table.add_row(name, *describe(estimate))
    for row in rest_rows(outcome):
        table.add_row(*row)
    for row in nuisance_rows(outcome):
        table.add_row(*row)
    for row in fixed_rows(outcome):
        table.add_row(*row, style="dim")
    return table


# ---- errors ------------------------------------------------------------------------------------


def error_table(outcome: Outcome) -> Table:
    """Errors of the stages: fit, cross-validated, held out, chi-square, beside the noise."""
    table = _table("Distance of the measured points from the predicted shape, RMS")
    table.add_column("stage")
    columns = {"fit": "fit", "validated": "cross-validated", "held_out": "held out"}
    columns["chi2"] = "chi2/dof"
    if not cross_validated(outcome):
        del columns["validated"]
    for name in columns.values():
        table.add_column(name, justify="right")
    for row in stage_rows(outcome, "-"):
        table.add_row(row["label"], *(row[column] for column in columns))
    last = outcome.stages[-1]
    if outcome.measurement.readings:
        cells = {
            "fit": _newtons(last.readings_fit),
            "held_out": _newtons(last.readings_held_out),
        }
        table.add_row("  forces, moments", *(cells.get(column, "") for column in columns))
    table.add_section()
    floor = [millimetres(outcome.measurement.noise_distance)] + [""] * (len(columns) - 1)
    table.add_row(f"{NOISE_ALONE} ({outcome.measurement.std_source})", *floor)
    return table


def _newtons(errors: ReadingErrors) -> str:
    """Errors of forces and moments, as far as there are any."""
    found = ((errors.force, "N"), (errors.moment, "N m"))
    return ", ".join(f"{value:.2g} {unit}" for value, unit in found if value is not None) or "-"


# ---- diagnosis ---------------------------------------------------------------------------------


def candidate_table(outcome: Outcome) -> Table:
    """Every effect that was tried, in the order of `CANDIDATE_ORDER`."""
    table = _table(f"Effects that were tried: {CANDIDATE_ORDER}")
    table.caption, table.caption_justify = p_value_note(outcome), "left"
    table.add_column("effect")
    for column in ("score", "p-value", "cross-validated error"):
        table.add_column(column, justify="right")
    table.add_column("finding")
    for row in outcome.candidates:
        table.add_row(
            row.name,
            f"{row.score:.1f}",
            f"{row.p_value:.2g}",
            millimetres(row.rmse_cross_validated),
            finding_of(outcome, row)[1],
        )
    return table


# ---- timing ------------------------------------------------------------------------------------


def timing_table(outcome: Outcome) -> Table:
    """Wall-clock time of the parts of the run."""
    table = _table("Time")
    table.add_column("part")
    table.add_column("seconds", justify="right")
    table.add_column("")
    *parts, total = timing_rows(outcome)
    for row in parts:
        table.add_row(*row)
    table.add_section()
    table.add_row(*total)
    return table


# ---- one predicted pose ------------------------------------------------------------------------


def prediction_table(shape: dict[str, Any], notes: Iterable[str] = ()) -> RenderableType:
    """Reactions, energy, stability and shape of one predicted pose.

    Parameters
    ----------
    shape : dict
        As from `PredictedShape.as_dict`.
    """
    table = _table(f"{shape['cable']}: predicted shape")
    table.add_column("quantity")
    table.add_column("value")
    for row in prediction_rows(shape):
        table.add_row(*row)
    points = _table("Points from start to end")
    count, axes = len(shape["points"]), "xyz"[: len(shape["start"])]
    for column in ("s", *axes):
        points.add_column(f"{column} [m]", justify="right")
    for k, place in enumerate(shape["points"]):
        if k % max(1, (count - 1) // 10) == 0:
            s = shape["length"] * k / (count - 1)
            points.add_row(f"{s:.4f}", *(f"{x:.5f}" for x in place))
    return Group(table, points, *(Text(note) for note in notes))


def _side(shape: dict[str, Any]) -> str | None:
    """What tells the side on which a predicted cable hangs."""
    return BranchShape(0.0, shape["branch"], shape.get("turns")).chosen_by


def prediction_rows(shape: dict[str, Any]) -> list[tuple[str, str]]:
    """Quantities of a predicted pose, as from `PredictedShape.as_dict`, and their values."""
    rows = []
    for side in ("start", "end"):
        at = shape[side]
        if at is None:
            rows.append((side, "free"))
            continue
        rows.append((side, vector(at, "g", "m")))
        reached = shape["points"][0 if side == "start" else -1]
        if math.dist(at, reached) > _SHOWN:
            place = vector(reached, ".5f", "m")
            rows.append((f"{side} of the cable", f"{place}: fixture errors of the fit included"))
        force, moment = shape[f"force_on_{side}"], shape[f"moment_on_{side}"]
        rows.append((f"force of the cable on its {side}", vector(force, ".4g", "N")))
        if any(shape.get(f"{side}_{key}") is not None for key in ("heading", "orientation")):
            said = (
                f"{moment:.4g} N m" if isinstance(moment, float) else vector(moment, ".4g", "N m")
            )
            rows.append((f"moment of the cable on its {side}", said))
    rows.append(("energy", f"{shape['energy']:.6g} J"))
    rows.append(("smallest bend radius", millimetres(shape["min_bend_radius"])))
    stable = "yes" if shape["stable"] else "NO: the cable would not stay there"
    rows.append(("stable", stable))
    other = shape["other_side"]
    if other is not None:
        rows.append(("this side", f"`{_side(shape)}`"))
        near = f"{other['tipping']:.2g} rad (known to {other['tipping_std']:.2g} rad)"
        text = (
            f"`{_side(other)}`: {other['energy']:.6g} J, up to "
            f"{millimetres(other['greatest_distance'])} away; equally low with the clamp turned by "
            f"{near}"
        )
        rows.append(("also stable", text))
    return rows
