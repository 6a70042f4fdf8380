"""The README: its Python code runs word for word, its pictures and files are there."""

import re
from pathlib import Path

import pytest

from dlo_casadi.cli import COMMANDS
from dlo_casadi.config import dump_yaml, read_yaml

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SESSION = ROOT / "tests/data/bench/short_clean/session.yaml"


@pytest.fixture
def small_cable(tmp_path, monkeypatch):
    """A folder in which configs/cable.yaml is a quick session: five poses on a coarse mesh."""
    data = read_yaml(SESSION)
    poses = data["experiment"]["poses"][:5]
    for pose in poses:
        pose["file"] = str(SESSION.parent / pose["file"])
    data["experiment"]["poses"] = poses
    data |= {"model": {"n": 12}, "estimation": {"algorithm1": False}}
    data["diagnosis"] = {"enabled": False}
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs/cable.yaml").write_text(dump_yaml(data))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_python_code_runs_from_top_to_bottom(small_cable):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) == 3
    names = {}
    for block in blocks:
        exec(block, names)
    assert names["shape"].points(101).shape == (101, 2)
    assert names["stage"].rmse_held_out < 1e-3
    for file in ("poses.png", "shape.png", "results/cable/report.json"):
        assert (small_cable / file).stat().st_size > 1000


def test_the_first_two_commands_are_the_fit_and_the_tests():
    blocks = re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    assert blocks[0].strip().endswith("scripts/fit.py configs/cable.yaml")
    assert blocks[1].strip().endswith("-m pytest")


def test_pictures_and_files_exist_and_are_small():
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README)
    assert len(pictures) >= 3
    assert all((ROOT / picture).stat().st_size <= 200_000 for picture in pictures)
    named = set(re.findall(r"(?:scripts|configs)/[\w/]+\.(?:py|yaml)\b", README))
    assert named
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_every_subcommand_that_is_named_exists():
    named = set(re.findall(r"(?:^|bin/|`)dlo ([a-z][a-z-]+)", README, re.MULTILINE))
    assert {"new", "check", "fit", "predict"} < named
    assert named < set(COMMANDS)
