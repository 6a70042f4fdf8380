"""The C compiler: a generated solver as a shared library."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from dlo_casadi.codegen.generate import Solver
from dlo_casadi.errors import DloError


def compile_library(solver: Solver, folder: Path, flags: Sequence[str] = ("-O2",)) -> Path:
    """Compile a solver into a shared library in a folder, with the required flags and these.

    Raises
    ------
    DloError
        If there is no compiler, or it fails.
    """
    named = os.environ.get("CC", "").strip()
    # A path, or a name with options: gcc -m64.
    words = [named] if shutil.which(named) else named.split()
    names = words[:1] or ["cc", "gcc", "clang"]
    compiler = next((name for name in names if shutil.which(name)), None)
    if compiler is None:
        looked = f"CC is {named!r}" if named else f"looked for {', '.join(names)}"
        raise DloError(
            f"no C compiler found ({looked}).\n"
            "  Try: apt-get install gcc, or set CC; dlo generate-solver needs none."
        )
    if isinstance(flags, str):
        raise DloError(f"flags is a sequence of words, found {flags!r}\n  Try: {flags.split()}")
    solver.write(folder)
    library = folder / f"{solver.prefix}_solver.so"
    prefix = solver.prefix.upper()
    command = [compiler, *words[1:], "-std=c99", *flags, "-fPIC", "-shared"]
    command += [f"-D{prefix}_SHARED", f"-D{prefix}_BUILDING"]
    command += [f"{solver.prefix}_solver.c", "-o", library.name, "-lm"]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if run.returncode:
        raise DloError(f"{compiler} could not compile the solver:\n{run.stderr[:2000]}")
    return library


def workspace_of(library: ctypes.CDLL, prefix: str = "dlo") -> int:
    """Size of a workspace of a compiled solver, in doubles."""
    size = getattr(library, f"{prefix}_workspace_size")
    size.restype = ctypes.c_size_t
    return int(size())
