"""The page for those who carry on names rooms, files, scripts and commits that exist."""

import re
from pathlib import Path

import pytest
from test_layers import MAY_IMPORT

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs/pages/develop.md").read_text()
ROOMS = {room for room in MAY_IMPORT if (ROOT / "dlo_casadi" / room).is_dir()}
# What is in no way from YAML to report: how processes run, how text is drawn, many sessions.
ASIDE = {"runtime", "fleet", "show", "io", "paper"}


def test_every_room_is_in_the_picture():
    picture = TEXT.split("```text")[1].split("```")[0]
    missing = [room for room in ROOMS - ASIDE if not re.search(rf"\b{room}\b", picture)]
    assert missing == []


@pytest.mark.parametrize(
    "name", sorted(set(re.findall(r"`([\w./*-]+\.(?:py|in|md|cff|toml|html))`", TEXT)))
)
def test_a_named_file_is_there(name):
    """At its path from the top, from the package, or, without a folder, anywhere in the package."""
    package = ROOT / "dlo_casadi"
    found = [path for folder in (ROOT, package, ROOT / "scripts") for path in folder.glob(name)]
    assert found or ("/" not in name and list(package.rglob(name))), name


def test_the_way_from_a_file_to_a_report_has_a_file_at_each_step():
    table = TEXT.split("## From YAML to report")[1].split("is this table as code")[0]
    steps = [line.split("|")[2] for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(steps) >= 12
    assert all(".py`" in step for step in steps)


def test_every_script_that_judges_results_is_named():
    scripts = {path.name for path in (ROOT / "scripts").glob("check_*.py")}
    told = TEXT.split("## Did it get worse?")[1].split("## How to release")[0]
    other = (ROOT / "docs/pages/checks.md").read_text()
    assert [name for name in scripts if name not in told and name not in other] == []
    assert all(name in scripts | {"benchmark.py"} for name in re.findall(r"`(\w+\.py)", told))
