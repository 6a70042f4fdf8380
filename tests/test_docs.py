"""The documentation: its code runs, its commands parse, its pictures and files are there."""

import argparse
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import dlo_casadi as dlo
from dlo_casadi.cli import COMMANDS, main
from dlo_casadi.config import dump_yaml, read_yaml
from dlo_casadi.config.document import Document
from dlo_casadi.config.sections import Config

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs/pages"
TEXTS = {
    str(page.relative_to(ROOT)): page.read_text()
    for page in (ROOT / "README.md", *sorted(PAGES.rglob("*.md")))
}
SESSION = ROOT / "tests/data/bench/short_clean/session.yaml"


def blocks(text, language):
    """Code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def having(language):
    return [name for name, text in TEXTS.items() if blocks(text, language)]


def commands(text):
    """Command lines of a page, without comments and continuations."""
    lines = "".join(blocks(text, "(?:shell|bash)")).replace("\\\n", "").splitlines()
    return [shlex.split(part, comments=True) for line in lines for part in line.split("&&")]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder in which configs/cable.yaml is a quick session that has been fitted once."""
    folder = tmp_path_factory.mktemp("bench")
    data = read_yaml(SESSION)
    poses = data["experiment"]["poses"][:5]
    for pose in poses:
        pose["file"] = str(SESSION.parent / pose["file"])
    data["experiment"]["poses"] = poses
    data |= {"model": {"n": 12}, "estimation": {"algorithm1": False}}
    data["diagnosis"] = {"enabled": False}
    (folder / "configs").mkdir()
    (folder / "configs/cable.yaml").write_text(dump_yaml(data))
    result = dlo.fit(folder / "configs/cable.yaml")
    result.write(folder / "results/cable")
    return folder, result


@pytest.mark.parametrize("page", having("python"))
def test_python_runs_from_top_to_bottom(page, bench, monkeypatch, capsys, request):
    if page == "docs/pages/how-to/keep-limits.md":
        request.getfixturevalue("fewer_starts")
    folder, result = bench
    monkeypatch.chdir(folder)
    monkeypatch.setattr(dlo, "fit", lambda config: {"configs/cable.yaml": result}[config])
    known = set(dlo.EFFECTS)
    names = {"__name__": page}
    sys.modules[page] = type(sys)(page)  # where dataclasses look up the names of their types
    try:
        for block in blocks(TEXTS[page], "python"):
            exec(block, names)
    finally:
        del sys.modules[page]
        for name in set(dlo.EFFECTS) - known:  # registered on that page
            del dlo.EFFECTS[name]
    said = capsys.readouterr().out
    shown = re.findall(r"^```python\n[^`]*^```\n\n```text\n(.*?)^```", TEXTS[page], re.M | re.S)
    assert [text for text in shown if text not in said] == []


@pytest.mark.parametrize("page", having("(?:shell|bash)"))
def test_commands_are_understood(page, monkeypatch):
    """By the parsers of the commands and scripts themselves, which then go no further."""
    parse = argparse.ArgumentParser.parse_args

    def parse_only(parser, *given, **options):
        parse(parser, *given, **options)
        raise SystemExit(0)

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    for words in commands(TEXTS[page]):
        if not words:
            continue
        program = Path(words[0]).name
        if program == "dlo":
            assert words[1] in COMMANDS
            arguments = words[1:]
            with pytest.raises(SystemExit) as left:
                main(arguments)
            assert left.value.code == 0, words
        elif program == "python" and words[1].startswith("scripts/"):
            script = ROOT / words[1]
            monkeypatch.setattr(sys, "argv", words[1:])
            monkeypatch.syspath_prepend(script.parent)
            with pytest.raises(SystemExit) as left:
                runpy.run_path(str(script), run_name="__main__")
            needs_a_package = "Try: pip install" in str(left.value.code)
            assert left.value.code == 0 or needs_a_package, words


@pytest.mark.parametrize("page", having("yaml"))
def test_yaml_is_a_configuration_or_a_part_of_one(page, tmp_path):
    whole = read_yaml(SESSION)
    for block in blocks(TEXTS[page], "yaml"):
        (tmp_path / "part.yaml").write_text(block)
        part = read_yaml(tmp_path / "part.yaml")
        experiment = whole["experiment"] | part.get("experiment", {})
        (tmp_path / "whole.yaml").write_text(dump_yaml(whole | part | {"experiment": experiment}))
        checked = Document.read(tmp_path / "whole.yaml").checked(Config)
        assert part.keys() <= vars(checked).keys()


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_c_compiles_and_runs(bench, tmp_path, monkeypatch):
    folder, _ = bench
    monkeypatch.chdir(folder)
    asked = ["generate-solver", "results/cable", "--motion", "--quiet"]
    main([*asked, "--output", str(tmp_path)])
    program, motion, limits = blocks(TEXTS["docs/pages/how-to/planner.md"], "c")
    program = program.replace("    return 0;\n", f"{{\n{motion}}}\n{{\n{limits}}}\n    return 0;\n")
    (tmp_path / "program.c").write_text(program)
    command = [
        "cc",
        "-std=c99",
        "-Wall",
        "-Wextra",
        "-pedantic",
        "-Werror",
        "program.c",
        "dlo_solver.c",
    ]
    subprocess.run([*command, "-o", "program", "-lm"], cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "program"], check=True, capture_output=True, text=True)
    force = dlo.predict("results/cable", end=(0.3, -0.1)).end_force
    told, moving, violated = said.stdout.splitlines()  # by 16 N on the end
    assert told == f"end force {force[0]:.3f} {force[1]:.3f} N"
    assert moving.startswith("end force in motion ")
    assert violated.startswith("a limit is violated at s = ")


@pytest.mark.parametrize("page", [page for page, text in TEXTS.items() if "![" in text])
def test_pictures_have_a_description_and_are_small(page):
    shown = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", TEXTS[page])
    assert shown
    for alt, target in shown:
        assert len(alt) > 30, f"{target}: describe it for those who cannot see it"
        assert (ROOT / page).parent.joinpath(target).stat().st_size <= 200_000


@pytest.mark.parametrize("page", TEXTS)
def test_files_that_are_named_exist(page):
    named = set(re.findall(r"`((?:scripts|configs|tests|dlo_casadi)/[\w/]+\.\w+)", TEXTS[page]))
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_every_command_is_named():
    named = re.findall(r"\bdlo ([a-z][a-z-]+)", "\n".join(TEXTS.values()))
    assert set(COMMANDS) <= set(named)


def test_every_effect_has_its_section_and_picture():
    sections = "\n".join(text for page, text in TEXTS.items() if "/effects/" in page)
    for name, kind in dlo.EFFECTS.items():
        assert re.search(rf"^## {name}$", sections, re.MULTILINE)
        assert f"]({name}.svg)" in sections
        assert f"::: {kind.__module__}.{kind.__name__}\n" in sections


def test_every_public_name_has_its_entry():
    entries = "\n".join(text for page, text in TEXTS.items() if "/api/" in page)
    objects = set(re.findall(r"^::: (\S+)$", entries, re.MULTILINE))
    for name in dlo.__all__:
        public = getattr(dlo, name)
        home = getattr(public, "__module__", None)
        assert home is None or {f"{home}.{name}", home} & objects, f"::: {home}.{name}"


def test_outputs_of_the_casadi_function_are_listed_in_their_order():
    rope = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
    cable = dlo.known_cable(rope, gravity=(0, -9.81), boundary=("pinned", "pinned"))
    table = TEXTS["docs/pages/how-to/casadi.md"].split("| output |")[1].split("\n\n")[0]
    assert re.findall(r"^\| `(\w+)`", table, re.MULTILINE) == cable.function().name_out()


def test_every_example_is_shown():
    shown = TEXTS["docs/pages/how-to/examples.md"]
    names = {script.stem for script in (ROOT / "scripts/examples").glob("*.py")}
    assert [
        name
        for name in names - {"simulated_rod"}
        if f'--8<-- "scripts/examples/{name}.py"' not in shown
    ] == []


@pytest.mark.parametrize("page", [page for page in TEXTS if page != "README.md"])
def test_lines_of_code_fit_on_a_page(page):
    lines = "".join(blocks(TEXTS[page], r"\w*")).splitlines()
    assert [line for line in lines if len(line) > 100] == []
