"""Functions of a segment as compiled C, for a cable evaluated in one pose after the other."""

import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path

import casadi as ca

from dlo_casadi.codegen.compiler import compile_library
from dlo_casadi.codegen.generate import Solver
from dlo_casadi.codegen.obstacles import Obstacles
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.stacked import Mapped

# What an equilibrium, its derivatives and those of its curve take.
_NAMES = (
    *("segment", "segment_sensitivity", "segment_curve_slopes"),
    *("station_slopes", "at_ends", "end_sensitivity"),
)
# Not contracted: products and sums are rounded as by CasADi.
_FLAGS = ("-O1", "-ffp-contract=off")


def compile_segments(model: CableModel) -> None:
    """Evaluate functions of a model as compiled C from now on, on any mesh.

    Raises
    ------
    DloError
        If there is no C compiler.
    """
    compile_functions([functions_of(model).mapped(name) for name in _NAMES])


def compile_functions(mapped: Sequence[Mapped]) -> None:
    """Compile functions into one library."""
    left = [one for one in mapped if not one.compiled]
    if not left:
        return
    generator = ca.CodeGenerator("dlo_solver.c")
    for one in left:
        generator.add(one.function)
    folder = Path(tempfile.mkdtemp(prefix="dlo_segments_"))
    source = Solver("dlo", "", {"dlo_solver.c": generator.dump()}, Obstacles())
    try:
        library = compile_library(source, folder, _FLAGS)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    for one in left:
        one.use(ca.external(one.function.name(), str(library)))
    weakref.finalize(left[0], shutil.rmtree, folder, ignore_errors=True)
