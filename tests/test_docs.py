"""The documentation: all that is public has its place in it."""

import re
from pathlib import Path

import dlo_casadi

PAGES = Path(__file__).parents[1] / "docs/pages"


def test_every_public_name_has_its_entry():
    entries = "\n".join(page.read_text() for page in (PAGES / "api").glob("*.md"))
    objects = set(re.findall(r"^::: (\S+)$", entries, re.MULTILINE))
    for name in dlo_casadi.__all__:
        public = getattr(dlo_casadi, name)
        home = getattr(public, "__module__", None)
        assert home is None or {f"{home}.{name}", home} & objects, f"::: {home}.{name}"
