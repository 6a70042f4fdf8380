"""Compile a generated solver into a shared library."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from dlo_casadi.codegen.generate import Solver
from dlo_casadi.errors import DloError


def compile_library(solver: Solver, folder: Path, flags: Sequence[str] = ("-O2",)) -> Path:
    """Compile a solver into a shared library.

    Parameters
    ----------
    solver : Solver
    folder : Path
        Where the files go.
    flags : sequence of str
        Of the compiler, beside what a shared library needs.

    Raises
    ------
    DloError
        If there is no compiler, or it fails.
    """
    named = os.environ.get("CC")
    compiler = next((c for c in (named, "cc", "gcc", "clang") if c and shutil.which(c)), None)
    if compiler is None:
        raise DloError(
            "no C compiler found (looked for $CC, cc, gcc, clang).\n"
            "  Try: apt-get install gcc, or set CC; scripts/generate_solver.py needs none."
        )
    solver.write(folder)
    library = folder / f"{solver.prefix}_solver.so"
    command = [compiler, "-std=c99", *flags, "-fPIC", "-shared", f"{solver.prefix}_solver.c"]
    run = subprocess.run(
        [*command, "-o", library.name, "-lm"], cwd=folder, capture_output=True, text=True
    )
    if run.returncode:
        raise DloError(f"{compiler} could not compile the solver:\n{run.stderr[:2000]}")
    return library
