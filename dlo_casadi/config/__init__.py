"""Convert YAML text <-> checked objects: the configuration of a fit, and plain YAML for results.

No other package imports yaml and pydantic. All units are SI. All problems of a file are reported
together, each with its line.
"""

from dlo_casadi.config.cable import Cable
from dlo_casadi.config.document import dump_yaml, read_yaml
from dlo_casadi.config.effects import declared_effects, declared_setup, wrong_effects
from dlo_casadi.config.load import (
    any_photographs,
    checked_config,
    known_config,
    load_config,
)
from dlo_casadi.config.motions import FixturePath, Motion
from dlo_casadi.config.options import (
    Centerlines,
    DeclaredCamera,
    DeclaredEffect,
    DeclaredTolerances,
    EstimationOptions,
    Images,
    Limits,
)
from dlo_casadi.config.sections import Config, Pose, SkippedPose
from dlo_casadi.config.supports import Clip, Obstacle
