"""What is public is in one list, docs/pages/stability.md; versions and dates agree everywhere."""

import re
from difflib import ndiff
from pathlib import Path

import list_public
import pytest
import yaml

import dlo_casadi as dlo

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def page():
    return list_public.page()


def test_the_list_of_what_is_stable_is_that_of_the_code(page):
    found, told = page.splitlines(), list_public.PAGE.read_text().splitlines()
    changes = [line for line in ndiff(told, found) if line[:2] in ("- ", "+ ")]
    assert not changes, (
        "new lines (+): write the list, `python scripts/list_public.py`.\n"
        "Lines that are gone (-): see `How a change is announced` in docs/pages/stability.md.\n"
        + "\n".join(changes)
    )


def test_the_list_has_every_kind_of_entry(page):
    parts = dict(re.findall(r"^### (\S+)[^\n]*\n\n```text\n(.*?)^```", page, re.M | re.S))
    for part, entry in {
        "Python:": "fit(",
        "Effects:": "lumped_mass: mass, position",
        "Effects": "PointLoad(label",
        "Keys": "Experiment: gravity, boundary",
        "Schemas": "dlo-report/1",
        "Commands": "dlo predict PARAMETERS, --end",
        "C,": "dlo_status dlo_solve(const dlo_pose *pose",
    }.items():
        assert entry in parts[part], part
    assert all(name in parts["Python:"] for name in dlo.__all__)


def test_the_latest_release_of_the_changelog_is_this_version():
    heads = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    released = [head for head in heads if head != "Unreleased"]
    assert heads[:1] in (released[:1], ["Unreleased"])
    version, date = re.fullmatch(r"(\d+\.\d+\.\d+) \((\d{4}-\d\d-\d\d)\)", released[0]).groups()
    cited = yaml.safe_load((ROOT / ".github/CITATION.cff").read_text())
    assert version == dlo.__version__ == cited["version"]
    assert date == str(cited["date-released"])
