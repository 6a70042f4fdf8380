"""What the page says in words and tables: pure functions of an outcome."""

from __future__ import annotations

import inspect
from typing import Any

from dlo_casadi.config import Config
from dlo_casadi.diagnosis.next_pose import NextPose
from dlo_casadi.effects import EFFECTS
from dlo_casadi.errors import counted
from dlo_casadi.report.canvas import NOISE_ALONE, before_after, label_of, millimetres
from dlo_casadi.report.json_report import all_warnings
from dlo_casadi.report.text_findings import (
    CANDIDATE_ORDER,
    finding_of,
    p_value_note,
    reading_text,
    separation_text,
    stage_rows,
    timing_rows,
    verdict_lines,
)
from dlo_casadi.report.text_parameters import (
    describe,
    fixed_rows,
    footnotes,
    nuisance_rows,
    rest_rows,
)
from dlo_casadi.session.outcome import Outcome, ParameterEstimate
from dlo_casadi.thresholds import NORMAL_95

# Where a number does not exist.
NOTHING = "–"
VERDICT_WORDS = {
    "complete": "Complete",
    "effect_found": "Effect found",
    "unexplained": "Unexplained",
}


def page_data(outcome: Outcome) -> dict[str, Any]:
    """Everything that the template writes, but for pictures and charts."""
    said = [line.strip() for line in verdict_lines(outcome)]
    before, after = before_after(outcome)
    m = outcome.measurement
    return {
        "title": outcome.config.cable.name,
        "config_name": outcome.config.name,
        "verdict": outcome.verdict or "off",
        "verdict_word": verdict_word(outcome),
        "sentence": sentence(said[0]),
        "details": said[1:],
        "tiles": tiles(outcome),
        "warnings": all_warnings(outcome),
        "before": None if before is None else label_of(before, outcome),
        "after": None if after is None else label_of(after, outcome),
        "last": label_of(outcome.stages[-1], outcome),
        "stages": stage_rows(outcome, NOTHING),
        "noise": millimetres(m.std),
        "noise_alone": NOISE_ALONE,
        "noise_distance": millimetres(m.noise_distance),
        "noise_source": m.std_source,
        "correlation": millimetres(m.correlation_length) if m.correlation_length > 0 else None,
        "candidates": candidate_rows(outcome),
        "candidate_order": CANDIDATE_ORDER,
        "p_value_note": p_value_note(outcome),
        "parameters": parameter_rows(outcome),
        "nuisances": nuisance_rows(outcome),
        "fixed": fixed_rows(outcome),
        "footnotes": footnotes(outcome),
        "photographed": m.kind == "images",
        "next_pose": outcome.next_pose,
        "next_pose_said": outcome.next_pose and _said_of(outcome.next_pose),
        "unexplained": outcome.unexplained,
        "timing": timing_rows(outcome),
        "mesh": f"{counted(outcome.discretization.n, outcome.discretization.element)}, "
        f"mesh error {millimetres(outcome.discretization.error)}",
        "versions": outcome.versions,
        "configuration": configuration_text(outcome.config),
    }


def _said_of(proposal: NextPose) -> str:
    """What a pose that is proposed would tell: by its shape, and by a reading."""
    return f"{sentence(separation_text(proposal))} {reading_text(proposal.reading)}"


def sentence(line: str) -> str:
    """A line of the terminal as a sentence of its own."""
    text = line.removeprefix("Verdict: ")
    for word in ("unexplained. ", "complete. ", "the fit has failed. "):
        text = text.removeprefix(word)
    return text[:1].upper() + text[1:]


def verdict_word(outcome: Outcome) -> str:
    """The verdict in one or two words."""
    if outcome.fit.failed:
        return "Fit failed"
    if outcome.verdict is None:
        return "Not diagnosed"
    return VERDICT_WORDS[outcome.verdict]


def tiles(outcome: Outcome) -> list[tuple[str, str, str]]:
    """The numbers that most readers come for: name, value, remark."""
    before, after = before_after(outcome)
    m = outcome.measurement
    rows = []
    if after is not None:
        stiffness = after.parameters.get("bending_stiffness")
        if stiffness is not None:
            value, interval, remark = describe(stiffness)
            known = f"95 %: {interval}" if interval else remark
            rows.append(("bending stiffness", value, known))
        role = "held-out poses" if after.rmse_held_out is not None else "fit poses"
        now = after.rmse_held_out if after.rmse_held_out is not None else after.rmse_fit
        was = None
        if before is not None:
            was = before.rmse_held_out if after.rmse_held_out is not None else before.rmse_fit
        said = "" if was is None or before is None else f"{label_of(before, outcome)}: "
        rows.append((f"error, {role}", _mm(now), f"{said}{_mm(was)}" if said else ""))
    rows.append((NOISE_ALONE, millimetres(m.noise_distance), f"of the points, {m.std_source}"))
    lost = f"; {len(m.held_out_missing)} held out were not measured" if m.held_out_missing else ""
    said = f"to fit + held out to check{lost}"
    rows.append(("poses", f"{m.poses_fit} + {m.poses_held_out}", said))
    return rows


def candidate_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """Candidates for a missing effect, as ranked, with what could not be told apart."""
    largest = max([row.score for row in outcome.candidates], default=0.0)
    rows = []
    for row in outcome.candidates:
        name, score = row.name, row.score
        status, said = finding_of(outcome, row)
        rows.append(
            {
                "name": name,
                "meaning": meaning(name),
                "score": f"{score:,.0f}" if score >= 100 else f"{score:.2g}",
                "share": max(score, 0.0) / largest if largest > 0 else 0.0,
                "p_value": f"{row.p_value:.2g}",
                "validated": _mm(row.rmse_cross_validated),
                "status": status,
                "said": said,
            }
        )
    return rows


def meaning(name: str) -> str:
    """What an effect is, in a line."""
    known = EFFECTS.get(name)
    text = inspect.getdoc(known) or "" if known is not None else ""
    return text.partition("\n")[0].replace("`", "")


def parameter_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """Fitted parameters of the last stage with 95 % intervals, and what the data cannot tell."""
    rows = []
    for name, estimate in outcome.stages[-1].parameters.items():
        value, interval, remark = describe(estimate)
        doubt = (
            "unknown" if estimate.identifiable is False else "bound" if estimate.at_bound else ""
        )
        rows.append(
            {
                "name": name,
                "value": value,
                "interval": interval or symmetric_interval(estimate),
                "remark": remark,
                "doubt": doubt,
            }
        )
    for name, value, _, remark in rest_rows(outcome):
        rows.append({"name": name, "value": value, "interval": "", "remark": remark, "doubt": ""})
    return rows


def symmetric_interval(estimate: ParameterEstimate) -> str:
    """A 95 % interval from the standard deviation, where no profile was computed."""
    if estimate.identifiable is False or not estimate.std > 0:
        return ""
    unit = f" {estimate.unit}" if estimate.unit else ""
    low = estimate.value - NORMAL_95 * estimate.std
    high = estimate.value + NORMAL_95 * estimate.std
    return f"{low:.4g} to {high:.4g}{unit}"


def configuration_text(config: Config) -> str:
    """The configuration as it stands in its file."""
    try:
        return config.path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        return f"# {config.path.name} cannot be read any more: {error.strerror}"


def _mm(value: float | None) -> str:
    return NOTHING if value is None else millimetres(value)
