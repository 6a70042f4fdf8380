"""Effects: the explicit list of what a configuration or the diagnosis may name."""

from dlo_casadi.effects.across_gravity import GravityTilt, SideLoad
from dlo_casadi.effects.acting import MassAt, PointForceAt, SpringAt
from dlo_casadi.effects.bending_anisotropy import BendingAnisotropy
from dlo_casadi.effects.bending_softening import BendingSoftening
from dlo_casadi.effects.cable import CableData, Parameter, Setup
from dlo_casadi.effects.camera_frame import CameraFrame
from dlo_casadi.effects.clamps import ClampAngle, ClampCompliance, ClampRotation
from dlo_casadi.effects.clips import ClipAngle, ClipOffset, ClipSlip
from dlo_casadi.effects.clock_delay import ClockDelay
from dlo_casadi.effects.contact import ContactPlane, ObstacleOffset
from dlo_casadi.effects.damping import AirDrag, Damping, PinFriction, TurningLoss, ViscousDrag
from dlo_casadi.effects.effect import (
    BoundaryEffect,
    ContactEffect,
    Effect,
    EndConditions,
    Fitted,
    Kinematics,
    Load,
    MeasurementEffect,
    PointLoad,
    SectionLaw,
    StateEffect,
    Viewpoint,
)
from dlo_casadi.effects.end_offset import EndOffset
from dlo_casadi.effects.end_spring import EndSpring, PinMoment, StartSpring
from dlo_casadi.effects.image_distortion import ImageDistortion
from dlo_casadi.effects.image_scale import ImageScale
from dlo_casadi.effects.length import AxialStretch, LengthError
from dlo_casadi.effects.lumped_mass import LumpedMass
from dlo_casadi.effects.mass_error import MassError
from dlo_casadi.effects.nuisances import EdgeBias, SensorBias
from dlo_casadi.effects.point_force import PointForce, UnknownPull
from dlo_casadi.effects.registry import Registry
from dlo_casadi.effects.rest_shape import PlasticSet, RestCurvatureDrift
from dlo_casadi.effects.standoff_error import StandoffError
from dlo_casadi.effects.stiffness import DynamicStiffness, StiffnessGradient, StiffSection
from dlo_casadi.effects.tether import Tether
from dlo_casadi.rod.element import Cell

# What an effect of one's own is written with.
__all__ = [
    "EFFECTS",
    "BoundaryEffect",
    "CableData",
    "Cell",
    "ContactEffect",
    "Damping",
    "Effect",
    "EndConditions",
    "Kinematics",
    "Load",
    "MassAt",
    "MeasurementEffect",
    "Parameter",
    "PointForceAt",
    "PointLoad",
    "SectionLaw",
    "SpringAt",
    "StateEffect",
    "Viewpoint",
]

EFFECTS = Registry(
    (effect.name, effect)
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
        ClipOffset,
        ClipSlip,
        ClipAngle,
        ObstacleOffset,
        ContactPlane,
        RestCurvatureDrift,
        PlasticSet,
        ImageScale,
        ImageDistortion,
        StandoffError,
        CameraFrame,
    )
)

# Effects that still shapes do not know.
IN_MOTION: dict[str, type[Effect]] = {
    kind.name: kind
    for kind in (AirDrag, ViscousDrag, PinFriction, TurningLoss, DynamicStiffness, ClockDelay)
}

# Effect that estimates the mass if it is not declared.
UNKNOWN_MASS: type[Effect] = MassError
# Effects within which a motion may differ without a finding, and the standard deviation of their
# parameter: polymers and strands relax by more than a hundredth, and frequencies tell stiffness to
# a thousandth; which turnings internal damping opposes is not known.
TOLERATED_IN_MOTION: dict[type[Effect], float] = {DynamicStiffness: 0.01, TurningLoss: 0.5}
# Effect of the fixtures' clock, for a declared tolerance.
OF_CLOCKS: type[Effect] = ClockDelay
# Effect whose parameter moves a clip along the cable, for derivatives by the clip's arc length.
ALONG_CABLE = ClipSlip

# Effects of every measurement, estimated together with the others, never declared or diagnosed.
NUISANCES: dict[str, type[Effect]] = {kind.name: kind for kind in (EdgeBias, SensorBias)}


def random_effects() -> dict[str, type[Effect]]:
    """Effects that may differ at random from pose to pose, registered ones of users among them."""
    kinds: list[type[Effect]] = [PinMoment, *EFFECTS.values()]
    return {kind.name: kind for kind in kinds if kind.at_random}


def known_effect(name: str) -> type[Effect] | None:
    """The effect or nuisance of that name."""
    return EFFECTS.get(name) or IN_MOTION.get(name) or NUISANCES.get(name)
