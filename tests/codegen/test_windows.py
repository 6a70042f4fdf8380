"""Generated C as Microsoft's compiler reads it, by clang with its target and its command line.

Windows' own headers are not here: `math.h` is replaced by C99's declarations of what a kernel may
call. Nothing is linked or run.
"""

import re
import shutil
import subprocess
from functools import cache

import numpy as np
import pytest

from dlo_casadi.codegen import generate
from dlo_casadi.effects import AxialStretch, BendingSoftening, CableData
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("clang") is None, reason="clang is not installed")

ONE = "acos asin atan ceil cos cosh exp fabs floor log rint sin sinh sqrt tan tanh"
MATH = '#define NAN __builtin_nanf("")\n' + "".join(
    f"double {name}({arguments});\n"
    for names, arguments in ((ONE, "double"), ("atan2 fmax fmin fmod pow", "double, double"))
    for name in names.split()
)
TARGET = ("clang", "--target=x86_64-pc-windows-msvc", "-I.")
STRICT = (*TARGET, "-Wall", "-Wextra", "-Wpedantic", "-Wvla", "-Werror", "-fsyntax-only")
CL = (*TARGET, "--driver-mode=cl", "/W4", "/WX", "/Zs", "-Wvla")
CABLE = CableData(0.8, 0.2, 0.01, 0.05)
LOOM = CableData(0.8, 0.05, 0.01, 0.05, torsional_stiffness=0.04)
SPACE = {"gravity": (0.0, 0.0, -9.81), "n_rest": 0}
MODELS = {
    "plane": (CableModel(CABLE, 6, effects=(AxialStretch(), BendingSoftening())), 0),
    "plane, links": (CableModel(CABLE, 6, "link"), 0),
    "plane, saddle, obstacles": (CableModel(CABLE, 6, n_rest=0, clips=("clamped",)), 2),
    "space": (CableModel(LOOM, 6, "arc", "clamped", "free", **SPACE), 0),
    "space, eyelet, obstacles": (
        CableModel(LOOM, 6, "arc", "clamped", "clamped", clips=("eyelet",), **SPACE),
        1,
    ),
}


@cache
def files(name):
    model, obstacles = MODELS[name]
    rest = np.zeros(model.chain.n_rests)
    return generate(model, model.nominal, rest, "rope", obstacles=obstacles).files


@pytest.fixture(params=MODELS)
def folder(request, tmp_path):
    for name, text in {**files(request.param), "math.h": MATH}.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def run(folder, *command):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_source_compiles(folder):
    for standard in ("-std=c99", "-std=c17"):
        run(folder, *STRICT, standard, "rope_solver.c")
    run(folder, *CL, "rope_solver.c")


def test_no_word_is_left_that_its_default_mode_lacks(folder):
    """Clang knows `restrict` in every mode of C; cl without /std:c11 does not."""
    text = run(folder, *TARGET, "-std=c99", "-E", "-P", "rope_solver.c")
    assert "__restrict out" in text
    assert not re.search(r"\b(restrict|_Complex|_Static_assert|_Alignas|typeof)\b", text)


def test_the_header_is_included_from_c_and_c_plus_plus(folder):
    (folder / "user.c").write_text(
        '#include "rope_solver.h"\n#include "rope_solver.h"\n'
        "int main(void) { return (int)sizeof(rope_pose) - (int)sizeof *rope_message(ROPE_OK); }\n"
    )
    for defined in ((), ("-DROPE_SHARED",)):
        run(folder, *STRICT, *defined, "-std=c99", "user.c")
        run(folder, *STRICT, *defined, "-std=c++11", "-x", "c++", "user.c")
        run(folder, *CL, *defined, "/TC", "user.c")
        run(folder, *CL, *defined, "/TP", "user.c")


def test_a_shared_library_exports_the_header_and_what_casadi_asks_for(folder):
    """An object lists what it exports; without the words of a shared library that is nothing."""
    shared = ("-DROPE_SHARED", "-DROPE_BUILDING")
    found = []
    for defined in ((), shared):
        run(folder, *TARGET, "-O0", *defined, "-c", "rope_solver.c", "-o", "solver.obj")
        words = re.findall(rb"/EXPORT:(\w+)", (folder / "solver.obj").read_bytes())
        found.append({word.decode() for word in words})
    assert found[0] == set()
    header = (folder / "rope_solver.h").read_text()
    declared = set(re.findall(r"\b(rope_[a-z_]+)\((?=const|long|rope_status)", header))
    assert {"rope_solve", "rope_limits", "rope_message", "rope_cable"} <= declared
    assert declared <= found[1]
    asked = {f"{name}_{part}" for name in ("rope_cable", "jac_rope_cable") for part in ("n_in",
             "n_out", "sparsity_in", "sparsity_out", "work")}  # fmt: skip
    assert asked <= found[1]


def test_a_user_of_a_shared_library_imports_it(folder):
    (folder / "user.c").write_text(
        '#include "rope_solver.h"\nconst char *said(void) { return rope_message(ROPE_OK); }\n'
    )
    for defined, imported in (((), False), (("-DROPE_SHARED",), True)):
        run(folder, *TARGET, *defined, "-c", "user.c", "-o", "user.obj")
        assert (b"__imp_rope_message" in (folder / "user.obj").read_bytes()) == imported
