"""What may stand behind a key of a file: numbers, places, orientations; how was measured.

What lies beyond a range is a slip (a unit, an exponent) and cannot be computed with: it is refused
with the range that is allowed. What can be computed but is hardly meant is a warning of
`load_config`.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, Self, TypeAlias

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from dlo_casadi.config.problems import Contradiction, Problem, did_you_mean, show
from dlo_casadi.effects.cable import STIFFNESS_BOUNDS
from dlo_casadi.errors import counted
from dlo_casadi.model.cable_model import Tolerances as Known


class Range(NamedTuple):
    """From where to where a value can lie."""

    least: float
    most: float
    unit: str

    def __contains__(self, value: object) -> bool:
        return isinstance(value, int | float) and self.least <= value <= self.most

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g}{self.unit and ' '}{self.unit} is possible"

    def complaint(self, value: float) -> str:
        """What is wrong with a value that lies outside; empty if it does not."""
        return "" if value in self else f"{value:g}{self.unit and ' '}{self.unit}: {self}"


# Nothing shorter than a millimetre is held in two fixtures; 100 m hang between two masts.
LENGTH = Range(1.0e-3, 100.0, "m")
# Rounding to three digits moves the length of a quaternion by so much at most.
_UNIT = 2.0e-3
# Carbon fibres have 5e-6 m; the upper limit is the length itself.
_THINNEST = 1.0e-6
# A millimetre of the thinnest wire on sale (copper, 10 um): 9e3 pi (5e-6)^2 1e-3 = 7e-10 kg.
_LIGHTEST = 1.0e-10
# A metre of a submarine power cable has 100 kg.
_HEAVIEST, _HEAVIEST_PER_METRE = 1000.0, 100.0
# From polystyrene foam to osmium, the densest metal.
_DENSITIES = Range(15.0, 2.26e4, "kg/m^3")
# A strip whose thickness is declared as its diameter seems denser (0.9 mm, 0.25 m and 17 g: 1.1e5),
# a tube lighter; but 200 kg/m^3, less than any rope, are 2e5 in grams, and what is lighter than air
# does not hang.
_POSSIBLE_DENSITIES = Range(1.2, 2.0e5, "kg/m^3")
# A carbon fibre has E pi d^4 / 64 = 2.3e11 pi (5e-6)^4 / 64 = 7e-12 N m^2, a steel bar of 0.5 m
# 6e8 N m^2: the bounds of the fit itself.
STIFFNESS = Range(*STIFFNESS_BOUNDS, "N m^2")
# The largest centrifuge for models of soil reaches some 1e3 times the Earth's 9.81 m/s^2.
GRAVITY = Range(0.0, 1.0e4, "m/s^2")
# A frame whose origin is farther away is that of a map; of 1e3 m, doubles resolve 1e-13 m.
COORDINATE = Range(-1.0e3, 1.0e3, "m")
# The heaviest cable (100 kg/m, 100 m) weighs 1e5 N; taut it pulls more. A moment: a metre's arm.
FORCE, MOMENT = Range(-1.0e6, 1.0e6, "N"), Range(-1.0e6, 1.0e6, "N m")
# Two elements have a joint between them; of a metre, 2000 are half a millimetre each, less than a
# cable is thick.
MESH = Range(2, 2000, "elements")
# Cubic splines need four coefficients. A line of 240 points has four between two knots of 64; the
# covariance that a result holds grows with their square.
REST_COEFFICIENTS = Range(0, 64, "coefficients")


def implausible_sizes(length: float, mass: float, diameter: float) -> list[Problem]:
    """Find sizes [m], [kg] of a cable that no cable has: one by one, then all together."""

    def density(diameter: float) -> float:
        """Mass over volume [kg/m^3] of a round cable: m / (pi d^2 / 4 L)."""
        return mass / (length * math.pi * diameter * diameter / 4)  # inf where ** would raise

    def meant(value: float, possible: bool) -> str:
        return f"did you mean {value:g}? " if possible else ""

    def in_metres() -> str:
        """Question after a diameter of millimetres or centimetres that would be sound."""
        sound = [d for d in (diameter / 1e3, diameter / 1e2) if density(d) in _DENSITIES]
        return f", did you mean {sound[0]:g}?" if sound else ""

    wrong: list[tuple[str, str]] = []
    if length not in LENGTH:
        hint = meant(length / 1e3, length / 1e3 in LENGTH)
        wrong.append(("length", f"{length:g} m: units are SI, {hint}{LENGTH}"))
    elif diameter > length:
        text = f"{diameter:g} m is larger than the length {length:g} m: units are SI{in_metres()}"
        wrong.append(("diameter", text))
    elif thin := Range(_THINNEST, length, "m").complaint(diameter):
        wrong.append(("diameter", thin))
    heaviest = min(_HEAVIEST, _HEAVIEST_PER_METRE * length)
    if mass > heaviest:
        hint = meant(mass / 1e3, mass / 1e3 <= heaviest)  # of grams
        text = f"units are SI, {hint}at most {heaviest:g} kg is possible"
        wrong.append(("mass", f"{mass:g} kg for {length:g} m: {text}"))
    elif mass < _LIGHTEST:
        text = f"no cable is lighter than {_LIGHTEST:g} kg; to leave its weight out, write "
        wrong.append(("mass", f"{mass:g} kg: {text}gravity: [0, 0]"))
    apparent = math.nan if wrong else density(diameter)  # told of sizes that are sound alone
    if apparent > _POSSIBLE_DENSITIES.most:
        hint = meant(mass / 1e3, apparent / 1e3 in _DENSITIES)
        text = f"{mass:g} kg make it {apparent / 1e3:.3g} times as dense as water (osmium, the "
        text += f"densest metal: {_DENSITIES.most / 1e3:g}): units are SI, {hint}diameter and "
        wrong.append(("mass", f"{text}length in m?"))
    elif apparent < _POSSIBLE_DENSITIES.least:
        text = f"{diameter:g} m make {mass:g} kg lighter than air, {apparent:.2g} kg/m^3: units "
        wrong.append(("diameter", f"{text}are SI{in_metres()}, mass in kg?"))
    return [Problem((key,), text) for key, text in wrong]


def implausible_quaternion(values: Sequence[float]) -> str:
    """What is wrong with an orientation (x, y, z, w); empty if its length is one."""
    belongs = "a unit quaternion [qx, qy, qz, qw] belongs here"
    if len(values) != 4:
        return f"{belongs}, not {counted(len(values), 'number')}"
    size = math.hypot(*values)
    return "" if abs(size - 1) <= _UNIT else f"{belongs}, its length is {size:.4g}"


# ---- types -------------------------------------------------------------------------------------


class Section(BaseModel):
    """A frozen mapping of the file: unknown keys are errors, the docstring of a key is its help."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class OpenSection(Section):
    """A section in which other keys may stand beside those that are read."""

    model_config = ConfigDict(extra="ignore")


def optional(section: type[Section]) -> BeforeValidator:
    """Let a section be empty: `model:` with nothing behind it."""
    return BeforeValidator(
        lambda value: {} if value is None else value, json_schema_input_type=section | None
    )


def checked(complaint: Callable[[Any], str | list[Problem]]) -> AfterValidator:
    """Refuse a value with what is wrong with it, or with its keys, if anything is."""

    def check(value: Any) -> Any:
        if wrong := complaint(value):
            raise ValueError(wrong) if isinstance(wrong, str) else Contradiction(*wrong)
        return value

    return AfterValidator(check)


def within(allowed: Range) -> AfterValidator:
    """Refuse a number, or the numbers of a list, that lie outside of a range."""

    def complaint(value: Any) -> str:
        numbers = value if isinstance(value, tuple) else (value,)
        return "; ".join(filter(None, map(allowed.complaint, numbers)))

    return checked(complaint)


def stacked(names: Sequence[str]) -> BeforeValidator:
    """Numbers of several components by their names: one list, the components one after another."""

    def check(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        if missing := [name for name in names if not isinstance(value.get(name), list | tuple)]:
            raise ValueError(f"{missing[0]} is missing")
        return [number for name in names for number in value[name]]

    return BeforeValidator(check)


def _listed(belongs: str, schema: Any, *counts: int) -> BeforeValidator:
    """A list of one of these counts of numbers; the schema of editors tells it by its types."""

    def check(value: object) -> object:
        if not isinstance(value, list | tuple) or len(value) not in counts:
            raise ValueError(f"{belongs}, found {show(value)}")
        return value

    return BeforeValidator(check, json_schema_input_type=schema)


def _moment(value: object) -> object:
    if isinstance(value, list | tuple) and len(value) == 3:
        return value
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (value,)
    raise ValueError(f"one number belongs here, in space three [mx, my, mz], found {show(value)}")


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
NonNegative = Annotated[Number, Field(ge=0.0)]
Count = Annotated[int, Field(strict=True)]
Elements = Annotated[Count, Field(ge=MESH.least, le=MESH.most)]
RestCoefficients = Annotated[Count, Field(ge=REST_COEFFICIENTS.least, le=REST_COEFFICIENTS.most)]
Name = Annotated[str, Field(coerce_numbers_to_str=True)]
Switch = Annotated[bool, Field(strict=True)]
_Two: TypeAlias = tuple[Number, Number]
Row: TypeAlias = tuple[Number, Number, Number]
_Four: TypeAlias = tuple[Number, Number, Number, Number]
Vector = Annotated[_Two, _listed("two numbers [x, y] belong here", _Two, 2)]
Direction = Annotated[
    tuple[Number, ...],
    _listed("two numbers [x, y] belong here, in space three [x, y, z]", _Two | Row, 2, 3),
]
Place = Annotated[Direction, within(COORDINATE)]
Gravity = Annotated[Direction, checked(lambda vector: GRAVITY.complaint(math.hypot(*vector)))]
Force = Annotated[Direction, within(FORCE)]
Moment = Annotated[
    tuple[Number, ...],
    BeforeValidator(_moment, json_schema_input_type=Number | Row),
    within(MOMENT),
]
Quaternion = Annotated[
    tuple[Number, ...],
    _listed("a quaternion [qx, qy, qz, qw] belongs here", _Four, 4),
    checked(implausible_quaternion),
]


# ---- how was measured: camera, board or reference, noise and tolerances --------------------------


_STANDARD = Known()
# A nanonewton is what atomic force microscopes resolve.
FORCE_STD, MOMENT_STD = FORCE._replace(least=1.0e-9), MOMENT._replace(least=1.0e-9)
# A camera's picture is less than 1e5 pixels wide, its focal length less than ten times that.
PIXELS = Range(-1.0e6, 1.0e6, "px")
FOCAL_LENGTH = Range(1.0, 1.0e6, "px")
# Terms of a wide lens that cancel one another reach hundreds; a million is a slip.
DISTORTION = Range(-1.0e6, 1.0e6, "")
# A marker of a tenth of a millimetre has no pixels; ten metres are the side of a house.
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


class Camera(Section):
    """A pinhole camera with lens distortion, in OpenCV's convention."""

    matrix: Annotated[tuple[Row, Row, Row], checked(_no_pinhole)]
    """Camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [pixel]."""
    distortion: Annotated[tuple[Number, ...], within(DISTORTION), checked(_unknown_count)] = (
        0.0,
    ) * 5
    """OpenCV's 4, 5, 8, 12 or 14 coefficients k1, k2, p1, p2, k3, k4, ...; [] for none."""


# OpenCV's dictionaries of markers, and how many each has.
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


class Board(Section):
    """A plane board with ArUco markers; it defines the frame in which everything is measured."""

    dictionary: Annotated[str, checked(_unknown_dictionary)]
    """OpenCV's name of the marker dictionary, such as DICT_4X4_50."""
    marker_size: Annotated[Positive, within(MARKER)]
    """Side of the black square of a marker [m]."""
    standoff: Annotated[NonNegative, within(COORDINATE)] = 0.0
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


class Reference(Section):
    """Two known points in the photograph: scale, rotation and origin of a similarity transform."""

    pixels: Annotated[tuple[_Pixel, _Pixel], checked(_one_point)]
    """The two points in the photograph [[u, v], [u, v]], u to the right, v down [pixel]."""
    points: Annotated[tuple[_Place, _Place], checked(_one_point)]
    """The same two points in the board frame [[x, y], [x, y]] [m]."""


class Measurement(Section):
    """How well was measured."""

    std: Positive | None = None
    """Standard deviation of one centre-line coordinate [m]; estimated when absent, and, with a
    warning, where the points scatter more."""
    force_std: Annotated[Positive, within(FORCE_STD)] | None = None
    """Standard deviation of one component of a force on a fixture [N]; estimated when absent."""
    moment_std: Annotated[Positive, within(MOMENT_STD)] | None = None
    """Standard deviation of one component of a moment on a fixture [N m]; estimated when absent."""


class Images(Measurement):
    """Photographs of the cable, with a board or two known points."""

    kind: Literal["images"] = "images"
    """images."""
    camera: Camera | None = None
    """The camera. Without it, it is found from the session's photographs where it is needed (in
    space, or with a standoff); else the board's plane is mapped by a homography."""
    board: Board | None = None
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

    kind: Literal["centerlines"] = "centerlines"
    """centerlines."""


class Tolerances(Section):
    """How well the declared values are known: one standard deviation each."""

    length: Positive = _STANDARD.length
    """Of the cable's length [m]."""
    end: Positive = _STANDARD.end
    """Of a coordinate of a fixture [m]."""
    heading: Positive = _STANDARD.heading
    """Of a clamp's heading in a plane [rad]."""
    rotation: Positive = _STANDARD.rotation
    """Of a clamp's orientation in space, about each of its axes [rad]."""
    roll: Positive = _STANDARD.roll
    """Of the roll of a cable in its end clamp, about itself [rad]."""
    scale: Positive = _STANDARD.scale
    """Of the scale of the measurement, relative."""
    camera_rotation: Positive = _STANDARD.camera_rotation
    """Of the frame of a measurement in space against the fixtures, about each axis [rad]."""
    camera_translation: Positive = _STANDARD.camera_translation
    """Of the frame of a measurement in space against the fixtures, along each axis [m]."""
    force_bias: Positive = _STANDARD.force_bias
    """Of a constant offset of a sensor's force, each component [N]."""
    moment_bias: Positive = _STANDARD.moment_bias
    """Of a constant offset of a sensor's moment, each component [N m]."""
