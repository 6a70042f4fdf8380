"""The checked objects: one class for each section of a configuration. All units are SI.

Sensors, tolerances and options are in `options`.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from pydantic import (
    BeforeValidator,
    Field,
    StrictBool,
    ValidationInfo,
    field_validator,
    model_validator,
)

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.cable import Cable
from dlo_casadi.config.document import dump_yaml, yaml_text
from dlo_casadi.config.frozen import ConfigSection, Given, Numbers, Rows, Turned, entry, optional
from dlo_casadi.config.motions import Motion
from dlo_casadi.config.options import (
    Centerlines,
    DeclaredTolerances,
    DiagnosisOptions,
    EstimationOptions,
    Images,
    Limits,
    ModelOptions,
)
from dlo_casadi.config.problems import PLACEHOLDER, ConfigProblem, Contradiction, show
from dlo_casadi.config.supports import Boundary, Clip, Obstacle
from dlo_casadi.config.values import (
    ArcLengths,
    Force,
    Gravity,
    Heading,
    Moment,
    Name,
    Number,
    Place,
    Points,
    Positive,
    Quaternion,
    checked,
    no_file_name,
)
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.errors import counted, well_formed
from dlo_casadi.rod.ends import REACTIONS, clip_force
from dlo_casadi.rod.obstacles import Obstacle as Surface
from dlo_casadi.rod.supports import SupportKind


def _both_ends(value: object) -> object:
    if isinstance(value, list | tuple) and len(value) == 2:
        return dict(zip(("start", "end"), value, strict=True))
    if isinstance(value, str | list | tuple) and value != PLACEHOLDER:
        raise ValueError(f"[start, end] belongs here, such as [pinned, clamped], found {value!r}")
    return value


_as_boundary = BeforeValidator(_both_ends, json_schema_input_type=Boundary | tuple[str, str])


# pose_01_a -> pose_01: a digit followed by letters.
_TOLD_APART = re.compile(r"(.*[0-9])[-_. ]?[A-Za-z]+")


class Pose(ConfigSection):
    """One shape: where the ends were held, and the file, the files or the points that show it.

    Without these it has readings of forces and moments alone.

    From Python `start` and `end` may stand without their names: `Pose(start, end, points=...)`.
    Numbers may be arrays or CasADi's DM, and a quaternion SciPy's Rotation.
    """

    file: Given[Path | None, str | PathLike[str] | None] = entry(default=None)
    """Photograph or CSV, found relative to the YAML; an absolute path once loaded."""
    files: Given[tuple[Path, ...], Sequence[str | PathLike[str]]] = entry(default=())
    """Photographs from several places [a.jpg, b.jpg, ...] of a cable in space, instead of file."""
    points: Given[Points | None, Rows | None] = entry(default=None)
    """Points [[x, y], ...] along the cable [m], in space [[x, y, z], ...], instead of a file."""
    at: Given[ArcLengths | None, Numbers | None] = entry(default=None)
    """Arc lengths [m] of the points from the start, [s, ...], which makes them markers. Of a cable
    that is fed through its start they are its length less what is from there to its end."""
    name: Annotated[Name, checked(no_file_name)] = entry(default="", validate_default=True)
    """What to call the pose; as its file without folder and ending, or by its number, when
    absent."""
    start: Given[Place, Numbers] = entry(kw_only=False)
    """Where the start is held [m]: [x, y], in space [x, y, z]."""
    end: Given[Place | None, Numbers | None] = entry(default=None, kw_only=False)
    """Where the end is held [m]: [x, y], in space [x, y, z]; a free end has none."""
    start_heading: Heading | None = None
    """Direction of the cable in a clamped start, counter-clockwise from +x [rad]."""
    end_heading: Heading | None = None
    """Direction of the cable in a clamped end, continuous along the cable [rad]."""
    start_orientation: Given[Quaternion | None, Turned | None] = entry(default=None)
    """Frame of a clamped start in space, a quaternion [qx, qy, qz, qw]; x forward along the
    cable."""
    end_orientation: Given[Quaternion | None, Turned | None] = entry(default=None)
    """Frame of a clamped end in space, a quaternion [qx, qy, qz, qw]; x forward along the cable."""
    turns: Number = 0.0
    """Of the twists that bring the end into its clamp, the one nearest to so many full turns about
    its x axis; 0.5 or -0.5 tells which way a clamp is rolled by half a turn."""
    role: Literal["fit", "held_out"] = "fit"
    """fit, or held_out to check the prediction."""
    start_force: Given[Force | None, Numbers | None] = entry(default=None)
    """Force [N] that the cable exerts on its start fixture, in the frame of gravity; what hangs
    between sensor and cable is taken off before."""
    start_moment: Given[Moment | None, float | Numbers | None] = entry(default=None)
    """Moment [N m] that the cable exerts on its start fixture, about `start`, counter-clockwise;
    in space [mx, my, mz] about axes parallel to the world's."""
    end_force: Given[Force | None, Numbers | None] = entry(default=None)
    """Force [N] that the cable exerts on its end fixture, as start_force."""
    end_moment: Given[Moment | None, float | Numbers | None] = entry(default=None)
    """Moment [N m] that the cable exerts on its end fixture, about `end`, as start_moment."""
    branch: Literal["ccw", "cw", "previous"] | None = None
    """Of several equilibria: the way the cable turns from start to end, or the previous pose's."""
    clips: Given[tuple[Clip, ...], Sequence[Clip | Mapping[str, Any]]] = entry(default=())
    """What holds the cable between its ends, in the order along it."""
    end_tension: Number | None = None
    """Tension [N] of the cable beyond a sliding end, which pulls it out; 0 where it lies slack."""
    start_tension: Number | None = None
    """Tension [N] of the cable beyond a sliding start, as end_tension."""
    free_length: Positive | None = None
    """Length [m] between the ends of a cable that slides through one, where no tension is known: a
    first value, which is estimated; of the measured line when absent."""
    over: StrictBool | dict[str, StrictBool] | None = None
    """Whether the cable passes over (true) or under (false) the bars among the obstacles, or some
    of them, {bar: true}: whether it crosses the half-plane that stands on a bar's axis, or the one
    that hangs from it. Without it, the side of lower energy."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """All its files."""
        return self.files if self.file is None else (self.file,)

    @property
    def shown(self) -> bool:
        """Whether a file or points show its shape; otherwise it has readings alone."""
        return bool(self.paths) or self.points is not None

    @property
    def shown_by(self) -> str:
        """Names of its files, or its own name, for messages."""
        return ", ".join(path.name for path in self.paths) or self.name

    @property
    def photographs(self) -> dict[str, Path]:
        """Its files by their names without folder and extension."""
        return {well_formed(path.stem): path for path in self.paths}

    @property
    def labelled(self) -> dict[str, Path]:
        """Its files by names that begin with the pose's: two poses may have files of one name."""
        return {
            name if f"{name}_".startswith(f"{self.name}_") else f"{self.name}_{name}": path
            for name, path in self.photographs.items()
        }

    @property
    def readings(self) -> dict[str, tuple[float, ...]]:
        """Forces and moments that were measured, by names of `ends.reaction_rows`."""
        found = {name: getattr(self, name) for name in REACTIONS}
        found |= {clip_force(k): clip.clip_force for k, clip in enumerate(self.clips, start=1)}
        return {name: value for name, value in found.items() if value is not None}

    def vector(self) -> FloatArray:
        """Return the pose as numbers, for `function`, `transcribe` and the generated C.

        (6,) in a plane: start x, y, end x, y [m], start heading, end heading [rad]. (15,) in space:
        start, end [m], their quaternions (x, y, z, w), turns. What is not given is 0, or (0, 0, 0,
        1). Then the tension [N] beyond each end that slides. Then for each clip its arc length and
        place [m] and, if one of them is clamped, its heading or quaternion: see dlo_pose in the C
        header.
        """
        return self.held.numbers

    @property
    def held(self) -> HeldPose:
        """How its ends are held."""
        names = [item.name for item in dataclasses.fields(HeldPose) if hasattr(self, item.name)]
        held = {name: getattr(self, name) for name in names}
        clips = tuple(clip.held(k) for k, clip in enumerate(self.clips, start=1))
        return HeldPose(**{**held, "clips": clips})

    @field_validator("file", mode="before")
    @classmethod
    def _absolute(cls, value: object, info: ValidationInfo) -> Path:
        if not isinstance(value, str | Path) or str(value).strip() in ("", PLACEHOLDER):
            raise ValueError(f"a file name belongs here, found {show(value)}")
        folder = (info.context or {}).get("folder", Path())
        return (folder / value).absolute()

    @field_validator("files", mode="before")
    @classmethod
    def _all_absolute(cls, value: object, info: ValidationInfo) -> tuple[Path, ...]:
        if not isinstance(value, list | tuple) or not value:
            raise ValueError(f"file names [a.jpg, b.jpg] belong here, found {show(value)}")
        files = tuple(cls._absolute(item, info) for item in value)
        if len({well_formed(file.stem) for file in files}) < len(files):
            names = ", ".join(file.name for file in files)
            raise ValueError(f"each photograph needs a name of its own, found {names}")
        return files

    @field_validator("name", mode="after")
    @classmethod
    def _named(cls, value: str, info: ValidationInfo) -> str:
        """For photographs in `files`: the name of the first without the letters after its number.

        For example pose_01 from pose_01_a.jpg and pose_01_b.jpg.
        """
        files = info.data.get("files") or ()
        paths = files or [file for file in [info.data.get("file")] if file is not None]
        if value or not paths:
            return value
        first = well_formed(paths[0].stem)
        found = _TOLD_APART.fullmatch(first) if files else None
        return found[1] if found else first

    @model_validator(mode="after")
    def _shown_once(self) -> Self:
        given = [key for key in ("file", "files", "points") if getattr(self, key)]
        if len(given) > 1:
            raise ValueError(f"give file, files or points, found {' and '.join(given)}")
        if self.at is not None and len(self.at) != len(self.points or ()):
            points = counted(len(self.points or ()), "point")
            text = f"{counted(len(self.at), 'arc length')} for {points}: each point has one"
            text += "" if self.points else "; those of a CSV are its column s_m"
            raise Contradiction(ConfigProblem(("at",), text))
        if self.points is not None and len(self.points) == 1:
            raise Contradiction(
                ConfigProblem(("points",), "one point only; a pose takes two or more")
            )
        for s, after in pairwise(self.at or ()):
            if after <= s:
                text = f"{after:g} m follows {s:g} m; arc lengths grow from the start to the end"
                raise Contradiction(ConfigProblem(("at",), text))
        return self


class Experiment(ConfigSection):
    """What was measured, and under which conditions."""

    gravity: Gravity
    """Gravity in the board frame, such as [0.0, -9.81] [m/s^2]; three numbers put the cable in
    space."""
    boundary: Annotated[Boundary, _as_boundary]
    """How the two ends are held: {start: pinned | clamped | swivel, end: pinned | clamped |
    swivel | slide | free}, or [start, end]."""
    measurement: Annotated[Images | Centerlines, Field(discriminator="kind")]
    """What the files of the poses are: kind: images or kind: centerlines."""
    tolerances: Annotated[DeclaredTolerances, optional(DeclaredTolerances)] = DeclaredTolerances()
    """How well the declared values are known."""
    obstacles: tuple[Obstacle, ...] = ()
    """What the cable may touch, in all poses."""
    poses: tuple[Pose, ...]
    """The poses, in the order in which they were taken; they may be left out if there are motions
    that begin or end at rest."""
    motions: tuple[Motion, ...] = ()
    """Recordings of the moving cable."""

    @model_validator(mode="before")
    @classmethod
    def _without_poses(cls, given: Any) -> Any:
        if isinstance(given, Mapping) and given.get("motions") and given.get("poses") is None:
            return {**given, "poses": ()}
        return given

    @field_validator("motions")
    @classmethod
    def _called(cls, motions: tuple[Motion, ...]) -> tuple[Motion, ...]:
        """Name motions without a file by their number."""
        return tuple(
            motion if motion.name else motion.changed(name=f"motion_{k:02d}")
            for k, motion in enumerate(motions, start=1)
        )

    @property
    def in_space(self) -> bool:
        """Whether the cable may leave the plane."""
        return len(self.gravity) == 3

    @property
    def fed_by_length(self) -> bool:
        """Whether ends slide and there are poses, of which none tells the tension beyond them."""
        slides = self.boundary.start.slides or self.boundary.end.slides
        none = all(pose.held.tensions == (None, None) for pose in self.poses)
        return slides and bool(self.poses) and none

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """Obstacles in the form that the statics use."""
        return tuple(item.surface(k) for k, item in enumerate(self.obstacles, start=1))

    @property
    def clips(self) -> tuple[SupportKind, ...]:
        """Kinds of the clips, the same in all poses."""
        return tuple(clip.kind for pose in self.poses[:1] for clip in pose.held.clips)

    @field_validator("poses", mode="before")
    @classmethod
    def _listed(cls, poses: Any) -> Any:
        if isinstance(poses, ConfigSection):
            raise ValueError("a list belongs here, found one pose")
        return poses

    @field_validator("poses")
    @classmethod
    def _shown(cls, poses: tuple[Pose, ...]) -> tuple[Pose, ...]:
        """Refuse a pose without any measurement; name poses without a file by their number."""
        text = (
            "'file' is missing: a photograph or CSV; or files: [a.jpg, b.jpg] of photographs; or "
            "points: [[x, y], ...]; or readings alone, such as end_force: [fx, fy]"
        )
        if nothing := [k for k, x in enumerate(poses) if not (x.shown or x.readings)]:
            raise Contradiction(*(ConfigProblem((k,), text) for k in nothing))
        return tuple(
            pose if pose.name else pose.changed(name=f"pose_{k:02d}")
            for k, pose in enumerate(poses, start=1)
        )


# ---- the whole -------------------------------------------------------------------------------


class SkippedPose(NamedTuple):
    """A pose that cannot be used, why, and what it was meant for."""

    name: str
    reason: str
    role: Literal["fit", "held_out"]


class _Notes(NamedTuple):
    """What is known of a configuration beside its contents."""

    path: Path | None = None
    warnings: tuple[str, ...] = ()
    skipped: tuple[SkippedPose, ...] = ()


class Config(ConfigSection):
    """A session as it is declared: all that a fit starts from."""

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
    limits: Annotated[Limits, optional(Limits)] = Limits()
    """What the cable must keep in every pose, checked with a probability."""

    _notes: ClassVar[_Notes] = _Notes()

    @property
    def path(self) -> Path | None:
        """The YAML file, absolute; None for a session made in Python."""
        return self._notes.path

    @property
    def warnings(self) -> tuple[str, ...]:
        """What looks unintended but does not stop the fit."""
        return self._notes.warnings

    @property
    def skipped(self) -> tuple[SkippedPose, ...]:
        """Poses that cannot be used.

        Poses farther apart than the cable is long have no equilibrium and are not in
        `experiment.poses`. Poses whose file is missing stay there, because their end conditions are
        part of the cable's history, but they are not in `measured_poses`.
        """
        return self._notes.skipped

    def __repr__(self) -> str:
        poses = counted(len(self.experiment.poses), "pose")
        return f"<{type(self).__name__} {self.name!r}: {poses}>"

    __str__ = __repr__

    def noted(self, **notes: Any) -> Self:
        """The same configuration with other `path`, `warnings` or `skipped`."""
        noted = self.changed()
        vars(noted)["_notes"] = self._notes._replace(**notes)
        return noted

    @property
    def name(self) -> str:
        """Name of the session: its file without folder and extension, or the cable's name."""
        return well_formed(self.cable.name if self.path is None else self.path.stem)

    @property
    def text(self) -> str:
        """The session as a configuration file, as far as it was declared.

        Raises OSError if its file cannot be read any more.
        """
        if self.path is None:
            return dump_yaml(self.plain)
        return yaml_text(self.path)

    @property
    def measured_poses(self) -> tuple[Pose, ...]:
        """Poses with a measurement, in the order in which they were taken."""
        skipped = {pose.name for pose in self.skipped}
        return tuple(pose for pose in self.experiment.poses if pose.name not in skipped)
