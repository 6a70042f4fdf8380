"""What the subcommands share: the look of their help, and where they print."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from dlo_casadi.config import Config, load_config
from dlo_casadi.errors import ConfigError

EXIT_CODES = "exit codes: 0 done, 1 a bug, 2 bad input, 130 interrupted"


def command(name: str, description: str, examples: str, codes: str = "") -> argparse.ArgumentParser:
    """Parser of a subcommand, with examples and exit codes below its help.

    Parameters
    ----------
    examples : str
        One command a line.
    codes : str
        What the exit codes mean here, if it is more than in every command.
    """
    listed = "\n".join(f"  {line}" for line in examples.splitlines())
    return argparse.ArgumentParser(
        prog=f"dlo {name}",
        description=description,
        epilog=f"examples:\n{listed}\n\n{EXIT_CODES}{'; ' * bool(codes)}{codes}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the configuration."""
    parser.add_argument("config", type=Path, help="configuration, such as configs/cable.yaml")


def add_parameters(parser: argparse.ArgumentParser) -> None:
    """Add the file of a fitted cable."""
    parser.add_argument("parameters", type=Path, help="parameters.yaml of a fit, or its folder")


def parsed(
    parser: argparse.ArgumentParser, argv: Sequence[str], json: str = "print JSON instead of tables"
) -> argparse.Namespace:
    """Add `--quiet` and `--json`, of which `json` is the help, and parse."""
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--json", action="store_true", help=json)
    return parser.parse_args(argv)


def add_jobs(parser: argparse.ArgumentParser, default: int = 1) -> None:
    """Add `--jobs`."""
    text = "number of processes; default %(default)s"
    parser.add_argument("--jobs", type=_positive, default=default, metavar="N", help=text)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: a number of processes, 1 or more")
    return int(text)


def session_jobs() -> int:
    """Processes of a single session by default: two where there are two processors.

    A third saves little. One where other processes cannot be started.
    """
    if multiprocessing.current_process().daemon:
        return 1
    return min(2, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2)


def configuration(path: Path) -> Config:
    """Load a configuration; of a folder, say which configurations it holds."""
    if os.path.isdir(path):
        found = [str(file) for file in sorted(path.glob("*.y*ml"))[:5]]
        hint = ", ".join(found) or "a YAML file, such as configs/cable.yaml"
        many = f"; all in it and below: dlo fit-many {path}" if found else ""
        raise ConfigError(f"a folder is no configuration.\n  Try: {hint}{many}", path)
    return load_config(path)


def console(quiet: bool = False) -> Console:
    """Where results go; a file or a pipe has room for a whole table."""
    width = None if sys.stdout.isatty() else 120
    return Console(quiet=quiet, highlight=False, width=width)


def print_json(data: Any) -> None:
    """Print plain data as JSON, and nothing else."""
    print(json.dumps(data, indent=1, allow_nan=False))
