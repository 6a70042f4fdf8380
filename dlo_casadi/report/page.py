"""report.html: one page for the person at the bench, in one file that asks for nothing else."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from dlo_casadi.errors import counted
from dlo_casadi.report.page_data import page_data
from dlo_casadi.report.page_pictures import pictures, scene_pictures
from dlo_casadi.report.page_views import view_pictures_of
from dlo_casadi.report.room import VIEWS
from dlo_casadi.report.text_parameters import vector
from dlo_casadi.session.outcome import Outcome

# By which a page is known as written by this package.
GENERATOR = '<meta name="generator" content="dlo_casadi">'


def report_page(outcome: Outcome) -> str:
    """The text of report.html.

    All text of the session is escaped. The page's own policy forbids it to load anything, and to
    run any script but those that are written into it, known by their hashes.
    """
    # Bokeh takes half a second to load: only who draws a page waits for it.
    from dlo_casadi.report.page_charts import charts

    drawn = pictures(outcome)
    return render(
        "report.html",
        [_script_library(), page_script()],
        outcome.config.experiment.in_space,
        pictures=drawn,
        photographs=view_pictures_of(outcome),
        room=drawn[0].room,
        forces_read=any(mark.kind == "force-read" for item in drawn for mark in item.over),
        scenes=scene_pictures(outcome),
        charts={name: as_data(text) for name, text in charts(outcome).items()},
        **page_data(outcome),
    )


def render(template: str, scripts: list[str], in_space: bool, **data: Any) -> str:
    """Fill a template with data.

    Parameters
    ----------
    template : str
        Name of a file in `templates/`.
    scripts : list of str
        Those that the page may run.
    in_space : bool
        Whether its pictures are rooms that can be turned.
    """
    page = _environment().get_template(template)
    style = _text("page.css")
    if in_space:
        scripts, style = [*scripts, _text("room.js")], f"{style}\n{_text('room.css')}"
    return page.render(
        generator=Markup(GENERATOR),
        style=Markup(style),
        views=VIEWS if in_space else None,
        scripts=[Markup(script) for script in scripts],
        policy=" ".join(f"'sha256-{_hash(script)}'" for script in scripts) or "'none'",
        **data,
    )


def units(text: str) -> str:
    """Units as they are printed: N m^2 becomes N m², and is not broken."""
    text = text.replace(">=", "≥").replace("<=", "≤")
    return text.replace(" N m^2", "\u00a0N\u00a0m^2").replace("^2", "²").replace("^3", "³")


def breakable(name: str) -> Markup:
    """A name in code that may be broken after its underscores and dots."""
    return Markup(re.sub(r"([_.])", r"\1<wbr>", str(escape(name))))


def page_script() -> str:
    """The page's own script."""
    return _text("page.js")


def as_data(text: str) -> Markup:
    """JSON that may stand in a script element: nothing in it can end the element."""
    escaped = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"}
    for sign, code in escaped.items():
        text = text.replace(sign, code)
    return Markup(text)


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


@cache
def _script_library() -> str:
    """Bokeh's own script, without its widgets and tables."""
    from bokeh.resources import INLINE

    script = INLINE.clone(components=["bokeh"]).js_raw[0]
    assert "</script" not in script
    return script.strip()


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
