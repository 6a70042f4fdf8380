"""YAML text <-> checked objects: the configuration of a fit, and plain YAML for results.

The only module that imports yaml. All units are SI. Every problem of a file is reported at once,
each with its line.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import ErrorDetails

from dlo_casadi.errors import ConfigError

Place = tuple[str | int, ...]
"""Keys and indices that lead from the top of a file to a value."""


class Problem(NamedTuple):
    """Something wrong, and where in the file."""

    place: Place
    message: str


class Contradiction(ValueError):  # noqa: N818  (a ValueError is what pydantic collects)
    """What is wrong inside one section: problems by the key they belong to."""

    def __init__(self, *problems: Problem) -> None:
        super().__init__("; ".join(problem.message for problem in problems))
        self.problems = problems


def _pair(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"two numbers [x, y] belong here, found {_show(value)}")
    return value


def _empty_section(value: object) -> object:
    """Read `model:` with nothing behind it as an empty section."""
    return {} if value is None else value


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
NonNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0)]
Count = Annotated[int, Field(strict=True, ge=1)]
Switch = Annotated[bool, Field(strict=True)]
Vector = Annotated[tuple[Number, Number], BeforeValidator(_pair)]
Row = tuple[Number, Number, Number]


class Section(BaseModel):
    """A frozen mapping of the file: unknown keys are errors, the docstring of a key is its help."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class Cable(Section):
    """The cable between its two fixtures."""

    name: Annotated[str, Field(coerce_numbers_to_str=True)] = "cable"
    """What to call the cable."""
    length: Positive
    """Length along the cable between its two fixtures [m]."""
    mass: Positive
    """Mass of that length [kg]."""
    diameter: Positive
    """Outer diameter [m]."""
    youngs_modulus: Positive | None = None
    """Young's modulus E of a solid round rod [Pa], a crude prior; or give bending_stiffness."""
    bending_stiffness: Positive | None = None
    """Bending stiffness EI [N m^2], a crude prior; or give youngs_modulus."""
    rest_shape: Literal["straight", "curved"] = "curved"
    """Shape without load: straight (no rest curvature is fitted) or curved."""

    @property
    def prior_bending_stiffness(self) -> float:
        """First guess of EI [N m^2]: as declared, or E pi d^4 / 64."""
        if self.bending_stiffness is not None:
            return self.bending_stiffness
        assert self.youngs_modulus is not None  # checked when the object was made
        return self.youngs_modulus * math.pi * self.diameter**4 / 64.0

    @model_validator(mode="after")
    def _plausible(self) -> Cable:
        length, mass, diameter = self.length, self.mass, self.diameter
        problems = []
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
        if length > 100.0:
            text = f"{length:g} m: units are SI, did you mean {length / 1e3:g}?"
            problems.append(Problem(("length",), text))
        elif diameter > length:
            text = (
                f"{diameter:g} m is larger than the length {length:g} m: units are SI, "
                f"did you mean {diameter / 1e3:g}?"
            )
            problems.append(Problem(("diameter",), text))
        if mass > min(1000.0, 100.0 * length):
            text = f"{mass:g} kg for {length:g} m: units are SI, did you mean {mass / 1e3:g}?"
            problems.append(Problem(("mass",), text))
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
    """Distortion coefficients k1, k2, p1, p2, k3."""

    @model_validator(mode="after")
    def _plausible(self) -> Camera:
        (fx, _, _), (below, fy, _), last = self.matrix
        if fx <= 0.0 or fy <= 0.0 or below != 0.0 or last != (0.0, 0.0, 1.0):
            text = "must read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy"
            raise Contradiction(Problem(("matrix",), text))
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14):
            text = (
                f"found {len(self.distortion)} numbers; OpenCV knows 4, 5 "
                "[k1, k2, p1, p2, k3], 8, 12 or 14"
            )
            raise Contradiction(Problem(("distortion",), text))
        return self


ARUCO_DICTIONARIES = (
    *(f"DICT_{k}X{k}_{count}" for k in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    *(f"DICT_APRILTAG_{family}" for family in ("16h5", "25h9", "36h10", "36h11")),
)
"""Names of OpenCV's predefined marker dictionaries."""


class Board(Section):
    """A plane board with ArUco markers; it defines the frame in which everything is measured."""

    dictionary: str
    """OpenCV's name of the marker dictionary, such as DICT_4X4_50."""
    marker_size: Positive
    """Side of the black square of a marker [m]."""
    standoff: NonNegative = 0.0
    """Distance of the cable's axis in front of the board [m]; other than 0 needs a camera."""
    marker_centers: Annotated[dict[Annotated[int, Field(ge=0)], Vector], Field(min_length=1)]
    """Centre of each marker by its id: {0: [x, y], 1: [x, y], ...} [m]."""

    @model_validator(mode="after")
    def _plausible(self) -> Board:
        if self.dictionary not in ARUCO_DICTIONARIES:
            hint = _did_you_mean(self.dictionary, ARUCO_DICTIONARIES)
            text = f"OpenCV has no dictionary {self.dictionary!r}{hint}"
            raise Contradiction(Problem(("dictionary",), text))
        size = self.dictionary.rsplit("_", 1)[1]
        too_large = [i for i in self.marker_centers if size.isdigit() and i >= int(size)]
        if too_large:
            text = f"{self.dictionary} has no marker {too_large[0]}: its ids end at {int(size) - 1}"
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
        return self


class Images(Section):
    """Photographs of the cable, with a board or two known points."""

    kind: Literal["images"]
    """images."""
    std: Positive | None = None
    """Standard deviation of one centre-line coordinate [m]; estimated when absent."""
    camera: Camera | None = None
    """The camera; without it the board's plane is mapped by a homography."""
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
        if self.board is not None and self.camera is None and self.board.standoff != 0.0:
            text = (
                f"{self.board.standoff:g} m need a camera: without one only the plane of the "
                "board itself can be measured"
            )
            raise Contradiction(Problem(("board", "standoff"), text))
        return self


class Centerlines(Section):
    """Centre-lines that were measured elsewhere, one CSV file a pose."""

    kind: Literal["centerlines"]
    """centerlines."""
    std: Positive | None = None
    """Standard deviation of one centre-line coordinate [m]; estimated when absent."""


class Tolerances(Section):
    """How well the declared values are known: one standard deviation each."""

    length: Positive = 5.0e-4
    """Of the cable's length [m]."""
    end: Positive = 2.0e-4
    """Of a coordinate of a fixture [m]."""
    heading: Positive = 1.0e-2
    """Of a clamp's heading [rad]."""
    scale: Positive = 3.0e-4
    """Of the scale of the measurement, relative."""


class Pose(Section):
    """One measured shape: where the ends were held, and the file that shows it."""

    file: Path
    """Photograph or CSV, found relative to the YAML; an absolute path once loaded."""
    start: Vector
    """Where the start is held [x, y] [m]."""
    end: Vector | None = None
    """Where the end is held [x, y] [m]; a free end has none."""
    start_heading: Number | None = None
    """Direction of the cable in a clamped start, counter-clockwise from +x [rad]."""
    end_heading: Number | None = None
    """Direction of the cable in a clamped end, continuous along the cable [rad]."""
    role: Literal["fit", "held_out"] = "fit"
    """fit, or held_out to check the prediction."""
    branch: Literal["ccw", "cw"] | None = None
    """Which way the cable turns from start to end, where several equilibria exist."""

    @property
    def name(self) -> str:
        """Name of the pose: its file without folder and ending."""
        return self.file.stem

    @field_validator("file", mode="before")
    @classmethod
    def _absolute(cls, value: object, info: ValidationInfo) -> object:
        if not isinstance(value, str | Path) or not str(value).strip():
            raise ValueError(f"a file name belongs here, found {_show(value)}")
        folder = (info.context or {}).get("folder", Path())
        return (folder / value).absolute()


class Experiment(Section):
    """What was measured, and under which conditions."""

    gravity: Vector
    """Gravity in the board frame, such as [0.0, -9.81] [m/s^2]."""
    boundary: Boundary
    """How the two ends are held: {start: pinned | clamped, end: pinned | clamped | free}."""
    measurement: Annotated[Images | Centerlines, Field(discriminator="kind")]
    """What the files of the poses are: kind: images or kind: centerlines."""
    tolerances: Annotated[Tolerances, BeforeValidator(_empty_section)] = Tolerances()
    """How well the declared values are known."""
    poses: Annotated[tuple[Pose, ...], Field(min_length=1)]
    """The poses, in the order in which they were taken."""


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
    parameters: dict[str, Annotated[EffectParameter, BeforeValidator(_as_parameter)]] = {}
    """Initial guess of each parameter by its name; {value: ..., fixed: true} keeps a value."""


class ModelOptions(Section):
    """The declared model."""

    n: Annotated[int, Field(strict=True, ge=2, le=2000)] | None = None
    """Number of elements; chosen from the data when absent."""
    element: Literal["arc", "link"] = "arc"
    """arc (heading varies linearly in an element) or link (straight, as in the paper)."""
    effects: tuple[Annotated[DeclaredEffect, BeforeValidator(_as_effect)], ...] = ()
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
    rest_curvature_coefficients: Count | None = None
    """Number of coefficients of the rest curvature; chosen from the data when absent."""


class DiagnosisOptions(Section):
    """The search for missing effects."""

    enabled: Switch = True
    """Whether missing effects are searched for."""
    exclude: tuple[str, ...] = ()
    """Names of effects that are not tried."""
    significance: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = 0.005
    """Largest p-value with which an effect is added."""
    max_effects: Annotated[int, Field(strict=True, ge=0)] = 4
    """Largest number of effects that are added."""


class SkippedPose(NamedTuple):
    """A pose that cannot be used, and why."""

    name: str
    reason: str


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
    model: ModelOptions
    estimation: EstimationOptions
    diagnosis: DiagnosisOptions
    warnings: tuple[str, ...] = ()
    skipped: tuple[SkippedPose, ...] = ()

    @property
    def name(self) -> str:
        """Name of the configuration: its file without folder and ending."""
        return self.path.stem

    @property
    def measured_poses(self) -> tuple[Pose, ...]:
        """Poses with a file to read, in the order in which they were taken."""
        skipped = {pose.name for pose in self.skipped}
        return tuple(pose for pose in self.experiment.poses if pose.name not in skipped)


class _File(Section):
    """What may stand at the top of a configuration."""

    cable: Cable
    """The cable: length, mass, diameter, youngs_modulus or bending_stiffness."""
    experiment: Experiment
    """The experiment: gravity, boundary, measurement, poses."""
    model: Annotated[ModelOptions, BeforeValidator(_empty_section)] = ModelOptions()
    """The declared model."""
    estimation: Annotated[EstimationOptions, BeforeValidator(_empty_section)] = EstimationOptions()
    """How the parameters are estimated."""
    diagnosis: Annotated[DiagnosisOptions, BeforeValidator(_empty_section)] = DiagnosisOptions()
    """The search for missing effects."""


def load_config(path: str | Path) -> Config:
    """Read and check a configuration.

    Parameters
    ----------
    path : str or Path
        The YAML file.

    Returns
    -------
    Config
        Frozen, with the files of the poses as absolute paths.

    Raises
    ------
    ConfigError
        If the file cannot be used; the message lists every problem with its line. A pose that
        cannot be reached or has no file is left out and noted in `Config.skipped`; that is an
        error only if no pose to fit remains.
    """
    source = Path(path)
    document = _Document.read(source)
    if not isinstance(document.data, dict):
        raise ConfigError(
            f"a mapping with cable: and experiment: belongs at the top, "
            f"found {_kind_of(document.data)}",
            file=source,
        )
    try:
        file = _File.model_validate(
            document.data, context={"folder": source.absolute().resolve().parent}
        )
    except ValidationError as error:
        raise document.error(_explain(error.errors(), document.data)) from None

    if problems := _contradictions(file.experiment):
        raise document.error(problems)

    poses = file.experiment.poses
    unreachable = _unreachable(poses, file.cable, file.experiment.tolerances)
    reachable = tuple(pose for pose in poses if pose.name not in unreachable)
    problems_by_pose = unreachable | _missing(reachable)
    skipped = {
        pose.name: problems_by_pose[pose.name] for pose in poses if pose.name in problems_by_pose
    }
    n_fit = sum(pose.role == "fit" and pose.name not in skipped for pose in poses)
    if n_fit == 0:
        raise document.error(_no_fit_pose(poses, skipped))
    warnings = _oddities(file)
    if n_fit == 1:
        warnings.append("only one pose to fit: what it tells cannot be checked on another one")
    return Config(
        path=source.absolute().resolve(),
        cable=file.cable,
        experiment=file.experiment.model_copy(update={"poses": reachable}),
        model=file.model,
        estimation=file.estimation,
        diagnosis=file.diagnosis,
        warnings=tuple(warnings),
        skipped=tuple(SkippedPose(name, reason) for name, reason in skipped.items()),
    )


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file as plain dicts, lists, text and numbers.

    Numbers such as 1e-3 are numbers here, as in YAML 1.2; a key that occurs twice is an error.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    object
        Its contents.

    Raises
    ------
    ConfigError
        If the file cannot be read, is empty, or is not YAML.
    """
    return _Document.read(Path(path)).data


def dump_yaml(data: object) -> str:
    """Write plain data as YAML: every digit of a float, keys in their order, no aliases.

    Parameters
    ----------
    data : object
        Mappings, sequences, arrays, numbers, text, paths, None; nested as you like.

    Returns
    -------
    str
        Text that `read_yaml` turns into the same data.
    """
    return yaml.dump(
        _plain(data),
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=100,
    )


def _plain(data: object) -> object:
    """Arrays, tuples and subclasses of the basic types as what YAML knows."""
    if hasattr(data, "tolist"):
        data = data.tolist()
    if data is None or isinstance(data, bool):
        return data
    if isinstance(data, Mapping):
        return {_plain(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    for basic in (int, float, str):
        if isinstance(data, basic):
            return basic(data)
    if isinstance(data, Path):
        return str(data)
    raise TypeError(f"{type(data).__name__} cannot be written as YAML: {data!r}")


# --- YAML -----------------------------------------------------------------------------------------

_FLOAT = re.compile(
    r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_INT = re.compile(r"^[-+]?[0-9]+$")


def _with_numbers_of_yaml_1_2(resolver: type[yaml.resolver.BaseResolver]) -> None:
    """Let 1e-3 be a number, 012 twelve, 1:30 and 2024-01-01 text."""
    replaced = [f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "timestamp")]
    resolver.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in known if tag not in replaced]
        for first, known in resolver.yaml_implicit_resolvers.items()
    }
    resolver.add_implicit_resolver("tag:yaml.org,2002:int", _INT, list("-+0123456789"))
    resolver.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


class _Loader(yaml.SafeLoader):
    """SafeLoader with the numbers of YAML 1.2."""

    def construct_decimal(self, node: yaml.ScalarNode) -> int:
        return int(self.construct_scalar(node))

    def construct_number(self, node: yaml.ScalarNode) -> float:
        return float(re.sub(r"\.(?=inf|nan)", "", self.construct_scalar(node).lower()))


_with_numbers_of_yaml_1_2(_Loader)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_decimal)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_number)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that repeats instead of referring, and quotes what any YAML takes for a number."""

    def ignore_aliases(self, data: object) -> bool:
        return True


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


@dataclass(frozen=True)
class _Document:
    """A YAML file: its data, and the node tree that knows the lines."""

    source: Path
    root: yaml.Node
    data: Any

    @classmethod
    def read(cls, source: Path) -> _Document:
        try:
            text = source.read_bytes()
        except FileNotFoundError:
            near = _did_you_mean(source.name, [p.name for p in source.parent.glob("*.y*ml")])
            raise ConfigError(f"no such file{near}", file=source) from None
        except OSError as error:
            raise ConfigError(f"cannot be read: {error.strerror}", file=source) from None
        try:
            loader = _Loader(text)
            root = loader.get_single_node()
            if root is None:
                raise ConfigError("the file is empty", file=source)
            _refuse_repeated_keys(root, source)
            return cls(source, root, loader.construct_document(root))
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            hint = " (indent with spaces)" if "'\\t'" in str(error.problem) else ""
            raise ConfigError(
                f"not valid YAML: {error.problem}{hint}",
                file=source,
                line=None if mark is None else mark.line + 1,
            ) from None
        except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(f"not a YAML text file: {reason}", file=source) from None

    def line(self, place: Place) -> int:
        """Line of a place; of the nearest enclosing one if it is not in the file."""
        node = self.root
        line = int(node.start_mark.line) + 1
        for part in place:
            if isinstance(node, yaml.MappingNode):
                found = [(k, v) for k, v in node.value if getattr(k, "value", None) == str(part)]
                if not found:
                    continue
                key, node = found[0]
                line = key.start_mark.line + 1
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int):
                if part >= len(node.value):
                    break
                node = node.value[part]
                line = node.start_mark.line + 1
            else:
                break
        return line

    def error(self, problems: Iterable[Problem], most: int = 12) -> ConfigError:
        """All problems as one error, in the order of their lines."""
        lines = sorted({(self.line(problem.place), problem.message) for problem in problems})
        if len(lines) == 1:
            return ConfigError(lines[0][1], file=self.source, line=lines[0][0])
        listed = [f"  line {line}: {message}" for line, message in lines[:most]]
        if len(lines) > most:
            listed.append(f"  ... and {len(lines) - most} more")
        return ConfigError("\n".join([f"{len(lines)} problems", *listed]), file=self.source)


def _refuse_repeated_keys(root: yaml.Node, source: Path) -> None:
    waiting, seen = [root], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            waiting.extend(node.value)
        elif isinstance(node, yaml.MappingNode):
            first: dict[Hashable, int] = {}
            for key, value in node.value:
                line = key.start_mark.line + 1
                if isinstance(key, yaml.ScalarNode) and key.value in first:
                    raise ConfigError(
                        f"key {key.value!r} occurs twice, first in line {first[key.value]}",
                        file=source,
                        line=line,
                    )
                if isinstance(key, yaml.ScalarNode):
                    first[key.value] = line
                waiting.append(value)


# --- Messages -------------------------------------------------------------------------------------


def _show(value: object) -> str:
    """Show a value as it stands in the file."""
    if value is None:
        return "nothing"
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 60 else text[:57] + "..."


def _kind_of(value: object) -> str:
    return {dict: "a mapping", list: "a list", str: "text", type(None): "nothing"}.get(
        type(value), _show(value)
    )


def _did_you_mean(word: str, known: Iterable[str]) -> str:
    """Name the nearest known word if it is near, all of them otherwise."""
    words = sorted(set(known))
    near = difflib.get_close_matches(word, words, 1, cutoff=0.6)
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; known here: {', '.join(words)}" if words else ""


def _label(place: Place, data: Any) -> str:
    """Name a place in words: cable.length, pose 4 (pose_04.jpg) end."""
    words: list[str] = []
    for part in place:
        if isinstance(data, dict) and part in data:
            data = data[part]
            words.append(str(part))
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            data = data[part]
            if words == ["experiment", "poses"]:
                file = data.get("file") if isinstance(data, dict) else None
                words = [f"pose {part + 1}" + (f" ({file})" if isinstance(file, str) else "")]
            else:
                words[-1] += f"[{part}]"
    return ".".join(words) or "the file"


def _sections(annotation: Any) -> list[type[Section]]:
    """Find the sections that an annotation names."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [section for part in get_args(annotation) for section in _sections(part)]


def _section_at(place: Place) -> type[Section]:
    """Find the section at a place; what is no key of it (index, kind) is passed over."""
    found: list[type[Section]] = [_File]
    for part in place:
        inner = [
            section
            for outer in found
            if part in outer.model_fields
            for section in _sections(outer.model_fields[str(part)].annotation)
        ]
        kinds = [s for s in found if part in get_args(_annotation(s, "kind"))]
        found = inner or kinds or found
    return found[0]


def _annotation(section: type[Section], key: str) -> Any:
    return section.model_fields[key].annotation if key in section.model_fields else None


def _homes(key: str, section: type[Section] = _File, at: str = "") -> list[str]:
    """List the sections that know a key."""
    homes = [at or "the top"] if key in section.model_fields else []
    for name, field in section.model_fields.items():
        for inner in _sections(field.annotation):
            kind = get_args(_annotation(inner, "kind"))
            homes += _homes(
                key, inner, f"{at}.{name}".lstrip(".") + "".join(f" (kind: {k})" for k in kind)
            )
    return homes


def _help(section: type[Section], key: str) -> str:
    text = section.model_fields[key].description if key in section.model_fields else None
    return f": {text.rstrip('.')}" if text else ""


def _about_number(value: object) -> str:
    """Guess why text stands where a number belongs."""
    text = str(value).strip()
    if isinstance(value, str) and _FLOAT.match(text):
        return "; write it without quotes"
    if re.fullmatch(r"[-+]?[0-9]+,[0-9]+", text):
        return f"; the decimal sign is a point: {text.replace(',', '.')}"
    if found := re.fullmatch(r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*[a-zA-Z/^*0-9]+", text):
        return f"; write it in SI units without the unit, such as {found[1]}"
    return ""


_MESSAGES: dict[str, str] = {
    "float_type": "a number belongs here, found {input}{number}",
    "float_parsing": "a number belongs here, found {input}{number}",
    "finite_number": "a finite number belongs here, found {input}",
    "int_type": "a whole number belongs here, found {input}",
    "int_parsing": "a whole number belongs here, found {input}",
    "int_from_float": "a whole number belongs here, found {input}",
    "bool_type": "true or false belongs here, found {input}",
    "string_type": "text belongs here, found {input}",
    "greater_than": "must be larger than {gt:g}, found {input}",
    "greater_than_equal": "must not be smaller than {ge:g}, found {input}",
    "less_than": "must be smaller than {lt:g}, found {input}",
    "less_than_equal": "must not be larger than {le:g}, found {input}",
    "literal_error": "allowed are {expected}, found {input}",
    "model_type": "a mapping of keys and values belongs here, found {kind}",
    "model_attributes_type": "a mapping of keys and values belongs here, found {kind}",
    "dict_type": "a mapping of keys and values belongs here, found {kind}",
    "tuple_type": "a list belongs here, found {kind}",
    "too_short": "at least {min_length} belongs here, found {actual_length}",
    "too_long": "at most {max_length} belong here, found {actual_length}",
    "invalid_key": "a key must be text, found {input}",
}


def _explain(errors: Sequence[ErrorDetails], data: Any) -> list[Problem]:
    """Say what pydantic found in the words of the file."""
    problems: list[Problem] = []
    suggested: set[Place] = set()
    for error in errors:
        if error["type"] == "extra_forbidden":
            *above, key = error["loc"]
            known = list(_section_at(tuple(above)).model_fields)
            near = difflib.get_close_matches(str(key), known, 1, cutoff=0.6)
            suggested.update((*above, name) for name in near)
    for error in errors:
        place, context = error["loc"], error.get("ctx", {})
        section, label = _section_at(place[:-1]), _label(place, data)
        kind = error["type"]
        if kind == "missing":
            if place in suggested:
                continue
            key = place[-1]
            text = (
                f"{label} has only {key} values"
                if isinstance(key, int)
                else f"{key!r} is missing in {label}{_help(section, key)}"
            )
        elif kind == "extra_forbidden":
            key = str(place[-1])
            homes = _homes(key)
            hint = _did_you_mean(key, section.model_fields)
            if homes and "did you mean" not in hint:
                hint = f"; it belongs into {' or '.join(homes)}"
            text = f"unknown key {key!r} in {_label(place[:-1], data)}{hint}"
        elif kind in ("union_tag_invalid", "union_tag_not_found"):
            place = (*place, "kind")
            found = context.get("tag")
            text = f"{label}: kind must be images or centerlines, found {_show(found)}"
        elif kind == "value_error" and isinstance(context["error"], Contradiction):
            for inner in context["error"].problems:
                at = (*place, *inner.place)
                problems.append(Problem(at, f"{_label(at, data)}: {inner.message}"))
            continue
        elif kind == "value_error":
            text = f"{label}: {context['error']}"
        elif kind in _MESSAGES:
            words = {
                "input": _show(error["input"]),
                "kind": _kind_of(error["input"]),
                "number": _about_number(error["input"]),
            }
            text = f"{label}: {_MESSAGES[kind].format(**(context | words))}"
            if place[-1] == "start" and error["input"] == "free":
                text += "; only the end can be free"
            if "tolerances" in place and error["input"] == 0:
                text += "; for a value that is known exactly write a small one, such as 1.0e-6"
        else:
            text = f"{label}: {error['msg']}"
        problems.append(Problem(place, text))
    return problems


# --- Checks across sections -----------------------------------------------------------------------

_IMAGE_ENDINGS = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}


def _contradictions(experiment: Experiment) -> list[Problem]:
    """Find poses that do not fit the boundary, the kind of measurement, or each other."""
    problems: list[Problem] = []
    held = experiment.boundary
    names: dict[str, int] = {}
    for i, pose in enumerate(experiment.poses):

        def wrong(message: str, i: int = i, pose: Pose = pose) -> None:
            at = ("experiment", "poses", i)
            problems.append(Problem(at, f"pose {i + 1} ({pose.file.name}): {message}"))

        if pose.name in names:
            wrong(
                f"pose {names[pose.name] + 1} is called {pose.name!r} too; results are named after "
                "the file without its ending, give each its own"
            )
        names.setdefault(pose.name, i)
        if held.start == "clamped" and pose.start_heading is None:
            wrong("a clamped start needs a start_heading [rad]")
        if held.end == "clamped" and pose.end_heading is None:
            wrong("a clamped end needs an end_heading [rad], continuous along the cable")
        if held.end != "free" and pose.end is None:
            wrong(f"a {held.end} end needs its position: end: [x, y]")
        if held.end == "free":
            for key in ("end", "end_heading"):
                if getattr(pose, key) is not None:
                    wrong(f"a free end has no {key}; boundary.end: pinned or clamped?")
        ending = pose.file.suffix.lower()
        if experiment.measurement.kind == "images" and ending == ".csv":
            wrong("a CSV is not a photograph; measurement kind: centerlines?")
        if experiment.measurement.kind == "centerlines" and ending in _IMAGE_ENDINGS:
            wrong("a photograph is not a CSV; measurement kind: images?")
    if not any(pose.role == "fit" for pose in experiment.poses):
        at = ("experiment", "poses")
        problems.append(Problem(at, "no pose has role: fit, there is nothing to fit to"))
    return problems


def _unreachable(poses: Iterable[Pose], cable: Cable, tolerances: Tolerances) -> dict[str, str]:
    """Find poses whose ends are farther apart than the cable is long, beyond three tolerances."""
    slack = 3.0 * math.hypot(tolerances.length, tolerances.end)
    reasons: dict[str, str] = {}
    for pose in poses:
        if pose.end is None:
            continue
        distance = math.dist(pose.start, pose.end)
        if distance > cable.length + slack:
            unit = "in metres" if distance > 10.0 * cable.length else "and the cable's length right"
            reasons[pose.name] = (
                f"end ({pose.end[0]:g}, {pose.end[1]:g}) m is {distance:.4g} m from the start; "
                f"the cable is {cable.length:.4g} m long. Is the end {unit}?"
            )
    return reasons


def _missing(poses: Iterable[Pose]) -> dict[str, str]:
    """Find poses whose file does not exist."""
    reasons: dict[str, str] = {}
    for pose in poses:
        if pose.file.is_file():
            continue
        folder = pose.file.parent
        names = [p.name for p in folder.iterdir()] if folder.is_dir() else []
        near = difflib.get_close_matches(pose.file.name, names, 1, cutoff=0.8)
        hint = f"did you mean {near[0]}?" if near else "files are found relative to the YAML"
        reasons[pose.name] = f"{pose.file} does not exist; {hint}"
    return reasons


def _no_fit_pose(poses: Sequence[Pose], skipped: Mapping[str, str]) -> list[Problem]:
    return [
        Problem(
            ("experiment", "poses", i),
            f"no pose to fit is left; pose {i + 1} ({pose.file.name}): {skipped[pose.name]}",
        )
        for i, pose in enumerate(poses)
        if pose.role == "fit" and pose.name in skipped
    ]


def _oddities(file: _File) -> list[str]:
    """Find what can be computed with but is probably not meant."""
    cable, experiment = file.cable, file.experiment
    held, poses = experiment.boundary, experiment.poses
    warnings = []
    if cable.youngs_modulus is not None and cable.youngs_modulus < 1.0e4:
        warnings.append(
            f"youngs_modulus {cable.youngs_modulus:g} Pa is softer than any cable: in pascal?"
        )
    density = cable.mass / (cable.length * math.pi * cable.diameter**2 / 4.0)
    if density > 1.0e6:
        warnings.append(
            f"the cable is {density / 1000:.3g} times as dense as water: "
            "mass in kg, diameter and length in m?"
        )
    spans = [math.dist(pose.start, pose.end) for pose in poses if pose.end is not None]
    if spans and 0.0 < 50.0 * max(spans) < cable.length:
        warnings.append(
            f"the cable is {cable.length:g} m long, but its ends are never more than "
            f"{max(spans):g} m apart: all in metres?"
        )
    if math.hypot(*experiment.gravity) > 100.0:
        warnings.append(f"gravity is {math.hypot(*experiment.gravity):g} m/s^2: in m/s^2?")
    std = experiment.measurement.std
    if std is not None and std > 0.02 * cable.length:
        warnings.append(f"std {std:g} m is large for a cable of {cable.length:g} m: in metres?")
    for end in ("start", "end"):
        headings = {pose.name: getattr(pose, f"{end}_heading") for pose in poses}
        given = {name: value for name, value in headings.items() if value is not None}
        if given and getattr(held, end) == "pinned":
            warnings.append(f"{end}_heading is not used, the {end} is pinned: {', '.join(given)}")
        large = [f"{name} {value:g}" for name, value in given.items() if abs(value) > 25.0]
        if large and getattr(held, end) == "clamped":
            warnings.append(f"{end}_heading turns around often, in radians? {', '.join(large)}")
    return warnings
