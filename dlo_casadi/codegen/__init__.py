"""The C solver that planners embed."""

from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.codegen.generate import Solver, generate
from dlo_casadi.codegen.shapes import (
    QUANTITIES,
    CompiledShape,
    Gap,
    ShapePath,
    Slope,
    Usage,
)
from dlo_casadi.codegen.statuses import STATUSES
from dlo_casadi.rod.obstacles import Capsule, Plane
