"""Write the list of what is public into docs/pages/stability.md: what a release must keep.

The list is read from the code: names and parameters of the Python interface, keys of a
configuration, effects, schemas of results, commands and their options, and the C interface.
"""

import argparse
import inspect
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from textwrap import fill
from typing import Any
from unittest.mock import patch

import numpy as np

import dlo_casadi as dlo
from dlo_casadi import effects
from dlo_casadi.cli import COMMANDS, main
from dlo_casadi.codegen import generate
from dlo_casadi.config.template import config_schema
from dlo_casadi.effects import CableData
from dlo_casadi.model.cable_model import CableModel

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/pages/stability.md"
HEADING = "## The list\n"


def page() -> str:
    """The page with the list as the code has it now."""
    said = PAGE.read_text().partition(HEADING)[0]
    return f"{said}{HEADING}\nWritten by `scripts/list_public.py`.\n{listed()}"


def listed() -> str:
    """All parts of the list, in Markdown."""
    parts = {
        "Python: `import dlo_casadi as dlo`": python_lines(dlo),
        "Effects of your own (provisional): `from dlo_casadi.effects import ...`": python_lines(
            effects
        ),
        "Effects: their names, and those of their parameters": effect_lines(),
        "Keys of a configuration": key_lines(),
        "Schemas of results": schema_lines(),
        "Commands": command_lines(),
        "C, with the prefix `dlo`": c_lines(),
    }
    blocks = (
        "\n".join(["", f"### {title}", "", "```text", *map(_wrapped, lines), "```", ""])
        for title, lines in parts.items()
    )
    return "".join(blocks)


def _wrapped(line: str) -> str:
    """A line in parts that fit on a page."""
    width, later = 98, 8 * " "
    return fill(
        line, width, subsequent_indent=later, break_long_words=False, break_on_hyphens=False
    )


def python_lines(module: Any) -> list[str]:
    """Names in `__all__`; parameters of what users call, attributes and methods of classes."""
    lines: list[str] = []
    for name in module.__all__:
        value = getattr(module, name)
        called = _is_declared(value) or inspect.isfunction(value) or module is effects
        lines.append(f"{name}{_parameters(value)}" if called and callable(value) else name)
        if inspect.isclass(value):
            others = [getattr(module, other) for other in module.__all__ if other != name]
            listed = set(filter(inspect.isclass, others))
            lines += [f"    {member}" for member in sorted(_members(value, listed))]
    return lines


def _is_declared(value: Any) -> bool:
    """Whether it is a part of a session: its attributes are the parameters of its constructor."""
    return hasattr(value, "__pydantic_fields__")


def _members(kind: type, listed: set[Any]) -> Iterator[str]:
    """Attributes and methods of the package's own classes, but for those of a class in the list."""
    names = {field.name for field in fields(kind)} if is_dataclass(kind) else set()
    inherited: set[str] = set()
    for base in kind.__mro__:
        home = base.__module__
        if home == "dlo_casadi.api" or (home.startswith("dlo_casadi.") and not _is_declared(kind)):
            names |= {*vars(base), *inspect.get_annotations(base)}
        if base in listed:
            inherited |= {name for one in base.__mro__ for name in vars(one)}
    for name in names - inherited:
        value = inspect.getattr_static(kind, name, None)
        if isinstance(value, staticmethod | classmethod):
            value = getattr(kind, name)
        if not name.startswith("_") and (callable(value) or not _is_declared(kind)):
            yield f"{name}{_parameters(value)}" if callable(value) else name


def _parameters(call: Any) -> str:
    """Parameters of a call without their types."""
    try:
        signature = inspect.signature(call)
    except ValueError:
        return ""
    bare = [
        parameter.replace(annotation=inspect.Parameter.empty)
        for name, parameter in signature.parameters.items()
        if name != "self"
    ]
    return str(inspect.Signature(bare))


def effect_lines() -> list[str]:
    """Each effect that a configuration may name, with its parameters in space or else the plane."""
    plane, space = (CableData(0.8, 0.2, 0.01, 0.05, torsional_stiffness=t) for t in (None, 0.04))
    lines = []
    for name, kind in sorted(dlo.EFFECTS.items()):
        own = [[p.name for p in kind().parameters(cable)] for cable in (plane, space)]
        text = ", ".join(own[0])
        lines.append(f"{name}: {text}" + f"; in space {', '.join(own[1])}" * (own[0] != own[1]))
    return lines


def key_lines() -> list[str]:
    """Each key of a configuration, sections in the order of their names."""
    schema = config_schema()
    sections = {"(top)": schema, **schema["$defs"]}
    return [
        f"{section}: {', '.join(found['properties'])}"
        for section, found in sections.items()
        if "properties" in found
    ]


def schema_lines() -> list[str]:
    """Identifiers of the files that the package writes."""
    texts = [file.read_text() for file in (ROOT / "dlo_casadi").rglob("*.py")]
    return sorted({found for text in texts for found in re.findall(r'"(dlo-\w+/\d+)"', text)})


def command_lines() -> list[str]:
    """Each command with its arguments and options."""
    lines = []
    for name in COMMANDS:
        parser = _parser_of(name)
        words = []
        for action in parser._actions:
            if action.dest != "help":
                words.append(" | ".join(action.option_strings) or action.dest.upper())
        lines.append(f"dlo {name} {', '.join(words)}".rstrip())
    return lines


def _parser_of(command: str) -> argparse.ArgumentParser:
    found: list[argparse.ArgumentParser] = []

    def keep(parser: argparse.ArgumentParser, *given: object) -> None:
        found.append(parser)
        raise SystemExit

    with patch.object(argparse.ArgumentParser, "parse_args", keep), suppress(SystemExit):
        main([command])
    return found[0]


def c_lines() -> list[str]:
    """Numbers, types and functions of the header of solvers that have all; CMake; the C++ class."""
    numbers: set[str] = set()
    types: set[str] = set()
    functions: set[str] = set()
    flat, loom = (CableData(0.8, 0.1, 0.01, 0.05, torsional_stiffness=t) for t in (None, 0.04))
    for cable, gravity in ((flat, (0.0, -9.81)), (loom, (0.0, 0.0, -9.81))):
        held = {"start": "clamped", "end": "clamped", "clips": ("clamped",)}
        model = CableModel(cable, 4, "arc", **held, gravity=gravity, n_rest=0)
        source = generate(model, model.nominal, np.zeros(model.chain.n_rests), obstacles=1)
        header, own = (
            re.sub(r"/\*.*?\*/", "", source.files[f"dlo_solver.{ending}"], flags=re.S)
            for ending in ("h", "hpp")
        )
        numbers |= {*re.findall(r"^#define (DLO_\w+) ", header, re.M)} - {"DLO_API"}
        numbers |= {*re.findall(r"defined\((DLO_\w+)\)", header)}
        numbers |= {*re.findall(r"option\((DLO_\w+)", source.files["CMakeLists.txt"])}
        for kind, body, name in re.findall(r"typedef (enum|struct) \{([^}]*)\} (\w+);", header):
            words = re.sub(r"#.*", "", body).split("," if kind == "enum" else ";")
            inside = ", ".join(" ".join(word.split()) for word in words if word.strip())
            where = " in space" if model.in_space else " in a plane"
            own_where = where if name in ("dlo_pose", "dlo_clip") else ""
            types.add(f"{name}{own_where}: {inside}")
        functions |= {" ".join(f.split()) for f in re.findall(r"DLO_API\n([^;#]+);", header)}
        offered = re.findall(
            r"^ALL_FOR_CASADI\((\w+), \w+, (\w+)", source.files["dlo_solver.c"], re.M
        )
        names = ", ".join(sorted(sum(offered, ())))
        functions.add(f"for casadi.external, ccw and cw in a plane: {names}")
        public = own.partition("private:")[0]
        types |= {f"dlo::{name}" for name in re.findall(r"^(?:struct|class) (\w+)", public, re.M)}
        for name, given in re.findall(r" (\w+)\(([^)]*)\)\n    \{", public):
            functions.add(f"dlo::Solver::{name}({' '.join(given.split())})")
    return [", ".join(sorted(numbers)), *sorted(types), *sorted(functions)]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    PAGE.write_text(page())
    sys.stdout.write(f"{PAGE}\n")
