"""Numbers of things in messages, in reports and on the command line: of one there is no plural."""

import ast
import re
from pathlib import Path

import pytest
from rich.console import Console

from dlo_casadi.cli.common import Counter
from dlo_casadi.errors import counted
from dlo_casadi.fleet.rows import overview_html
from dlo_casadi.paper.algorithm1 import Algorithm1Status, _message
from dlo_casadi.runtime.parallel import Tally

PACKAGE = Path(__file__).parents[1] / "dlo_casadi"
THINGS = (
    r"^ ((?!and |of )[a-z-]+ )?(iterations|poses|points|photographs|sessions|warnings|elements"
    r"|markers|lines|numbers|bytes|pixels|places|obstacles|distances)\b"
)


def bare_counts(text: str) -> list[str]:
    """Numbers before a plural in f-strings, but constants of the module and measured ones."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.JoinedStr):
            continue
        for value, after in zip(node.values, node.values[1:], strict=False):
            told = isinstance(value, ast.FormattedValue) and isinstance(after, ast.Constant)
            if told and re.match(THINGS, after.value) and value.format_spec is None:
                name = ast.unparse(value.value)
                if not name.split("[")[0].strip("_").isupper():
                    found.append(f"{{{name}}}{after.value}")
    return found


@pytest.mark.parametrize(("number", "text"), [(0, "0 poses"), (1, "1 pose"), (2, "2 poses")])
def test_one_is_one(number, text):
    assert counted(number, "pose") == text


def test_what_can_be_one_is_said_so(tmp_path):
    assert "After 1 iteration (" in _message(Algorithm1Status.CONVERGED, [1.0, 2.0], 0.1, 1, 1)
    assert "of 1 pose did" in _message(Algorithm1Status.CONVERGED, [1.0, 2.0], 0.1, 1, 1)
    assert "<title>0 sessions</title>" in overview_html([], tmp_path)
    counter = Counter(Console(), noun="pose")
    assert counter._text(Tally(1, 0, 1, 0.0, None)) == "1 of 1 pose"
    assert counter._text(Tally(1200, 0, 2400, 0.0, None)) == "1 200 of 2 400 poses"


@pytest.mark.parametrize(("done", "text"), [(0, "60"), (1, "70"), (4, "95")])
def test_a_continued_run_counts_what_an_earlier_one_has_finished(done, text):
    """Of ten tasks six are finished, and the last one has five poses."""
    counter = Counter(Console(), noun="pose", size=10, count=95)
    assert counter._text(Tally(done, 0, 4, 0.0, None)) == f"{text} of 95 poses"


def test_no_message_counts_without_it():
    """`{n} poses` reads "1 poses" one day; a share of several is `{k} of {counted(n, ...)}`."""
    found = [
        f"{file.relative_to(PACKAGE)}: {text}"
        for file in sorted(PACKAGE.rglob("*.py"))
        for text in bare_counts(file.read_text())
    ]
    assert found == []
