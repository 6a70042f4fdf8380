"""What `dlo check` has found, as a table and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from dlo_casadi.config import Config
from dlo_casadi.report.json_report import finite
from dlo_casadi.session.hypotheses import Suspicion
from dlo_casadi.session.outcome import PoseInput


def check_dict(
    config: Config, inputs: Sequence[PoseInput], found: Sequence[Suspicion]
) -> dict[str, Any]:
    """Everything as plain data in SI units: ok, mistakes, warnings, and one row for each pose."""
    unread = [f"{item.name}: {item.problem}" for item in inputs if item.problem]
    known = {item.name for item in inputs}
    left_out = [f"{item.name}: {item.reason}" for item in config.skipped if item.name not in known]
    mistakes = [*(item.message for item in found), *left_out, *unread]
    rows: dict[str, Any] = finite(
        {
            "config": config.name,
            "ok": not mistakes,
            "mistakes": mistakes,
            "warnings": list(config.warnings),
            "poses": [pose_row(config, item) for item in inputs],
        }
    )
    return rows


def pose_row(config: Config, item: PoseInput) -> dict[str, Any]:
    """What was found in one pose; None for what was not."""
    declared = {pose.name: pose for pose in config.experiment.poses}[item.name]
    read = len(item.points) > 0
    length = float(np.linalg.norm(np.diff(item.points, axis=0), axis=1).sum()) if read else None
    away = [
        float(np.linalg.norm(item.points[k] - place))
        for k, place in ((0, declared.start), (-1, declared.end))
        if read and place is not None
    ]
    return {
        "name": item.name,
        "role": item.role,
        "points": len(item.points),
        "length": length,
        "length_over_declared": None if length is None else length / config.cable.length,
        "largest_distance_from_fixture": max(away) if away else None,
        "coverage": item.coverage,
        "confidence": item.confidence,
        "pixel": item.pixel,
        "markers": None if item.markers is None else list(item.markers),
        "problem": item.problem or None,
        "advice": list(item.messages),
    }


def check_table(config: Config, rows: Sequence[dict[str, Any]]) -> Table:
    """One line for each pose; columns that no pose has something for are left out."""
    table = Table(
        title=f"{config.cable.name}: what was found, {config.cable.length:g} m declared",
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
    )
    shown = {name: any(row[key] is not None for row in rows) for name, key in _OPTIONAL.items()}
    table.add_column("pose")
    table.add_column("role")
    table.add_column("length", justify="right")
    table.add_column("of declared", justify="right")
    table.add_column("off fixtures", justify="right")
    for name, present in shown.items():
        if present:
            table.add_column(name, justify="right")
    for row in rows:
        cells = [row["name"], "held out" if row["role"] == "held_out" else "fit"]
        cells += [_number(row["length"], "{:.3f} m"), _percent(row["length_over_declared"])]
        cells.append(_number(row["largest_distance_from_fixture"], "{:.1f} mm", 1e3))
        optional = {
            "seen": _percent(row["coverage"]),
            "confidence": _percent(row["confidence"]),
            "pixel": _number(row["pixel"], "{:.2f} mm", 1e3),
            "markers": "-" if row["markers"] is None else " ".join(map(str, row["markers"])),
        }
        cells += [optional[name] for name, present in shown.items() if present]
        table.add_row(*cells, style="red" if row["problem"] else "")
    return table


def advice_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What the camera step noticed, one sentence a line."""
    return [f"{row['name']}: {text}" for row in rows for text in row["advice"]]


_OPTIONAL = {
    "seen": "coverage",
    "confidence": "confidence",
    "pixel": "pixel",
    "markers": "markers",
}


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return "-" if value is None else form.format(factor * value)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"
