"""The checked objects: one class for each section of a configuration. All units are SI.

How was measured is in `measuring`.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from dlo_casadi.config.problems import PLACEHOLDER, Contradiction, Problem, show
from dlo_casadi.config.values import (
    STIFFNESS,
    Centerlines,
    Elements,
    Force,
    Gravity,
    Images,
    Moment,
    Name,
    Number,
    Place,
    Positive,
    Quaternion,
    RestCoefficients,
    Section,
    Switch,
    Tolerances,
    implausible_sizes,
    optional,
    within,
)
from dlo_casadi.errors import well_formed
from dlo_casadi.rod.ends import REACTIONS
from dlo_casadi.thresholds import SIGNIFICANCE

# Of copper in plastic [kg/m^3]: two sessions of tests have 2200. `mass_error` finds a fifth of it,
# a foam, to five times, which no metal of cables reaches.
DENSITY = 2200.0


class Cable(Section):
    """The cable between its two fixtures."""

    name: Name = "cable"
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
    torsional_stiffness: Annotated[Positive, within(STIFFNESS)] | None = None
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
    def _plausible(self) -> Self:
        declared, young = self.bending_stiffness, self.youngs_modulus
        problems = implausible_sizes(self.length, self.prior_mass, self.diameter)
        if declared is not None and (wrong := STIFFNESS.complaint(declared)):
            problems.append(Problem(("bending_stiffness",), wrong))
        if (young is None) == (declared is None):
            found, key = ("neither", ()) if young is None else ("both", ("bending_stiffness",))
            text = f"give youngs_modulus [Pa] or bending_stiffness [N m^2], found {found}"
            problems.append(Problem(key, text))
        elif young and (wrong := STIFFNESS.complaint(self.prior_bending_stiffness)):
            problems.append(Problem(("youngs_modulus",), f"{wrong} for EI = E pi d^4 / 64"))
        if problems:
            raise Contradiction(*problems)
        return self


class Boundary(Section):
    """How the two ends are held."""

    start: Literal["pinned", "clamped"]
    """Start of the cable: pinned (free to turn) or clamped (its heading is held)."""
    end: Literal["pinned", "clamped", "free"]
    """End of the cable: pinned, clamped or free."""


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
    start_force: Force | None = None
    """Force [N] that the cable exerts on its start fixture, in the frame of gravity; what hangs
    between sensor and cable is taken off before."""
    start_moment: Moment | None = None
    """Moment [N m] that the cable exerts on its start fixture, about `start`, counter-clockwise;
    in space [mx, my, mz] about axes parallel to the world's."""
    end_force: Force | None = None
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
    def _absolute(cls, value: object, info: ValidationInfo) -> Path:
        if not isinstance(value, str | Path) or not str(value).strip():
            raise ValueError(f"a file name belongs here, found {show(value)}")
        if value == PLACEHOLDER:
            raise ValueError("a file name belongs here")
        folder = (info.context or {}).get("folder", Path())
        return (folder / value).absolute()

    @field_validator("files", mode="before")
    @classmethod
    def _all_absolute(cls, value: object, info: ValidationInfo) -> tuple[Path, ...]:
        if not isinstance(value, list | tuple) or not value:
            raise ValueError(f"file names [a.jpg, b.jpg] belong here, found {show(value)}")
        if info.data.get("file") is not None:
            raise ValueError("give file or files, found both")
        files = tuple(cls._absolute(item, info) for item in value)
        if len({well_formed(file.stem) for file in files}) < len(files):
            names = ", ".join(file.name for file in files)
            raise ValueError(f"each photograph needs a name of its own, found {names}")
        return files

    @model_validator(mode="after")
    def _shown(self) -> Self:
        if self.file is None and not self.files:
            raise ValueError(
                "'file' is missing: a photograph or CSV; or files: [a.jpg, b.jpg] of photographs"
            )
        return self


class Experiment(Section):
    """What was measured, and under which conditions."""

    gravity: Gravity
    """Gravity in the board frame, such as [0.0, -9.81] [m/s^2]; three numbers put the cable in
    space."""
    boundary: Boundary
    """How the two ends are held: {start: pinned | clamped, end: pinned | clamped | free}."""
    measurement: Annotated[Images | Centerlines, Field(discriminator="kind")]
    """What the files of the poses are: kind: images or kind: centerlines."""
    tolerances: Annotated[Tolerances, optional(Tolerances)] = Tolerances()
    """How well the declared values are known."""
    poses: tuple[Pose, ...]
    """The poses, in the order in which they were taken."""

    @property
    def in_space(self) -> bool:
        """Whether the cable may leave the plane."""
        return len(self.gravity) == 3


# ---- how the fit goes about it ----------------------------------------------------------------

ElementName = Literal["quadratic", "arc", "link"]


class EffectParameter(Section):
    """The declared value of an effect's parameter: an initial guess, or kept when fixed."""

    value: Number
    """Value in the parameter's own unit."""
    fixed: Switch = False
    """Whether the value is kept; otherwise it is where the fit starts."""


_as_parameter = BeforeValidator(
    lambda value: value if isinstance(value, Mapping | EffectParameter) else {"value": value},
    json_schema_input_type=float | EffectParameter,
)


class DeclaredEffect(Section):
    """An effect that is part of the model from the start."""

    name: str
    """Name of the effect, such as lumped_mass."""
    parameters: dict[str, Annotated[EffectParameter, _as_parameter]] = Field(default={})
    """Initial guess of each parameter by its name; {value: ..., fixed: true} keeps a value."""


_as_effect = BeforeValidator(
    lambda value: {"name": value} if isinstance(value, str) else value,
    json_schema_input_type=str | DeclaredEffect,
)


class ModelOptions(Section):
    """The declared model."""

    n: Elements | None = None
    """Number of elements; chosen from the data when absent."""
    element: ElementName = "quadratic"
    """quadratic (curvature changes in an element: fourth order), arc (it is constant: second
    order, five times cheaper) or link (straight, as in the paper; in a plane only)."""
    effects: tuple[Annotated[DeclaredEffect, _as_effect], ...] = ()
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
    rest_curvature_coefficients: RestCoefficients | None = None
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


# ---- the whole -------------------------------------------------------------------------------


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
    model: Annotated[ModelOptions, optional(ModelOptions)] = ModelOptions()
    """The declared model."""
    estimation: Annotated[EstimationOptions, optional(EstimationOptions)] = EstimationOptions()
    """How the parameters are estimated."""
    diagnosis: Annotated[DiagnosisOptions, optional(DiagnosisOptions)] = DiagnosisOptions()
    """The search for missing effects."""
