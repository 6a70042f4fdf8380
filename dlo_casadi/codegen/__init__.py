"""The C solver that planners embed."""

from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.codegen.generate import Solver, generate
from dlo_casadi.codegen.shapes import STATUSES, Path2D, Shape, Slope

__all__ = ["STATUSES", "CompiledSolver", "Path2D", "Shape", "Slope", "Solver", "generate"]
