"""Effects: the explicit list of what a configuration or the diagnosis may name."""

from dlo_casadi.effects.across_gravity import GravityTilt as GravityTilt
from dlo_casadi.effects.across_gravity import SideLoad as SideLoad
from dlo_casadi.effects.bending_anisotropy import BendingAnisotropy as BendingAnisotropy
from dlo_casadi.effects.bending_softening import BendingSoftening as BendingSoftening
from dlo_casadi.effects.cable import CableData as CableData
from dlo_casadi.effects.camera_frame import CameraFrame as CameraFrame
from dlo_casadi.effects.clamps import ClampAngle as ClampAngle
from dlo_casadi.effects.clamps import ClampCompliance as ClampCompliance
from dlo_casadi.effects.clamps import ClampRotation as ClampRotation
from dlo_casadi.effects.clips import ClipOffset as ClipOffset
from dlo_casadi.effects.clips import ClipSlip as ClipSlip
from dlo_casadi.effects.contact import ContactPlane as ContactPlane
from dlo_casadi.effects.contact import ObstacleOffset as ObstacleOffset
from dlo_casadi.effects.edge_bias import EdgeBias as EdgeBias
from dlo_casadi.effects.effect import BoundaryEffect as BoundaryEffect
from dlo_casadi.effects.effect import ContactEffect as ContactEffect
from dlo_casadi.effects.effect import Effect as Effect
from dlo_casadi.effects.effect import EndConditions as EndConditions
from dlo_casadi.effects.effect import Fitted as Fitted
from dlo_casadi.effects.effect import Kinematics as Kinematics
from dlo_casadi.effects.effect import Load as Load
from dlo_casadi.effects.effect import MeasurementEffect as MeasurementEffect
from dlo_casadi.effects.effect import PointForceAt as PointForceAt
from dlo_casadi.effects.effect import PointLoad as PointLoad
from dlo_casadi.effects.effect import SectionLaw as SectionLaw
from dlo_casadi.effects.effect import SpringAt as SpringAt
from dlo_casadi.effects.effect import StateEffect as StateEffect
from dlo_casadi.effects.effect import Viewpoint as Viewpoint
from dlo_casadi.effects.end_offset import EndOffset as EndOffset
from dlo_casadi.effects.end_spring import EndSpring as EndSpring
from dlo_casadi.effects.end_spring import PinMoment as PinMoment
from dlo_casadi.effects.end_spring import StartSpring as StartSpring
from dlo_casadi.effects.image_distortion import ImageDistortion as ImageDistortion
from dlo_casadi.effects.image_scale import ImageScale as ImageScale
from dlo_casadi.effects.length import AxialStretch as AxialStretch
from dlo_casadi.effects.length import LengthError as LengthError
from dlo_casadi.effects.lumped_mass import LumpedMass as LumpedMass
from dlo_casadi.effects.mass_error import MassError as MassError
from dlo_casadi.effects.point_force import PointForce as PointForce
from dlo_casadi.effects.point_force import UnknownPull as UnknownPull
from dlo_casadi.effects.rest_shape import PlasticSet as PlasticSet
from dlo_casadi.effects.rest_shape import RestCurvatureDrift as RestCurvatureDrift
from dlo_casadi.effects.sensor_bias import SensorBias as SensorBias
from dlo_casadi.effects.setup import Setup as Setup
from dlo_casadi.effects.standoff_error import StandoffError as StandoffError
from dlo_casadi.effects.stiffness import StiffnessGradient as StiffnessGradient
from dlo_casadi.effects.stiffness import StiffSection as StiffSection
from dlo_casadi.effects.tether import Tether as Tether

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
        ClipOffset,
        ClipSlip,
        ObstacleOffset,
        ContactPlane,
        RestCurvatureDrift,
        PlasticSet,
        ImageScale,
        ImageDistortion,
        StandoffError,
        CameraFrame,
    )
}

# The effect that estimates a mass that is not declared.
UNKNOWN_MASS: type[Effect] = MassError
# The effect whose parameter moves a clip along the cable, for derivatives by its arc length.
ALONG_CABLE = ClipSlip

# Effects that may differ at random from pose to pose.
_KINDS: list[type[Effect]] = [PinMoment, *EFFECTS.values()]
RANDOM = {kind.name: kind for kind in _KINDS if kind.at_random}

# Effects of every measurement that are estimated with the others, never declared or diagnosed.
NUISANCES: dict[str, type[Effect]] = {kind.name: kind for kind in (EdgeBias, SensorBias)}


def known_effect(name: str) -> type[Effect] | None:
    """The effect or nuisance of that name."""
    return EFFECTS.get(name) or NUISANCES.get(name)
