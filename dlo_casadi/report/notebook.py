"""Results as a notebook shows them: a few lines, or a small table."""

from collections.abc import Iterable, Sequence
from html import escape

from dlo_casadi.equilibrium.fitted_cable import CableShape
from dlo_casadi.errors import counted
from dlo_casadi.report.tables import error_rows, fitted_rows, prediction_rows
from dlo_casadi.report.words import all_warnings, verdict_lines
from dlo_casadi.session.outcome import Outcome


def outcome_text(outcome: Outcome) -> str:
    """Cable, verdict, parameters and errors in a few lines."""
    lines = verdict_lines(outcome)
    lines[0] = f"{outcome.config.cable.name}: {lines[0]}"
    for row in (*fitted_rows(outcome), *error_rows(outcome)):
        lines.append("  " + "  ".join(filter(None, row)))
    warnings = len(all_warnings(outcome))
    if warnings:
        lines.append(f"  {counted(warnings, 'warning')}: see .warnings")
    return "\n".join(lines)


def outcome_html(outcome: Outcome) -> str:
    """The same as a short table."""
    rows = [*fitted_rows(outcome), *error_rows(outcome)]
    remarks = [*verdict_lines(outcome), *all_warnings(outcome)]
    return _table(outcome.config.cable.name, rows, remarks)


def shape_text(shape: CableShape) -> str:
    """A predicted pose in a few lines."""
    lines = [f"  {name}: {value}" for name, value in prediction_rows(shape)]
    return "\n".join([f"{shape.cable.model.cable.name}: predicted shape", *lines])


def shape_html(shape: CableShape) -> str:
    """The same as a short table."""
    return _table(f"{shape.cable.model.cable.name}: predicted shape", prediction_rows(shape))


def _table(title: str, rows: Sequence[Sequence[str]], remarks: Iterable[str] = ()) -> str:
    """HTML table with everything escaped; the remarks below it."""
    columns = max(map(len, rows))
    full = [[*row, *[""] * (columns - len(row))] for row in rows]
    cells = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in full]
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    below = "".join(f"<div>{escape(remark.strip())}</div>" for remark in remarks)
    return f"<div><b>{escape(title)}</b><table>{body}</table>{below}</div>"
