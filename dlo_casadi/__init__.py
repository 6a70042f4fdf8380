"""Elastic models of cables in the plane and in space: fit, diagnose, predict, embed."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "1.0.0"

if TYPE_CHECKING:
    from dlo_casadi.api import Result as Result
    from dlo_casadi.api import Session as Session
    from dlo_casadi.api import fit as fit
    from dlo_casadi.api import known_cable as known_cable
    from dlo_casadi.api import predict as predict
    from dlo_casadi.cable.estimate import Covariance as Covariance
    from dlo_casadi.cable.estimate import Estimate as Estimate
    from dlo_casadi.cable.file import load as load
    from dlo_casadi.cable.fitted_cable import FittedCable as FittedCable
    from dlo_casadi.cable.fitted_cable import Shape as Shape
    from dlo_casadi.cable.move import Move as Move
    from dlo_casadi.cable.placing import Placing as Placing
    from dlo_casadi.codegen import CompiledSolver as CompiledSolver
    from dlo_casadi.config import Cable as Cable
    from dlo_casadi.config import Clip as Clip
    from dlo_casadi.config import FixturePath as FixturePath
    from dlo_casadi.config import Motion as Motion
    from dlo_casadi.config import Obstacle as Obstacle
    from dlo_casadi.config import Pose as Pose
    from dlo_casadi.effects import EFFECTS as EFFECTS
    from dlo_casadi.errors import ConfigError as ConfigError
    from dlo_casadi.errors import DloError as DloError
    from dlo_casadi.errors import EquilibriumError as EquilibriumError
    from dlo_casadi.errors import EstimationError as EstimationError
    from dlo_casadi.errors import MeasurementError as MeasurementError
    from dlo_casadi.errors import VisionError as VisionError
    from dlo_casadi.tracking.tracker import Tracker as Tracker
    from dlo_casadi.tracking.update import Update as Update

# Module -> its public names. They are imported on first use, so that the command responds at once
# and handles an interrupt.
_PUBLIC = {
    "api": "Result Session fit known_cable predict",
    "cable.estimate": "Covariance Estimate",
    "cable.file": "load",
    "cable.fitted_cable": "FittedCable Shape",
    "cable.move": "Move",
    "cable.placing": "Placing",
    "tracking.tracker": "Tracker",
    "tracking.update": "Update",
    "codegen": "CompiledSolver",
    "config": "Cable Clip FixturePath Motion Obstacle Pose",
    "effects": "EFFECTS",
    "errors": "ConfigError DloError EquilibriumError EstimationError MeasurementError VisionError",
}
_HOMES = {name: f"{__name__}.{home}" for home, names in _PUBLIC.items() for name in names.split()}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
