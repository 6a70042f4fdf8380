"""Write the C solver of a fitted cable for planners to embed.

    python scripts/generate_solver.py results/<run>/parameters.yaml --output DIR

Writes <prefix>_solver.h, <prefix>_solver.c, CMakeLists.txt, <prefix>_solver.pc.in and example.c.
"""

import argparse
import sys
from pathlib import Path

from dlo_casadi.codegen import generate
from dlo_casadi.errors import DloError
from dlo_casadi.report.parameters_file import load_parameters


def main() -> int:
    """Read the parameters, generate, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parameters", type=Path, help="parameters.yaml of a fit")
    parser.add_argument("--output", type=Path, required=True, help="folder for the C files")
    parser.add_argument("--prefix", default="dlo", help="begins all public names (dlo)")
    parser.add_argument("--elements", type=int, help="number of elements, instead of the fit's")
    parser.add_argument("--element", choices=("arc", "link"), help="instead of the fit's")
    chosen = parser.parse_args()
    try:
        model, p, rest, metadata = load_parameters(chosen.parameters)
        if chosen.elements or chosen.element:
            if model.has_state:
                raise DloError("the state of a drifting cable belongs to the fit's own elements")
            model = model.with_mesh(chosen.elements or model.n, chosen.element)
            rest = model.rest_basis @ metadata.coefficients
        solver = generate(model, p, rest, chosen.prefix)
        written = solver.write(chosen.output)
    except DloError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for path in written:
        print(path)
    print(f"model hash {solver.hash}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
