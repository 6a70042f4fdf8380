"""The generated folder: any name compiles, all files or none, and nothing else is touched."""

import os
import shutil
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from files import tree

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.generate import MARK, comment
from dlo_casadi.effects import CableData
from dlo_casadi.errors import OutputError
from dlo_casadi.model.cable_model import CableModel

CABLE = CableData(length=0.5, mass=0.1, diameter=0.01, bending_stiffness=0.02)
STRICT = ["-Wall", "-Wextra", "-Wtrigraphs", "-Werror", "-fsyntax-only"]
NASTY = {
    "end of a comment": "a */ int x; /* b",
    "begin of a comment": "/*/*/**/*//",
    "line comment": "http://a//b",
    "trigraph of a backslash": "a ??/",
    "trigraphs": "??????/??=??(??'*??/",
    "backslash": "a \\",
    "parts of a comment's end": "*\\\n/ *??/\n/",
    "lines": "a\nb\r\nc\u2028d\u0085e\x0bf\x0cg",
    "control characters": "\x00\x01\x07\x1b[31m\x7f\x9f\ufeff",
    "right to left": "\u202e\u2066*/ if (admin) \u2069\u202d",
    "lone surrogates": "\udce9\ud800",
    "letters": "Kabelbäume, 電線, \U0001f600",
    "marks of templates": "@HASH@ dlo_solve @TABLE@ ${prefix} $<1:x> %s #",
    "nothing": "",
}


@cache
def solver(name="bench cable", prefix="dlo"):
    model = CableModel(replace(CABLE, name=name), n=6)
    return generate(model, model.nominal, np.zeros(6), prefix)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
@pytest.mark.parametrize("name", NASTY.values(), ids=NASTY)
def test_any_name_of_a_cable_compiles_and_is_one_line_of_ascii(tmp_path, name):
    plain, nasty = solver(), solver(name)
    assert comment(name).isascii()
    assert comment(name).isprintable()
    # The header alone names the cable, so that it alone can break: every line but one is as ever.
    changed = {file for file, text in nasty.files.items() if text != plain.files[file]}
    assert changed == {"dlo_solver.h"}
    header, before = (s.files["dlo_solver.h"].split("\n") for s in (nasty, plain))
    assert header[1:] == before[1:]
    assert header[0] == before[0].replace("bench cable", comment(name))

    nasty.write(tmp_path)
    for command in (["cc", "-std=c99"], ["cc", "-std=gnu17"], ["c++", "-x", "c++"]):
        if shutil.which(command[0]) is None:
            continue
        run = subprocess.run(
            [*command, *STRICT, "example.c"], cwd=tmp_path, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stderr


def test_names_that_differ_stay_different_and_plain_ones_as_they_are():
    assert comment("black wire, 0.5 m (#3)") == "black wire, 0.5 m (#3)"
    assert comment("http://a/b?c") == "http://a/b?c"
    assert len({comment(name) for name in NASTY.values()}) == len(NASTY)


def test_the_folder_holds_all_files_and_what_was_there(tmp_path):
    (tmp_path / "planner.c").write_text("mine")
    written = solver().write(tmp_path)
    assert {path.name for path in written} == set(solver().files)
    assert set(tree(tmp_path)) == {"planner.c", *solver().files}
    assert all(MARK in text for text in solver().files.values())

    solver("another").write(tmp_path)
    solver(prefix="rope").write(tmp_path)
    found = tree(tmp_path)
    assert found["planner.c"] == b"mine"
    assert b"another" in found["dlo_solver.h"]
    assert b"rope_solver" in found["CMakeLists.txt"]


@pytest.mark.parametrize("name", ["CMakeLists.txt", "example.c", "dlo_solver.h"])
def test_a_file_of_the_users_is_not_replaced(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(OutputError, match=f"holds {name} from elsewhere.*\n  Try: another folder"):
        solver().write(tmp_path)
    assert tree(tmp_path) == {name: b"mine"}


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("count", [0, 2])
def test_a_full_disk_leaves_the_earlier_solver(tmp_path, monkeypatch, step, count):
    folder, left, work = tmp_path / "solver", [count], getattr(os, step)

    def fails(*arguments):
        left[0] -= 1
        if left[0] == -1:
            raise OSError(28, os.strerror(28))
        return work(*arguments)

    solver().write(folder)
    before = tree(folder)
    monkeypatch.setattr(os, step, fails)
    for target in (folder, tmp_path / "new"):
        left[0] = count
        with pytest.raises(OutputError, match=r"cannot be written: No space left.*\n  Try:") as e:
            solver("another").write(target)
        assert e.value.path in (target, *(target / name for name in before))
        assert str(e.value).startswith(str(e.value.path))
    assert tree(folder) == before
    assert list(tmp_path.iterdir()) == [folder]
