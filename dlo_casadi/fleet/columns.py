"""Columns of the table of many sessions, and the row of one."""

from __future__ import annotations

from typing import Any

from dlo_casadi import __version__

SCHEMA = "dlo-fleet/1"
Row = dict[str, Any]

STAGES = ("initial", "stiffness_only", "algorithm1", "batch", "closed")
TIMES = ("vision", "algorithm1", "batch", "diagnosis", "total")
# Begins the names of all columns that differ from run to run.
TIME = "time_"

# Column -> what it holds; empty (null) where a session has no such thing.
COLUMNS: dict[str, str] = {
    "session": "text",
    "status": "text",
    "message": "text",
    "cable": "text",
    "verdict": "text",
    "effects": "effects",
    "bending_stiffness": "number",
    "bending_stiffness_std": "number",
    "bending_stiffness_low_95": "number",
    "bending_stiffness_high_95": "number",
    "identifiable": "truth",
    "torsional_stiffness": "number",
    "torsional_stiffness_std": "number",
    "parameters": "parameters",
    "rest_curvature_s": "numbers",
    "rest_curvature": "numbers",
    "rest_curvature_std": "numbers",
    "rest_curvature_z": "numbers",
    "rest_curvature_z_std": "numbers",
    **{
        f"{stage}_{what}": "number"
        for stage in STAGES
        for what in ("rmse_fit", "rmse_held_out", "chi2_per_dof")
    },
    "unexplained_force_x": "number",
    "unexplained_force_y": "number",
    "unexplained_force_z": "number",
    "unexplained_position": "number",
    "noise_std": "number",
    "noise_correlation_length": "number",
    "kind": "text",
    "poses_fit": "count",
    "poses_held_out": "count",
    "points": "count",
    "elements": "count",
    "discretization_error": "number",
    "warnings": "texts",
    "config_hash": "text",
    "package_version": "text",
    **{f"{TIME}{part}_s": "number" for part in TIMES},
    f"{TIME}session_s": "number",
}

UNITS = {
    "bending_stiffness": "N m^2",
    "torsional_stiffness": "N m^2",
    "torsional_stiffness_std": "N m^2",
    **dict.fromkeys((name for name in COLUMNS if name.startswith("rest_curvature")), "1/m"),
    **dict.fromkeys((name for name in COLUMNS if name.startswith("unexplained_force")), "N"),
    **{
        name: "m"
        for name in COLUMNS
        if name.endswith(("rmse_fit", "rmse_held_out", "_s", "position", "_error"))
        or name.startswith("noise_")
    },
    **{f"bending_stiffness_{end}": "N m^2" for end in ("std", "low_95", "high_95")},
    **{name: "s" for name in COLUMNS if name.startswith(TIME)},
}


def empty_row(key: str, digest: str, status: str, message: str, seconds: float) -> Row:
    """Row of a session without results."""
    return dict.fromkeys(COLUMNS) | {
        "session": key,
        "status": status,
        "message": message,
        "effects": [],
        "parameters": [],
        "rest_curvature_s": [],
        "rest_curvature": [],
        "rest_curvature_std": [],
        "rest_curvature_z": [],
        "rest_curvature_z_std": [],
        "warnings": [],
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
        "parameters": [
            {"name": name, "value": item["value"], "std": item["std"], "unit": item["unit"]}
            for name, item in last["parameters"].items()
            if name != "rest_curvature"
        ],
        "rest_curvature_s": rest["s"],
        **_rest_columns(rest),
        **{f"unexplained_force_{axis}": value for axis, value in zip("xyz", force, strict=False)},
        "unexplained_position": pull.get("position"),
        "noise_std": measurement["std"],
        "noise_correlation_length": measurement["correlation_length_m"],
        "kind": measurement["kind"],
        "poses_fit": measurement["poses_fit"],
        "poses_held_out": measurement["poses_held_out"],
        "points": measurement["points"],
        "elements": mesh["n"],
        "discretization_error": mesh["error_m"],
        "warnings": report["warnings"],
    }
    for stage in report["stages"]:
        for what in ("rmse_fit", "rmse_held_out", "chi2_per_dof"):
            row[f"{stage['name']}_{what}"] = stage[what]
    for part in TIMES:
        row[f"{TIME}{part}_s"] = report["timing_s"].get(part)
    return row


def _rest_columns(rest: dict[str, Any]) -> dict[str, Any]:
    """Rest curvature in a plane, or in space about the material axis y, and then about z."""
    about = {"": rest} if "value" in rest else {"": rest["k_y"], "_z": rest["k_z"]}
    return {
        f"rest_curvature{axis}{suffix}": item[key]
        for axis, item in about.items()
        for suffix, key in (("", "value"), ("_std", "std"))
    }


def _effect(effect: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": effect["name"],
        "p_value": effect["p_value"],
        "rmse_cross_validated_before": effect["rmse_cross_validated_before"],
        "rmse_cross_validated_after": effect["rmse_cross_validated_after"],
        "indistinguishable_from": effect["indistinguishable_from"],
        "parameters": [
            {"name": name, "value": item["value"], "std": item["std"], "unit": item["unit"]}
            for name, item in effect["parameters"].items()
        ],
    }


def last_error(row: Row) -> float | None:
    """Error of the last stage [m]: of held-out poses where there are any."""
    for stage in ("closed", "batch"):
        for what in ("rmse_held_out", "rmse_fit"):
            value: float | None = row[f"{stage}_{what}"]
            if value is not None:
                return value
    return None
