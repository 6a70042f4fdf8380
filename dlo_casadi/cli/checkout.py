"""Scripts that are no part of the installed package: run from a checkout."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import dlo_casadi
from dlo_casadi.cli.options import command
from dlo_casadi.errors import DloError

EXAMPLES = """\
dlo {name}
dlo {name} -- --help                         options of the script, which follow --"""


def run_script(name: str, description: str, script: str, argv: Sequence[str]) -> int:
    """Run `dlo NAME [-- OPTION ...]`: a script of the checkout that the package belongs to.

    Raises
    ------
    DloError
        If the package was installed without its checkout.
    """
    parser = command(name, description, EXAMPLES.format(name=name), "others are the script's own")
    parser.add_argument("option", nargs="*", help="passed on to the script")
    chosen = parser.parse_args(argv)
    path = Path(dlo_casadi.__file__).parents[1] / "scripts" / script
    if not path.is_file():
        raise DloError(
            f"{script} is not part of the installed package; it needs a checkout: clone the "
            "repository, install it with `pip install -e .` and call dlo from there."
        )
    return subprocess.run([sys.executable, str(path), *chosen.option], check=False).returncode
