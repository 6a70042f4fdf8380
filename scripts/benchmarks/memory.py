"""Sanitisers, valgrind and threads over random problems, for several kinds of cable."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.codegen import generate
from dlo_casadi.effects import AxialStretch, BendingSoftening, CableData, LumpedMass
from dlo_casadi.model.cable_model import CableModel

HERE = Path(__file__).parent
# Element, ends, gravity, whose three numbers put a cable in space, and obstacles; memory.c has two.
PLANE, SPACE = (0.0, -9.81), (0.0, 0.0, -9.81)
KINDS = (
    ("link", "pinned", "pinned", PLANE, 0),
    ("arc", "clamped", "clamped", PLANE, 0),
    ("link", "clamped", "free", PLANE, 0),
    ("arc", "pinned", "pinned", PLANE, 2),
    ("quadratic", "clamped", "clamped", SPACE, 0),
    ("arc", "clamped", "free", SPACE, 0),
)
THREADS = 8
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
SANITIZE = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
RACES = ("-g", "-O1", "-fsanitize=thread")


def run(problems: int = 100) -> dict[str, Any]:
    """Counted statuses (ok, unreachable, ...), and the output of the tools or "silent"."""
    out: dict[str, Any] = {}
    for element, start, end, gravity, obstacles in KINDS:
        # A law of the section inside quadratic elements in space takes minutes to compile.
        law = () if gravity is SPACE else (BendingSoftening(),)
        for effects in ((), (AxialStretch(), LumpedMass(), *law)):
            torsion = 0.04 if gravity is SPACE else None
            cable = CableData(0.8, 0.2, 0.01, 0.05, torsional_stiffness=torsion)
            model = CableModel(cable, 12, element, start, end, gravity, effects=effects)  # type: ignore[arg-type]
            p = model.nominal.copy()
            p[1:] += 1e-3
            rest = model.rest_basis @ np.random.default_rng(0).normal(size=model.n_coefficients)
            folder = Path(tempfile.mkdtemp(prefix="dlo_memory_"))
            generate(model, p, rest, obstacles=obstacles).write(folder)
            shutil.copy(HERE / "memory.c", folder)
            where = "in space" if model.in_space else "in the plane"
            name = f"{element} {start} {end} {where}" + " on obstacles" * (obstacles > 0)
            name += " with effects" if effects else ""
            few = max(1, problems // 20)
            out[name] = {
                "sanitizers": build_and_run(folder, SANITIZE, [], problems),
                "threads": build_and_run(folder, RACES, [], few, THREADS),
                "valgrind": build_and_run(
                    folder,
                    ("-g", "-O1"),
                    ["valgrind", "-q", "--error-exitcode=9", "--leak-check=full"],
                    few,
                ),
            }
            shutil.rmtree(folder)
    return out


def build_and_run(
    folder: Path, flags: tuple[str, ...], runner: list[str], problems: int, threads: int = 1
) -> str:
    """Compile and run in `folder`; counted statuses if silent, else what was said."""
    if runner and shutil.which(runner[0]) is None:
        return f"{runner[0]} is not installed"
    sources = ["memory.c", "dlo_solver.c", "-lm", "-pthread", "-o", "run"]
    build = ["cc", "-std=c99", *STRICT, *flags, *sources]
    made = subprocess.run(build, cwd=folder, capture_output=True, text=True)
    if made.returncode:
        return made.stderr
    command = [*runner, "./run", str(problems), str(threads)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    silent = done.returncode == 0 and not done.stderr
    return (
        f"silent: {done.stdout.strip()}" if silent else f"{done.returncode}: {done.stderr[:2000]}"
    )
