"""Rows of the report's tables: parameters, errors, time, one predicted pose; notebook output."""

import math
from dataclasses import replace

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import Covariance, Estimate, from_to
from dlo_casadi.effects.mass_error import MASS_FACTOR
from dlo_casadi.errors import counted
from dlo_casadi.report import findings, words
from dlo_casadi.rod.quantities import QUANTITIES
from dlo_casadi.runtime.work import Part
from dlo_casadi.session.outcome import MASS, Outcome, ReadingErrors
from dlo_casadi.show import text
from dlo_casadi.show.text import html_table

# Correlations beyond which a summary names the pair.
_STRONG = 0.9
# A row of the tables of parameters: name, value, 95 % interval, remark.
Row = tuple[str, str, str, str]
NO_FIT = "of a model that does not fit"
NOTHING = "-"


def describe(
    estimate: Estimate, explains: bool | None = None, seen: str = "shapes"
) -> tuple[str, str, str]:
    """Value, interval and remark; no number where the data do not determine one.

    `explains`: of the stage; a model that does not fit gets neither std nor interval. `seen`: what
    was measured, see `words.seen`.
    """
    if explains is False:
        return (f"{estimate.value:.4g}{_after(estimate.unit)}", "", NO_FIT)
    if estimate.identifiable is False:
        return (unidentified(estimate), "", f"not identifiable from these {seen}")
    unit, interval = _after(estimate.unit), ""
    if estimate.interval_95 is not None:
        interval = f"{from_to(estimate.interval_95)}{unit}"
    value = text.plus_minus(estimate.value, estimate.std) + unit
    return (value, interval, "at a bound" if estimate.at_bound else "")


def unidentified(estimate: Estimate) -> str:
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
    stage = outcome.stages[-1]
    seen = words.seen(outcome)
    return [(name, *describe(x, stage.explains, seen)) for name, x in stage.parameters.items()]


def rest_rows(outcome: Outcome) -> list[Row]:
    """The rest curvature of the last stage in one line, in space for each material axis."""
    if outcome.config.cable.rest_shape == "straight":
        return [("rest curvature", "0 1/m", "", "fixed: declared straight")]
    rest = outcome.stages[-1].rest_curvature
    if not rest.value.size:
        return []
    names = [f"rest curvature{name and f' k_{name}'}" for name in words.directions(outcome)]
    parts = zip(names, *(np.atleast_2d(known) for known in rest.known), strict=True)
    return [(name, *_rest_words(value, std, outcome)) for name, value, std in parts]


def _rest_words(value: FloatArray, std: FloatArray, outcome: Outcome) -> tuple[str, str, str]:
    """Range, no interval, and remark on a rest curvature (M,), NaN where it is not determined."""
    known = np.isfinite(value)
    seen = f"not determined by these {words.seen(outcome)}"
    if not known.any():
        return "unknown", "", seen
    low, high = value[known].min(), value[known].max()
    remark = f"std {std[known].mean():.2g} 1/m on average"
    if not known.all():
        remark += f"; {1 - known.mean():.0%} of it {seen}"
    return f"{low:.3g} to {high:.3g} 1/m", "", remark


def nuisance_rows(outcome: Outcome) -> list[Row]:
    """Values known within a tolerance that the fit adjusted."""
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
        rows.append((q.name, text.plus_minus(value, fit.std(q.name)) + unit, "", remark))
    return rows


def fixed_rows(outcome: Outcome) -> list[Row]:
    """Declared values that the fit kept."""
    cable, fit = outcome.config.cable, outcome.fit
    kept = {"length": f"{cable.length:g} m"}
    if MASS not in outcome.stages[-1].parameters:
        kept[MASS] = f"{cable.mass:g} kg"
    kept["gravity"] = text.vector(outcome.config.experiment.gravity, "g", "m/s^2")
    for q, free in zip(fit.model.parameters, fit.problem.unknowns.free, strict=True):
        if not free:
            kept[q.name] = f"{fit.value(q.name):.4g}{_after(q.unit)}"
    return [(name, value, "", "fixed") for name, value in kept.items()]


def footnotes(outcome: Outcome) -> list[str]:
    """Remarks needed to read the table of parameters correctly."""
    lines, found = [], outcome.stages[-1].parameters
    stiffness, twisting = found.get("bending_stiffness"), found.get("torsional_stiffness")
    gravity = outcome.config.experiment.gravity
    if outcome.stages[-1].explains is False:
        return ["The model does not explain what was measured: its numbers have no intervals."]
    if stiffness is not None and stiffness.identifiable is False:
        bound = unidentified(stiffness)
        known = f"EI {bound}" if bound[0] in "<>" else f"EI: {bound}"
        lines.append(f"{known}, not identifiable from these {words.seen(outcome)}.")
        poses = (
            "poses in which weight and stiffness compete more (ends close together), or hang a "
            "known weight on the cable and declare it under model.effects."
        )
        force = "end_force or start_force of a pose: without gravity shapes tell no stiffness."
        lines.append(f"Try: {poses if any(gravity) else force}")
    elif stiffness is not None and not outcome.measurement.readings:
        known = "EI is" if twisting is None else "EI and GJ are"
        weight = outcome.fit.mass * math.hypot(*gravity)
        ratio = f" EI over weight is {stiffness.value / weight:.4g} m^2." if weight else ""
        lines.append(
            f"Shapes give the ratio of stiffness to weight: {known} as exact as the declared mass."
            f"{ratio}"
        )
        lines += _best_reading(outcome)
    if MASS in found and found[MASS].identifiable is False:
        lines.append(
            "The readings do not tell mass from EI: only their ratio is known. Try: end_force or "
            "start_force of more poses, or a smaller force_std and force_bias."
        )
    if twisting is not None and twisting.identifiable is False:
        held = outcome.config.experiment.boundary
        lines.append(
            f"GJ is not identifiable from these {words.seen(outcome)}. Try: poses that twist the "
            "cable, with the end clamp rolled by up to half a turn."
            if held.start.roll and held.end.roll
            else "GJ is not identifiable: only ends that both hold the roll twist the cable. Try: "
            "clamps at both ends, one rolled by up to half a turn."
        )
    return lines


def _best_reading(outcome: Outcome) -> list[str]:
    """Pose in which a force reading determines mass and stiffnesses best (all scale together)."""
    experiment = outcome.config.experiment
    ends = ("start", "end") if experiment.boundary.end.place else ("start",)
    forces = {
        (name, side): float(np.linalg.norm(force))
        for name, shape in outcome.stages[-1].shapes.items()
        for side, force in zip(ends, shape.forces, strict=False)
    }
    if not forces or not any(experiment.gravity):
        return []
    (pose, side), force = max(forces.items(), key=lambda item: item[1])
    return [
        f"A measurement of {side}_force in {pose}, about {force:.3g} N, would check that mass: to "
        f"1 % if noise and offset of the sensor are below {force / 100:.2g} N."
    ]


def _after(unit: str) -> str:
    return f" {unit}" if unit else ""


def stage_rows(outcome: Outcome, nothing: str) -> list[dict[str, str]]:
    """Errors of the stages as text: fit, cross-validated, held out, chi-square.

    A stage with poses measured in another equilibrium has a second row. `nothing`: text for a
    missing number.
    """

    def row(label: str, note: str, fit: float | None, held_out: float | None) -> dict[str, str]:
        known = {"fit": fit, "held_out": held_out, "validated": None}
        cells = {key: text.millimetres(x, nothing) for key, x in known.items()}
        return {"label": label, "mark": "", "note": note, "chi2": nothing, **cells}

    marks = {stage.name: kind for kind, _, stage in words.compared(outcome)}
    validated = words.cross_validated(outcome)
    rows = []
    for stage in outcome.stages:
        own = row(words.label_of(stage, outcome), stage.note, stage.rmse_fit, stage.rmse_held_out)
        if not outcome.measurement.points:
            own["fit"] = newtons(stage.readings_fit, nothing)
            own["held_out"] = newtons(stage.readings_held_out, nothing)
        own["mark"] = marks.get(stage.name, "")
        own["held_out"] += words.predicted_share(outcome, stage)
        own["validated"] = text.millimetres(validated.get(stage.name), nothing)
        if stage.chi2_per_dof is not None:
            own["chi2"] = f"{stage.chi2_per_dof:.3g}"
        rows.append(own)
        if stage.other_branch:
            note = f"poses in another equilibrium: {', '.join(stage.other_branch)}"
            errors = stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch
            rows.append(row(words.ON_BRANCH, note, *errors))
    return rows


def newtons(errors: ReadingErrors, nothing: str = NOTHING) -> str:
    """Errors of forces and moments that were measured."""
    found = ((errors.of(x), x.unit) for x in QUANTITIES)
    return ", ".join(f"{value:.2g} {unit}" for value, unit in found if value is not None) or nothing


def error_rows(outcome: Outcome) -> list[tuple[str, str]]:
    """RMS distance of the measured points from the last stage's shapes, and that of noise."""
    stage, m = outcome.stages[-1], outcome.measurement
    if not m.points:
        errors = (("fit", stage.readings_fit), ("held out", stage.readings_held_out))
        found = [(f"readings, {role}", newtons(known)) for role, known in errors]
        missing = [("held out, not measured", ", ".join(m.held_out_missing))]
        return [row for row in (*found, *missing) if row[1] not in ("", NOTHING)]
    rows = [("error of the fit", text.millimetres(stage.rmse_fit))]
    if stage.rmse_held_out is not None:
        share = words.predicted_share(outcome, stage)
        rows.append(("held out", text.millimetres(stage.rmse_held_out) + share))
    if m.held_out_missing:
        rows.append(("held out, not measured", ", ".join(m.held_out_missing)))
    if stage.other_branch:
        both = (stage.rmse_fit_measured_branch, stage.rmse_held_out_measured_branch)
        known = (text.millimetres(value) for value in both if value is not None)
        rows.append((words.ON_BRANCH, ", ".join(known)))
    return [*rows, (f"{words.NOISE_ALONE} ({m.std_source})", text.millimetres(m.noise_distance))]


def timing_rows(outcome: Outcome) -> list[tuple[str, str, str]]:
    """Part of the run, seconds and remark; the total comes last."""
    timing = outcome.timing
    read, search, total = timing["vision"], timing["diagnosis"], timing["total"]
    photographs = sum((pose.image is not None) + len(pose.views) for pose in outcome.poses)
    rows = [("reading the lines", read, "")]
    if photographs:
        remark = f"{read / photographs:.2f} s a photograph ({photographs})"
        rows = [("photographs to centre-lines", read, remark)]
    # In space neither IPOPT nor the paper's loop runs.
    within = {"Algorithm 1": timing["algorithm1"], "IPOPT": timing["batch"]}
    parts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in within.items() if seconds)
    of_search = outcome.work.parts.get("diagnosis", Part()).steps
    others = outcome.work.steps - of_search
    left = max(total - read - search, 0.0)
    rows.append(("fits and predictions", left, counted(others, "step") if others else ""))
    if search:
        rows.append(("diagnosis", search, counted(of_search, "step") if of_search else ""))
    remark = "without imports and writing" + (f"; of it or beside it {parts}" if parts else "")
    rows.append(("total", total, remark))
    return [(name, f"{seconds:.2f}", remark) for name, seconds, remark in rows]


def work_rows(outcome: Outcome) -> list[tuple[str, str, str, str]]:
    """What took how long in a run: part, indented, how often, steps of its fits, seconds."""
    return [
        ("  " * depth + name, str(one.calls), str(one.steps), f"{one.seconds:.2f}")
        for depth, name, one in outcome.work.rows()
    ]


# ---- results as a notebook shows them: a few lines, or a small table -----------------------------


def outcome_text(outcome: Outcome) -> str:
    """Cable, verdict, parameters and errors in a few lines."""
    lines = findings.verdict_lines(outcome)
    lines[0] = f"{outcome.config.cable.name}: {lines[0]}"
    for row in (*fitted_rows(outcome), *error_rows(outcome)):
        lines.append("  " + "  ".join(filter(None, row)))
    lines += [f"  warning: {said}" for said in outcome.serious]
    others = len(words.all_warnings(outcome)) - len(outcome.serious)
    if others:
        more = "further " * bool(outcome.serious)
        lines.append(f"  {counted(others, f'{more}warning')}: see .warnings")
    return "\n".join(lines)


def estimates_of(outcome: Outcome) -> dict[str, Estimate]:
    """All parameters of the last stage; those known within tolerances come last."""
    stage, fit = outcome.stages[-1], outcome.fit
    known, free = dict(stage.parameters), fit.problem.unknowns.names
    for q in fit.model.parameters:
        if q.name not in known and not (q.name == MASS_FACTOR and MASS in known):
            known[q.name] = Estimate(
                fit.value(q.name), fit.std(q.name), q.unit, fixed=q.name not in free
            )
    if stage.explains is False:
        return {name: replace(x, interval_95=None) for name, x in known.items()}
    return known


def _stage_lines(outcome: Outcome) -> list[str]:
    """Errors and chi-square of all stages, aligned; `before` and `after` mark what is compared."""
    head = ("stage", "", "fit", "cross-validated", "held out", "chi2 per dof")
    keys = ("label", "mark", "fit", "validated", "held_out", "chi2")
    table = [head, *(tuple(row[key] for key in keys) for row in stage_rows(outcome, "-"))]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    rows = ("  ".join(f"{x:{w}}" for x, w in zip(row, widths, strict=True)) for row in table)
    return ["Errors by stage", *(f"  {row}".rstrip() for row in rows)]


def _effect_lines(outcome: Outcome) -> list[str]:
    """Added effects: p-value, cross-validated errors, and names of their parameters in `params`."""
    lines = []
    for one in outcome.effects:
        both = (one.rmse_cross_validated_before, one.rmse_cross_validated_after)
        before, after = (text.millimetres(x) for x in both)
        chance = "" if one.p_value is None else f"p {one.p_value:.2g}, "
        names = ", ".join(
            name for name in estimates_of(outcome) if name.startswith(f"{one.label}.")
        )
        lines.append(f"  {one}: {chance}cross-validated {before} -> {after}; {names}")
    return ["Added effects", *lines] if lines else []


def summary_text(outcome: Outcome) -> str:
    """Errors, all parameters, strong correlations and warnings."""
    fit, names = outcome.fit, outcome.fit.named_covariance[0]
    covariance = Covariance(*fit.named_covariance)
    shown, correlation = estimates_of(outcome), covariance.correlation
    measurement = outcome.measurement
    poses = counted(measurement.poses_fit + measurement.poses_held_out, "pose")
    width = max(map(len, shown))
    pairs = [
        (abs(correlation[i, j]), f"  {names[i]}, {names[j]}: {correlation[i, j]:+.2f}")
        for i in range(len(names))
        for j in range(i)
        if {names[i], names[j]} <= set(shown) and abs(correlation[i, j]) > _STRONG
    ]
    warnings = [*outcome.doubts, *words.all_warnings(outcome)]
    verdict, *more = findings.verdict_lines(outcome)
    doubt = ""
    if outcome.stages[-1].explains is False:
        doubt = " of a model that does not fit: the standard deviations hold within it only"
    lines = [
        f"{outcome.config.cable.name}: {verdict}",
        *more,
        f"  {poses} ({measurement.poses_held_out} held out), {words.counted_data(measurement)}",
        *("  " + "  ".join(filter(None, row)) for row in error_rows(outcome)),
        *_stage_lines(outcome),
        *_effect_lines(outcome),
        f"Parameters{doubt}",
        *(f"  {name:{width}}  {found}" for name, found in shown.items()),
        *("  " + "  ".join(filter(None, row)) for row in rest_rows(outcome)),
    ]
    if pairs:
        lines += [f"Correlations beyond {_STRONG}", *(said for _, said in sorted(pairs)[::-1])]
    if warnings:
        lines += ["Warnings", *(f"  {said}" for said in warnings)]
    return "\n".join(lines)


def outcome_html(outcome: Outcome) -> str:
    """The same as a short table."""
    rows = [*fitted_rows(outcome), *error_rows(outcome)]
    remarks = [*findings.verdict_lines(outcome), *words.all_warnings(outcome)]
    return html_table(outcome.config.cable.name, rows, remarks)
