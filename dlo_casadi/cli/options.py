"""What the subcommands share: the look of their help, and where they print."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from rich.console import Console

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


def console(quiet: bool = False) -> Console:
    """Where results go; a file or a pipe has room for a whole table."""
    width = None if sys.stdout.isatty() else 120
    return Console(quiet=quiet, highlight=False, width=width)


def print_json(data: Any) -> None:
    """Print plain data as JSON, and nothing else."""
    print(json.dumps(data, indent=1, allow_nan=False))
