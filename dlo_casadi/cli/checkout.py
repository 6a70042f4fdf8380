"""Scripts that are no part of the installed package: run from a checkout."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import dlo_casadi
from dlo_casadi.errors import DloError


def run_script(name: str, argv: Sequence[str]) -> int:
    """Run a script of the checkout that the package belongs to; return its exit code.

    Raises
    ------
    DloError
        If the package was installed without its checkout.
    """
    script = Path(dlo_casadi.__file__).parents[1] / "scripts" / f"{name}.py"
    if not script.is_file():
        raise DloError(
            f"{script.name} is not part of the installed package; it needs a checkout: clone the "
            "repository, install it with `pip install -e .` and call dlo from there."
        )
    return subprocess.run([sys.executable, str(script), *argv], check=False).returncode
