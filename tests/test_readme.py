"""The README: short, and its first two commands are the fit and the tests."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_first_two_commands_are_the_fit_and_the_tests():
    blocks = re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    assert blocks[0].strip().endswith("scripts/fit.py configs/cable.yaml")
    assert blocks[1].strip().endswith("-m pytest")


def test_it_is_read_in_five_minutes():
    assert len(README.splitlines()) <= 150


def test_its_links_lead_somewhere():
    targets = re.findall(r"\]\((?!http)([^)#]+)", README)
    assert len(targets) > 10
    assert [target for target in targets if not (ROOT / target).exists()] == []
