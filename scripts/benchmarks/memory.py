"""Sanitisers and valgrind over random problems, for several kinds of cable."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from dlo_casadi.codegen import generate
from dlo_casadi.effects import AxialStretch, BendingSoftening, Cable, LumpedMass
from dlo_casadi.model import CableModel

HERE = Path(__file__).parent
KINDS = (("link", "pinned", "pinned"), ("arc", "clamped", "clamped"), ("link", "clamped", "free"))
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
SANITIZE = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def run(problems: int = 100) -> dict[str, Any]:
    """Statuses counted (ok, unreachable, ...) and what the tools said; "silent" is good."""
    out: dict[str, Any] = {}
    for element, start, end in KINDS:
        for effects in ((), (AxialStretch(), BendingSoftening(), LumpedMass())):
            cable = Cable(0.8, 0.2, 0.01, 0.05)
            model = CableModel(cable, 12, element, start, end, effects=effects)  # type: ignore[arg-type]
            p = model.nominal.copy()
            p[1:] += 1e-3
            rest = model.rest_basis @ np.random.default_rng(0).normal(size=9)
            folder = Path(tempfile.mkdtemp(prefix="dlo_memory_"))
            generate(model, p, rest).write(folder)
            shutil.copy(HERE / "memory.c", folder)
            name = f"{element} {start} {end}" + (" with effects" if effects else "")
            out[name] = {
                "sanitizers": _build(folder, SANITIZE, [], problems),
                "valgrind": _build(
                    folder,
                    ("-g", "-O1"),
                    ["valgrind", "-q", "--error-exitcode=9", "--leak-check=full"],
                    max(1, problems // 20),
                ),
            }
            shutil.rmtree(folder)
    return out


def _build(folder: Path, flags: tuple[str, ...], runner: list[str], problems: int) -> str:
    """Compile and run; counted statuses if silent, else what was said."""
    if runner and shutil.which(runner[0]) is None:
        return f"{runner[0]} is not installed"
    build = ["cc", "-std=c99", *STRICT, *flags, "memory.c", "dlo_solver.c", "-lm", "-o", "run"]
    made = subprocess.run(build, cwd=folder, capture_output=True, text=True)
    if made.returncode:
        return made.stderr
    done = subprocess.run(
        [*runner, "./run", str(problems)], cwd=folder, capture_output=True, text=True
    )
    silent = done.returncode == 0 and not done.stderr
    return f"silent: {done.stdout.strip()}" if silent else done.stderr[:2000]
