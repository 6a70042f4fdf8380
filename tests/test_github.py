"""What GitHub reads under .github/ is well formed and names files that exist."""

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
GITHUB = ROOT / ".github"
FORMS = sorted(
    set((GITHUB / "ISSUE_TEMPLATE").glob("*.yml")) - {GITHUB / "ISSUE_TEMPLATE/config.yml"}
)


def read(path):
    return yaml.safe_load(path.read_text())


@pytest.mark.parametrize("form", FORMS, ids=lambda path: path.stem)
def test_a_form_has_what_github_requires(form):
    found = read(form)
    assert {"name", "description", "body"} <= set(found)
    parts = found["body"]
    assert all(part["type"] in ("input", "textarea", "dropdown", "checkboxes") for part in parts)
    assert all(part["attributes"]["label"] for part in parts)
    assert len({part["id"] for part in parts}) == len(parts)
    assert any(part.get("validations", {}).get("required") for part in parts)


def test_a_question_about_a_fit_asks_for_the_configuration_and_the_report():
    asked = {part["id"]: part for part in read(GITHUB / "ISSUE_TEMPLATE/fit.yml")["body"]}
    assert all(asked[name]["validations"]["required"] for name in ("configuration", "report"))
    assert "report.json" in asked["report"]["attributes"]["description"]


def test_the_workflow_runs_the_checks_of_any_machine():
    jobs = read(GITHUB / "workflows/checks.yml")["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert commands == [".ci/run"]
    assert (ROOT / ".ci/run").stat().st_mode & 0o111


def test_the_citation_is_complete():
    """Keys that the Citation File Format requires, and those by which a version is found."""
    cited = read(GITHUB / "CITATION.cff")
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= set(cited)
    assert all("name" in author or "family-names" in author for author in cited["authors"])


@pytest.mark.parametrize("page", sorted(GITHUB.glob("*.md")), ids=lambda path: path.stem)
def test_links_of_a_page_lead_to_files(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target
