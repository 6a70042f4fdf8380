"""The report as a list of sections: page, terminal and report.json are renderings of it.

A section says where it applies, what its template on the page is filled with, its keys in
report.json, and its lines on the terminal. Its template is `templates/section_NAME.html`.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from dlo_casadi.errors import counted
from dlo_casadi.io.files import finite
from dlo_casadi.report import documents, findings, motions, tables, words
from dlo_casadi.report.canvas import inline_svg
from dlo_casadi.report.documents import fields_of
from dlo_casadi.report.figures import figures_of
from dlo_casadi.report.page_pictures import pictures, scene_pictures, view_pictures
from dlo_casadi.report.page_tables import NOTHING, candidate_rows, parameter_rows, tiles
from dlo_casadi.report.terminal import limits_table, plain_table
from dlo_casadi.rod.quantities import QUANTITIES
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.show.text import millimetres


@dataclass(frozen=True)
class Report:
    """A run, and what its page shows; `drawn`: its `figures_of`, if they have been drawn."""

    outcome: Outcome
    drawn: Mapping[str, Figure] | None = None

    @cached_property
    def shared(self) -> dict[str, Any]:
        """Data for the templates of all sections."""
        outcome, shown = self.outcome, pictures(self.outcome)
        labels = {item.kind: item.label for item in words.compared(outcome)}
        charts = figures_of(outcome) if self.drawn is None else self.drawn
        return {
            "outcome": outcome,
            "m": outcome.measurement,
            "noise": millimetres(outcome.measurement.std),
            "shown": outcome.measurement.points > 0,
            "before": labels.get("before"),
            "after": labels.get("after"),
            "pictures": shown,
            "photographs": view_pictures(outcome.poses, words.compared(outcome)),
            "room": shown[0].behind.room,
            "clips": bool(outcome.config.experiment.clips),
            "obstacles": any(mark.kind == "obstacle" for item in shown for mark in item.under),
            "forces_read": any(mark.kind == "force-read" for item in shown for mark in item.over),
            "scenes": scene_pictures(outcome),
            "charts": {name: Markup(inline_svg(chart, name)) for name, chart in charts.items()},
        }


def _always(outcome: Outcome) -> bool:
    return True


def _nothing(outcome: Outcome) -> Any:
    return {}


@dataclass(frozen=True)
class Section:
    """One part of a report.

    Parameters
    ----------
    name : str
        Its anchor on the page.
    title : callable
        Outcome -> its name in the page's contents; empty above the contents.
    applies : callable
        Outcome -> whether page and terminal have it; report.json always has all keys.
    context : callable
        Outcome -> data for its template, beside `Report.shared`.
    data : callable
        Outcome -> its keys and values in report.json.
    terminal : callable
        Outcome -> its lines and tables on the terminal.
    """

    name: str
    title: Callable[[Outcome], str] = lambda outcome: ""
    applies: Callable[[Outcome], object] = _always
    context: Callable[[Outcome], dict[str, Any]] = _nothing
    data: Callable[[Outcome], dict[str, Any]] = _nothing
    terminal: Callable[[Outcome], Iterable[RenderableType]] = _nothing

    @property
    def template(self) -> str:
        """Name of its template."""
        return f"section_{self.name}.html"


# ---- verdict and warnings ----------------------------------------------------------------------


def _verdict(outcome: Outcome) -> dict[str, Any]:
    found = findings.conclusion_of(outcome)
    return {
        "verdict": outcome.verdict or "off",
        "verdict_word": words.sentence(found.word),
        "sentence": found.sentence,
        "details": findings.details(outcome),
        "tiles": tiles(outcome),
    }


def _verdict_data(outcome: Outcome) -> dict[str, Any]:
    repeats = outcome.repeatability
    return {
        "verdict": outcome.verdict,
        "effects": [
            asdict(effect)
            | {
                "parameters": {
                    name: fields_of(found, "value", "std", "unit")
                    for name, found in effect.parameters.items()
                }
            }
            for effect in outcome.effects
        ],
        "structure": outcome.structure
        and dict(zip(("before", "after"), map(asdict, outcome.structure), strict=True)),
        "either_side": {name: asdict(found) for name, found in outcome.either_side.items()},
        "repeatability": {
            "rest_curvature_std": outcome.fit.problem.priors.pose_scatter.rest_std,
            "from_pose_to_pose": documents.scatter_dict(outcome.fit),
            "expected_spread_m": repeats.expected_spread,
            "source": repeats.source,
            "held_out_inside_90": outcome.inside_band,
        },
        "if_hidden": {
            name: documents.hidden_dict(found) for name, found in outcome.if_hidden.items()
        },
    }


def _warning_lines(outcome: Outcome) -> list[RenderableType]:
    return [
        Text.assemble(("warning: ", "bold yellow"), text) for text in words.all_warnings(outcome)
    ]


# ---- errors ------------------------------------------------------------------------------------


def _measured(outcome: Outcome) -> dict[str, Any]:
    m = outcome.measurement
    return {
        "measurement": {
            **fields_of(m, "kind", "poses_fit", "poses_held_out", "held_out_missing", "points"),
            **fields_of(m, "std", "std_source"),
            "correlation_length_m": m.correlation_length,
            **fields_of(m, "readings", *(quantity.std_key for quantity in QUANTITIES)),
        },
        "stages": [documents.stage_dict(stage, outcome) for stage in outcome.stages],
    }


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


# ---- what may be missing ------------------------------------------------------------------------


def _pull(outcome: Outcome) -> dict[str, Any] | None:
    if (load := outcome.unexplained) is None:
        return None
    return {
        **fields_of(load, "force", "force_per_pose", "poses", "position"),
        "interval_95": load.interval,
    }


def _next_pose(outcome: Outcome) -> dict[str, Any] | None:
    if (proposal := outcome.next_pose) is None:
        return None
    return {
        **fields_of(proposal, "end", "separates"),
        "expected_difference_m": proposal.difference,
        "expected_difference_std": proposal.separation,
        "reading": asdict(proposal.reading),
    }


# ---- parameters --------------------------------------------------------------------------------


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


def _parameter_lines(outcome: Outcome) -> list[RenderableType]:
    notes = (Text(f"  {line}") for line in tables.footnotes(outcome))
    return [_parameter_table(outcome), *notes]


# ---- the run -----------------------------------------------------------------------------------


def _heading(outcome: Outcome) -> Text:
    m = outcome.measurement
    noise = f"noise std {millimetres(m.std)} ({m.std_source})"
    if not m.points:
        noise = f"noise std of readings {m.reading_noise}"
    if m.correlation_length > 0:
        noise += f", correlated over {millimetres(m.correlation_length)}"
    missing = len(m.held_out_missing)
    declared = f" of {m.poses_held_out + missing}" if missing else ""
    text = (
        f"{counted(m.poses_fit, 'fit pose')}, {m.poses_held_out}{declared} held out, "
        f"{words.counted_data(m)}; {noise}; {words.mesh_text(outcome)}"
    )
    return Text.assemble((outcome.config.cable.name, "bold"), ": ", text)


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


def _run(outcome: Outcome) -> dict[str, Any]:
    config = outcome.config
    return {
        "config": config.name,
        "config_path": None if config.path is None else str(config.path),
        "versions": outcome.versions,
        "timing_s": {**outcome.timing, "parts": documents.work_list(outcome.work)},
        "discretization": {
            **fields_of(outcome.fit.model, "n", "element"),
            "error_m": outcome.mesh_error,
        },
    }


# ---- the list ----------------------------------------------------------------------------------

SECTIONS = (
    Section(
        "verdict",
        context=_verdict,
        data=_verdict_data,
        terminal=lambda outcome: map(Text, findings.verdict_lines(outcome)),
    ),
    Section(
        "warnings",
        applies=words.all_warnings,
        context=lambda outcome: {"warnings": words.all_warnings(outcome)},
        data=lambda outcome: {"warnings": [*outcome.doubts, *words.all_warnings(outcome)]},
        terminal=_warning_lines,
    ),
    Section(
        "errors",
        lambda outcome: "Errors",
        context=lambda outcome: {"rows": tables.stage_rows(outcome, NOTHING)},
        data=_measured,
        terminal=lambda outcome: [_error_table(outcome)],
    ),
    Section(
        "poses",
        lambda outcome: "Photographs" if words.photographs_alone(outcome) else "Poses",
    ),
    Section(
        "residuals",
        lambda outcome: "Residuals",
        applies=lambda outcome: words.compared(outcome) and outcome.measurement.points,
    ),
    Section(
        "candidates",
        lambda outcome: "What may be missing",
        applies=lambda outcome: outcome.candidates,
        context=lambda outcome: {"candidates": candidate_rows(outcome)},
        data=lambda outcome: {
            "candidates": [
                asdict(row) | {"reason": row.reason or None} for row in outcome.candidates
            ]
        },
    ),
    Section(
        "pull",
        lambda outcome: "Where it is pulled",
        applies=lambda outcome: outcome.unexplained,
        context=lambda outcome: {"unexplained": outcome.unexplained},
        data=lambda outcome: {"unexplained": _pull(outcome)},
    ),
    Section(
        "next",
        lambda outcome: "Next pose",
        applies=lambda outcome: outcome.next_pose,
        context=lambda outcome: {"next_pose": outcome.next_pose},
        data=lambda outcome: {
            "next_pose": _next_pose(outcome),
            "next_motion": documents.motion_proposal(outcome.next_motion),
        },
    ),
    Section(
        "limits",
        lambda outcome: "Limits",
        applies=lambda outcome: outcome.limits,
        data=lambda outcome: {"limits": [check.as_dict() for check in outcome.limits]},
        terminal=lambda outcome: [limits_table(outcome.config.cable.name, outcome.limits)],
    ),
    Section(
        "motion",
        lambda outcome: "In motion",
        applies=motions.stages_of,
        context=motions.context_of,
        data=lambda outcome: {
            "motion_scores": dict(outcome.motion_scores),
            "modes": outcome.modes.as_rows() if outcome.modes else [],
        },
        terminal=lambda outcome: [
            motions.motion_table(outcome),
            *([motions.mode_table(outcome)] if outcome.modes else []),
        ],
    ),
    Section(
        "parameters",
        lambda outcome: "Parameters",
        context=lambda outcome: {
            "parameters": parameter_rows(outcome),
            "nuisances": tables.nuisance_rows(outcome),
            "fixed": tables.fixed_rows(outcome),
        },
        terminal=_parameter_lines,
    ),
    Section(
        "run",
        lambda outcome: "Run",
        context=lambda outcome: {"timing": tables.timing_rows(outcome)},
        data=_run,
        terminal=lambda outcome: [_timing_table(outcome)],
    ),
)
# On the terminal the last lines are seen first: the verdict stands near them.
_ON_TERMINAL = ("parameters", "errors", "motion", "verdict", "limits", "warnings", "run")


def report_dict(outcome: Outcome) -> dict[str, Any]:
    """All results of a run that a program may need, as plain data.

    Every key of the schema is present; unknown values are None, never NaN.
    """
    document: dict[str, Any] = {"schema": "dlo-report/1"}
    for section in SECTIONS:
        document |= section.data(outcome)
    return finite(document)


def report_text(outcome: Outcome) -> str:
    """The text of report.json."""
    return json.dumps(report_dict(outcome), indent=1, allow_nan=False) + "\n"


def print_summary(console: Console, outcome: Outcome) -> None:
    """Print everything that a user should see at the end of a run."""
    known = {section.name: section for section in SECTIONS if section.applies(outcome)}
    parts = [tuple(known[name].terminal(outcome)) for name in _ON_TERMINAL if name in known]
    spaced = [item for part in parts for item in ("", *part)]
    console.print(Group("", _heading(outcome), *spaced[1:]))
