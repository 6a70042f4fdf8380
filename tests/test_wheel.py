"""Wheel and source distribution: what they hold, and that both work without the checkout."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import dlo_casadi as dlo

ROOT = Path(__file__).parents[1]
setuptools = pytest.importorskip("setuptools", minversion="77", reason="builds the wheel")

# A prediction, a configuration and C: the last two from templates.
USE = """
import sys
import dlo_casadi as dlo
from dlo_casadi.cli import main
assert dlo.__file__.startswith(sys.argv[1]), dlo.__file__
rope = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
known = dlo.known_cable(rope, gravity=(0, -9.81), boundary=("pinned", "pinned"), model={"n": 8})
assert known.solve(end=(0.5, -0.1)).stable
assert main(["new", "rope.yaml"]) == 0
from dlo_casadi.codegen import generate
generate(known.model, known.p, known.rest).write("solver")
"""


def run(*command, **options):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """What a distribution is built from, beside which the build may leave files."""
    folder = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    left_out = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "dlo_casadi", folder / "dlo_casadi", ignore=left_out)
    return folder


def built(folder, what):
    """The path of a wheel or sdist, built by the backend of pyproject.toml, without a network."""
    target = folder / "dist"
    code = f"from setuptools import build_meta; build_meta.build_{what}({str(target)!r})"
    target.mkdir(exist_ok=True)
    run(sys.executable, "-c", code, cwd=folder)
    return next(target.glob("*.tar.gz" if what == "sdist" else "*.whl"))


@pytest.fixture(scope="module")
def wheel(source):
    return built(source, "wheel")


def files_of_the_package(folder):
    return {
        path.relative_to(folder).as_posix()
        for path in (folder / "dlo_casadi").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_the_wheel_holds_all_files_of_the_package_and_nothing_else(wheel, source):
    assert wheel.name == f"dlo_casadi-{dlo.__version__}-py3-none-any.whl"
    names = set(zipfile.ZipFile(wheel).namelist())
    notes = {name for name in names if name.startswith(f"dlo_casadi-{dlo.__version__}.dist-info/")}
    assert names - notes == files_of_the_package(source)
    assert any(name.endswith("licenses/LICENSE") for name in notes)
    assert any(name.startswith("dlo_casadi/codegen/templates/") for name in names)


def test_the_wheel_says_what_it_needs_and_offers(wheel):
    notes = f"dlo_casadi-{dlo.__version__}.dist-info"
    told = zipfile.ZipFile(wheel)
    metadata = told.read(f"{notes}/METADATA").decode()
    assert re.search(r"^Requires-Python: >=3\.11$", metadata, re.M)
    assert {"casadi", "numpy", "scipy"} <= set(re.findall(r"^Requires-Dist: (\w+)", metadata, re.M))
    assert "dlo = dlo_casadi.cli:main" in told.read(f"{notes}/entry_points.txt").decode()


def test_an_editable_install_is_a_path_that_type_checkers_follow(source, tmp_path):
    """They read paths in a .pth file, and run no hook that finds the package at its import."""
    shutil.copytree(source, tmp_path / "source", ignore=shutil.ignore_patterns("dist"))
    with zipfile.ZipFile(built(tmp_path / "source", "editable")) as told:
        (path,) = (name for name in told.namelist() if name.endswith(".pth"))
        found = Path(told.read(path).decode().strip())
    assert (found / "dlo_casadi/py.typed").is_file()
    assert found.samefile(tmp_path / "source")


def test_an_unpacked_wheel_works_without_the_checkout(wheel, tmp_path):
    """Installed in a fresh environment it does, too: see the test marked long."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    there = str(tmp_path / "site")
    run(sys.executable, "-c", USE, there, cwd=tmp_path, env=os.environ | {"PYTHONPATH": there})
    assert {"dlo_solver.c", "CMakeLists.txt"} <= {p.name for p in (tmp_path / "solver").iterdir()}


def test_the_source_distribution_gives_the_same_wheel(source, wheel, tmp_path):
    with tarfile.open(built(source, "sdist")) as archive:
        archive.extractall(tmp_path, filter="data")
    again = built(tmp_path / f"dlo_casadi-{dlo.__version__}", "wheel")
    contents = [
        {name: told.read(name) for name in told.namelist() if not name.endswith("RECORD")}
        for told in map(zipfile.ZipFile, (wheel, again))
    ]
    assert contents[0] == contents[1]


@pytest.mark.long
@pytest.mark.parametrize("what", ["wheel", "sdist"])
def test_it_is_installed_in_a_fresh_environment_with_what_it_needs(source, what, tmp_path):
    """Downloads the dependencies: some hundred megabytes."""
    venv.create(tmp_path / "env", with_pip=True)
    scripts = tmp_path / "env" / Path(sysconfig.get_path("scripts")).name
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    run(scripts / "python", "-m", "pip", "install", "-q", built(source, what), env=env)
    assert run(scripts / "dlo", "--version", env=env).strip() == f"dlo {dlo.__version__}"
    run(scripts / "python", "-c", USE, tmp_path, cwd=tmp_path, env=env)
