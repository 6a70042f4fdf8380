"""The table of many sessions: its columns and rows, and a page that lists unusual ones first."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args
from urllib.parse import quote

import numpy as np

from dlo_casadi import __version__
from dlo_casadi.errors import counted
from dlo_casadi.fleet import parquet_library
from dlo_casadi.io.files import write_file
from dlo_casadi.session.outcome import StageName
from dlo_casadi.session.run import TIMED

if TYPE_CHECKING:
    import pyarrow

SCHEMA = "dlo-fleet/1"
TABLE = "table.parquet"
Row = dict[str, Any]

STAGES = get_args(StageName)
TIMES = (*TIMED, "total")
_INTERVAL = ("_low_95", "_high_95")
# Errors of a stage and their units.
_ERRORS = {"rmse_fit": "m", "rmse_held_out": "m", "chi2_per_dof": ""}

# Column -> type and unit; null where a session has no value. Columns that differ from run to run
# have names that begin with `time_`.
COLUMNS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("session", "status", "message", "cable", "verdict"), ("text", "")),
    "effects": ("effects", ""),
    **{f"bending_stiffness{part}": ("number", "N m^2") for part in ("", "_std", *_INTERVAL)},
    "identifiable": ("truth", ""),
    "torsional_stiffness": ("number", "N m^2"),
    "torsional_stiffness_std": ("number", "N m^2"),
    "parameters": ("parameters", ""),
    "rest_curvature_s": ("numbers", "m"),
    **{f"rest_curvature{part}": ("numbers", "1/m") for part in ("", "_std", "_z", "_z_std")},
    **{f"{stage}_{what}": ("number", _ERRORS[what]) for stage in STAGES for what in _ERRORS},
    **{f"unexplained_force_{axis}": ("number", "N") for axis in "xyz"},
    "unexplained_position": ("number", "m"),
    "noise_std": ("number", "m"),
    "noise_correlation_length": ("number", "m"),
    "kind": ("text", ""),
    **dict.fromkeys(("poses_fit", "poses_held_out", "points", "elements"), ("count", "")),
    "discretization_error": ("number", "m"),
    "warnings": ("texts", ""),
    "config_hash": ("text", ""),
    "package_version": ("text", ""),
    **{f"time_{part}_s": ("number", "s") for part in (*TIMES, "session")},
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
        "time_session_s": seconds,
    }


def row_of(key: str, digest: str, cable: str, report: dict[str, Any], seconds: float) -> Row:
    """Row of a session with results, from its report ("dlo-report/1")."""
    found = report["stages"][-1]["parameters"]
    stiffness, torsion = found["bending_stiffness"], found.get("torsional_stiffness", {})
    interval = stiffness["interval_95"] or (None, None)
    # In a plane; in space about the material axis y, then about z.
    rest = found["rest_curvature"]
    about = {"": rest} if "value" in rest else {"": rest["k_y"], "_z": rest["k_z"]}
    measurement, mesh = report["measurement"], report["discretization"]
    pull = report["unexplained"] or {}
    force = pull.get("force") or ()
    kept = ("name", "label", "p_value", "rmse_cross_validated_before", "rmse_cross_validated_after")
    return empty_row(key, digest, "done", "", seconds) | {
        "cable": cable,
        "verdict": report["verdict"],
        "effects": [
            {name: effect[name] for name in (*kept, "indistinguishable_from")}
            | {"parameters": _parameters(effect["parameters"])}
            for effect in report["effects"]
        ],
        "bending_stiffness": stiffness["value"],
        "bending_stiffness_std": stiffness["std"],
        **{f"bending_stiffness{end}": x for end, x in zip(_INTERVAL, interval, strict=True)},
        "identifiable": stiffness["identifiable"],
        "torsional_stiffness": torsion.get("value"),
        "torsional_stiffness_std": torsion.get("std"),
        "parameters": _parameters(found),
        "rest_curvature_s": rest["s"],
        **{f"rest_curvature{axis}": item["value"] for axis, item in about.items()},
        **{f"rest_curvature{axis}_std": item["std"] for axis, item in about.items()},
        **{
            f"{stage['name']}_{what}": stage[what] for stage in report["stages"] for what in _ERRORS
        },
        **{f"unexplained_force_{axis}": value for axis, value in zip("xyz", force, strict=False)},
        "unexplained_position": pull.get("position"),
        "noise_std": measurement["std"],
        "noise_correlation_length": measurement["correlation_length_m"],
        **{name: measurement[name] for name in ("kind", "poses_fit", "poses_held_out", "points")},
        "elements": mesh["n"],
        "discretization_error": mesh["error_m"],
        "warnings": report["warnings"],
        **{f"time_{part}_s": report["timing_s"].get(part) for part in TIMES},
    }


def _parameters(items: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {"name": name} | {key: item[key] for key in ("value", "std", "unit")}
        for name, item in items.items()
        if name != "rest_curvature"
    ]


def last_error(row: Row) -> float | None:
    """Error of the last stage [m]: of held-out poses if there are any; None without predictions."""
    stage = "batch" if row["closed_chi2_per_dof"] is None else "closed"
    error: float | None = row[f"{stage}_rmse_{'held_out' if row['poses_held_out'] else 'fit'}"]
    return error


def _row_file(output: Path, key: str) -> Path:
    return output / "rows" / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.json"


def write_row(output: Path, row: Row) -> None:
    """Write a session's row durably; it replaces an earlier one."""
    write_file(_row_file(output, row["session"]), json.dumps(row, allow_nan=False))


def read_row(output: Path, key: str, digest: str) -> Row | None:
    """Read the row of a session if it belongs to the session's current digest."""
    try:
        row: Row = json.loads(_row_file(output, key).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    valid = isinstance(row, dict) and row.keys() == COLUMNS.keys()
    return row if valid and (row["session"], row["config_hash"]) == (key, digest) else None


def write_table(output: Path, rows: Iterable[Row]) -> None:
    """Write all rows into one table, sorted by key; equal rows give equal bytes."""
    pyarrow, parquet = parquet_library()
    ordered = sorted(rows, key=lambda row: str(row["session"]))
    table = pyarrow.Table.from_pylist(ordered, schema=arrow_schema())
    write_file(output / TABLE, lambda stream: parquet.write_table(table, stream))


def arrow_schema() -> pyarrow.Schema:
    """Types and units of the columns."""
    pa, _ = parquet_library()
    text, number = pa.string(), pa.float64()
    values = {"name": text, "value": number, "std": number, "unit": text}
    parameters = pa.list_(pa.struct(values.items()))
    effect = {
        "name": text,
        "label": text,
        "p_value": number,
        "rmse_cross_validated_before": number,
        "rmse_cross_validated_after": number,
        "indistinguishable_from": pa.list_(text),
        "parameters": parameters,
    }
    kinds = {
        "text": text,
        "number": number,
        "count": pa.int64(),
        "truth": pa.bool_(),
        "texts": pa.list_(text),
        "numbers": pa.list_(number),
        "parameters": parameters,
        "effects": pa.list_(pa.struct(effect.items())),
    }
    fields = [
        pa.field(name, kinds[kind], metadata={"unit": unit} if unit else None)
        for name, (kind, unit) in COLUMNS.items()
    ]
    return pa.schema(fields, metadata={"schema": SCHEMA, "dlo_casadi": __version__})


# ---- the page ------------------------------------------------------------------------------------

# Modified z-score beyond which a value is an outlier (Iglewicz and Hoaglin, 1993).
OUTLYING = 3.5
# Fewest sessions for a search for outliers.
FEWEST = 5
# Largest z-score, used also if all other values are equal to the last digit.
LARGEST = 99.0


@dataclass(frozen=True)
class Judged:
    """A row and its outlier scores.

    Parameters
    ----------
    row : dict
    stiffness_z, error_z : float or None
        Robust z-scores of log EI and of the log of the last stage's error.
    """

    row: Row
    stiffness_z: float | None
    error_z: float | None

    @property
    def error(self) -> float | None:
        """Error of the last stage [m]."""
        return last_error(self.row)

    @property
    def verdict(self) -> str:
        """Verdict of the diagnosis, or why there is none."""
        row = self.row
        return str(
            (row["verdict"] or "not diagnosed") if row["status"] == "done" else row["status"]
        )

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons to look at this session first; empty if it is not unusual."""
        if self.row["status"] != "done":
            return (self.verdict,)
        stiffness, error = self.stiffness_z or 0.0, self.error_z or 0.0
        reasons = {
            "unexplained": self.verdict == "unexplained",
            "stiffer": stiffness > OUTLYING,
            "softer": stiffness < -OUTLYING,
            # Flag only large errors as outliers, never small ones.
            "larger error": error > OUTLYING,
        }
        return tuple(text for text, holds in reasons.items() if holds)

    @property
    def order(self) -> tuple[bool, bool, bool, float, str]:
        """Sorting key: the most unusual sessions first."""
        return (
            self.row["status"] == "done",
            "unexplained" not in self.reasons,
            not self.reasons,
            -max(abs(self.stiffness_z or 0.0), self.error_z or 0.0),
            str(self.row["session"]),
        )


def judge(rows: Sequence[Row]) -> list[Judged]:
    """All rows, the most unusual first: failed, unexplained, outlying; the rest by score."""
    measures = [row["bending_stiffness"] for row in rows], [last_error(row) for row in rows]
    scores = [
        robust_z([None if x is None or x <= 0 else float(np.log(x)) for x in values])
        for values in measures
    ]
    return sorted(map(Judged, rows, *scores), key=lambda item: item.order)


def robust_z(values: Sequence[float | None]) -> list[float | None]:
    """Modified z-scores: z = 0.6745 (x - median) / median |x - median|.

    None for missing values, and for all if there are fewer than five.

    References
    ----------
    Iglewicz and Hoaglin, How to detect and handle outliers, 1993.
    """
    known = np.array(values, dtype=float)
    if np.isfinite(known).sum() < FEWEST:
        return [None] * len(values)
    away = known - np.nanmedian(known)
    with np.errstate(divide="ignore", invalid="ignore"):
        scores = 0.6745 * away / np.nanmedian(np.abs(away))
    scores = np.clip(np.where(away == 0, 0.0, scores), -LARGEST, LARGEST)
    return [None if np.isnan(score) else float(score) for score in scores]


def overview_html(rows: Sequence[Row], output: Path | None) -> str:
    """The page of a fleet as text: one row per session; self-contained, without a script.

    `output`: folder of the page; sessions with results in it are linked. None: nothing is linked.
    """
    # Imported late: workers import this module but write no page.
    from jinja2 import StrictUndefined, Template

    text = (files("dlo_casadi.fleet") / "templates" / "overview.html").read_text("utf-8")
    page = Template(text, trim_blocks=True, autoescape=True, undefined=StrictUndefined)
    judged = judge(rows)
    verdicts = Counter(item.verdict for item in judged)
    counts = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in verdicts.most_common())
    odd = sum(bool(item.reasons) for item in judged)
    return page.render(
        title=counted(len(rows), "session"),
        summary=f"{counts or 'nothing is finished yet'}. {odd} to look at first.",
        judged=[(item, None if output is None else _link(item.row, output)) for item in judged],
        outlying=OUTLYING,
        version=__version__,
    )


def _link(row: Row, output: Path) -> str | None:
    """Link to the page of the session's results, or of its failure."""
    for name in ("report.html", "report.json") if row["status"] == "done" else ("failed.html",):
        if (output / "sessions" / row["session"] / name).is_file():
            return quote(f"sessions/{row['session']}/{name}")
    return None
