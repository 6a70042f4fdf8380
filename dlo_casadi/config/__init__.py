"""YAML text <-> checked objects: the configuration of a fit, and plain YAML for results.

The only package that imports yaml. All units are SI. Every problem of a file is reported at once,
each with its line.
"""

from dlo_casadi.config.document import dump_yaml, read_yaml
from dlo_casadi.config.load import load_config, unknown_effect
from dlo_casadi.config.sections import (
    Board,
    Boundary,
    Cable,
    Camera,
    Centerlines,
    Config,
    DeclaredEffect,
    DiagnosisOptions,
    EffectParameter,
    EstimationOptions,
    Experiment,
    Images,
    ModelOptions,
    Pose,
    Reference,
    SkippedPose,
    Tolerances,
    implausible_sizes,
)

__all__ = [
    "Board",
    "Boundary",
    "Cable",
    "Camera",
    "Centerlines",
    "Config",
    "DeclaredEffect",
    "DiagnosisOptions",
    "EffectParameter",
    "EstimationOptions",
    "Experiment",
    "Images",
    "ModelOptions",
    "Pose",
    "Reference",
    "SkippedPose",
    "Tolerances",
    "dump_yaml",
    "implausible_sizes",
    "load_config",
    "read_yaml",
    "unknown_effect",
]
