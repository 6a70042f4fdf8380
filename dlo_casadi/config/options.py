"""How a session was measured and is fitted: sensors, the model, the diagnosis; and limits."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from dlo_casadi.config.cameras import camera_of
from dlo_casadi.config.frozen import ConfigSection, entry
from dlo_casadi.config.problems import ConfigProblem, did_you_mean
from dlo_casadi.config.values import (
    COORDINATE,
    FORCE,
    LENGTH,
    MOMENT,
    Elements,
    NonNegative,
    Number,
    Positive,
    Range,
    RestCoefficients,
    Row,
    Switch,
    Vector,
    checked,
    within,
)
from dlo_casadi.errors import counted
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.rod.supports import SupportKind
from dlo_casadi.thresholds import SIGNIFICANCE

ElementName = Literal["quadratic", "arc", "link"]


class EffectParameter(ConfigSection):
    """The declared value of an effect's parameter: an initial guess, or kept when fixed."""

    value: Number
    """Value in the parameter's own unit."""
    fixed: Switch = False
    """Whether the value is kept; otherwise it is where the fit starts."""


_as_parameter = BeforeValidator(
    lambda value: value if isinstance(value, Mapping | EffectParameter) else {"value": value},
    json_schema_input_type=float | EffectParameter,
)


class DeclaredEffect(ConfigSection):
    """An effect that is part of the model from the start."""

    name: str
    """Name of the effect, such as lumped_mass."""
    parameters: dict[str, Annotated[EffectParameter, _as_parameter]] = entry(default={})
    """Initial guess of each parameter by its name; {value: ..., fixed: true} keeps a value."""


_as_effect = BeforeValidator(
    lambda value: {"name": value} if isinstance(value, str) else value,
    json_schema_input_type=str | DeclaredEffect,
)


class ModelOptions(ConfigSection):
    """The declared model."""

    n: Elements | None = None
    """Number of elements; chosen from the data when absent."""
    element: ElementName = "quadratic"
    """quadratic (curvature changes in an element: fourth order), arc (it is constant: second
    order, five times cheaper) or link (straight, as in the paper; in a plane only)."""
    effects: tuple[Annotated[DeclaredEffect, _as_effect], ...] = ()
    """Effects beside bending and weight."""


class EstimationOptions(ConfigSection):
    """How the parameters are estimated."""

    algorithm1: Switch = True
    """Whether the paper's loop runs as a baseline."""
    algorithm1_n: Annotated[int, Field(strict=True, ge=2, le=200)] = 10
    """Number of links in the paper's loop."""
    algorithm1_inner: Literal["ipopt", "cobyla"] = "ipopt"
    """Its inner minimisation: ipopt, or cobyla as in the paper (about 1 s a pose)."""
    robust: Switch = False
    """Whether single points far off their neighbours on the line are left out."""
    plausibility: Switch = True
    """Whether contradictions of the configuration stop the fit, or leave out a single pose."""
    rest_curvature_coefficients: RestCoefficients | None = None
    """Number of coefficients of the rest curvature, 0 for a straight one; chosen from the data."""


class DiagnosisOptions(ConfigSection):
    """The search for missing effects."""

    enabled: Switch = True
    """Whether missing effects are searched for."""
    exclude: tuple[str, ...] = ()
    """Names of effects that are not tried."""
    significance: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = SIGNIFICANCE
    """Largest p-value with which an effect is added."""
    max_effects: Annotated[int, Field(strict=True, ge=0)] = 4
    """Largest number of effects that are added."""


# Largest bend radius and clearance of a limit, in lengths of the cable. At three lengths the whole
# cable turns by 20 degrees; a limit mistakenly given in millimetres would be hundreds of lengths.
_LARGEST = 3.0
# A full turn within a tenth of a millimetre.
_TWIST = Range(0.0, 1.0e5, "1/m")
# The bound of `end_roll`: of a larger tolerance the bound would decide instead.
_ROLL = Range(0.0, 9.0, "rad")


class Limits(ConfigSection):
    """What the cable must keep."""

    bend_radius: Annotated[Positive, within(LENGTH._replace(least=1.0e-4))] | None = None
    """Least radius of curvature [m]."""
    force: Annotated[Positive, within(FORCE._replace(least=0.0))] | None = None
    """Greatest force of the cable on each of its fixtures [N]."""
    moment: Annotated[Positive, within(MOMENT._replace(least=0.0))] | None = None
    """Greatest moment of the cable on each clamp [N m]."""
    twist: Annotated[Positive, within(_TWIST)] | None = None
    """Greatest twist in space, the angle about the axis per length [1/m]."""
    clearance: Annotated[Positive, within(LENGTH._replace(least=1.0e-6))] | None = None
    """Smallest distance [m] of the cable's surface from obstacles it must not touch
    (`touch: avoided`)."""

    @property
    def given(self) -> dict[str, float]:
        """The declared limits, by name."""
        return self.declared

    def problems(
        self, held: Sequence[SupportKind], sprung: bool, twists: bool, length: float, avoided: bool
    ) -> Iterator[ConfigProblem]:
        """Find limits that are meaningless for a cable.

        `held`: kinds of its ends and clips; `sprung`: whether a pin has a spring; `length` [m]: of
        the cable; `twists`: whether it can twist, in space; `avoided`: whether there are obstacles
        that it must not touch.
        """
        for name in ("bend_radius", "clearance"):
            value = self.given.get(name, 0.0)
            if value > _LARGEST * length:
                text = f"limits.{name}: {value:g} m for a cable of {length:g} m: units are SI"
                meant = value / 1e3
                hint = f", did you mean {meant:g}?" if meant < length else ""
                yield ConfigProblem((name,), f"{text}{hint}")
        if self.clearance is not None and not avoided:
            text = "limits.clearance: there is no obstacle that the cable is not meant to touch"
            hint = "obstacles (experiment: obstacles, --obstacles FILE) without touch: allowed"
            yield ConfigProblem(("clearance",), f"{text}. Try: {hint}")
        if self.twist is not None and not twists:
            text = "limits.twist: a cable in a plane (two numbers of gravity) does not twist"
            yield ConfigProblem(("twist",), f"{text}. Try: leave it out")
        if self.moment is not None and not (sprung or any(kind.direction for kind in held)):
            text = f"limits.moment: nothing takes a moment, no end is clamped ({', '.join(held)})"
            yield ConfigProblem(("moment",), f"{text}. Try: leave it out")


# ---- measuring -----------------------------------------------------------------------------------

_STANDARD = Tolerances()
# Atomic force microscopes resolve a nanonewton.
FORCE_STD, MOMENT_STD = FORCE._replace(least=1.0e-9), MOMENT._replace(least=1.0e-9)
# A camera's picture is less than 1e5 pixels wide, its focal length less than ten times that.
PIXELS = Range(-1.0e6, 1.0e6, "px")
FOCAL_LENGTH = Range(1.0, 1.0e6, "px")
# Terms of a wide lens that cancel each other reach hundreds; a million is a typing error.
DISTORTION = Range(-1.0e6, 1.0e6, "")
# A marker of a tenth of a millimetre covers no pixel; ten metres are the side of a house.
MARKER = Range(1.0e-4, 10.0, "m")


def _no_pinhole(matrix: tuple[Row, Row, Row]) -> str:
    (fx, skew, cx), (below, fy, cy), last = matrix
    if fx <= 0.0 or fy <= 0.0 or skew != 0.0 or below != 0.0 or last != (0.0, 0.0, 1.0):
        return "must read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy"
    wrong = [*map(FOCAL_LENGTH.complaint, (fx, fy)), *map(PIXELS.complaint, (cx, cy))]
    return "; ".join(filter(None, wrong))


def _unknown_count(distortion: tuple[float, ...]) -> str:
    if len(distortion) in (0, 4, 5, 8, 12, 14):
        return ""
    found = counted(len(distortion), "number")
    return f"found {found}; OpenCV knows 4, 5 [k1, k2, p1, p2, k3], 8, 12 or 14"


class DeclaredCamera(ConfigSection):
    """A pinhole camera with lens distortion, in OpenCV's convention."""

    matrix: Annotated[tuple[Row, Row, Row], checked(_no_pinhole)]
    """Camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [pixel]."""
    distortion: Annotated[tuple[Number, ...], within(DISTORTION), checked(_unknown_count)] = (
        0.0,
    ) * 5
    """OpenCV's 4, 5, 8, 12 or 14 coefficients k1, k2, p1, p2, k3, k4, ...; [] for none."""


# OpenCV's marker dictionaries and the number of markers in each.
_DICTIONARIES = {
    **{f"DICT_{k}X{k}_{n}": n for k in (4, 5, 6, 7) for n in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}
_MOST_MARKERS = max(_DICTIONARIES.values())
_Centers: TypeAlias = dict[Annotated[int, Field(ge=0)], Annotated[Vector, within(COORDINATE)]]


def _unknown_dictionary(name: str) -> str:
    hint = did_you_mean(name, _DICTIONARIES)
    return "" if name in _DICTIONARIES else f"OpenCV has no dictionary {name!r}{hint}"


class DeclaredBoard(ConfigSection):
    """A plane board with ArUco markers; it defines the frame in which everything is measured."""

    dictionary: Annotated[str, checked(_unknown_dictionary)]
    """OpenCV's name of the marker dictionary, such as DICT_4X4_50."""
    marker_size: Annotated[Positive, within(MARKER)]
    """Side of the black square of a marker [m]."""
    standoff: Annotated[NonNegative, within(COORDINATE._replace(least=0.0))] = 0.0
    """Distance of the cable's axis in front of the board [m]; other than 0 needs a camera, or
    photographs from several directions that show it."""
    marker_centers: Annotated[_Centers, Field(min_length=1, max_length=_MOST_MARKERS)]
    """Centre of each marker by its id: {0: [x, y], 1: [x, y], ...} [m]."""

    @field_validator("marker_centers")
    @classmethod
    def _plausible(cls, centers: _Centers, info: ValidationInfo) -> _Centers:
        name, side = info.data.get("dictionary", ""), info.data.get("marker_size", 0.0)
        count = _DICTIONARIES.get(name, _MOST_MARKERS)
        if too_large := [i for i in centers if i >= count]:
            raise ValueError(f"{name} has no marker {too_large[0]:g}: its ids end at {count - 1}")
        for (i, a), (j, b) in itertools.combinations(centers.items(), 2):
            if math.dist(a, b) < side:
                raise ValueError(
                    f"markers {i} and {j} are {math.dist(a, b):g} m apart, closer than their "
                    f"size of {side:g} m: all in metres?"
                )
        return centers


def _one_point(pair: tuple[Vector, Vector]) -> str:
    return f"the two points are the same: {list(pair[0])}" if pair[0] == pair[1] else ""


_Pixel = Annotated[Vector, within(PIXELS)]
_Place = Annotated[Vector, within(COORDINATE)]


class Reference(ConfigSection):
    """Two known points in the photograph: scale, rotation and origin of a similarity transform."""

    pixels: Annotated[tuple[_Pixel, _Pixel], checked(_one_point)]
    """The two points in the photograph [[u, v], [u, v]], u to the right, v down [pixel]."""
    points: Annotated[tuple[_Place, _Place], checked(_one_point)]
    """The same two points in the board frame [[x, y], [x, y]] [m]."""


class Measurement(ConfigSection):
    """How well was measured."""

    # As descriptions, which the classes below inherit, unlike docstrings.
    std: Annotated[
        Positive | None,
        Field(
            description="Standard deviation of one centre-line coordinate [m]; estimated when "
            "absent, and, with a warning, where the points scatter more."
        ),
    ] = None
    force_std: Annotated[
        Annotated[Positive, within(FORCE_STD)] | None,
        Field(
            description="Standard deviation of one component of a force on a fixture [N]; "
            "estimated when absent."
        ),
    ] = None
    moment_std: Annotated[
        Annotated[Positive, within(MOMENT_STD)] | None,
        Field(
            description="Standard deviation of one component of a moment on a fixture [N m]; "
            "estimated when absent."
        ),
    ] = None


class Images(Measurement):
    """Photographs of the cable, with a board or two known points."""

    kind: Literal["images"]
    """images."""
    camera: Annotated[
        DeclaredCamera | None,
        BeforeValidator(camera_of, json_schema_input_type=str | DeclaredCamera | None),
    ] = None
    """The camera: matrix and distortion, or the content or the file of a calibration by ROS, OpenCV
    or Kalibr. Without it, it is found from the session's photographs where it is needed (in space,
    or with a standoff); else the board's plane is mapped by a homography."""
    board: DeclaredBoard | None = None
    """The board with its markers; or give reference."""
    reference: Reference | None = None
    """Two known points; or give board."""

    @model_validator(mode="after")
    def _one_frame(self) -> Self:
        if (self.board is None) == (self.reference is None):
            found = "neither" if self.board is None else "both"
            raise ValueError(f"kind: images needs either a board or a reference, found {found}")
        return self


class Centerlines(Measurement):
    """Centre-lines that were measured elsewhere, one CSV file a pose."""

    kind: Literal["centerlines"]
    """centerlines."""


class DeclaredTolerances(ConfigSection):
    """How well the declared values are known: one standard deviation each."""

    length: Positive = _STANDARD.length
    """Of the cable's length [m]."""
    end: Positive = _STANDARD.end
    """Of a coordinate of a fixture [m]."""
    heading: Positive = _STANDARD.heading
    """Of the heading of a clamp or saddle in a plane [rad]."""
    rotation: Positive = _STANDARD.rotation
    """Of a clamp's orientation in space, about each of its axes, of a saddle's across [rad]."""
    roll: Annotated[Positive, within(_ROLL)] = _STANDARD.roll
    """Of the roll of a cable in its end clamp, about itself [rad]."""
    clip: Positive = _STANDARD.clip
    """Of a coordinate of a clip between the ends [m]."""
    slip: Positive = _STANDARD.slip
    """Of the arc length at which a clip holds the cable [m]."""
    obstacle: Positive = _STANDARD.obstacle
    """Of the place of an obstacle's surface, along its normal [m]."""
    scale: Positive = _STANDARD.scale
    """Of the scale of the measurement, relative."""
    camera_rotation: Positive = _STANDARD.camera_rotation
    """Of the frame of a measurement in space against the fixtures, about each axis [rad]."""
    camera_translation: Positive = _STANDARD.camera_translation
    """Of the frame of a measurement in space against the fixtures, along each axis [m]."""
    delay: Positive | None = _STANDARD.delay
    """Of the fixtures' clock against that of the points of motions [s]; without it a difference is
    an effect to be found."""
    force_bias: Positive = _STANDARD.force_bias
    """Of a constant offset of a sensor's force, each component [N]."""
    moment_bias: Positive = _STANDARD.moment_bias
    """Of a constant offset of a sensor's moment, each component [N m]."""
