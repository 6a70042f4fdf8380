"""Common parts of the subcommands: options, format of the help, and output."""

import argparse
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from decimal import Decimal
from functools import wraps
from inspect import getdoc
from pathlib import Path
from textwrap import indent
from typing import Any

from rich.console import Console
from rich.markup import escape

from dlo_casadi.cli import EXIT_CODES, OK
from dlo_casadi.config import Config, load_config
from dlo_casadi.errors import ConfigError, DloError
from dlo_casadi.io.files import finite

# Endings of figures' names.
DRAWN = (".png", ".pdf", ".svg", ".jpg")

# Function that adds an option to a parser or a group.
Option = Callable[[Any], object]


def option(*names: str, **settings: Any) -> Option:
    """An argument of `argparse`."""
    return lambda parser: parser.add_argument(*names, **settings)


def one_of(*options: Option, required: bool = False) -> Option:
    """Make a group of mutually exclusive options."""

    def add(parser: Any) -> None:
        group = parser.add_mutually_exclusive_group(required=required)
        for item in options:
            item(group)

    return add


def jobs(default: int = 1) -> Option:
    """`--jobs`."""
    text = "number of processes; default %(default)s"
    return option("--jobs", type=_positive, default=default, metavar="N", help=text)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: a number of processes, 1 or more")
    return int(text)


def figure(what: str) -> Option:
    """`--figure`, the name of a file that can be drawn."""
    text = f"{what}: {', '.join(DRAWN)}"
    return option("--figure", type=_drawn, metavar="FILE", help=text)


def _drawn(text: str) -> Path:
    if Path(text).suffix.lower() not in DRAWN:
        raise DloError(f"--figure {text}: the name must end in {', '.join(DRAWN)}")
    return Path(text)


CONFIG = option("config", type=Path, help="configuration, such as configs/cable.yaml")
PARAMETERS = option("parameters", type=Path, help="parameters.yaml of a fit, or its folder")
SCHEDULER = option("--scheduler", metavar="ADDRESS", help="of a Dask cluster, instead")


def command(
    *options: Option, codes: str = "", json: str | None = "print JSON instead of tables"
) -> Callable[[Callable[[argparse.Namespace], int | None]], Callable[[Sequence[str]], int]]:
    """Make a subcommand from the function of the same name: from arguments to exit code.

    Its docstring is the help: a description and, after an empty line, examples, one command a line.
    A `CONFIG` among the options is loaded before the call.

    Parameters
    ----------
    options : Option
        In the order of the help.
    codes : str
        Meaning of the exit codes, if they differ from those of every command.
    json : str or None
        Help of `--json`, which is added with `--quiet`; neither is added if None.
    """
    if json is not None:
        quiet = option("--quiet", action="store_true", help="print nothing but errors")
        options = (*options, quiet, option("--json", action="store_true", help=json))

    def decorate(work: Callable[[argparse.Namespace], int | None]) -> Callable[..., int]:
        @wraps(work)
        def run(argv: Sequence[str]) -> int:
            description, _, examples = str(getdoc(work)).partition("\n\n")
            epilog = (
                f"examples:\n{indent(examples, '  ')}\n\n{EXIT_CODES}{'; ' * bool(codes)}{codes}"
            )
            parser = argparse.ArgumentParser(
                prog=f"dlo {work.__name__.strip('_').replace('_', '-')}",
                description=description,
                epilog=epilog,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            )
            for item in options:
                item(parser)
            chosen = parser.parse_args(plain_numbers(argv))
            if "config" in chosen:
                chosen.config = configuration(chosen.config)
            return work(chosen) or OK

        return run

    return decorate


def plain_numbers(argv: Sequence[str]) -> list[str]:
    """Write -1e-2 as -0.01: argparse takes the former for an option."""
    number = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
    return [f"{Decimal(text):f}" if number.fullmatch(text) else text for text in argv]


def configuration(path: Path) -> Config:
    """Load a configuration; for a folder, list the configurations it holds."""
    if os.path.isdir(path):
        found = [str(file) for file in sorted(path.glob("*.y*ml"))[:5]]
        hint = ", ".join(found) or "a YAML file, such as configs/cable.yaml"
        many = f"; all in it and below: dlo fit-many {path}" if found else ""
        raise ConfigError(f"a folder is no configuration.\n  Try: {hint}{many}", path)
    return load_config(path)


class Page(Console):
    """Destination of results: JSON only with `--json`, otherwise text, unless `--quiet`."""

    def __init__(self, chosen: argparse.Namespace) -> None:
        width = None if sys.stdout.isatty() else 120  # a file or a pipe has room for a whole table
        quiet = chosen.quiet or chosen.json
        super().__init__(quiet=quiet, highlight=False, emoji=False, width=width)
        self.as_json: bool = chosen.json

    def data(self, data: Any) -> None:
        """Print plain data as JSON, if requested; numbers that are not finite as null."""
        if self.as_json:
            print(json.dumps(finite(data), indent=1, allow_nan=False))

    def say(self, text: object, mark: str = "") -> None:
        """Print a line unchanged, however long, after a mark with markup."""
        self.print(f"{mark}{escape(str(text))}", soft_wrap=True)

    def warn(self, text: str) -> None:
        """Print a warning."""
        self.say(text, "[bold yellow]warning:[/] ")
