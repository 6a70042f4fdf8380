"""Rows of the tables of a report: parameters, errors, time, one predicted pose; notebooks."""

import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from dlo_casadi.equilibrium.fitted_cable import CableShape
from dlo_casadi.errors import counted
from dlo_casadi.report import words
from dlo_casadi.session.outcome import MASS, Outcome, ParameterEstimate
from dlo_casadi.session.pose_shape import BranchShape

# Distances [m] that the table of a prediction shows.
_SHOWN = 5e-6
# A row of the tables of parameters: name, value, 95 % interval, remark.
Row = tuple[str, str, str, str]


def describe(estimate: ParameterEstimate) -> tuple[str, str, str]:
    """Value, interval and remark: no number where the data do not tell one."""
    if estimate.identifiable is False:
        return (unidentified(estimate), "", "not identifiable from these shapes")
    unit, interval = _after(estimate.unit), ""
    if estimate.interval_95 is not None:
        ends = ("unbounded" if x is None else f"{x:.4g}" for x in estimate.interval_95)
        interval = f"{' to '.join(ends)}{unit}"
    value = words.plus_minus(estimate.value, estimate.std) + unit
    return (value, interval, "at a bound" if estimate.at_bound else "")


def unidentified(estimate: ParameterEstimate) -> str:
    """What can be said of a parameter that the shapes do not determine."""
    low, high = estimate.interval_95 or (None, None)
    unit = _after(estimate.unit)
    if low is not None and high is not None:
        return f"{low:.2g} to {high:.2g}{unit}"
    if low is not None:
        return f">= {low:.2g}{unit}"
    return "unknown" if high is None else f"<= {high:.2g}{unit}"


def fitted_rows(outcome: Outcome) -> list[Row]:
    """Parameters of the last stage."""
    return [(name, *describe(found)) for name, found in outcome.stages[-1].parameters.items()]


def rest_rows(outcome: Outcome) -> list[Row]:
    """The rest curvature of the last stage in a line, in space about each material axis."""
    if outcome.config.cable.rest_shape == "straight":
        return [("rest curvature", "0 1/m", "", "fixed: declared straight")]
    rest = outcome.stages[-1].rest_curvature
    if not rest.value.size:
        return []
    names = [f"rest curvature{name and f' k_{name}'}" for name in words.directions(outcome)]
    parts = zip(names, np.atleast_2d(rest.value), np.atleast_2d(rest.std), strict=True)
    return [
        (
            name,
            f"{value.min():.3g} to {value.max():.3g} 1/m",
            "",
            f"std {std.mean():.2g} 1/m on average",
        )
        for name, value, std in parts
    ]


def nuisance_rows(outcome: Outcome) -> list[Row]:
    """What is known within a tolerance and was adjusted there."""
    fit = outcome.fit
    reported = set(outcome.stages[-1].parameters)
    hidden = tuple(f"{effect.label}." for effect in fit.model.effects if not effect.shown)
    rows = []
    for q in fit.model.parameters:
        tolerance = fit.model.priors.get(q.name)
        if tolerance is None or q.name in reported or q.name.startswith(hidden):
            continue
        value, unit = fit.value(q.name), _after(q.unit)
        moved = round((value - q.nominal) / tolerance, 1) + 0.0
        remark = f"{moved:+.1f} of its tolerance {tolerance:g}{unit}"
        rows.append((q.name, words.plus_minus(value, fit.std(q.name)) + unit, "", remark))
    return rows


def fixed_rows(outcome: Outcome) -> list[Row]:
    """What was declared and kept."""
    cable, fit = outcome.config.cable, outcome.fit
    kept = {"length": f"{cable.length:g} m", MASS: f"{cable.mass:g} kg"}
    if MASS in outcome.stages[-1].parameters:
        del kept[MASS]
    kept["gravity"] = words.vector(outcome.config.experiment.gravity, "g", "m/s^2")
    for q, free in zip(fit.model.parameters, fit.problem.unknowns.free, strict=True):
        if not free:
            kept[q.name] = f"{fit.value(q.name):.4g}{_after(q.unit)}"
    return [(name, value, "", "fixed") for name, value in kept.items()]


def footnotes(outcome: Outcome) -> list[str]:
    """What the table of parameters needs to be read rightly."""
    lines, found = [], outcome.stages[-1].parameters
    stiffness, twisting = found.get("bending_stiffness"), found.get("torsional_stiffness")
    gravity = outcome.config.experiment.gravity
    if stiffness is not None and stiffness.identifiable is False:
        bound = unidentified(stiffness)
        known = f"EI {bound}" if bound[0] in "<>" else f"EI: {bound}"
        lines.append(f"{known}, not identifiable from these shapes.")
        hung = (
            "poses in which weight and stiffness compete more (ends close together), or hang a "
            "known weight on the cable and declare it under model.effects."
        )
        force = "end_force or start_force of a pose: without gravity shapes tell no stiffness."
        lines.append(f"Try: {hung if any(gravity) else force}")
    elif stiffness is not None and not outcome.measurement.readings:
        known = "EI is" if twisting is None else "EI and GJ are"
        weight = outcome.fit.mass * math.hypot(*gravity)
        ratio = f" EI over weight is {stiffness.value / weight:.4g} m^2." if weight else ""
        lines.append(
            f"Shapes give the ratio of stiffness to weight: {known} as good as the declared mass."
            f"{ratio}"
        )
        lines += _best_reading(outcome)
    if MASS in found and found[MASS].identifiable is False:
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


def _best_reading(outcome: Outcome) -> list[str]:
    """In which pose a reading of a force tells mass and stiffnesses best: all grow alike."""
    experiment = outcome.config.experiment
    ends = ("start", "end") if experiment.boundary.end != "free" else ("start",)
    forces = {
        (name, side): float(np.linalg.norm(force))
        for name, shape in outcome.stages[-1].shapes.items()
        for side, force in zip(ends, shape.forces, strict=False)
    }
    if not forces or not any(experiment.gravity):
        return []
    (pose, side), force = max(forces.items(), key=lambda item: item[1])
    return [
        f"One reading of {side}_force as in {pose}, {force:.3g} N, would tell it: to 1 % if noise "
        f"and offset of the sensor are below {force / 100:.2g} N."
    ]


def _after(unit: str) -> str:
    return f" {unit}" if unit else ""


def stage_rows(outcome: Outcome, nothing: str) -> list[dict[str, str]]:
    """Errors of the stages in words: fit, cross-validated, held out, chi-square.

    A stage of which poses were measured in another equilibrium has a second row.

    Parameters
    ----------
    nothing : str
        What stands where there is no number.
    """

    def row(label: str, note: str, fit: float | None, held_out: float | None) -> dict[str, str]:
        known = {"fit": fit, "held_out": held_out, "validated": None}
        cells = {key: words.millimetres(x, nothing) for key, x in known.items()}
        return {"label": label, "mark": "", "note": note, "chi2": nothing, **cells}

    marks = {stage.name: kind for kind, _, stage in words.compared(outcome)}
    validated = words.cross_validated(outcome)
    rows = []
    for stage in outcome.stages:
        own = row(words.label_of(stage, outcome), stage.note, stage.rmse_fit, stage.rmse_held_out)
        own["mark"] = marks.get(stage.name, "")
        own["held_out"] += words.predicted_share(outcome, stage)
        own["validated"] = words.millimetres(validated.get(stage.name), nothing)
        if stage.chi2_per_dof is not None:
            own["chi2"] = f"{stage.chi2_per_dof:.3g}"
        rows.append(own)
        if stage.other_branch:
            note = f"poses in another equilibrium: {', '.join(stage.other_branch)}"
            errors = stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch
            rows.append(row(words.ON_BRANCH, note, *errors))
    return rows


def error_rows(outcome: Outcome) -> list[tuple[str, str]]:
    """RMS distance of the measured points from the last stage's shapes, and by noise alone."""
    stage, m = outcome.stages[-1], outcome.measurement
    rows = [("error of the fit", words.millimetres(stage.rmse_fit))]
    if stage.rmse_held_out is not None:
        share = words.predicted_share(outcome, stage)
        rows.append(("held out", words.millimetres(stage.rmse_held_out) + share))
    if stage.other_branch:
        both = (stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch)
        known = (words.millimetres(value) for value in both if value is not None)
        rows.append((words.ON_BRANCH, ", ".join(known)))
    return [*rows, (f"{words.NOISE_ALONE} ({m.std_source})", words.millimetres(m.noise_distance))]


def timing_rows(outcome: Outcome) -> list[tuple[str, str, str]]:
    """Part of the run, seconds and remark; the total comes last."""
    timing = outcome.timing
    read, search, total = timing["vision"], timing["diagnosis"], timing["total"]
    photographs = sum((pose.image is not None) + len(pose.views) for pose in outcome.poses)
    rows = [("centre-lines", read, "")]
    if photographs:
        remark = f"{read / photographs:.2f} s a photograph ({photographs})"
        rows = [("photographs to centre-lines", read, remark)]
    # In space neither IPOPT nor the paper's loop runs.
    within = {"Algorithm 1": timing["algorithm1"], "IPOPT": timing["batch"]}
    parts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in within.items() if seconds)
    rows.append(("fits and predictions", max(total - read - search, 0.0), ""))
    if search:
        rows.append(("diagnosis", search, ""))
    remark = "without imports and writing" + (f"; of it or beside it {parts}" if parts else "")
    rows.append(("total", total, remark))
    return [(name, f"{seconds:.2f}", remark) for name, seconds, remark in rows]


# ---- one predicted pose ------------------------------------------------------------------------


def prediction_rows(shape: CableShape) -> list[tuple[str, str]]:
    """Quantities of a predicted pose, and their values."""
    rows, pose, eq, other = [], shape.pose, shape.equilibrium, shape.other_side
    points = shape.points()
    start = ("start", pose.start, points[0], eq.lam_start, eq.moments[0])
    for side, at, reached, force, moment in (
        start,
        ("end", pose.end, points[-1], eq.lam, eq.moments[1]),
    ):
        if at is None:
            rows.append((side, "free"))
            continue
        rows.append((side, words.vector(at, "g", "m")))
        if math.dist(at, reached) > _SHOWN:
            place = words.vector(reached, ".5f", "m")
            rows.append((f"{side} of the cable", f"{place}: fixture errors of the fit included"))
        rows.append((f"force of the cable on its {side}", words.vector(force, ".4g", "N")))
        held = (getattr(pose, f"{side}_{key}") for key in ("heading", "orientation"))
        if any(direction is not None for direction in held):
            said = words.vector(moment, ".4g", "N m") if np.ndim(moment) else f"{moment:.4g} N m"
            rows.append((f"moment of the cable on its {side}", said))
    rows.append(("energy", f"{eq.energy:.6g} J"))
    rows.append(("smallest bend radius", words.millimetres(eq.min_bend_radius)))
    rows.append(("stable", "yes" if eq.stable else "NO: the cable would not stay there"))
    if other is not None and shape.tipping is not None:
        apart = float(np.linalg.norm(other.points() - points, axis=1).max())
        rows.append(("this side", f"`{_side(shape)}`"))
        text = (
            f"`{_side(other)}`: {other.equilibrium.energy:.6g} J, up to {words.millimetres(apart)} "
            f"away; equally low with the clamp turned by {shape.tipping.angle:.2g} rad (known to "
            f"{shape.tipping.std:.2g} rad)"
        )
        rows.append(("also stable", text))
    return rows


def _side(shape: CableShape) -> str | None:
    """What tells the side on which a predicted cable hangs."""
    turns = shape.pose.turns if shape.cable.model.in_space else None
    return BranchShape(0.0, shape.pose.branch, turns).chosen_by


# ---- results as a notebook shows them: a few lines, or a small table -----------------------------


def outcome_text(outcome: Outcome) -> str:
    """Cable, verdict, parameters and errors in a few lines."""
    lines = words.verdict_lines(outcome)
    lines[0] = f"{outcome.config.cable.name}: {lines[0]}"
    for row in (*fitted_rows(outcome), *error_rows(outcome)):
        lines.append("  " + "  ".join(filter(None, row)))
    warnings = len(words.all_warnings(outcome))
    if warnings:
        lines.append(f"  {counted(warnings, 'warning')}: see .warnings")
    return "\n".join(lines)


def outcome_html(outcome: Outcome) -> str:
    """The same as a short table."""
    rows = [*fitted_rows(outcome), *error_rows(outcome)]
    remarks = [*words.verdict_lines(outcome), *words.all_warnings(outcome)]
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
