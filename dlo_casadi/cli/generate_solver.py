"""`dlo generate-solver`: the C solver of a fitted cable."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import add_parameters, command, parsed, print_json
from dlo_casadi.codegen import generate
from dlo_casadi.equilibrium.fitted_cable import FittedCable
from dlo_casadi.errors import DloError
from dlo_casadi.io.parameters import load_parameters
from dlo_casadi.rod.chain import ELEMENTS

EXAMPLES = """\
dlo generate-solver results/cable/parameters.yaml --output solver
dlo generate-solver results/cable --output solver --prefix rope --elements 40"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo generate-solver PARAMETERS --output DIR [...]`."""
    parser = command(
        "generate-solver",
        "Write the C solver of a fitted cable for planners to embed: <prefix>_solver.h,\n"
        "<prefix>_solver.c, <prefix>_solver.hpp for C++, CMakeLists.txt, <prefix>_solver.pc.in and "
        "example.c.",
        EXAMPLES,
    )
    add_parameters(parser)
    parser.add_argument("--output", type=Path, required=True, help="folder for the C files")
    parser.add_argument("--prefix", default="dlo", help="begins all public names (dlo)")
    add_mesh(parser)
    chosen = parsed(parser, argv, "print files and hash as JSON")

    model, p, rest, _ = with_mesh(load_parameters(chosen.parameters), chosen)
    solver = generate(model, p, rest, chosen.prefix)
    written = solver.write(chosen.output)
    if chosen.json:
        print_json({"files": [str(path) for path in written], "solver_hash": solver.hash})
    elif not chosen.quiet:
        print(*written, f"model hash {solver.hash}", sep="\n")
    return OK


def add_mesh(parser: argparse.ArgumentParser) -> None:
    """Add `--elements` and `--element`, see `with_mesh`."""
    parser.add_argument("--elements", type=int, help="number of elements, instead of the fit's")
    parser.add_argument(
        "--element",
        choices=ELEMENTS,
        help="instead of the fit's; arcs are several times faster than quadratic elements",
    )


def with_mesh(cable: FittedCable, chosen: argparse.Namespace) -> FittedCable:
    """The cable on the mesh that is chosen, see `add_mesh`."""
    if not (chosen.elements or chosen.element):
        return cable
    if cable.model.has_state:
        raise DloError(
            f"{cable.model.cable.name!r} has a rest shape that changed from pose to pose, which is "
            "known on the fit's elements alone: leave out --elements and --element"
        )
    model = cable.model.with_mesh(chosen.elements or cable.model.n, chosen.element)
    return cable._replace(model=model, rest=model.rest_basis @ cable.metadata.coefficients)
