"""Tables for the terminal: what was found, how well, what is not known, and how long it took."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from dlo_casadi.diagnosis.structure import LARGEST_SCORE
from dlo_casadi.report.canvas import label_of
from dlo_casadi.report.geometry import directions
from dlo_casadi.report.json_report import all_warnings
from dlo_casadi.session.outcome import (
    MASS,
    BranchShape,
    Outcome,
    ParameterEstimate,
    ReadingErrors,
    Stage,
    StageName,
)
from dlo_casadi.thresholds import APART, EITHER, NOTABLE

# Parts of the run in the order in which they are done.
TIMED = {
    "vision": "photographs to centre-lines",
    "algorithm1": "Algorithm 1",
    "batch": "batch estimate",
    "diagnosis": "diagnosis",
}
# Parts that take less [s] were left out.
_NO_TIME = 1e-3


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
    noise = f"noise {_mm(m.std)} ({m.std_source})"
    if m.correlation_length > 0:
        noise += f", correlated over {_mm(m.correlation_length)}"
    declared = m.poses_held_out + len(m.held_out_missing)
    held_out = f"{m.poses_held_out} held out"
    if m.held_out_missing:
        held_out = f"{m.poses_held_out} of {declared} held out"
    text = (
        f"{m.poses_fit} fit poses, {held_out}, {m.points} points; {noise}; "
        f"{outcome.discretization.n} {outcome.discretization.element}s, "
        f"mesh error {_mm(outcome.discretization.error)}"
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


def describe(estimate: ParameterEstimate) -> tuple[str, str, str]:
    """Value, interval and remark: no number where the data do not tell one."""
    unit = f" {estimate.unit}" if estimate.unit else ""
    if estimate.identifiable is False:
        return (unidentified(estimate), "", "not identifiable from these shapes")
    value = plus_minus(estimate.value, estimate.std)
    interval = ""
    if estimate.interval_95 is not None:
        low, high = estimate.interval_95
        interval = f"{_bound(low)} to {_bound(high)}{unit}"
    return (value + unit, interval, "at a bound" if estimate.at_bound else "")


def unidentified(estimate: ParameterEstimate) -> str:
    """What can be said of a parameter that the shapes do not determine."""
    low, high = estimate.interval_95 or (None, None)
    unit = f" {estimate.unit}" if estimate.unit else ""
    if low is not None and high is not None:
        return f"{low:.2g} to {high:.2g}{unit}"
    if low is not None:
        return f">= {low:.2g}{unit}"
    if high is not None:
        return f"<= {high:.2g}{unit}"
    return "unknown"


def nuisance_rows(outcome: Outcome) -> list[tuple[str, str, str, str]]:
    """What is known within a tolerance and was adjusted there."""
    fit = outcome.fit
    reported = set(outcome.stages[-1].parameters)
    hidden = tuple(f"{effect.label}." for effect in fit.model.effects if not effect.shown)
    rows = []
    for q in fit.model.parameters:
        tolerance = fit.model.priors.get(q.name)
        if tolerance is None or q.name in reported or q.name.startswith(hidden):
            continue
        shift, unit = fit.value(q.name) - q.nominal, f" {q.unit}" if q.unit else ""
        rows.append(
            (
                q.name,
                plus_minus(fit.value(q.name), fit.std(q.name)) + unit,
                "",
                f"{round(shift / tolerance, 1) + 0.0:+.1f} of its tolerance {tolerance:g}{unit}",
            )
        )
    return rows


def fixed_rows(outcome: Outcome) -> list[tuple[str, str, str, str]]:
    """What was declared and kept."""
    cable, gravity = outcome.config.cable, outcome.config.experiment.gravity
    fitted = outcome.stages[-1].parameters
    rows = [
        ("length", f"{cable.length:g} m", "", "fixed"),
        *([("mass", f"{cable.mass:g} kg", "", "fixed")] if MASS not in fitted else []),
        ("gravity", vector(gravity, "g", "m/s^2"), "", "fixed"),
    ]
    unknowns = outcome.fit.problem.unknowns
    for q, free in zip(outcome.fit.model.parameters, unknowns.free, strict=True):
        if not free:
            unit = f" {q.unit}" if q.unit else ""
            rows.append((q.name, f"{outcome.fit.value(q.name):.4g}{unit}", "", "fixed"))
    return rows


def footnotes(outcome: Outcome) -> list[str]:
    """What the table of parameters needs to be read rightly."""
    lines = []
    stiffness = outcome.stages[-1].parameters.get("bending_stiffness")
    twisting = outcome.stages[-1].parameters.get("torsional_stiffness")
    if stiffness is not None and stiffness.identifiable is False:
        bound = unidentified(stiffness)
        known = f"EI {bound}" if bound[0] in "<>" else f"EI: {bound}"
        lines.append(f"{known}, not identifiable from these shapes.")
        lines.append(
            "Try: poses in which weight and stiffness compete more (ends close together), or "
            "hang a known weight on the cable and declare it under model.effects."
        )
    elif stiffness is not None and not outcome.measurement.readings:
        known = "EI is" if twisting is None else "EI and GJ are"
        weight = outcome.fit.mass * math.hypot(*outcome.config.experiment.gravity)
        ratio = f" EI over weight is {stiffness.value / weight:.4g} m^2." if weight else ""
        lines.append(
            f"Shapes give the ratio of stiffness to weight: {known} as good as the declared mass."
            f"{ratio}"
        )
        lines += absolute_lines(outcome)
    mass = outcome.stages[-1].parameters.get(MASS)
    if mass is not None and mass.identifiable is False:
        lines.append(
            "The readings do not tell mass from EI: only their ratio is known. Try: end_force or "
            "start_force of more poses, or a smaller force_std and force_bias."
        )
    if twisting is not None and twisting.identifiable is False:
        lines.append(
            "GJ is not identifiable from these shapes. Try: poses that twist the cable, with the "
            "end clamp rolled by up to half a turn."
        )
    return lines


def absolute_lines(outcome: Outcome) -> list[str]:
    """In which pose a reading of a force tells mass and stiffnesses best: all grow alike."""
    ends = ("start", "end") if outcome.config.experiment.boundary.end != "free" else ("start",)
    forces = {
        (name, side): float(np.linalg.norm(force))
        for name, shape in outcome.stages[-1].shapes.items()
        for side, force in zip(ends, shape.forces, strict=False)
    }
    if not forces or not any(outcome.config.experiment.gravity):
        return []
    (pose, side), force = max(forces.items(), key=lambda item: item[1])
    return [
        f"One reading of {side}_force as in {pose}, {force:.3g} N, would tell it: to 1 % if noise "
        f"and offset of the sensor are below {force / 100:.2g} N."
    ]


def rest_rows(outcome: Outcome) -> list[tuple[str, str, str, str]]:
    """The rest curvature of the last stage in a line."""
    if outcome.config.cable.rest_shape == "straight":
        return [("rest curvature", "0 1/m", "", "fixed: declared straight")]
    rest = outcome.stages[-1].rest_curvature
    if not rest.value.size:
        return []
    names = [f"rest curvature{name and f' k_{name}'}" for name in directions(outcome)]
    return [
        (
            name,
            f"{value.min():.3g} to {value.max():.3g} 1/m",
            "",
            f"std {std.mean():.2g} 1/m on average",
        )
        for name, value, std in zip(
            names, np.atleast_2d(rest.value), np.atleast_2d(rest.std), strict=True
        )
    ]


# ---- errors ------------------------------------------------------------------------------------


def error_table(outcome: Outcome) -> Table:
    """Errors of the stages: fit, cross-validated, held out, chi-square, beside the noise."""
    table = _table("Distance of the measured points from the predicted shape, RMS")
    table.add_column("stage")
    validated = cross_validated(outcome)
    columns = ["fit", "cross-validated", "held out", "chi2/dof"]
    if not validated:
        columns.remove("cross-validated")
    for column in columns:
        table.add_column(column, justify="right")
    for stage in outcome.stages:
        cells = {
            "fit": _mm(stage.rmse_fit),
            "cross-validated": _mm(validated.get(stage.name)),
            "held out": _mm(stage.rmse_held_out) + predicted_share(outcome, stage),
            "chi2/dof": "-" if stage.chi2_per_dof is None else f"{stage.chi2_per_dof:.3g}",
        }
        table.add_row(label_of(stage, outcome), *(cells[column] for column in columns))
        if stage.other_branch:
            cells = {
                "fit": _mm(stage.rmse_fit_measured_branch),
                "held out": _mm(stage.rmse_held_out_measured_branch),
            }
            table.add_row(f"  {ON_BRANCH}", *(cells.get(column, "") for column in columns))
    last = outcome.stages[-1]
    if outcome.measurement.readings:
        cells = {
            "fit": _newtons(last.readings_fit),
            "held out": _newtons(last.readings_held_out),
        }
        table.add_row("  forces, moments", *(cells.get(column, "") for column in columns))
    table.add_section()
    floor = [_mm(outcome.measurement.std)] + [""] * (len(columns) - 1)
    table.add_row(f"noise ({outcome.measurement.std_source})", *floor)
    return table


def _newtons(errors: ReadingErrors) -> str:
    """Errors of forces and moments, as far as there are any."""
    found = ((errors.force, "N"), (errors.moment, "N m"))
    return ", ".join(f"{value:.2g} {unit}" for value, unit in found if value is not None) or "-"


# The errors of a stage, of which some poses were measured in another equilibrium.
ON_BRANCH = "on the measured branch"


def predicted_share(outcome: Outcome, stage: Stage) -> str:
    """How many of the held-out poses a stage has predicted, where it is not all of them."""
    held_out = outcome.held_out(stage)
    if not held_out.missing or not stage.shapes:
        return ""
    return f" ({held_out.predicted} of {held_out.declared})"


def branch_text(found: BranchShape) -> str:
    """Error of a pose in the equilibrium in which it was measured, and how to choose that one."""
    return f"{ON_BRANCH} {_mm(found.rmse)} ({found.chosen_by or 'no branch chooses it'})"


def cross_validated(outcome: Outcome) -> dict[StageName, float | None]:
    """Cross-validated errors [m] of the stages for which the diagnosis has computed them."""
    if not outcome.effects:
        searched = outcome.diagnosis
        known = searched is not None and searched.validation_after.complete
        return {"batch": searched.validation_after.rmse} if known else {}
    return {
        "batch": outcome.effects[0]["rmse_cross_validated_before"],
        "closed": outcome.effects[-1]["rmse_cross_validated_after"],
    }


# ---- verdict -----------------------------------------------------------------------------------


def verdict_lines(outcome: Outcome) -> list[str]:
    """What the diagnosis has led to, in sentences."""
    if outcome.doubts:
        head, *others = (f"{text[:1].upper()}{text[1:]}." for text in outcome.doubts)
        word = "the fit has failed" if outcome.fit.failed else "unexplained"
        lines = [f"Verdict: {word}. {head}", *(f"  {text}" for text in others)]
    elif outcome.verdict is not None:
        lines = [_verdict(outcome)]
    else:
        lines = ["Diagnosis: switched off; nothing was looked for in the residual."]
    lines += structure_lines(outcome)
    for effect in outcome.effects:
        lines += _effect_lines(effect)
    load = outcome.unexplained
    if load is not None:
        force, (low, high) = load["force"], load["interval_95"]
        lines.append(
            f"  Without naming a cause: pulled by {vector(force, '.3g', 'N')} on average "
            f"at {load['position']:.3f} m ({low:.3f} to {high:.3f} m) from the start."
        )
        experiment = outcome.config.experiment
        if experiment.boundary.end == "free" and np.dot(force, experiment.gravity) < 0:
            lines.append(
                "  Nothing lifts a cable with a free tip: a weight elsewhere (lumped_mass) or "
                "another stiffness may stand behind it."
            )
    if outcome.next_pose is not None:
        lines.append(
            f"  To tell {' from '.join(outcome.next_pose['separates'])}: hold the end at "
            f"{vector(outcome.next_pose['end'], '.3f', 'm')}; {separation_text(outcome.next_pose)}"
        )
        lines.append(f"  {reading_text(outcome.next_pose['reading'])}")
    return lines


# Distances [m] that the table of a prediction shows.
_SHOWN = 5e-6
# Nobody measures a pose more often.
MOST_REPEATS = 20


def separation_text(proposal: dict[str, Any]) -> str:
    """How far rivals differ in a proposed pose, and how often it has to be measured."""
    z = proposal["expected_difference_std"]
    text = (
        f"they differ there by {_mm(proposal['expected_difference_m'])} RMS, {z:.2g} standard "
        "deviations of the noise of one whole line: "
    )
    repeats = math.ceil(min((APART / max(z, 1e-9)) ** 2, 1e9))
    if repeats <= 1:
        return text + "one measurement suffices."
    if repeats <= MOST_REPEATS:
        return text + f"measure it {repeats} times."
    return text + f"even {MOST_REPEATS} measurements would not tell them apart."


def reading_text(proposal: dict[str, Any]) -> str:
    """What a reading of force or moment in the proposed pose would tell of rivals."""
    unit = "N m" if proposal["name"].endswith("moment") else "N"
    text = (
        f"A reading of {proposal['name']} there differs by {proposal['difference']:.2g} {unit}, "
        f"{proposal['separation']:.2g} standard deviations of one: "
    )
    if proposal["times"] is None or proposal["times"] > MOST_REPEATS:
        return text + "it would not tell them apart."
    times = proposal["times"]
    return text + ("one suffices." if times == 1 else f"read it {times} times.")


# What the residual may depend on, by the key of its normal score.
DEPENDENCES = {
    "runs_z": "runs along the cable",
    "order_z": "the order of the poses",
    "span_z": "the distance of the ends",
    "position_z": "the place in the {plane}",
}


def structure_lines(outcome: Outcome) -> list[str]:
    """What the declared model's residual depends on, where it is not noise."""
    if outcome.structure is None or outcome.verdict == "complete":
        return []
    before = outcome.structure["before"]
    plane = "picture" if outcome.measurement.kind == "images" else "plane"
    found = [
        f"{text.format(plane=plane)} ({_score(key, before[key])})"
        for key, text in DEPENDENCES.items()
        if abs(before[key]) > NOTABLE
    ]
    if not found:
        return []
    return [f"  The declared model's residual depends on {', '.join(found)}."]


def _score(key: str, value: float) -> str:
    """A normal score; where its test ends, only that it lies beyond."""
    if key != "runs_z" and abs(value) >= 0.999 * LARGEST_SCORE:
        return "z > 7" if value > 0 else "z < -7"
    return f"z = {value:+.1f}"


def _verdict(outcome: Outcome) -> str:
    names = " and ".join(effect["name"] for effect in outcome.effects)
    if outcome.verdict == "unexplained":
        after = outcome.structure["after"] if outcome.structure else None
        if names and after and after["p_value"] >= outcome.config.diagnosis.significance:
            error = outcome.effects[-1]["rmse_cross_validated_after"]
            return (
                f"Verdict: unexplained. With {names} every pose is fitted, but one that is left "
                f"out is predicted {_mm(error)} off (noise {_mm(outcome.measurement.std)})."
            )
        found = f" even with {names}" if names else ""
        return f"Verdict: unexplained. The residual is not noise{found}."
    if outcome.effects:
        return f"Verdict: the declared model lacked {names}; with it the residual is noise."
    return "Verdict: complete. The declared model explains the shapes down to their noise."


def _effect_lines(effect: dict[str, Any]) -> list[str]:
    values = ", ".join(_quantity(name, row) for name, row in effect["parameters"].items())
    line = f"  {effect['name']}: {values}"
    if effect["p_value"] is not None:
        # Below the smallest double it is zero.
        p_value = effect["p_value"]
        line += f" (p = {p_value:.1g})" if p_value > 0 else " (p < 1e-307)"
    lines = [line]
    rivals = effect["indistinguishable_from"]
    if rivals:
        lines.append(f"    These data cannot tell it from {' or '.join(rivals)}.")
    return lines


def _quantity(name: str, row: dict[str, Any]) -> str:
    if row["value"] is None:
        return f"{name} unbounded"
    return f"{name} {plus_minus(row['value'], row['std'] or 0.0)} {row['unit']}".strip()


# How candidates are ordered; the score alone does not tell how well a refit does.
CANDIDATE_ORDER = "first those that a refit confirms, by BIC, then other refits, the rest by score"


def p_value_note(outcome: Outcome) -> str:
    """What the p-values of candidates and of added effects are."""
    note = "p-value: score test in the declared model, corrected for the number of effects tried."
    if outcome.effects and outcome.measurement.std_source == "estimated":
        note += (
            " The p of an added effect is the larger of that before it was added and that under "
            "the noise left once it is in the model."
        )
    return note


def candidate_table(outcome: Outcome) -> Table:
    """Every effect that was tried, in the order of `CANDIDATE_ORDER`."""
    table = _table(f"Effects that were tried: {CANDIDATE_ORDER}")
    table.caption, table.caption_justify = p_value_note(outcome), "left"
    table.add_column("effect")
    for column in ("score", "p-value", "cross-validated error"):
        table.add_column(column, justify="right")
    table.add_column("")
    added = {effect["name"] for effect in outcome.effects}
    rivals = {name for effect in outcome.effects for name in effect["indistinguishable_from"]}
    for row in outcome.candidates:
        name, p = row["name"], row["p_value"]
        remark = "added" if name in added else "cannot be told apart from it" * (name in rivals)
        table.add_row(
            name,
            f"{row['score']:.1f}",
            "-" if p is None else f"{p:.2g}",
            _mm(row["rmse_cross_validated"]),
            remark,
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


def timing_rows(outcome: Outcome) -> list[tuple[str, str, str]]:
    """Part of the run, seconds and remark; the total comes last."""
    timing = outcome.timing
    photographs = sum((pose.image is not None) + len(pose.views) for pose in outcome.poses)
    rest = timing["total"] - sum(timing.get(name, 0.0) for name in TIMED)
    rows = []
    for name, label in TIMED.items():
        if timing.get(name, 0.0) < _NO_TIME:  # in space IPOPT, and the paper's loop, do not run
            continue
        remark = ""
        if name == "vision" and photographs:
            remark = f"{timing[name] / photographs:.2f} s a photograph ({photographs})"
        elif name == "vision":
            label = "centre-lines"
        rows.append((label, f"{timing[name]:.2f}", remark))
    rows.append(("other fits and predictions", f"{max(rest, 0.0):.2f}", ""))
    rows.append(("total", f"{timing['total']:.2f}", ""))
    return rows


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
    rows.append(("smallest bend radius", _mm(shape["min_bend_radius"])))
    stable = "yes" if shape["stable"] else "NO: the cable would not stay there"
    rows.append(("stable", stable))
    if shape["tipping"] is not None and shape["tipping"] < EITHER:
        turned = f"equally low with the clamp turned by {shape['tipping']:.2g} rad"
        rows.append(("also stable", f"falling to the other side, {turned}"))
    return rows


def vector(components: Iterable[float], form: str, unit: str) -> str:
    """Components of a vector in brackets, and their unit."""
    return f"({', '.join(format(x, form) for x in components)}) {unit}"


def plus_minus(value: float, std: float) -> str:
    """A value with the digits that its standard deviation leaves: two of the latter."""
    if not std > 0:
        return f"{value:.4g}"
    decimals = 1 - math.floor(math.log10(std))
    if std >= 10 * abs(value) or not 0 <= decimals <= 7:
        return f"{value:.2g} ± {std:.2g}"
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"


def _bound(value: float | None) -> str:
    return "unbounded" if value is None else f"{value:.4g}"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.3g} mm"
