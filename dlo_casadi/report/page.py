"""Write report.html and failed.html: one self-contained page for the person at the bench."""

import base64
import hashlib
import inspect
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from dlo_casadi.cable.estimate import Estimate
from dlo_casadi.config import Config
from dlo_casadi.effects import EFFECTS
from dlo_casadi.errors import DloError, counted
from dlo_casadi.report import tables, words
from dlo_casadi.report.canvas import inline_svg
from dlo_casadi.report.figures import figures_of
from dlo_casadi.report.page_pictures import pictures, pose_pictures, scene_pictures, view_pictures
from dlo_casadi.report.scene import VIEWS
from dlo_casadi.report.words import compared
from dlo_casadi.session.outcome import Outcome, PoseInput
from dlo_casadi.show import text
from dlo_casadi.show.text import millimetres
from dlo_casadi.thresholds import NORMAL_95

# Text that marks a page as written by this package.
GENERATOR = '<meta name="generator" content="dlo_casadi">'
# Text for a missing number.
NOTHING = "–"


# ---- of a run ----------------------------------------------------------------------------------


def report_page(outcome: Outcome, drawn: Mapping[str, Figure] | None = None) -> str:
    """The text of report.html.

    All text of the session is escaped. The page's own policy forbids it to load anything, and to
    run any script other than its own, which are known by their hashes. `drawn`: the `figures_of`
    the outcome, if they have been drawn already.
    """
    shown = pictures(outcome)
    charts = figures_of(outcome) if drawn is None else drawn
    return _render(
        "report.html",
        outcome.config,
        pictures=shown,
        photographs=view_pictures(outcome.poses, compared(outcome)),
        room=shown[0].behind.room,
        clips=bool(outcome.config.experiment.clips),
        obstacles=any(mark.kind == "obstacle" for item in shown for mark in item.under),
        forces_read=any(mark.kind == "force-read" for item in shown for mark in item.over),
        scenes=scene_pictures(outcome),
        charts={name: Markup(inline_svg(chart, name)) for name, chart in charts.items()},
        outcome=outcome,
        **page_data(outcome),
    )


def page_data(outcome: Outcome) -> dict[str, Any]:
    """Data for the template of a run, besides pictures, charts and the outcome itself."""
    found = words.conclusion_of(outcome)
    labels = {item.kind: item.label for item in compared(outcome)}
    return {
        "verdict": outcome.verdict or "off",
        "verdict_word": words.sentence(found.word),
        "sentence": found.sentence,
        "details": [line.strip() for line in words.details(outcome)],
        "before": labels.get("before"),
        "after": labels.get("after"),
        "tiles": tiles(outcome),
        "candidates": candidate_rows(outcome),
        "parameters": parameter_rows(outcome),
    }


def tiles(outcome: Outcome) -> list[tuple[str, str, str]]:
    """The numbers that most readers look for: name, value, remark."""
    rows, m, shown = [], outcome.measurement, compared(outcome)
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


# ---- of a run that has failed ------------------------------------------------------------------


def failure_page(config: Config, error: DloError, poses: Sequence[PoseInput] = ()) -> str:
    """The text of failed.html: configuration, error, and the poses that were read."""
    known = {pose.name: pose for pose in poses}
    shown = [
        known.get(pose.name, PoseInput.unread(config, pose)) for pose in config.experiment.poses
    ]
    heading, _, rest = error.message.partition("\n")
    return _render(
        "failed.html",
        config,
        kind=type(error).__name__,
        heading=words.sentence(heading),
        rest=rest,
        hints=hints([error.message, *(pose.problem for pose in shown)]),
        read=sum(pose.readable for pose in shown),
        reached=bool(poses),
        skipped=[item for item in config.skipped if item.name not in {x.name for x in shown}],
        pictures=pose_pictures(config, shown),
        photographs=view_pictures(shown),
    )


def hints(messages: Sequence[str]) -> list[str]:
    """The advice in messages (their "Try: ..."), without duplicates."""
    found = [hint for text in messages for hint in re.findall(r"Try: (.+)", text)]
    return list(dict.fromkeys(hint[:1].upper() + hint[1:] for hint in found))


# ---- of both -----------------------------------------------------------------------------------


def _render(template: str, config: Config, **data: Any) -> str:
    """Fill a file of `templates/` with data."""
    page = _environment().get_template(template)
    in_space = config.experiment.in_space
    names = ["page", *["room"] * in_space]  # pictures in space are rooms that can be rotated
    scripts = [_text(f"{name}.js") for name in names]
    hashes = [base64.b64encode(hashlib.sha256(x.encode()).digest()).decode() for x in scripts]
    return page.render(
        generator=Markup(GENERATOR),
        style=Markup("\n".join(_text(f"{name}.css") for name in names)),
        views=VIEWS if in_space else None,
        scripts=[Markup(script) for script in scripts],
        policy=" ".join(f"'sha256-{script}'" for script in hashes),
        title=config.cable.name,
        config_name=config.name,
        photographed=config.experiment.measurement.kind == "images",
        configuration=configuration_text(config),
        **data,
    )


def configuration_text(config: Config) -> str:
    """Text of the configuration's file; without a file the text that it would have."""
    try:
        return config.text
    except OSError as error:
        return f"# {Path(error.filename).name} cannot be read any more: {error.strerror}"


def units(text: str) -> str:
    """Typeset units: N m^2 becomes N m² and is not broken across lines."""
    text = text.replace(">=", "≥").replace("<=", "≤")
    return text.replace(" N m^2", "\u00a0N\u00a0m^2").replace("^2", "²").replace("^3", "³")


def breakable(name: str) -> Markup:
    """A name in code that may be broken after its underscores and dots."""
    return Markup(re.sub(r"([_.])", r"\1<wbr>", str(escape(name))))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("dlo_casadi.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"words": words, "tables": tables}
    for item in (units, breakable, counted, words.sentence, millimetres, text.vector):
        environment.filters[item.__name__] = item
    return environment


def _text(name: str) -> str:
    return files("dlo_casadi.report").joinpath("templates", name).read_text("utf-8").strip()
