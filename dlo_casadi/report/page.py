"""Write report.html and failed.html: one self-contained page for the person at the bench."""

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.config import Config
from dlo_casadi.errors import DloError, counted
from dlo_casadi.report import findings, tables, words
from dlo_casadi.report.page_pictures import pose_pictures, view_pictures
from dlo_casadi.report.scene import VIEWS
from dlo_casadi.report.sections import SECTIONS, Report
from dlo_casadi.session.outcome import Outcome, PoseInput
from dlo_casadi.show import text
from dlo_casadi.show.text import millimetres

# Text that marks a page as written by this package.
GENERATOR = '<meta name="generator" content="dlo_casadi">'


# ---- of a run ----------------------------------------------------------------------------------


def report_page(outcome: Outcome, drawn: Mapping[str, Figure] | None = None) -> str:
    """The text of report.html.

    All text of the session is escaped. The page's own policy forbids it to load anything, and to
    run any script other than its own, which are known by their hashes. `drawn`: the `figures_of`
    the outcome, if they have been drawn already.
    """
    config, report = outcome.config, Report(outcome, drawn)
    shared = report.shared | _of_config(config)
    parts = [
        (section, section.title(outcome), Markup(_filled(section.template, shared | more)))
        for section in SECTIONS
        if section.applies(outcome)
        for more in (section.context(outcome),)
    ]
    return _render("report.html", config, parts=parts, outcome=outcome)


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


# ---- of a cable that is watched ----------------------------------------------------------------

# Poses in the table of the page.
_LISTED = 20


def watched_page(
    cable: FittedCable, source: Path, total: int, rows: Sequence[tuple[str, float, bool, str]]
) -> str:
    """The text of watch.html, which a browser loads again every two seconds.

    `rows`: of the last poses the name, the distance [m] from the prediction, whether it was
    refused, and what it told.
    """
    highest = max((rms for _, rms, *_ in rows), default=0.0)
    changed = [said for *_, said in rows if "changed since" in said]
    return _filled(
        "watch.html",
        {
            "generator": Markup(GENERATOR),
            "style": Markup(_text("page.css")),
            "cable": cable.name,
            "state": "it has changed" if changed else "as it was fitted",
            "change": changed[-1] if changed else "",
            "source": source.name,
            "total": total,
            "parameters": [(k, str(x)) for k, x in cable.params.items() if not x.fixed],
            "bars": [(rms / (highest or 1.0), refused) for _, rms, refused, _ in rows],
            "highest": highest,
            "lines": [(name, said) for name, *_, said in rows][: -_LISTED - 1 : -1],
        },
    )


# ---- of both -----------------------------------------------------------------------------------


def _render(template: str, config: Config, **data: Any) -> str:
    """Fill a page of `templates/` with data."""
    # Pictures in space are rooms that can be rotated.
    names = ["page", *["room"] * config.experiment.in_space]
    scripts = [_text(f"{name}.js") for name in names]
    hashes = [base64.b64encode(hashlib.sha256(x.encode()).digest()).decode() for x in scripts]
    page = {
        "generator": Markup(GENERATOR),
        "style": Markup("\n".join(_text(f"{name}.css") for name in names)),
        "scripts": [Markup(script) for script in scripts],
        "policy": " ".join(f"'sha256-{script}'" for script in hashes),
        "title": config.cable.name,
    }
    return _filled(template, page | _of_config(config) | data)


def _of_config(config: Config) -> dict[str, Any]:
    """Data of the configuration for any template."""
    return {
        "views": VIEWS if config.experiment.in_space else None,
        "config_name": config.name,
        "photographed": config.experiment.measurement.kind == "images",
        "configuration": configuration_text(config),
    }


def _filled(template: str, data: Mapping[str, Any]) -> str:
    return _environment().get_template(template).render(data)


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
    environment.globals |= {"words": words, "findings": findings, "tables": tables}
    for item in (units, breakable, counted, words.sentence, millimetres, text.vector):
        environment.filters[item.__name__] = item
    return environment


def _text(name: str) -> str:
    return files("dlo_casadi.report").joinpath("templates", name).read_text("utf-8").strip()
