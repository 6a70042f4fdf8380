"""Models of electrical cables from photographs: fit, diagnose, predict, embed."""

__version__ = "0.1.0"

from dlo_casadi.codegen import CompiledSolver
from dlo_casadi.config import Config, load_config
from dlo_casadi.effects import EFFECTS, Cable
from dlo_casadi.equilibrium import Equilibrium, Pose, solve_equilibrium
from dlo_casadi.errors import (
    ConfigError,
    DloError,
    EquilibriumError,
    EstimationError,
    MeasurementError,
    VisionError,
)
from dlo_casadi.model import CableModel
from dlo_casadi.session import Outcome, run_session

__all__ = [
    "EFFECTS",
    "Cable",
    "CableModel",
    "CompiledSolver",
    "Config",
    "ConfigError",
    "DloError",
    "Equilibrium",
    "EquilibriumError",
    "EstimationError",
    "MeasurementError",
    "Outcome",
    "Pose",
    "VisionError",
    "load_config",
    "run_session",
    "solve_equilibrium",
]
