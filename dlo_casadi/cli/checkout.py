"""`dlo reproduce`, `dlo benchmark`: scripts of a checkout, no part of the installed package."""

import argparse
import subprocess
import sys
from pathlib import Path

import dlo_casadi
from dlo_casadi.cli.options import command, option
from dlo_casadi.errors import DloError

_script = command(
    option("option", nargs="*", help="passed on to the script"),
    codes="others are the script's own",
    json=None,
)


@_script
def reproduce(chosen: argparse.Namespace) -> int:
    """Compare with the paper of Quartaro et al.; runs scripts/reproduce_paper.py of a checkout.

    dlo reproduce
    dlo reproduce -- --help                         options of the script, which follow --
    """
    return _run("reproduce_paper.py", chosen)


@_script
def benchmark(chosen: argparse.Namespace) -> int:
    """Time the C solver beside other solvers: runs scripts/benchmark.py of the checkout.

    dlo benchmark
    dlo benchmark -- --help                         options of the script, which follow --
    """
    return _run("benchmark.py", chosen)


def _run(name: str, chosen: argparse.Namespace) -> int:
    path = Path(dlo_casadi.__file__).parents[1] / "scripts" / name
    if not path.is_file():
        raise DloError(
            f"{name} is not part of the installed package; it needs a checkout: clone the "
            "repository, install it with `pip install -e .` and call dlo from there."
        )
    return subprocess.run([sys.executable, str(path), *chosen.option], check=False).returncode
