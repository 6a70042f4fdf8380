"""How was measured: camera, board or reference, noise and tolerances."""

import itertools
import math
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, ValidationInfo, field_validator, model_validator

from dlo_casadi.config.problems import did_you_mean
from dlo_casadi.config.values import (
    COORDINATE,
    FORCE,
    MOMENT,
    ConfigSection,
    NonNegative,
    Number,
    Positive,
    Range,
    Row,
    Vector,
    checked,
    within,
)
from dlo_casadi.errors import counted
from dlo_casadi.model.cable_model import Tolerances

_STANDARD = Tolerances()
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


class DeclaredCamera(ConfigSection):
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


class DeclaredBoard(ConfigSection):
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


class Reference(ConfigSection):
    """Two known points in the photograph: scale, rotation and origin of a similarity transform."""

    pixels: Annotated[tuple[_Pixel, _Pixel], checked(_one_point)]
    """The two points in the photograph [[u, v], [u, v]], u to the right, v down [pixel]."""
    points: Annotated[tuple[_Place, _Place], checked(_one_point)]
    """The same two points in the board frame [[x, y], [x, y]] [m]."""


class Measurement(ConfigSection):
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
    camera: DeclaredCamera | None = None
    """The camera. Without it, it is found from the session's photographs where it is needed (in
    space, or with a standoff); else the board's plane is mapped by a homography."""
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

    kind: Literal["centerlines"] = "centerlines"
    """centerlines."""


class DeclaredTolerances(ConfigSection):
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
    force_bias: Positive = _STANDARD.force_bias
    """Of a constant offset of a sensor's force, each component [N]."""
    moment_bias: Positive = _STANDARD.moment_bias
    """Of a constant offset of a sensor's moment, each component [N m]."""
