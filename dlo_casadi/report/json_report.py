"""report.json: what a run has found, for other programs (schema "dlo-report/1")."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

import numpy as np

from dlo_casadi.errors import well_formed
from dlo_casadi.session.outcome import (
    Outcome,
    ParameterEstimate,
    ReadingErrors,
    RestCurvatureEstimate,
    StageName,
)

SCHEMA = "dlo-report/1"
# In every report, in this order; `closed` only where an effect was added.
ALWAYS: tuple[StageName, ...] = ("initial", "stiffness_only", "algorithm1", "batch")


def report_dict(outcome: Outcome) -> dict[str, Any]:
    """Everything that a program may want to know of a run, as plain data.

    Every key of the schema is present; what is not known is None, never NaN.
    """
    measurement, load, proposal = outcome.measurement, outcome.unexplained, outcome.next_pose
    tests = outcome.structure
    names: list[StageName] = list(ALWAYS)
    if outcome.stage("closed") is not None:
        names.append("closed")
    document = {
        "schema": SCHEMA,
        "config": outcome.config.name,
        "versions": outcome.versions,
        "warnings": [*outcome.doubts, *all_warnings(outcome)],
        "timing_s": outcome.timing,
        "measurement": {
            "kind": measurement.kind,
            "poses_fit": measurement.poses_fit,
            "poses_held_out": measurement.poses_held_out,
            "held_out_missing": list(measurement.held_out_missing),
            "points": measurement.points,
            "std": measurement.std,
            "std_source": measurement.std_source,
            "correlation_length_m": measurement.correlation_length,
            "readings": measurement.readings,
            "force_std": measurement.force_std,
            "moment_std": measurement.moment_std,
        },
        "stages": [_stage(name, outcome) for name in names],
        "repeatability": {
            "rest_curvature_std": outcome.repeatability.rest_curvature_std,
            "expected_spread_m": outcome.repeatability.expected_spread,
            "source": outcome.repeatability.source,
            "held_out_inside_90": outcome.inside_band,
        },
        "discretization": {
            "n": outcome.discretization.n,
            "element": outcome.discretization.element,
            "error_m": outcome.discretization.error,
        },
        "effects": list(map(asdict, outcome.effects)),
        "candidates": [asdict(row) | {"reason": row.reason or None} for row in outcome.candidates],
        "verdict": outcome.verdict,
        "either_side": {name: asdict(found) for name, found in outcome.either_side.items()},
        "unexplained": load
        and {
            "force": load.force,
            "force_per_pose": load.force_per_pose,
            "poses": load.poses,
            "position": load.position,
            "interval_95": load.interval,
        },
        "next_pose": proposal
        and {
            "end": proposal.end,
            "separates": proposal.separates,
            "expected_difference_m": proposal.difference,
            "expected_difference_std": proposal.separation,
            "reading": asdict(proposal.reading),
        },
        "structure": tests and dict(zip(("before", "after"), map(asdict, tests), strict=True)),
        "hidden_weight": outcome.hidden_weight and asdict(outcome.hidden_weight),
    }
    plain: dict[str, Any] = finite(document)
    return plain


def report_text(outcome: Outcome) -> str:
    """The text of report.json."""
    return json.dumps(report_dict(outcome), indent=1, allow_nan=False) + "\n"


def all_warnings(outcome: Outcome) -> list[str]:
    """Warnings of the run, why a stage lacks a number, and what sits on a bound."""
    lines = list(outcome.warnings)
    held_out = outcome.measurement.poses_held_out > 0
    for name in ALWAYS:
        stage = outcome.stage(name)
        if stage is None:
            lines.append(f"stage {name} did not run")
        elif stage.rmse_fit is None or (held_out and stage.rmse_held_out is None):
            lines.append(f"stage {name}: {stage.note or 'some poses could not be predicted'}")
    if outcome.stages:
        for key, estimate in outcome.stages[-1].parameters.items():
            if estimate.at_bound:
                value = f"{estimate.value:.4g} {estimate.unit}".strip()
                lines.append(f"{key} sits on a bound of what physics permits: {value}")
    return lines


def finite(value: Any) -> Any:
    """Copy with plain numbers for NumPy's, None for what is not finite, and `well_formed` text."""
    if isinstance(value, dict):
        return {finite(str(key)): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return finite(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return well_formed(value)
    return value


def _stage(name: StageName, outcome: Outcome) -> dict[str, Any]:
    """One stage; with None for all numbers if it did not run."""
    stage = outcome.stage(name)
    if stage is None or not stage.parameters:
        unknown = {
            "value": None,
            "std": None,
            "unit": "N m^2",
            "interval_95": None,
            "identifiable": None,
        }
        return {
            "name": name,
            "rmse_fit": None,
            "rmse_held_out": None,
            **_reading_errors(ReadingErrors(), ReadingErrors()),
            "readings": {},
            "rmse_fit_measured_branch": None,
            "rmse_held_out_measured_branch": None,
            "other_branch": {},
            "measured_side": {},
            "held_out": None,
            "chi2_per_dof": None,
            "parameters": {
                "bending_stiffness": unknown,
                "rest_curvature": {"s": [], "value": [], "std": []},
            },
        }
    parameters: dict[str, Any] = {
        key: _estimate(estimate) for key, estimate in stage.parameters.items()
    }
    parameters["rest_curvature"] = _rest_curvature(stage.rest_curvature)
    return {
        "name": name,
        "rmse_fit": stage.rmse_fit,
        "rmse_held_out": stage.rmse_held_out,
        **_reading_errors(stage.readings_fit, stage.readings_held_out),
        "readings": {
            pose: {
                key: {"measured": known, "predicted": model}
                for key, (known, model) in shape.readings.items()
            }
            for pose, shape in stage.shapes.items()
            if shape.readings
        },
        "rmse_fit_measured_branch": stage.rmse_fit_measured_branch,
        "rmse_held_out_measured_branch": stage.rmse_held_out_measured_branch,
        "other_branch": {
            pose: {
                "rmse": stage.shapes[pose].rmse,
                "rmse_measured_branch": found.rmse,
                "branch": found.branch,
                "turns": found.turns,
            }
            for pose, found in stage.other_branch.items()
        },
        "measured_side": {pose: asdict(found) for pose, found in stage.measured_side.items()},
        "held_out": asdict(outcome.held_out(stage)),
        "chi2_per_dof": stage.chi2_per_dof,
        "parameters": parameters,
    }


def _reading_errors(fit: ReadingErrors, held_out: ReadingErrors) -> dict[str, float | None]:
    return {
        "force_rmse_fit": fit.force,
        "force_rmse_held_out": held_out.force,
        "moment_rmse_fit": fit.moment,
        "moment_rmse_held_out": held_out.moment,
    }


def _rest_curvature(rest: RestCurvatureEstimate) -> dict[str, Any]:
    """Value and standard deviation along the cable, in space about each material axis."""
    if rest.value.ndim == 1:
        return {"s": rest.s, "value": rest.value, "std": rest.std}
    about = zip(("k_y", "k_z"), rest.value, rest.std, strict=True)
    return {"s": rest.s, **{name: {"value": value, "std": std} for name, value, std in about}}


def _estimate(estimate: ParameterEstimate) -> dict[str, Any]:
    interval = estimate.interval_95
    return {
        "value": estimate.value,
        "std": estimate.std,
        "unit": estimate.unit,
        "interval_95": None if interval is None else list(interval),
        "identifiable": estimate.identifiable,
    }
