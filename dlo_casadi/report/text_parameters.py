"""Parameters in words: values with their errors, intervals, and what shapes do not tell."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from dlo_casadi.report.geometry import directions
from dlo_casadi.session.outcome import MASS, Outcome, ParameterEstimate


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
        hung = (
            "poses in which weight and stiffness compete more (ends close together), or hang a "
            "known weight on the cable and declare it under model.effects."
        )
        force = "end_force or start_force of a pose: without gravity shapes tell no stiffness."
        lines.append(f"Try: {hung if any(outcome.config.experiment.gravity) else force}")
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
