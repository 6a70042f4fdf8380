"""YAML text <-> checked objects: the configuration of a fit, and plain YAML for results.

The only package that imports yaml. All units are SI. Every problem of a file is reported at once,
each with its line.
"""

from dlo_casadi.config.declared_effects import declared_setup, wrong_effects
from dlo_casadi.config.document import dump_yaml, read_document, read_yaml
from dlo_casadi.config.limits import (
    MESH,
    REST_COEFFICIENTS,
    Range,
    implausible_gravity,
    implausible_quaternion,
    implausible_sizes,
)
from dlo_casadi.config.load import load_config
from dlo_casadi.config.measuring import Camera, Centerlines, Images
from dlo_casadi.config.options import DeclaredEffect, EstimationOptions
from dlo_casadi.config.problems import Place, show
from dlo_casadi.config.sections import Config, Pose, SkippedPose

__all__ = [
    "MESH",
    "REST_COEFFICIENTS",
    "Camera",
    "Centerlines",
    "Config",
    "DeclaredEffect",
    "EstimationOptions",
    "Images",
    "Place",
    "Pose",
    "Range",
    "SkippedPose",
    "declared_setup",
    "dump_yaml",
    "implausible_gravity",
    "implausible_quaternion",
    "implausible_sizes",
    "load_config",
    "read_document",
    "read_yaml",
    "show",
    "wrong_effects",
]
