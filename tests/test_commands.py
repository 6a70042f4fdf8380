"""The command `dlo`: its help, and the subcommands beside fit and predict."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import cv2
import jsonschema
import pytest
from rich.console import Console

import dlo_casadi
from dlo_casadi.cli import COMMANDS, common, main
from dlo_casadi.config import dump_yaml, load_config, read_yaml
from dlo_casadi.config.template import config_schema, schema_text
from dlo_casadi.errors import ConfigError

ROOT = Path(__file__).parents[1]
BENCH = ROOT / "tests/data/bench"
CONFIGS = sorted(ROOT.glob("configs/*.yaml")) + sorted(BENCH.glob("*/session.yaml"))


@pytest.fixture(scope="module")
def orange(tmp_path_factory):
    """Two photographs, one of them with a card in front of the cable."""
    folder = tmp_path_factory.mktemp("orange")
    data = read_yaml(BENCH / "orange/session.yaml")
    data["experiment"]["poses"] = data["experiment"]["poses"][:2]
    for pose in data["experiment"]["poses"]:
        pose["file"] = str(BENCH / "orange" / pose["file"])
    (folder / "orange.yaml").write_text(dump_yaml(data))
    return folder / "orange.yaml"


@pytest.mark.parametrize(
    "command", [[Path(sys.executable).with_name("dlo")], [sys.executable, "-m", "dlo_casadi"]]
)
def test_the_installed_command_helps_without_the_numerical_libraries(command):
    """They alone take 1 to 3 s to import."""
    told = {**os.environ, "PYTHONPROFILEIMPORTTIME": "1"}
    done = subprocess.run([*command, "--help"], capture_output=True, text=True, env=told)
    assert done.returncode == 0
    imported = {line.split("|")[-1].strip() for line in done.stderr.splitlines()}
    assert "dlo_casadi.cli" in imported
    assert imported.isdisjoint({"numpy", "scipy", "casadi", "cv2", "matplotlib"})
    assert all(name in done.stdout for name in COMMANDS)
    assert "exit codes: 0 done, 1 a bug, 2 bad input, 130 interrupted" in done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_every_subcommand_has_help_with_examples_and_exit_codes(name, capsys):
    with pytest.raises(SystemExit) as left:
        main([name, "--help"])
    text = capsys.readouterr().out
    assert left.value.code == 0
    assert f"usage: dlo {name} [-h]" in text
    assert f"\n  dlo {name}" in text
    assert "exit codes: 0 done" in text


def test_an_unknown_subcommand_is_bad_input(capsys):
    assert main(["fitt"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("no subcommand is called 'fitt'; did you mean 'fit'?")
    assert len(said.splitlines()) == 1
    assert main([]) == 2
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"dlo {dlo_casadi.__version__}"


@pytest.mark.parametrize("delay", [0.5, 1.0])  # a loaded machine takes 0.2 s to start Python
def test_an_interrupt_during_the_imports_is_quiet(delay):
    command = [sys.executable, ROOT / "scripts/fit.py", BENCH / "short_clean/session.yaml"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as running:
        time.sleep(delay)
        running.send_signal(signal.SIGINT)
        assert running.stderr.read().startswith("interrupted")
        assert running.wait(timeout=60) == 130


# ---- check -------------------------------------------------------------------------------------


def test_check_prints_what_was_found_pose_by_pose(orange, capsys):
    assert main(["check", str(orange)]) == 0
    said = capsys.readouterr()
    text = " ".join(said.out.split())
    assert "0.9 m declared" in text
    assert re.search(r"pose_01 fit 0\.889 m 99 % \d\.\d mm 99 % 99 % 2\.73 mm 0 1 2 3", text)
    assert "pose_02: 9 % of the cable, between 0.54 and 0.62 m of the measured line" in text
    assert "Nothing contradicts the configuration." in text
    assert "read the poses:" in said.err


def test_check_shows_every_step_of_the_camera(orange, tmp_path, capsys):
    assert main(["check", str(orange), "--json", "--quiet", "--show", str(tmp_path / "look")]) == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert said.err == ""
    assert result["ok"]
    assert result["poses"][1]["coverage"] == pytest.approx(0.90, abs=0.01)
    assert [Path(path).name for path in result["pictures"][:4]] == [
        "pose_01_1_workplane.jpg",
        "pose_01_2_contrast.jpg",
        "pose_01_3_strands.jpg",
        "pose_01_4_centerline.jpg",
    ]
    assert len(result["pictures"]) == 8
    contrast = cv2.imread(result["pictures"][1])
    orange_share = (contrast[..., 2].astype(int) - contrast[..., 0] > 60).mean()
    assert 0.002 < orange_share < 0.05  # the cable, and little else, is marked
    assert cv2.imread(result["pictures"][3]).shape == (720, 1280, 3)


def test_check_shows_photographs_only(capsys, tmp_path):
    session = str(BENCH / "short_clean/session.yaml")
    assert main(["check", session, "--show", str(tmp_path)]) == 2
    assert "this configuration has centre-lines" in capsys.readouterr().err


# ---- new and schema ----------------------------------------------------------------------------


def test_new_lists_the_photographs_and_names_what_is_left(tmp_path, capsys):
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for name in ("pose_10.jpg", "pose_2.JPG", "notes.txt", "it's 3.png"):
        (photographs / name).touch()
    config = tmp_path / "rope.yaml"

    assert main(["new", str(config), "--photographs", str(photographs)]) == 0
    assert "3 poses, 12 places to fill in" in capsys.readouterr().out
    data = read_yaml(config)
    assert [pose["file"] for pose in data["experiment"]["poses"]] == [
        "photographs/it's 3.png",
        "photographs/pose_2.JPG",
        "photographs/pose_10.jpg",
    ]
    assert config.read_text().startswith("# yaml-language-server: $schema=schema.json\n")
    assert (tmp_path / "schema.json").read_text() == schema_text()
    assert main(["check", str(config)]) == 2
    said = capsys.readouterr().err
    assert "line 6: cable.length is still to be filled in: Length along the cable" in said
    assert "end is still to be filled in: Where the end is held [m]: [x, y]" in said

    assert main(["new", str(config)]) == 2
    assert "exists already, and nothing is replaced" in capsys.readouterr().err


def test_new_once_filled_in_is_a_configuration(tmp_path):
    config = tmp_path / "rope.yaml"
    folder = str(BENCH / "short_clean")
    assert main(["new", str(config), "--centerlines", folder, "--quiet"]) == 0
    with pytest.raises(ConfigError, match="16 problems"):
        load_config(config)

    text = config.read_text()
    for key, value in (("length", 0.55), ("mass", 0.2), ("diameter", 0.01)):
        text = text.replace(f"{key}: FILL_IN", f"{key}: {value}")
    text = text.replace("stiffness: FILL_IN", "stiffness: 0.3 ")
    config.write_text(text.replace("end: FILL_IN", "end: [0.3, 0.1]"))
    loaded = load_config(config)
    assert loaded.name == "rope"
    assert len(loaded.measured_poses) == 12
    jsonschema.validate(plain(config), config_schema())


def test_new_in_space_once_filled_in_is_a_configuration(tmp_path, capsys):
    config, folder = tmp_path / "loom.yaml", ROOT / "configs/space/markers"
    assert main(["new", str(config), "--space", "--photographs", str(folder)]) == 2
    assert "a pose has several photographs" in capsys.readouterr().err
    assert main(["new", str(config), "--space", "--centerlines", str(folder)]) == 0
    assert "10 poses, 44 places to fill in" in capsys.readouterr().out
    assert main(["check", str(config)]) == 2
    assert "start_orientation is still to be filled in: Frame of a" in capsys.readouterr().err

    text = config.read_text()
    for key, value in (
        ("length", "0.6"),
        ("mass", "0.03"),
        ("diameter", "0.004"),
        ("stiffness", "0.02 "),
        ("start", "[0.4, -0.2, 0.3]"),
        ("end", "[0.7, -0.3, 0.35]"),
        ("orientation", "[0, 0, 0, 1]"),
    ):
        text = text.replace(f"{key}: FILL_IN", f"{key}: {value}")
    config.write_text(text)
    loaded = load_config(config)
    assert loaded.experiment.in_space
    assert len(loaded.measured_poses) == 10
    jsonschema.validate(plain(config), config_schema())


def test_new_says_what_it_cannot_find(tmp_path, capsys):
    assert main(["new", str(tmp_path / "a.yaml"), "--photographs", str(tmp_path / "no")]) == 2
    assert "cannot be read: No such file" in capsys.readouterr().err
    assert main(["new", str(tmp_path / "a.yaml"), "--centerlines", str(tmp_path)]) == 2
    assert "holds no CSV file (.csv)" in capsys.readouterr().err
    assert main(["new", str(tmp_path / "a.txt")]) == 2
    assert "ends in .yaml" in capsys.readouterr().err


def plain(path):
    """A configuration as JSON, where keys are text."""
    return json.loads(json.dumps(read_yaml(path)))


def test_the_committed_schema_is_current(capsys):
    assert main(["schema"]) == 0
    current = capsys.readouterr().out
    assert (ROOT / "configs/schema.json").read_text() == current, "dlo schema > configs/schema.json"
    jsonschema.Draft202012Validator.check_schema(json.loads(current))


def mistakes_in(path):
    """What the schema has against a configuration."""
    validator = jsonschema.Draft202012Validator(config_schema())
    return [error.message for error in validator.iter_errors(plain(path))]


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_the_configurations_follow_the_schema(path):
    assert mistakes_in(path) == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("length", "lenght", "'lenght' was unexpected"),
        ("start: pinned", "start: free", "'free' is not one of"),
        ("[0.0, -9.81]", "[0.0, -9.81, 0.0, 0.0]", "is not valid under any"),
        ("mass: 0.23", "mass: heavy", "'heavy' is not valid under any"),
        ("diameter: 0.0128", "diameter: wide", "'wide' is not of type 'number'"),
    ],
)
def test_the_schema_finds_mistakes(old, new, said, tmp_path):
    changed = tmp_path / "cable.yaml"
    changed.write_text((ROOT / "configs/cable.yaml").read_text().replace(old, new, 1))
    with pytest.raises(jsonschema.ValidationError, match=re.escape(said)):
        jsonschema.validate(plain(changed), config_schema())


def test_the_schema_knows_the_short_forms(tmp_path):
    short = tmp_path / "cable.yaml"
    options = "model: {effects: [image_scale, {name: lumped_mass, parameters: {mass: 0.1}}]}\n"
    text = (ROOT / "configs/cable.yaml").read_text() + options + "diagnosis:\n"
    short.write_text(text.replace("file: ", f"file: {ROOT}/configs/"))
    declared = load_config(short).model.effects
    assert [effect.name for effect in declared] == ["image_scale", "lumped_mass"]
    assert mistakes_in(short) == []


# ---- diagnose, reproduce, benchmark ------------------------------------------------------------


def test_scripts_of_the_checkout_are_run_with_their_options(tmp_path, monkeypatch, capsys):
    (tmp_path / "dlo_casadi").mkdir()
    monkeypatch.setattr(dlo_casadi, "__file__", str(tmp_path / "dlo_casadi/__init__.py"))
    assert main(["benchmark"]) == 2
    assert "benchmark.py is not part of the installed package" in capsys.readouterr().err
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts/benchmark.py").write_text("import sys; sys.exit(len(sys.argv))")
    assert main(["benchmark", "--", "--a", "b"]) == 3
    with pytest.raises(SystemExit):
        main(["benchmark", "--a"])
    assert "usage: dlo benchmark [-h] [-- OPTION ...]" in capsys.readouterr().err


# ---- progress ----------------------------------------------------------------------------------


def test_the_remaining_time_is_told_line_by_line(monkeypatch):
    seconds = [0.0]
    monkeypatch.setattr(common, "time", SimpleNamespace(perf_counter=lambda: seconds[0]))
    out = StringIO()
    shown = common.Watch(Console(file=out))
    for done, seconds[0] in ((0, 0.0), (1, 4.0), (2, 12.0), (3, 15.0), (4, 20.0)):
        shown.step("search", done, 4)
    assert out.getvalue().splitlines() == ["search: 2 of 4, at most 12 s left", "search: 20.0 s"]


def test_quiet_shows_nothing():
    out = StringIO()
    with common.Watch(Console(file=out, force_terminal=True), quiet=True) as shown:
        shown.step("search", 0, 1)
        shown.message("something")
    assert out.getvalue() == ""


def test_a_terminal_shows_bars_with_the_time_that_is_left():
    out = StringIO()
    with common.Watch(Console(file=out, force_terminal=True, width=100)) as shown:
        shown.step("read pose_01.jpg", 0, 2)
        shown.step("read pose_02.jpg", 1, 2)
        shown.step("read ", 2, 2)
    assert "read the poses" in out.getvalue()
    assert "left, at most:" in out.getvalue()
