"""results/paper/: one page that needs nothing else, its numbers as JSON, its figures as files."""

from __future__ import annotations

import base64
import json
import platform
from collections.abc import Iterable
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from dlo_casadi import __version__
from dlo_casadi.io.files import make_folder, write_file
from paper.content import Part

SCHEMA = "dlo-paper/1"


def write(folder: Path, parts: Iterable[Part], order: Iterable[str]) -> dict[str, Any]:
    """Write the results; parts that did not run this time are kept from earlier ones.

    Returns
    -------
    dict
        What is in paper.json.
    """
    make_folder(folder / "figures")
    kept = earlier(folder / "paper.json")
    for part in parts:
        plain = asdict(part)
        plain["versions"] = {"dlo-casadi": __version__, "python": platform.python_version()}
        for section in plain["sections"]:
            for picture in section["pictures"]:
                name = f"{picture['name']}.svg"
                write_file(folder / "figures" / name, picture.pop("svg"))
        kept[part.name] = plain
    found = {name: kept[name] for name in order if name in kept}
    result = {"schema": SCHEMA, "parts": found}
    write_file(folder / "paper.json", json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    write_file(folder / "index.html", page(folder, list(found.values())))
    return result


def earlier(path: Path) -> dict[str, Any]:
    """Parts of an earlier run."""
    if not path.exists():
        return {}
    result = json.loads(path.read_text())
    return dict(result["parts"]) if result.get("schema") == SCHEMA else {}


def page(folder: Path, parts: list[dict[str, Any]]) -> str:
    """Text of index.html; all text is escaped, all pictures are in the page."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style = files("dlo_casadi.report").joinpath("templates/page.css").read_text()

    def picture(name: str) -> str:
        text = (folder / "figures" / f"{name}.svg").read_bytes()
        return "data:image/svg+xml;base64," + base64.b64encode(text).decode()

    return environment.get_template("page.html").render(
        style=Markup(style),
        parts=parts,
        sections=[section for part in parts for section in part["sections"]],
        claims=[claim for part in parts for claim in part["claims"]],
        targets=[target for part in parts for target in part["targets"]],
        picture=picture,
    )
