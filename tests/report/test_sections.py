"""Page, terminal and report.json follow one list of sections; sentences follow their rules."""

import re
from collections import Counter
from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console
from small_sessions import BARE
from test_figures import LOAD
from test_page import PROPOSAL

from dlo_casadi.errors import worded
from dlo_casadi.report import sections
from dlo_casadi.report.page import report_page
from dlo_casadi.report.sections import SECTIONS, Section, print_summary, report_dict


def test_every_key_of_the_report_is_of_one_section(outcome):
    keys = Counter(key for section in SECTIONS for key in section.data(outcome))
    assert max(keys.values()) == 1
    assert report_dict(outcome).keys() == {"schema", *keys}


def test_a_section_is_on_the_page_where_it_applies(outcome):
    """In the contents and as a section; those without a title stand above the contents."""
    found = replace(outcome, unexplained=LOAD, next_pose=PROPOSAL, verdict="unexplained")
    shown = []
    for run in (outcome, found):
        page = report_page(run, BARE)
        contents = re.findall(r'<li><a href="#(\w+)">([^<]+)</a></li>', page)
        own = [section for section in SECTIONS if section.applies(run) and section.title(run)]
        assert contents == [(section.name, section.title(run)) for section in own]
        assert re.findall(r'<h2 id="(\w+)"', page.split("<main")[1]) == [
            name for name, _ in contents
        ]
        shown.append({name for name, _ in contents})
    assert shown[1] - shown[0] == {"pull", "next"}


def test_all_that_sections_say_on_the_terminal_is_printed(outcome, monkeypatch):
    """A section with lines that has no place there would be lost."""
    nothing = Section("none").terminal
    own = [
        replace(one, applies=lambda _: True, terminal=lambda _, name=one.name: [f"of {name}"])
        for one in SECTIONS
        if one.terminal is not nothing
    ]
    assert {"verdict", "errors", "limits"} <= {section.name for section in own}
    monkeypatch.setattr(sections, "SECTIONS", own)
    console = Console(file=StringIO())
    print_summary(console, outcome)
    assert all(f"of {section.name}\n" in console.file.getvalue() for section in own)


@pytest.mark.parametrize(
    ("template", "value", "text"),
    [
        ("{x:mm} off", 0.0012345, "1.23 mm off"),
        ("{x:mm.2g} off", 0.0012345, "1.2 mm off"),
        ("{x:mm} off", None, "- off"),
        ("{x:# fit pose}", 1, "1 fit pose"),
        ("{x:# fit pose}", 2, "2 fit poses"),
        ("in {x}", ["a", "b"], "in a, b"),
        ("in {x}", ("a",), "in a"),
        ("{x:.2g} N", 1.234, "1.2 N"),
        ("{x}", "{left as it is}", "{left as it is}"),
    ],
)
def test_units_and_plurals_have_one_rule(template, value, text):
    assert worded(template, x=value) == text
