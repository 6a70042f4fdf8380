"""Hook of MkDocs: equations become MathML while the site is built, so that pages need no script."""

import html
import re

from latex2mathml.converter import convert

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: object) -> str:
    r"""Replace \(...\) in a line and \[...\] on its own, as `pymdownx.arithmatex` marks them."""
    return _EQUATION.sub(_as_mathml, content)


def _as_mathml(found: re.Match[str]) -> str:
    kind, latex = found.groups()
    if kind == "span":
        return convert(html.unescape(latex))
    return f'<div class="equation">{convert(html.unescape(latex), display="block")}</div>'
