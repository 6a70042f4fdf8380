"""Tables for the terminal: candidates, work, a predicted pose, limits, a check."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dlo_casadi.cable.fitted_cable import Shape
from dlo_casadi.cable.limits import LimitCheck
from dlo_casadi.config import Config
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
