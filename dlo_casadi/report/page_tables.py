"""Rows of the page's tables, beside those of `tables`."""

import inspect
from typing import Any

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.effects import EFFECTS
from dlo_casadi.report import tables, words
from dlo_casadi.session.outcome import Outcome
from dlo_casadi.show.text import millimetres
from dlo_casadi.thresholds import NORMAL_95

# Text for a missing number.
NOTHING = "–"


def tiles(outcome: Outcome) -> list[tuple[str, str, str]]:
    """The numbers that most readers look for: name, value, remark."""
    rows, m, shown = [], outcome.measurement, words.compared(outcome)
    if shown:
        after = shown[-1].stage
        stiffness = after.parameters.get("bending_stiffness")
        if stiffness is not None:
            value, interval, remark = tables.describe(
                stiffness, after.explains, words.seen(outcome)
            )
            rows.append(("bending stiffness", value, f"95 %: {interval}" if interval else remark))
        role, key = "held-out poses", "rmse_held_out"
        if after.rmse_held_out is None:
            role, key = "fit poses", "rmse_fit"
        was = [f"{x.label}: {millimetres(getattr(x.stage, key), NOTHING)}" for x in shown[:-1]]
        now = millimetres(getattr(after, key), NOTHING)
        if m.points:
            rows.append((f"error, {role}", now, "".join(was)))
        else:
            rows += [(*row, "RMS difference") for row in tables.error_rows(outcome)]
    if m.points:
        source = f"of the points, {m.std_source}"
        rows.append((words.NOISE_ALONE, millimetres(m.noise_distance), source))
    lost = f"; {len(m.held_out_missing)} held out were not measured" if m.held_out_missing else ""
    count = f"{m.poses_fit} + {m.poses_held_out}"
    return [*rows, ("poses", count, f"to fit + held out to check{lost}")]


def candidate_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """Candidates for a missing effect, as ranked, with those that could not be told apart."""
    largest = max([row.score for row in outcome.candidates], default=0.0)
    rows = []
    for row in outcome.candidates:
        status, said = words.finding_of(outcome, row)
        rows.append(
            {
                "name": row.name,
                "meaning": meaning(row.name),
                "score": words.score_text(row.score),
                "share": max(row.score, 0.0) / largest if largest > 0 else 0.0,
                "p_value": f"{row.p_value:.2g}",
                "validated": millimetres(row.rmse_cross_validated, NOTHING),
                "status": status,
                "said": said,
            }
        )
    return rows


def meaning(name: str) -> str:
    """Explain an effect in one line."""
    text = inspect.getdoc(EFFECTS[name]) or "" if name in EFFECTS else ""
    return text.partition("\n")[0].replace("`", "")


def parameter_rows(outcome: Outcome) -> list[dict[str, str]]:
    """Fitted parameters of the last stage with 95 % intervals, also undetermined ones."""
    keys = ("name", "value", "interval", "remark", "doubt")
    rows = []
    for name, value, interval, remark in tables.fitted_rows(outcome):
        found = outcome.stages[-1].parameters[name]
        doubt = "unknown" if found.identifiable is False else "bound" if found.at_bound else ""
        if outcome.stages[-1].explains is not False:
            interval = interval or symmetric_interval(found)
        rows.append((name, value, interval, remark, doubt))
    rows += [(*row, "") for row in tables.rest_rows(outcome)]
    return [dict(zip(keys, row, strict=True)) for row in rows]


def symmetric_interval(estimate: Estimate) -> str:
    """A 95 % interval from the standard deviation, for parameters without a profile."""
    if estimate.identifiable is False or not estimate.std > 0:
        return ""
    low, high = (estimate.value + sign * NORMAL_95 * estimate.std for sign in (-1, 1))
    return f"{low:.4g} to {high:.4g} {estimate.unit}".rstrip()
