"""Columns of the table of many sessions, and the row of one."""

from __future__ import annotations

from typing import Any, get_args

from dlo_casadi import __version__
from dlo_casadi.session.outcome import StageName
from dlo_casadi.session.run import TIMED

SCHEMA = "dlo-fleet/1"
Row = dict[str, Any]

STAGES = get_args(StageName)
TIMES = (*TIMED, "total")
# Begins the names of all columns that differ from run to run.
TIME = "time_"

# What a stage tells beside its parameters.
_ERRORS = {"rmse_fit": "m", "rmse_held_out": "m", "chi2_per_dof": ""}

# Column -> what it holds, and in which unit; empty (null) where a session has no such thing.
COLUMNS: dict[str, tuple[str, str]] = {
    "session": ("text", ""),
    "status": ("text", ""),
    "message": ("text", ""),
    "cable": ("text", ""),
    "verdict": ("text", ""),
    "effects": ("effects", ""),
    "bending_stiffness": ("number", "N m^2"),
    "bending_stiffness_std": ("number", "N m^2"),
    "bending_stiffness_low_95": ("number", "N m^2"),
    "bending_stiffness_high_95": ("number", "N m^2"),
    "identifiable": ("truth", ""),
    "torsional_stiffness": ("number", "N m^2"),
    "torsional_stiffness_std": ("number", "N m^2"),
    "parameters": ("parameters", ""),
    "rest_curvature_s": ("numbers", "m"),
    "rest_curvature": ("numbers", "1/m"),
    "rest_curvature_std": ("numbers", "1/m"),
    "rest_curvature_z": ("numbers", "1/m"),
    "rest_curvature_z_std": ("numbers", "1/m"),
    **{f"{stage}_{what}": ("number", _ERRORS[what]) for stage in STAGES for what in _ERRORS},
    "unexplained_force_x": ("number", "N"),
    "unexplained_force_y": ("number", "N"),
    "unexplained_force_z": ("number", "N"),
    "unexplained_position": ("number", "m"),
    "noise_std": ("number", "m"),
    "noise_correlation_length": ("number", "m"),
    "kind": ("text", ""),
    "poses_fit": ("count", ""),
    "poses_held_out": ("count", ""),
    "points": ("count", ""),
    "elements": ("count", ""),
    "discretization_error": ("number", "m"),
    "warnings": ("texts", ""),
    "config_hash": ("text", ""),
    "package_version": ("text", ""),
    **{f"{TIME}{part}_s": ("number", "s") for part in (*TIMES, "session")},
}


def empty_row(key: str, digest: str, status: str, message: str, seconds: float) -> Row:
    """Row of a session without results."""
    lists = ("effects", "parameters", "numbers", "texts")
    return {name: [] if kind in lists else None for name, (kind, _) in COLUMNS.items()} | {
        "session": key,
        "status": status,
        "message": message,
        "config_hash": digest,
        "package_version": __version__,
        f"{TIME}session_s": seconds,
    }


def row_of(key: str, digest: str, cable: str, report: dict[str, Any], seconds: float) -> Row:
    """Row of a session with results, from its report ("dlo-report/1")."""
    last = report["stages"][-1]
    stiffness = last["parameters"]["bending_stiffness"]
    low, high = stiffness["interval_95"] or (None, None)
    rest = last["parameters"]["rest_curvature"]
    measurement, mesh = report["measurement"], report["discretization"]
    pull = report["unexplained"] or {}
    force = pull.get("force") or ()
    torsion = last["parameters"].get("torsional_stiffness", {})
    row = empty_row(key, digest, "done", "", seconds) | {
        "cable": cable,
        "verdict": report["verdict"],
        "effects": [_effect(effect) for effect in report["effects"]],
        "bending_stiffness": stiffness["value"],
        "bending_stiffness_std": stiffness["std"],
        "bending_stiffness_low_95": low,
        "bending_stiffness_high_95": high,
        "identifiable": stiffness["identifiable"],
        "torsional_stiffness": torsion.get("value"),
        "torsional_stiffness_std": torsion.get("std"),
        "parameters": _parameters(last["parameters"]),
        "rest_curvature_s": rest["s"],
        **_rest_columns(rest),
        **{f"unexplained_force_{axis}": value for axis, value in zip("xyz", force, strict=False)},
        "unexplained_position": pull.get("position"),
        "noise_std": measurement["std"],
        "noise_correlation_length": measurement["correlation_length_m"],
        **{name: measurement[name] for name in ("kind", "poses_fit", "poses_held_out", "points")},
        "elements": mesh["n"],
        "discretization_error": mesh["error_m"],
        "warnings": report["warnings"],
    }
    row |= {
        f"{stage['name']}_{what}": stage[what] for stage in report["stages"] for what in _ERRORS
    }
    return row | {f"{TIME}{part}_s": report["timing_s"].get(part) for part in TIMES}


def _rest_columns(rest: dict[str, Any]) -> dict[str, Any]:
    """Rest curvature in a plane, or in space about the material axis y, and then about z."""
    about = {"": rest} if "value" in rest else {"": rest["k_y"], "_z": rest["k_z"]}
    return {
        f"rest_curvature{axis}{suffix}": item[key]
        for axis, item in about.items()
        for suffix, key in (("", "value"), ("_std", "std"))
    }


def _effect(effect: dict[str, Any]) -> dict[str, Any]:
    kept = (
        "name",
        "p_value",
        "rmse_cross_validated_before",
        "rmse_cross_validated_after",
        "indistinguishable_from",
    )
    return {name: effect[name] for name in kept} | {"parameters": _parameters(effect["parameters"])}


def _parameters(items: dict[str, Any]) -> list[dict[str, Any]]:
    kept = ("value", "std", "unit")
    return [
        {"name": name} | {key: item[key] for key in kept}
        for name, item in items.items()
        if name != "rest_curvature"
    ]


def last_error(row: Row) -> float | None:
    """Error of the last stage [m]: of held-out poses where there are any."""
    errors = ("rmse_held_out", "rmse_fit")
    names = [f"{stage}_{what}" for stage in ("closed", "batch") for what in errors]
    return next((row[name] for name in names if row[name] is not None), None)
