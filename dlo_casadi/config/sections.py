"""The checked objects: one class for each section of a configuration. All units are SI."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from dlo_casadi.config.limits import (
    COORDINATE,
    MARKER,
    MESH,
    REST_COEFFICIENTS,
    STIFFNESS,
    implausible_camera,
    implausible_pixels,
    implausible_sizes,
)
from dlo_casadi.config.problems import PLACEHOLDER, Contradiction, Problem, did_you_mean, show
from dlo_casadi.ends import REACTIONS
from dlo_casadi.errors import well_formed
from dlo_casadi.thresholds import SIGNIFICANCE


def _optional(section: type[Section]) -> BeforeValidator:
    """Let a section be empty: `model:` with nothing behind it."""
    return BeforeValidator(_empty_section, json_schema_input_type=section | None)


def _pair(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"two numbers [x, y] belong here, found {show(value)}")
    return value


def _place(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) not in (2, 3):
        raise ValueError(
            f"two numbers [x, y] belong here, in space three [x, y, z], found {show(value)}"
        )
    return value


def _moment(value: object) -> object:
    if isinstance(value, list | tuple):
        if len(value) == 3:
            return value
    elif isinstance(value, int | float) and not isinstance(value, bool):
        return (value,)
    raise ValueError(f"one number belongs here, in space three [mx, my, mz], found {show(value)}")


def _quaternion(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) != 4:
        raise ValueError(f"a quaternion [qx, qy, qz, qw] belongs here, found {show(value)}")
    return value


def _empty_section(value: object) -> object:
    """Read `model:` with nothing behind it as an empty section."""
    return {} if value is None else value


# Of copper in plastic [kg/m^3]: two sessions of tests have 2200. `mass_error` finds a fifth of it,
# a foam, to five times, which no metal of cables reaches.
DENSITY = 2200.0

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NonNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Count = Annotated[int, Field(strict=True)]
Switch = Annotated[bool, Field(strict=True)]
Vector = Annotated[
    tuple[Number, Number], BeforeValidator(_pair, json_schema_input_type=tuple[Number, Number])
]
Row = tuple[Number, Number, Number]
Place = Annotated[
    tuple[Number, ...],
    BeforeValidator(
        _place, json_schema_input_type=tuple[Number, Number] | tuple[Number, Number, Number]
    ),
]
Moment = Annotated[
    tuple[Number, ...],
    BeforeValidator(_moment, json_schema_input_type=Number | tuple[Number, Number, Number]),
]
Quaternion = Annotated[
    tuple[Number, ...],
    BeforeValidator(_quaternion, json_schema_input_type=tuple[Number, Number, Number, Number]),
]


class Section(BaseModel):
    """A frozen mapping of the file: unknown keys are errors, the docstring of a key is its help."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class Cable(Section):
    """The cable between its two fixtures."""

    name: Annotated[str, Field(coerce_numbers_to_str=True)] = "cable"
    """What to call the cable."""
    length: Positive
    """Length along the cable between its two fixtures [m]."""
    mass: Positive | None
    """Mass of that length [kg]; null where it is not known: readings of a force tell it."""
    diameter: Positive
    """Outer diameter [m]."""
    youngs_modulus: Positive | None = None
    """Young's modulus E of a solid round rod [Pa], a crude prior; or give bending_stiffness."""
    bending_stiffness: Positive | None = None
    """Bending stiffness EI [N m^2], a crude prior; or give youngs_modulus."""
    torsional_stiffness: Positive | None = None
    """Torsional stiffness GJ [N m^2] of a cable in space, a crude prior; EI / 1.3 when absent."""
    rest_shape: Literal["straight", "curved"] = "curved"
    """Shape without load: straight (no rest curvature is fitted) or curved."""

    @property
    def prior_bending_stiffness(self) -> float:
        """First guess of EI [N m^2]: as declared, or E pi d^4 / 64."""
        if self.bending_stiffness is not None:
            return self.bending_stiffness
        assert self.youngs_modulus is not None  # checked when the object was made
        square = self.diameter * self.diameter  # infinite of an absurd one, where ** raises
        return self.youngs_modulus * math.pi * square * square / 64.0

    @property
    def prior_mass(self) -> float:
        """Mass [kg] as declared, or that of a solid round rod of DENSITY."""
        if self.mass is not None:
            return self.mass
        return DENSITY * math.pi / 4.0 * self.diameter * self.diameter * self.length

    @property
    def prior_torsional_stiffness(self) -> float:
        """First guess of GJ [N m^2]: as declared, or EI / 1.3, of a round rod of nu = 0.3."""
        return self.torsional_stiffness or self.prior_bending_stiffness / 1.3

    @model_validator(mode="after")
    def _plausible(self) -> Cable:
        problems = implausible_sizes(
            self.length, self.prior_mass, self.diameter, self.bending_stiffness
        )
        if self.youngs_modulus is not None and self.bending_stiffness is None:
            stiffness = self.prior_bending_stiffness
            problems += STIFFNESS.problems(
                ("youngs_modulus",), stiffness, " for EI = E pi d^4 / 64"
            )
        if self.torsional_stiffness is not None:
            problems += STIFFNESS.problems(("torsional_stiffness",), self.torsional_stiffness)
        if self.youngs_modulus is None and self.bending_stiffness is None:
            problems.append(
                Problem((), "give youngs_modulus [Pa] or bending_stiffness [N m^2], found neither")
            )
        if self.youngs_modulus is not None and self.bending_stiffness is not None:
            problems.append(
                Problem(
                    ("bending_stiffness",), "give youngs_modulus or bending_stiffness, found both"
                )
            )
        if problems:
            raise Contradiction(*problems)
        return self


class Boundary(Section):
    """How the two ends are held."""

    start: Literal["pinned", "clamped"]
    """Start of the cable: pinned (free to turn) or clamped (its heading is held)."""
    end: Literal["pinned", "clamped", "free"]
    """End of the cable: pinned, clamped or free."""


class Camera(Section):
    """A pinhole camera with lens distortion, in OpenCV's convention."""

    matrix: tuple[Row, Row, Row]
    """Camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [pixel]."""
    distortion: tuple[Number, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's 4, 5, 8, 12 or 14 coefficients k1, k2, p1, p2, k3, k4, ...; [] for none."""

    @model_validator(mode="after")
    def _plausible(self) -> Camera:
        (fx, skew, _), (below, fy, _), last = self.matrix
        if fx <= 0.0 or fy <= 0.0 or skew != 0.0 or below != 0.0 or last != (0.0, 0.0, 1.0):
            text = "must read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy"
            raise Contradiction(Problem(("matrix",), text))
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14):
            text = (
                f"found {len(self.distortion)} numbers; OpenCV knows 4, 5 "
                "[k1, k2, p1, p2, k3], 8, 12 or 14"
            )
            raise Contradiction(Problem(("distortion",), text))
        if problems := implausible_camera(self.matrix, self.distortion):
            raise Contradiction(*problems)
        return self


ARUCO_DICTIONARIES = (
    *(f"DICT_{k}X{k}_{count}" for k in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    *(f"DICT_APRILTAG_{family}" for family in ("16h5", "25h9", "36h10", "36h11")),
)
"""Names of OpenCV's predefined marker dictionaries."""

_FAMILIES = {"ORIGINAL": 1024, "36h12": 250, "16h5": 30, "25h9": 35, "36h10": 2320, "36h11": 587}
"""Markers of the dictionaries whose name does not tell."""


class Board(Section):
    """A plane board with ArUco markers; it defines the frame in which everything is measured."""

    dictionary: str
    """OpenCV's name of the marker dictionary, such as DICT_4X4_50."""
    marker_size: Positive
    """Side of the black square of a marker [m]."""
    standoff: NonNegative = 0.0
    """Distance of the cable's axis in front of the board [m]; other than 0 needs a camera, or
    photographs from several directions that show it."""
    marker_centers: Annotated[
        dict[Annotated[int, Field(ge=0)], Vector],
        Field(min_length=1, max_length=max(_FAMILIES.values())),
    ]
    """Centre of each marker by its id: {0: [x, y], 1: [x, y], ...} [m]."""

    @model_validator(mode="after")
    def _plausible(self) -> Board:
        sizes = MARKER.problems(("marker_size",), self.marker_size)
        sizes += COORDINATE.problems(("standoff",), self.standoff)
        for i, center in self.marker_centers.items():
            for value in center:
                sizes += COORDINATE.problems(("marker_centers", i), value)
        if sizes:
            raise Contradiction(*sizes)
        if self.dictionary not in ARUCO_DICTIONARIES:
            hint = did_you_mean(self.dictionary, ARUCO_DICTIONARIES)
            text = f"OpenCV has no dictionary {self.dictionary!r}{hint}"
            raise Contradiction(Problem(("dictionary",), text))
        size = self.dictionary.rsplit("_", 1)[1]
        count = int(size) if size.isdigit() else _FAMILIES[size]
        too_large = [i for i in self.marker_centers if i >= count]
        if too_large:
            text = f"{self.dictionary} has no marker {too_large[0]:g}: its ids end at {count - 1}"
            raise Contradiction(Problem(("marker_centers",), text))
        for (i, a), (j, b) in itertools.combinations(self.marker_centers.items(), 2):
            if math.dist(a, b) < self.marker_size:
                text = (
                    f"markers {i} and {j} are {math.dist(a, b):g} m apart, closer than their "
                    f"size of {self.marker_size:g} m: all in metres?"
                )
                raise Contradiction(Problem(("marker_centers",), text))
        return self


class Reference(Section):
    """Two known points in the photograph: scale, rotation and origin of a similarity transform."""

    pixels: tuple[Vector, Vector]
    """The two points in the photograph [[u, v], [u, v]], u to the right, v down [pixel]."""
    points: tuple[Vector, Vector]
    """The same two points in the board frame [[x, y], [x, y]] [m]."""

    @model_validator(mode="after")
    def _distinct(self) -> Reference:
        for name, (a, b) in (("pixels", self.pixels), ("points", self.points)):
            if a == b:
                raise Contradiction(Problem((name,), f"the two points are the same: {list(a)}"))
        if problems := implausible_pixels(("pixels",), [x for pair in self.pixels for x in pair]):
            raise Contradiction(*problems)
        for k, point in enumerate(self.points):
            for value in point:
                if problems := COORDINATE.problems(("points", k), value):
                    raise Contradiction(*problems)
        return self


class Measurement(Section):
    """How well was measured."""

    std: Positive | None = None
    """Standard deviation of one centre-line coordinate [m]; estimated when absent, and, with a
    warning, where the points scatter more."""
    force_std: Positive | None = None
    """Standard deviation of one component of a force on a fixture [N]; estimated when absent."""
    moment_std: Positive | None = None
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
    def _one_frame(self) -> Images:
        if (self.board is None) == (self.reference is None):
            found = "neither" if self.board is None else "both"
            text = f"kind: images needs either a board or a reference, found {found}"
            raise Contradiction(Problem((), text))
        return self


class Centerlines(Measurement):
    """Centre-lines that were measured elsewhere, one CSV file a pose."""

    kind: Literal["centerlines"] = "centerlines"
    """centerlines."""


class Tolerances(Section):
    """How well the declared values are known: one standard deviation each."""

    length: Positive = 5.0e-4
    """Of the cable's length [m]."""
    end: Positive = 2.0e-4
    """Of a coordinate of a fixture [m]."""
    heading: Positive = 1.0e-2
    """Of a clamp's heading in a plane [rad]."""
    rotation: Positive = 5.0e-3
    """Of a clamp's orientation in space, about each of its axes [rad]."""
    roll: Positive = 1.0
    """Of the roll of a cable in its end clamp, about itself [rad]."""
    scale: Positive = 3.0e-4
    """Of the scale of the measurement, relative."""
    camera_rotation: Positive = 2.0e-3
    """Of the frame of a measurement in space against the fixtures, about each axis [rad]."""
    camera_translation: Positive = 1.0e-3
    """Of the frame of a measurement in space against the fixtures, along each axis [m]."""
    force_bias: Positive = 0.02
    """Of a constant offset of a sensor's force, each component [N]."""
    moment_bias: Positive = 2.0e-3
    """Of a constant offset of a sensor's moment, each component [N m]."""


# pose_01_a -> pose_01: a digit, and letters after it.
_TOLD_APART = re.compile(r"(.*[0-9])[-_. ]?[A-Za-z]+")


class Pose(Section):
    """One measured shape: where the ends were held, and the file or files that show it."""

    file: Path | None = None
    """Photograph or CSV, found relative to the YAML; an absolute path once loaded."""
    files: tuple[Path, ...] = ()
    """Photographs from several places [a.jpg, b.jpg, ...] of a cable in space, instead of file."""
    start: Place
    """Where the start is held [x, y] [m], in space [x, y, z]."""
    end: Place | None = None
    """Where the end is held [x, y] [m], in space [x, y, z]; a free end has none."""
    start_heading: Number | None = None
    """Direction of the cable in a clamped start, counter-clockwise from +x [rad]."""
    end_heading: Number | None = None
    """Direction of the cable in a clamped end, continuous along the cable [rad]."""
    start_orientation: Quaternion | None = None
    """Frame of a clamped start in space, a quaternion [qx, qy, qz, qw]; x forward along the
    cable."""
    end_orientation: Quaternion | None = None
    """Frame of a clamped end in space, a quaternion [qx, qy, qz, qw]; x forward along the cable."""
    turns: Number = 0.0
    """Of the twists that bring the end into its clamp, the one nearest to so many full turns about
    its x axis; 0.5 or -0.5 tells which way a clamp is rolled by half a turn."""
    role: Literal["fit", "held_out"] = "fit"
    """fit, or held_out to check the prediction."""
    start_force: Place | None = None
    """Force [N] that the cable exerts on its start fixture, in the frame of gravity; what hangs
    between sensor and cable is taken off before."""
    start_moment: Moment | None = None
    """Moment [N m] that the cable exerts on its start fixture, about `start`, counter-clockwise;
    in space [mx, my, mz] about axes parallel to the world's."""
    end_force: Place | None = None
    """Force [N] that the cable exerts on its end fixture, as start_force."""
    end_moment: Moment | None = None
    """Moment [N m] that the cable exerts on its end fixture, about `end`, as start_moment."""
    branch: Literal["ccw", "cw", "previous"] | None = None
    """Of several equilibria: the way the cable turns from start to end, or the previous pose's."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """All its files."""
        return self.files if self.file is None else (self.file,)

    @property
    def shown_by(self) -> str:
        """Names of its files, for messages."""
        return ", ".join(path.name for path in self.paths)

    @property
    def photographs(self) -> dict[str, Path]:
        """Its files by their names without folder and ending."""
        return {well_formed(path.stem): path for path in self.paths}

    @property
    def name(self) -> str:
        """Name of the pose: its file without folder and ending.

        Of photographs in `files` the first one's, without the letters after a number that tell
        them apart: pose_01 of pose_01_a.jpg and pose_01_b.jpg.
        """
        first = next(iter(self.photographs))
        found = _TOLD_APART.fullmatch(first) if self.files else None
        return found[1] if found else first

    @property
    def readings(self) -> dict[str, tuple[float, ...]]:
        """Forces and moments on the fixtures that were measured, by their keys."""
        found = {name: getattr(self, name) for name in REACTIONS}
        return {name: value for name, value in found.items() if value is not None}

    @field_validator("file", mode="before")
    @classmethod
    def _absolute(cls, value: object, info: ValidationInfo) -> object:
        if not isinstance(value, str | Path) or not str(value).strip():
            raise ValueError(f"a file name belongs here, found {show(value)}")
        if value == PLACEHOLDER:
            raise ValueError("a file name belongs here")
        folder = (info.context or {}).get("folder", Path())
        return (folder / value).absolute()

    @field_validator("files", mode="before")
    @classmethod
    def _all_absolute(cls, value: object, info: ValidationInfo) -> object:
        if not isinstance(value, list | tuple) or not value:
            raise ValueError(f"file names [a.jpg, b.jpg] belong here, found {show(value)}")
        return tuple(cls._absolute(item, info) for item in value)

    @model_validator(mode="after")
    def _shown(self) -> Pose:
        if self.file is None and not self.files:
            text = "'file' is missing: a photograph or CSV; or files: [a.jpg, b.jpg] of photographs"
            raise Contradiction(Problem((), text))
        if self.file is not None and self.files:
            raise Contradiction(Problem(("files",), "give file or files, found both"))
        twice = [path.name for path in self.files if len(self.photographs) < len(self.files)]
        if twice:
            text = f"each photograph needs a name of its own, found {', '.join(twice)}"
            raise Contradiction(Problem(("files",), text))
        return self


class Experiment(Section):
    """What was measured, and under which conditions."""

    gravity: Place
    """Gravity in the board frame, such as [0.0, -9.81] [m/s^2]; three numbers put the cable in
    space."""
    boundary: Boundary
    """How the two ends are held: {start: pinned | clamped, end: pinned | clamped | free}."""
    measurement: Annotated[Images | Centerlines, Field(discriminator="kind")]
    """What the files of the poses are: kind: images or kind: centerlines."""
    tolerances: Annotated[Tolerances, _optional(Tolerances)] = Tolerances()
    """How well the declared values are known."""
    poses: tuple[Pose, ...]
    """The poses, in the order in which they were taken."""

    @property
    def in_space(self) -> bool:
        """Whether the cable may leave the plane."""
        return len(self.gravity) == 3


class EffectParameter(Section):
    """The declared value of an effect's parameter: an initial guess, or kept when fixed."""

    value: Number
    """Value in the parameter's own unit."""
    fixed: Switch = False
    """Whether the value is kept; otherwise it is where the fit starts."""


def _as_parameter(value: object) -> object:
    return {"value": value} if not isinstance(value, Mapping | EffectParameter) else value


def _as_effect(value: object) -> object:
    return {"name": value} if isinstance(value, str) else value


class DeclaredEffect(Section):
    """An effect that is part of the model from the start."""

    name: str
    """Name of the effect, such as lumped_mass."""
    parameters: dict[
        str,
        Annotated[
            EffectParameter,
            BeforeValidator(_as_parameter, json_schema_input_type=float | EffectParameter),
        ],
    ] = {}
    """Initial guess of each parameter by its name; {value: ..., fixed: true} keeps a value."""


class ModelOptions(Section):
    """The declared model."""

    n: Annotated[Count, Field(ge=MESH.least, le=MESH.most)] | None = None
    """Number of elements; chosen from the data when absent."""
    element: Literal["quadratic", "arc", "link"] = "quadratic"
    """quadratic (curvature changes in an element: fourth order), arc (it is constant: second
    order, five times cheaper) or link (straight, as in the paper; in a plane only)."""
    effects: tuple[
        Annotated[
            DeclaredEffect,
            BeforeValidator(_as_effect, json_schema_input_type=str | DeclaredEffect),
        ],
        ...,
    ] = ()
    """Effects beside bending and weight."""


class EstimationOptions(Section):
    """How the parameters are estimated."""

    algorithm1: Switch = True
    """Whether the paper's loop runs as a baseline."""
    algorithm1_n: Annotated[int, Field(strict=True, ge=2, le=200)] = 10
    """Number of links in the paper's loop."""
    algorithm1_inner: Literal["ipopt", "cobyla"] = "ipopt"
    """Its inner minimisation: ipopt, or cobyla as in the paper (about 1 s a pose)."""
    robust: Switch = False
    """Whether outlying points weigh less."""
    plausibility: Switch = True
    """Whether contradictions of the configuration stop the fit, or leave out a single pose."""
    rest_curvature_coefficients: (
        Annotated[Count, Field(ge=REST_COEFFICIENTS.least, le=REST_COEFFICIENTS.most)] | None
    ) = None
    """Number of coefficients of the rest curvature, 0 for a straight one; chosen from the data."""


class DiagnosisOptions(Section):
    """The search for missing effects."""

    enabled: Switch = True
    """Whether missing effects are searched for."""
    exclude: tuple[str, ...] = ()
    """Names of effects that are not tried."""
    significance: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = SIGNIFICANCE
    """Largest p-value with which an effect is added."""
    max_effects: Annotated[int, Field(strict=True, ge=0)] = 4
    """Largest number of effects that are added."""


class SkippedPose(NamedTuple):
    """A pose that cannot be used, why, and what it was meant for."""

    name: str
    reason: str
    role: Literal["fit", "held_out"]


@dataclass(frozen=True)
class Config:
    """A checked configuration.

    Parameters
    ----------
    path : Path
        The YAML file, absolute.
    cable, experiment, model, estimation, diagnosis
        Its sections.
    warnings : tuple of str
        What looks odd but does not stop the fit.
    skipped : tuple of SkippedPose
        Poses that cannot be used. Those without an equilibrium (farther apart than the cable is
        long) are not in `experiment.poses`; those whose file is missing stay there, because their
        end conditions are part of the cable's history, but not in `measured_poses`.
    """

    path: Path
    cable: Cable
    experiment: Experiment
    model: ModelOptions = field(default_factory=ModelOptions)
    estimation: EstimationOptions = field(default_factory=EstimationOptions)
    diagnosis: DiagnosisOptions = field(default_factory=DiagnosisOptions)
    warnings: tuple[str, ...] = ()
    skipped: tuple[SkippedPose, ...] = ()

    @property
    def name(self) -> str:
        """Name of the configuration: its file without folder and ending."""
        return well_formed(self.path.stem)

    @property
    def measured_poses(self) -> tuple[Pose, ...]:
        """Poses with a file to read, in the order in which they were taken."""
        skipped = {pose.name for pose in self.skipped}
        return tuple(pose for pose in self.experiment.poses if pose.name not in skipped)


class File(Section):
    """What may stand at the top of a configuration."""

    cable: Cable
    """The cable: length, mass, diameter, youngs_modulus or bending_stiffness."""
    experiment: Experiment
    """The experiment: gravity, boundary, measurement, poses."""
    model: Annotated[ModelOptions, _optional(ModelOptions)] = ModelOptions()
    """The declared model."""
    estimation: Annotated[EstimationOptions, _optional(EstimationOptions)] = EstimationOptions()
    """How the parameters are estimated."""
    diagnosis: Annotated[DiagnosisOptions, _optional(DiagnosisOptions)] = DiagnosisOptions()
    """The search for missing effects."""
