"""The CMake package of a generated solver: a subdirectory, fetched, installed; nothing leaks."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from dlo_casadi.codegen import generate
from dlo_casadi.effects import CableData
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(
    shutil.which("cmake") is None or shutil.which("c++") is None, reason="no cmake, or no c++"
)

USER = """
#include "rope_solver.hpp"
#include <cstdio>
int main()
{
    rope_pose pose = {};
    pose.end[0] = 0.3;
    const rope_shape shape = rope::Solver().solve(pose);
    std::printf("%s", rope_message(shape.iterations > 0 ? ROPE_OK : ROPE_UNSTABLE));
}
"""
HEAD = "cmake_minimum_required(VERSION 3.14)\nproject(user C CXX)\n"
PROGRAM = "add_executable(user user.cpp)\ntarget_link_libraries(user PRIVATE rope::rope_solver)\n"
# Variables that any project with these commands has.
OF_CMAKE = re.compile(r"CMAKE_|FETCHCONTENT_|user_|rope_solver_|harness_solver_|.*-ADVANCED")


@pytest.fixture
def folder(tmp_path):
    """Two solvers, one of them to be used."""
    model = CableModel(CableData(0.8, 0.2, 0.01, 0.05), 4, "arc", n_rest=0)
    for name in ("rope", "harness"):
        source = generate(model, model.nominal, np.zeros(model.chain.n_rests), name)
        source.write(tmp_path / name)
    (tmp_path / "user").mkdir()
    (tmp_path / "user/user.cpp").write_text(USER)
    return tmp_path


def run(folder, *command):
    quick = {"CFLAGS": "-O0", "CXXFLAGS": "-O0"}
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, env=os.environ | quick
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build(folder, text, *options):
    """Configure and build the user's project, and say what its program says."""
    (folder / "user/CMakeLists.txt").write_text(HEAD + text + PROGRAM)
    run(folder, "cmake", "-S", "user", "-B", "build", *options)
    run(folder, "cmake", "--build", "build")
    return run(folder, "build/user")


def variables(folder):
    cache = (folder / "build/CMakeCache.txt").read_text()
    names = re.findall(r"^([\w-]+):(?!INTERNAL)", cache, re.M)
    return {name for name in names if not OF_CMAKE.match(name)}


def test_a_subdirectory_and_fetched_content_leave_nothing_but_their_own_options(folder):
    """Two solvers in one project, whose install step installs none of their files."""
    both = (
        "add_subdirectory(../rope rope)\n"
        "include(FetchContent)\n"
        "FetchContent_Declare(harness SOURCE_DIR ${CMAKE_CURRENT_SOURCE_DIR}/../harness)\n"
        "set(HARNESS_BUILD_EXAMPLE ON)\nFetchContent_MakeAvailable(harness)\n"
        "install(FILES user.cpp DESTINATION .)\n"
    )
    assert build(folder, both) == "stable equilibrium"
    assert "bend radius" in run(folder, "build/_deps/harness-build/harness_solver_example")
    assert not list((folder / "build").rglob("rope_solver_example*"))
    options = {"ROPE_BUILD_EXAMPLE", "ROPE_INSTALL", "HARNESS_INSTALL"}
    assert variables(folder) == options
    run(folder, "cmake", "--install", "build", "--prefix", "there")
    assert [path.name for path in (folder / "there").rglob("*")] == ["user.cpp"]


@pytest.mark.parametrize("shared", [pytest.param("OFF", marks=pytest.mark.long), "ON"])
def test_an_installed_package_is_found(folder, shared):
    there = folder / "there"
    options = (f"-DCMAKE_INSTALL_PREFIX={there}", f"-DBUILD_SHARED_LIBS={shared}")
    # As a project may hide all names of its libraries but those that are exported.
    hidden = "-DCMAKE_C_VISIBILITY_PRESET=hidden"
    run(folder, "cmake", "-S", "rope", "-B", "solver", *options, hidden)
    run(folder, "cmake", "--build", "solver", "--target", "install")
    wanted = "find_package(rope_solver 1 REQUIRED CONFIG)\n"
    assert build(folder, wanted, f"-DCMAKE_PREFIX_PATH={there}") == "stable equilibrium"
    installed = {path.name for path in there.rglob("*") if path.is_file()}
    library = "librope_solver.so" if shared == "ON" else "librope_solver.a"
    assert {"rope_solver.h", "rope_solver.hpp", "rope_solver.pc", library} <= installed
    assert "example.c" not in installed
    assert not list((folder / "solver").rglob("*example*"))
