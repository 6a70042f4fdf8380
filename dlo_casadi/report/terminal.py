"""Tables for the terminal: findings, their accuracy, what remains unknown, and run time."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from dlo_casadi.cable.fitted_cable import Shape
from dlo_casadi.cable.limits import LimitCheck
from dlo_casadi.config import Config
from dlo_casadi.errors import counted
from dlo_casadi.report import tables, words
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.show.text import millimetres

# Columns of a check's table: key of a pose's row, and how its value is written.
_CHECKED: dict[str, tuple[str, Callable[[Any], str]]] = {
    "length": ("length", "{:.3f} m".format),
    "of declared": ("length_over_declared", lambda share: f"{100 * share:.0f} %"),
    "off fixtures": ("largest_distance_from_fixture", lambda away: f"{1e3 * away:.1f} mm"),
    "seen": ("coverage", lambda share: f"{100 * share:.0f} %"),
    "confidence": ("confidence", lambda share: f"{100 * share:.0f} %"),
    "pixel": ("pixel", lambda size: f"{1e3 * size:.2f} mm"),
    "markers": ("markers", lambda numbers: " ".join(map(str, numbers))),
}
# Columns left out if no pose has a value for them.
_OPTIONAL = ("seen", "confidence", "pixel", "markers")


class _Verbatim(Table):
    """A table that prints text as it is: brackets in a name are no markup."""

    def add_row(self, *cells: RenderableType | None, **style: Any) -> None:
        super().add_row(*(Text(x) if isinstance(x, str) else x for x in cells), **style)


def plain_table(title: str, words: Sequence[str], numbers: Sequence[str] = ()) -> Table:
    """A table with columns of words, then of numbers."""
    table = _Verbatim(title=Text(title, "bold"), title_justify="left", box=box.SIMPLE_HEAD)
    for column in words:
        table.add_column(column)
    for column in numbers:
        table.add_column(column, justify="right")
    return table


# ---- a run -------------------------------------------------------------------------------------


def print_summary(console: Console, outcome: Outcome) -> None:
    """Print everything that a user should see at the end of a run."""
    warnings = [
        Text.assemble(("warning: ", "bold yellow"), text) for text in words.all_warnings(outcome)
    ]
    blank = [Text("")] if warnings else []
    console.print(
        Group(
            "",
            _heading(outcome),
            _parameter_table(outcome),
            *(Text("  " + line) for line in tables.footnotes(outcome)),
            "",
            _error_table(outcome),
            "",
            *(Text(line) for line in words.verdict_lines(outcome)),
            *([limits_table(outcome.config.cable.name, outcome.limits)] if outcome.limits else []),
            *blank,
            *warnings,
            "",
            _timing_table(outcome),
        )
    )


def _heading(outcome: Outcome) -> Text:
    m = outcome.measurement
    noise = f"noise std {millimetres(m.std)} ({m.std_source})"
    if not m.points:
        stds = ((m.force_std, "N"), (m.moment_std, "N m"))
        noise = ", ".join(f"{std:.2g} {unit}" for std, unit in stds if std is not None)
        noise = f"noise std of readings {noise}"
    if m.correlation_length > 0:
        noise += f", correlated over {millimetres(m.correlation_length)}"
    missing = len(m.held_out_missing)
    declared = f" of {m.poses_held_out + missing}" if missing else ""
    text = (
        f"{counted(m.poses_fit, 'fit pose')}, {m.poses_held_out}{declared} held out, "
        f"{words.counted_data(m)}; {noise}; {words.mesh_text(outcome)}"
    )
    return Text.assemble((outcome.config.cable.name, "bold"), ": ", text)


def _parameter_table(outcome: Outcome) -> Table:
    """Fitted parameters of the last stage with their units, and those that were kept fixed."""
    table = plain_table(f"Parameters ({words.label_of(outcome.stages[-1], outcome)})", [])
    for column in ("parameter", "value", "95 % interval", ""):
        table.add_column(column, no_wrap=bool(column))
    for row in (
        *tables.fitted_rows(outcome),
        *tables.rest_rows(outcome),
        *tables.nuisance_rows(outcome),
    ):
        table.add_row(*row)
    for row in tables.fixed_rows(outcome):
        table.add_row(*row, style="dim")
    return table


def _error_table(outcome: Outcome) -> Table:
    """Errors of the stages: fit, cross-validated, held out, chi-square, beside the noise."""
    columns = {"fit": "fit", "validated": "cross-validated", "held_out": "held out"}
    columns["chi2"] = "chi2/dof"
    if not words.cross_validated(outcome):
        del columns["validated"]
    title = "Distance of the measured points from the predicted shape, RMS"
    alone = not outcome.measurement.points
    if alone:
        title = "Difference of the readings from the predicted ones, RMS"
    table = plain_table(title, ["stage"], list(columns.values()))
    for row in tables.stage_rows(outcome, "-"):
        table.add_row(row["label"], *(row[column] for column in columns))
    if alone:
        return table
    if outcome.measurement.readings:
        last = outcome.stages[-1]
        both = {"fit": last.readings_fit, "held_out": last.readings_held_out}
        cells = {role: tables.newtons(errors) for role, errors in both.items()}
        table.add_row("  forces, moments", *(cells.get(column, "") for column in columns))
    table.add_section()
    floor = millimetres(outcome.measurement.noise_distance)
    table.add_row(f"{words.NOISE_ALONE} ({outcome.measurement.std_source})", floor)
    return table


def candidate_table(outcome: Outcome) -> Table:
    """Every effect that was tried, in the order of `CANDIDATE_ORDER`."""
    numbers = ("score", "p-value", "cross-validated error")
    table = plain_table(f"Effects that were tried: {words.CANDIDATE_ORDER}", ["effect"], numbers)
    table.caption, table.caption_justify = words.p_value_note(outcome), "left"
    table.add_column("finding")
    for row in outcome.candidates:
        error = millimetres(row.rmse_cross_validated)
        finding = words.finding_of(outcome, row)[1]
        table.add_row(row.name, f"{row.score:.1f}", f"{row.p_value:.2g}", error, finding)
    return table


def _timing_table(outcome: Outcome) -> Table:
    """Wall-clock time of the parts of the run."""
    table = plain_table("Time", ["part"], ["seconds"])
    table.add_column("")
    *parts, total = tables.timing_rows(outcome)
    for row in parts:
        table.add_row(*row)
    table.add_section()
    table.add_row(*total)
    return table


def work_table(outcome: Outcome) -> Table:
    """What took how long: parts of the run, steps of their fits, wall-clock time."""
    table = plain_table("Work", ["part"], ["times", "steps", "seconds"])
    for row in tables.work_rows(outcome):
        table.add_row(*row)
    return table


# ---- one predicted pose ------------------------------------------------------------------------


def prediction_table(shape: Shape, notes: Iterable[str] = ()) -> RenderableType:
    """Reactions, energy, stability and shape of one predicted pose."""
    table = plain_table(f"{shape.cable.name}: predicted shape", ["quantity", "value"])
    for row in shape.rows():
        table.add_row(*row)
    axes = "xyz"[: shape.points.shape[1]]
    points = plain_table(
        "Points from start to end", [], [f"{column} [m]" for column in ("s", *axes)]
    )
    for s, point in zip(shape.s[::10], shape.points[::10], strict=True):
        points.add_row(f"{s:.4f}", *(f"{x:.5f}" for x in point))
    return Group(table, points, *(Text(note) for note in notes))


def limits_table(name: str, checks: Sequence[LimitCheck]) -> Table:
    """One row for each limit of each pose, with the place that decides."""
    numbers = ("value", "limit", "violated")
    table = plain_table(f"{name}: limits", ["pose", "quantity"], numbers)
    for column in ("counted by", "tightest at", "verdict", "most of the variance"):
        table.add_column(column)
    colors = {"pass": "green", "risk": "yellow", "fail": "red"}
    for x in checks:
        verdict = Text(x.verdict, colors[x.verdict])
        value = x.text(x.value, x.std)
        table.add_row(
            x.pose, x.label, value, x.bound, x.chance, x.method, x.where, verdict, x.decided_by
        )
    return table


# ---- a check -----------------------------------------------------------------------------------


def check_table(config: Config, rows: Sequence[Mapping[str, Any]]) -> Table:
    """One line for each pose of `check_dict`; empty columns are left out."""
    shown = {
        name: (key, text)
        for name, (key, text) in _CHECKED.items()
        if name not in _OPTIONAL or any(row[key] is not None for row in rows)
    }
    title = f"{config.cable.name}: what was found, {config.cable.length:g} m declared"
    table = plain_table(title, ["pose", "role"], list(shown))
    for row in rows:
        cells = ["-" if row[key] is None else text(row[key]) for key, text in shown.values()]
        role = "held out" if row["role"] == "held_out" else "fit"
        style = "red" if row["problem"] else ""
        table.add_row(row["name"], role, *cells, style=style)
    return table
