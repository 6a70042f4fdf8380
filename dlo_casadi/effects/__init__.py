"""Effects: the explicit list of what a configuration or the diagnosis may name."""

from dlo_casadi.effects.axial_stretch import AxialStretch
from dlo_casadi.effects.bending_anisotropy import BendingAnisotropy
from dlo_casadi.effects.bending_softening import BendingSoftening
from dlo_casadi.effects.cable import Cable
from dlo_casadi.effects.camera_frame import CameraFrame
from dlo_casadi.effects.clamp_angle import ClampAngle
from dlo_casadi.effects.clamp_compliance import ClampCompliance
from dlo_casadi.effects.clamp_rotation import ClampRotation
from dlo_casadi.effects.edge_bias import EdgeBias
from dlo_casadi.effects.effect import (
    BoundaryEffect,
    Effect,
    EndConditions,
    Fitted,
    Kinematics,
    Load,
    MeasurementEffect,
    PointForceAt,
    PointLoad,
    SectionLaw,
    SpringAt,
    StateEffect,
    Viewpoint,
)
from dlo_casadi.effects.end_offset import EndOffset
from dlo_casadi.effects.end_spring import EndSpring, StartSpring
from dlo_casadi.effects.gravity_tilt import GravityTilt
from dlo_casadi.effects.image_distortion import ImageDistortion
from dlo_casadi.effects.image_scale import ImageScale
from dlo_casadi.effects.length_error import LengthError
from dlo_casadi.effects.lumped_mass import LumpedMass
from dlo_casadi.effects.mass_error import MassError
from dlo_casadi.effects.plastic_set import PlasticSet
from dlo_casadi.effects.point_force import PointForce
from dlo_casadi.effects.rest_curvature_drift import RestCurvatureDrift
from dlo_casadi.effects.sensor_bias import SensorBias
from dlo_casadi.effects.setup import Setup
from dlo_casadi.effects.side_load import SideLoad
from dlo_casadi.effects.standoff_error import StandoffError
from dlo_casadi.effects.stiff_section import StiffSection
from dlo_casadi.effects.stiffness_gradient import StiffnessGradient
from dlo_casadi.effects.tether import Tether
from dlo_casadi.effects.unknown_pull import UnknownPull

EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        LumpedMass,
        PointForce,
        Tether,
        SideLoad,
        GravityTilt,
        MassError,
        StiffnessGradient,
        StiffSection,
        BendingSoftening,
        BendingAnisotropy,
        AxialStretch,
        LengthError,
        StartSpring,
        EndSpring,
        ClampAngle,
        ClampRotation,
        ClampCompliance,
        EndOffset,
        RestCurvatureDrift,
        PlasticSet,
        ImageScale,
        ImageDistortion,
        StandoffError,
        CameraFrame,
    )
}

# What finds a mass that is not declared.
UNKNOWN_MASS: type[Effect] = MassError

# What a measurement has beside them: never declared, and never blamed for a residual.
NUISANCES: dict[str, type[Effect]] = {kind.name: kind for kind in (EdgeBias, SensorBias)}


def known_effect(name: str) -> type[Effect] | None:
    """The effect or nuisance of that name."""
    return EFFECTS.get(name) or NUISANCES.get(name)


__all__ = [
    "EFFECTS",
    "NUISANCES",
    "UNKNOWN_MASS",
    "AxialStretch",
    "BendingAnisotropy",
    "BendingSoftening",
    "BoundaryEffect",
    "Cable",
    "CameraFrame",
    "ClampAngle",
    "ClampCompliance",
    "ClampRotation",
    "EdgeBias",
    "Effect",
    "EndConditions",
    "EndOffset",
    "EndSpring",
    "Fitted",
    "GravityTilt",
    "ImageDistortion",
    "ImageScale",
    "Kinematics",
    "LengthError",
    "Load",
    "LumpedMass",
    "MassError",
    "MeasurementEffect",
    "PlasticSet",
    "PointForce",
    "PointForceAt",
    "PointLoad",
    "RestCurvatureDrift",
    "SectionLaw",
    "SensorBias",
    "Setup",
    "SideLoad",
    "SpringAt",
    "StandoffError",
    "StartSpring",
    "StateEffect",
    "StiffSection",
    "StiffnessGradient",
    "Tether",
    "UnknownPull",
    "Viewpoint",
    "known_effect",
]
