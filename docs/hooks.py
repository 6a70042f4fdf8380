"""Hooks of MkDocs: equations become MathML, and the schema of a configuration lists."""

import html
import json
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

SCHEMA = json.loads((Path(__file__).parents[1] / "configs/schema.json").read_text())
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_PLAIN = {ord(c): f"&#{ord(c)};" for c in "[]|_*"} | {ord("\n"): " "}  # no Markdown
_KEYS = re.compile(r"^<!-- keys of (\w+) -->$", re.MULTILINE)


def on_page_markdown(text: str, **_: object) -> str:
    """Replace `<!-- keys of Cable -->` by a list of that section's keys."""
    return _KEYS.sub(lambda found: _list(SCHEMA["$defs"][found[1]]), text)


def on_page_content(content: str, **_: object) -> str:
    r"""Replace \(...\) in a line and \[...\] on its own, as `pymdownx.arithmatex` marks them."""
    return _EQUATION.sub(_as_mathml, content)


def _list(section: dict[str, Any]) -> str:
    entries = []
    for key, told in section["properties"].items():
        default = told.get("default")
        note = "required" if key in section.get("required", ()) else ""
        if default not in (None, [], {}) and "$ref" not in json.dumps(told):
            note = f"default {json.dumps(default)}"
        meaning = html.escape(told["description"]).translate(_PLAIN)
        entries.append(f"`{key}`{note and f' ({note.translate(_PLAIN)})'}\n:   {meaning}\n")
    return "\n".join(entries)


def _as_mathml(found: re.Match[str]) -> str:
    kind, latex = found.groups()
    if kind == "span":
        return convert(html.unescape(latex))
    return f'<div class="equation">{convert(html.unescape(latex), display="block")}</div>'
