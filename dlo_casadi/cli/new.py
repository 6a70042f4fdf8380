"""Commands without a session: `dlo new`, `dlo schema`, `dlo reproduce`, `dlo benchmark`."""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import dlo_casadi
from dlo_casadi.cli.common import Page, command, one_of, option
from dlo_casadi.config.load import IMAGE_ENDINGS
from dlo_casadi.config.problems import PLACEHOLDER
from dlo_casadi.config.template import Kind, schema_text, template, to_fill_in
from dlo_casadi.errors import DloError, counted
from dlo_casadi.io.files import write_file
from dlo_casadi.rod.supports import CLIPS


@command(
    option("file", type=Path, help="the configuration to write, such as rope.yaml"),
    one_of(
        option("--photographs", type=Path, metavar="DIR", help="folder of photographs"),
        option("--centerlines", type=Path, metavar="DIR", help="folder of CSV files"),
    ),
    option(
        "--motion",
        nargs="+",
        type=Path,
        default=(),
        metavar="FILE",
        help="recordings of the moving cable: CSV of markers or lines, or videos",
    ),
    option("--space", action="store_true", help="a cable that leaves the plane, held by grippers"),
    option(
        "--clips",
        nargs="+",
        default=(),
        choices=[str(kind) for kind in CLIPS],
        help="what holds it between its ends, in the order along the cable",
    ),
    json="print what was written as JSON",
)
def new(chosen: argparse.Namespace) -> None:
    """Write a commented configuration to start from: one pose for each file that is found,
    and FILL_IN wherever only you know the value. Nothing is asked, nothing replaced.

    dlo new rope.yaml
    dlo new rope.yaml --photographs photographs/
    dlo new rope.yaml --centerlines measured/
    dlo new loom.yaml --space --centerlines markers/
    dlo new loom.yaml --space --clips pinned eyelet
    dlo new rope.yaml --photographs photographs/ --motion swing.mp4
    """
    target: Path = chosen.file
    if target.suffix not in (".yaml", ".yml"):
        raise DloError(f"{target}: the name of a configuration ends in .yaml")
    if chosen.space and chosen.photographs is not None:
        raise DloError(
            "--space: in space a pose has several photographs, and the folder does not tell which "
            "belong together.\n  Try: --centerlines, or --space alone"
        )
    files: list[str] = []
    if chosen.photographs is not None:
        files = _listed(chosen.photographs, IMAGE_ENDINGS, "photograph", target.parent)
    elif chosen.centerlines is not None:
        files = _listed(chosen.centerlines, (".csv",), "CSV file", target.parent)
    kind: Kind = "images" if chosen.centerlines is None else "centerlines"
    held = ["start", "start_orientation", "end", "end_orientation"]
    motions = [
        {
            "file": Path(os.path.relpath(path, target.parent)).as_posix(),
            **dict.fromkeys(held if chosen.space else held[::2], PLACEHOLDER),
            "begins": "moving",
            "role": "fit",
        }
        for path in chosen.motion
    ]
    if missing := [str(x) for x in chosen.motion if not x.is_file()]:
        raise DloError(f"--motion: {missing[0]} is no file")
    text = template(target.stem, files, kind, chosen.space, clips=chosen.clips, motions=motions)
    schema = target.with_name("schema.json")
    written = [target]
    if os.path.lexists(target):
        raise DloError(f"{target} exists already, and nothing is replaced")
    if not os.path.lexists(schema):
        write_file(schema, schema_text())
        written.append(schema)
    write_file(target, text)
    page = Page(chosen)
    told = {"motions": len(motions)} if motions else {}
    page.data({"files": [str(path) for path in written], "poses": len(files)} | told)
    poses = counted(len(files), "pose") if files else "a pose to copy"
    poses += f", {counted(len(motions), 'motion')}" if motions else ""
    page.say(f"{target}: {poses}, {to_fill_in(text)}\nthen: dlo check {target}")


def _listed(folder: Path, endings: Sequence[str], what: str, base: Path) -> list[str]:
    """Files of a folder sorted by name (pose_2 before pose_10), relative to `base`."""
    try:
        found = [path for path in folder.iterdir() if path.suffix.lower() in endings]
    except OSError as error:
        raise DloError(
            f"{folder} cannot be read: {error.strerror}.\n  Try: the folder that holds your {what}."
        ) from None
    if not found:
        raise DloError(f"{folder} holds no {what} ({', '.join(endings)})")

    def parts(path: Path) -> list[int | str]:
        return [int(t) if t.isdecimal() else t for t in re.split(r"(\d+)", path.name)]

    return [Path(os.path.relpath(path, base)).as_posix() for path in sorted(found, key=parts)]


@command(
    json=None,
)
def schema(chosen: argparse.Namespace) -> None:
    """Print the JSON schema of a configuration, for editors.

    dlo schema > schema.json
        then `# yaml-language-server: $schema=schema.json` as the first line of a configuration
        gives completion, help and checks in editors with the YAML language server
    """
    print(schema_text(), end="")


# ---- a checkout's scripts ------------------------------------------------------------------------


_script = command(
    option("option", nargs="*", metavar="-- OPTION", help="passed on to the script"),
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
