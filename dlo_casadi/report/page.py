"""report.html: one page for the person at the bench, in one file that asks for nothing else."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from dlo_casadi.errors import counted
from dlo_casadi.report.canvas import compared, inline_svg
from dlo_casadi.report.figures import figures_of
from dlo_casadi.report.page_data import page_data
from dlo_casadi.report.page_pictures import pictures, scene_pictures
from dlo_casadi.report.page_views import view_pictures
from dlo_casadi.report.room import VIEWS
from dlo_casadi.report.text_parameters import vector
from dlo_casadi.session.outcome import Outcome

# By which a page is known as written by this package.
GENERATOR = '<meta name="generator" content="dlo_casadi">'


def report_page(outcome: Outcome, drawn: Mapping[str, Figure] | None = None) -> str:
    """The text of report.html.

    All text of the session is escaped. The page's own policy forbids it to load anything, and to
    run any script but those that are written into it, known by their hashes.

    Parameters
    ----------
    drawn : mapping of str to Figure, optional
        The `figures_of` the outcome, if they have been drawn already.
    """
    shown = pictures(outcome)
    charts = figures_of(outcome) if drawn is None else drawn
    return render(
        "report.html",
        outcome.config.experiment.in_space,
        pictures=shown,
        photographs=view_pictures(outcome.poses, compared(outcome)),
        room=shown[0].behind.room,
        forces_read=any(mark.kind == "force-read" for item in shown for mark in item.over),
        scenes=scene_pictures(outcome),
        charts={name: Markup(inline_svg(chart, name)) for name, chart in charts.items()},
        **page_data(outcome),
    )


def render(template: str, in_space: bool, **data: Any) -> str:
    """Fill a template with data.

    Parameters
    ----------
    template : str
        Name of a file in `templates/`.
    in_space : bool
        Whether its pictures are rooms that can be turned.
    """
    page = _environment().get_template(template)
    names = ["page", *["room"] * in_space]
    scripts = [_text(f"{name}.js") for name in names]
    return page.render(
        generator=Markup(GENERATOR),
        style=Markup("\n".join(_text(f"{name}.css") for name in names)),
        views=VIEWS if in_space else None,
        scripts=[Markup(script) for script in scripts],
        policy=" ".join(f"'sha256-{_hash(script)}'" for script in scripts),
        **data,
    )


def units(text: str) -> str:
    """Units as they are printed: N m^2 becomes N m², and is not broken."""
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
    environment.filters |= {
        "units": units,
        "breakable": breakable,
        "vector": vector,
        "counted": counted,
    }
    return environment


def _text(name: str) -> str:
    environment = _environment()
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0].strip()


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
