"""`dlo generate-solver`: the C solver of a fitted cable."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import command, print_json
from dlo_casadi.codegen import generate
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
    parser.add_argument("parameters", type=Path, help="parameters.yaml of a fit, or its folder")
    parser.add_argument("--output", type=Path, required=True, help="folder for the C files")
    parser.add_argument("--prefix", default="dlo", help="begins all public names (dlo)")
    parser.add_argument("--elements", type=int, help="number of elements, instead of the fit's")
    parser.add_argument("--element", choices=ELEMENTS, help="instead of the fit's")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--json", action="store_true", help="print files and hash as JSON")
    chosen = parser.parse_args(argv)

    model, p, rest, metadata = load_parameters(chosen.parameters)
    if chosen.elements or chosen.element:
        if model.has_state:
            raise DloError("the state of a drifting cable belongs to the fit's own elements")
        model = model.with_mesh(chosen.elements or model.n, chosen.element)
        rest = model.rest_basis @ metadata.coefficients
    solver = generate(model, p, rest, chosen.prefix)
    written = solver.write(chosen.output)
    if chosen.json:
        print_json({"files": [str(path) for path in written], "solver_hash": solver.hash})
    elif not chosen.quiet:
        print(*written, f"model hash {solver.hash}", sep="\n")
    return OK
