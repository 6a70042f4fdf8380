"""Read parameters.yaml: a fitted cable, complete enough to compute with ("dlo-parameters/1").

Prediction, code generation and comparisons of cables read only this file. `report.documents` makes
its text.
"""

import difflib
import math
import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import Covariance, Estimate, Metadata
from dlo_casadi.cable.fitted_cable import FittedCable
from dlo_casadi.cable.saved import FILE, SCHEMA, parameters_hash
from dlo_casadi.config import Limits
from dlo_casadi.config.document import Document
from dlo_casadi.config.frozen import OpenSection
from dlo_casadi.config.options import ElementName
from dlo_casadi.config.problems import ConfigProblem, show
from dlo_casadi.config.sections import Boundary
from dlo_casadi.config.values import (
    STIFFNESS,
    Elements,
    Gravity,
    Name,
    NonNegative,
    Number,
    Place,
    Positive,
    Quaternion,
    RestCoefficients,
    checked,
    implausible_sizes,
    stacked,
    within,
)
from dlo_casadi.effects import EFFECTS, NUISANCES, CableData, Effect, known_effect
from dlo_casadi.effects.cable import Parameter
from dlo_casadi.equilibrium.spread import Uncertainty
from dlo_casadi.errors import ConfigError, DloError, counted
from dlo_casadi.model.cable_model import BENDING_STIFFNESS, CableModel
from dlo_casadi.model.pose_scatter import REST_CURVATURE, PoseScatter, sources_in
from dlo_casadi.rod.ends import deviation_names
from dlo_casadi.rod.node import Frame

# Largest file [bytes]: the covariance of 250 estimates, among them 128 rest coefficients in space,
# has 250^2 numbers of 25 bytes; all else has less than a fifth of that.
_LARGEST = 2_000_000
# Tolerance of a value at its bound, relative to the bound or the parameter's scale: for rounding in
# value = nominal + scale x, or exp(x), about 1e-14, and for the tolerance of solvers.
_ROUNDING = 1e-9
# Relative tolerance of a covariance's symmetry and correlations: they are inverses of matrices.
_DIGITS = 1e-6
# Maximum number of folders that a message lists.
_LISTED = 5
_DAMAGED, _REMEDY = "damaged parameters", ".\n  Try: the file as a fit has written it."


def _wrong_effect(row: Mapping[str, Any]) -> list[ConfigProblem]:
    """Problems with an effect and its options, by key."""
    name = row.get("name")
    kind = known_effect(name) if isinstance(name, str) else None
    if kind is None:
        known = ", ".join((*EFFECTS, *NUISANCES))
        return [ConfigProblem((), f"no effect is called {name!r}; known: {known}")]
    defaults = {item.name: item.default for item in fields(kind)}
    problems = []
    for key, value in row.items():
        if key not in ("name", *defaults):
            problems.append(ConfigProblem((key,), f"{name} knows {', '.join(defaults)}"))
        elif key != "name" and not _alike(value, defaults[key]):
            text = f"something like {defaults[key]!r} belongs here, found {show(value)}"
            problems.append(ConfigProblem((key,), text))
    return problems


def _alike(value: Any, default: Any) -> bool:
    """Whether a value has a default's form; if the default is empty, any list of whole numbers."""
    if default == ():
        return isinstance(value, list) and all(type(item) is int for item in value)
    if type(default) is int:
        return type(value) is int
    return bool(_form(value) == _form(default))


def _form(value: Any) -> Any:
    """Form of a value, item by item: a finite number, text, true or false."""
    if isinstance(value, list | tuple):
        return [_form(item) for item in value]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return "number" if number and abs(value) <= sys.float_info.max else type(value)


class _Cable(OpenSection):
    name: Name
    length: Positive
    mass: Positive
    diameter: Positive
    bending_stiffness: Annotated[Positive, within(STIFFNESS)]
    torsional_stiffness: Positive | None = None
    damping_time: NonNegative | None = None
    rest_shape: str


class _Value(OpenSection):
    value: Number
    std: NonNegative | None = None
    lower: float | None = None
    upper: float | None = None
    tolerance: float | None = None
    interval_95: tuple[float | None, float | None] | None = None
    interval_95_if_hidden: tuple[float | None, float | None] | None = None
    hidden: str = ""
    identifiable: bool | None = None
    unit: str = ""
    fitted: bool = False

    @property
    def complaint(self) -> str:
        low, high = self.interval_95 or (None, None)
        if low is None or high is None or low <= high:
            return ""
        return f"interval_95 is [low, high], found [{low:.12g}, {high:.12g}]"

    @property
    def estimate(self) -> Estimate:
        known = (self.interval_95, self.identifiable, self.interval_95_if_hidden, self.hidden)
        return Estimate(self.value, self.std or 0.0, self.unit, *known, fixed=not self.fitted)


class _Fitted(OpenSection):
    coefficients: Annotated[tuple[Number, ...], stacked(Frame.curvatures)]


class _State(OpenSection):
    rest_curvature: Annotated[tuple[Number, ...], stacked(Frame.strains)]


class _Covariance(OpenSection):
    names: tuple[str, ...]
    values: tuple[tuple[Number, ...], ...]

    @property
    def complaint(self) -> str:
        size = len(self.names)
        if [len(row) for row in self.values] != [size] * size:
            return f"{counted(size, 'row')} of as many values belong here"
        if len(set(self.names)) != size:
            return "a name stands here twice"
        values = np.array(self.values, dtype=float).reshape(size, size)
        variances = np.diag(values)
        if np.any(variances < 0):
            return f"the variance of {self.names[int(variances.argmin())]} is {variances.min():.3g}"
        largest = np.outer(np.sqrt(variances), np.sqrt(variances))
        for what, beyond in (
            ("not symmetric", np.abs(values - values.T) > _DIGITS * largest),
            ("larger than their deviations allow", np.abs(values) > (1 + _DIGITS) * largest),
        ):
            if np.any(beyond):
                i, j = np.argwhere(beyond)[0]
                return f"values of {self.names[i]} and {self.names[j]} are {what}"
        return ""


class _Fixtures(OpenSection):
    start: Place | None = None
    start_heading: Number | None = None
    end_heading: Number | None = None
    start_orientation: Quaternion | None = None
    end_orientation: Quaternion | None = None


class _Own(OpenSection):
    source: str = REST_CURVATURE
    std: NonNegative = 0.0


class _Scatter(OpenSection):
    fixtures: dict[str, NonNegative | None] | None = None
    rest_curvature_std: NonNegative = PoseScatter().std
    rest_curvature_smoothness: NonNegative = PoseScatter().smoothness
    from_pose_to_pose: _Own = _Own()
    hanging: NonNegative = 0.0


class ParametersFile(OpenSection):
    """The keys that are read from a parameters.yaml written by `report.documents`."""

    cable: Annotated[
        _Cable, checked(lambda cable: implausible_sizes(cable.length, cable.mass, cable.diameter))
    ]
    boundary: Boundary
    gravity: Gravity
    element: ElementName
    n: Elements
    n_rest: RestCoefficients
    effects: tuple[Annotated[dict[str, Any], checked(_wrong_effect)], ...]
    parameters: dict[str, Annotated[_Value, checked(lambda found: found.complaint)]]
    rest_curvature: _Fitted
    state: _State | None = None
    covariance: Annotated[_Covariance, checked(lambda found: found.complaint)]
    scatter: _Scatter | None = None
    fixtures: _Fixtures = _Fixtures()
    limits: Limits = Limits()
    explains: bool | None = None
    model_hash: Name
    config: Name = "unnamed"


def load(path: str | Path) -> FittedCable:
    """Read parameters.yaml and rebuild the model exactly.

    Parameters
    ----------
    path : str or Path
        The file, or the folder of results that holds it.

    Raises
    ------
    ConfigError
        If there is no such file, if it is not a parameters.yaml of this schema, or if a value in it
        is outside its bounds; the message names the key.
    """
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(
            f"{path!r} is no path.\n  Try: the parameters.yaml or the results folder of a fit."
        )
    source = Path(path)
    if os.path.isdir(source):
        source = source / FILE
        if not os.path.isfile(source):
            raise ConfigError(f"no {FILE} in this folder.{_results_near(source)}", source.parent)
    elif not os.path.exists(source):
        raise ConfigError(f"no such file or folder of results.{_results_near(source)}", source)
    document = Document.read(source, _LARGEST)
    data = document.data
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        found = data.get("schema") if isinstance(data, dict) else type(data).__name__
        remedy = "the parameters.yaml in the results folder of a fit."
        if isinstance(data, dict) and "experiment" in data:
            remedy = f"dlo fit {source}, or dlo_casadi.fit: this is a configuration, not a fit."
        raise ConfigError(
            f"no fitted parameters: schema {SCHEMA!r} expected, {found!r} found.\n  Try: {remedy}",
            source,
        )
    listed = data.get("effects")
    rows = listed if isinstance(listed, list) else []
    named = [row.get("name") for row in rows if isinstance(row, dict)]
    if own := [name for name in named if isinstance(name, str) and known_effect(name) is None]:
        raise ConfigError(
            f"effects: no effect is called {own[0]!r} in this process; "
            f"known: {', '.join((*EFFECTS, *NUISANCES))}.\n"
            f"  Try: for an effect of your own, in Python: dlo.EFFECTS[{own[0]!r}] = its class, "
            "before loading.",
            source,
        )
    file = document.checked(ParametersFile, _DAMAGED, _REMEDY)
    try:
        model = _model(file)
    except DloError as error:
        raise ConfigError(f"{_DAMAGED}: {error.message}{_REMEDY}", source) from None
    if problems := [*_unlike(file, model)]:
        raise document.error(problems, _DAMAGED, _REMEDY)
    return _cable(model, file, data, source)


def cable_of(document: dict[str, Any]) -> FittedCable:
    """The cable of the plain data of a parameters.yaml that a cable has written."""
    file = ParametersFile(**document)
    return _cable(_model(file), file, document, None)


def _cable(
    model: CableModel, file: ParametersFile, data: dict[str, Any], source: Path | None
) -> FittedCable:
    p = np.array([file.parameters[name].value for name in model.names])
    return FittedCable(model, p, _rest(file, model), metadata_of(data, source, file))


def _results_near(path: Path) -> str:
    """Advice for a wrong path: nearby folders of results, the most similar name first."""
    wanted = path.parent if path.suffix else path
    known = {
        folder.name: folder
        for base in (wanted.parent / "results", wanted.parent)
        for folder in sorted(base.glob("*"))
        if os.path.isfile(folder / FILE)  # False in a folder that must not be read
    }
    names = difflib.get_close_matches(wanted.name, known, 1) or list(known)[:_LISTED]
    listed = ", ".join(str(known[name]) for name in names)
    return f"\n  Try: {listed}" if listed else "\n  Try: the results folder of a fit (dlo fit)."


def _model(file: ParametersFile) -> CableModel:
    cable = asdict(file.cable)
    straight = cable.pop("rest_shape") == "straight"
    tolerances = {name: row.tolerance for name, row in file.parameters.items()}
    return CableModel(
        cable=CableData(**cable, straight=straight),
        n=file.n,
        element=file.element,
        start=file.boundary.start,
        end=file.boundary.end,
        gravity=file.gravity,
        effects=tuple(map(_effect, file.effects)),
        n_rest=file.n_rest,
        priors={name: std for name, std in tolerances.items() if std is not None},
    )


def _effect(row: Mapping[str, Any]) -> Effect:
    kind = known_effect(row["name"])
    assert kind is not None  # checked before
    options: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in row.items()}
    del options["name"]
    return kind(**options)


def _rest(file: ParametersFile, model: CableModel) -> FloatArray:
    """Rest strains (n_rests,) [1/m]: the state, or without one those of the coefficients."""
    if file.state is not None:
        return np.array(file.state.rest_curvature, dtype=float)
    return model.rest_basis @ np.array(file.rest_curvature.coefficients, dtype=float)


def _unlike(file: ParametersFile, model: CableModel) -> Iterator[ConfigProblem]:
    """Contradictions to the model: names and numbers of parameters, and their bounds."""
    if strange := set(file.parameters) ^ set(model.names):
        wrong = ", ".join(sorted(strange))
        yield ConfigProblem(
            ("parameters",), f"parameters and effects do not belong together: {wrong}"
        )
    for q in [] if strange else model.parameters:
        if wrong := _beyond(q, file.parameters[q.name]):
            name = f"parameters.{q.name}.value"
            yield ConfigProblem(("parameters", q.name, "value"), f"{name}: {wrong}")
    own = file.parameters.get(BENDING_STIFFNESS)
    if own and not (own.fitted or math.isclose(own.value, file.cable.bending_stiffness)):
        text = (
            f"cable.bending_stiffness is {file.cable.bending_stiffness:.12g}, "
            f"parameters.{BENDING_STIFFNESS}.value, which is used, {own.value:.12g}"
        )
        yield ConfigProblem(("cable", BENDING_STIFFNESS), text)
    yield from _other_rest(file, model)
    start = file.fixtures.start
    if start is not None and len(start) != len(file.gravity):
        text = f"{counted(len(file.gravity), 'number')} belong here, found {len(start)}"
        yield ConfigProblem(("fixtures", "start"), f"fixtures.start: {text}")
    coefficients = {f"rest_curvature[{k}]" for k in range(model.n_coefficients)}
    for name in set(file.covariance.names) - {*model.names, *coefficients}:
        text = f"covariance.names: nothing is called {show(name)}"
        yield ConfigProblem(("covariance", "names"), text)
    scatter, known = file.scatter or _Scatter(), (REST_CURVATURE, *sources_in(model))
    if scatter.from_pose_to_pose.source not in known:
        text = f"scatter.from_pose_to_pose.source: this cable has {', '.join(known)}"
        yield ConfigProblem(("scatter", "from_pose_to_pose", "source"), text)
    # A fit's clips and random effects are no part of this model.
    others = re.compile(r"clip_\d|\w+_from_pose_to_pose\.")
    for name in {*(scatter.fixtures or {})} - {*deviation_names(model.node)}:
        if not others.match(name):
            text = f"scatter.fixtures: nothing is called {show(name)}"
            yield ConfigProblem(("scatter", "fixtures", name), text)


def _other_rest(file: ParametersFile, model: CableModel) -> Iterator[ConfigProblem]:
    """Rest curvatures of the wrong number, or that contradict each other."""
    wrong = False
    for key, size, found in (
        ("rest_curvature", model.n_coefficients, file.rest_curvature.coefficients),
        ("state", model.chain.n_rests, file.state.rest_curvature if file.state else None),
    ):
        if found is not None and len(found) != size:
            wrong = True
            text = f"{counted(size, 'number')} belong here, found {len(found)}"
            yield ConfigProblem((key,), f"{key}: {text}")
    if model.has_state and file.state is None:
        yield ConfigProblem((), "'state' is missing: effects change the rest shape")
    if wrong or model.has_state or file.state is None:
        return
    state, fitted = _rest(file, model), _rest(file.changed(state=None), model)
    gap = float(np.abs(state - fitted).max(initial=0.0))
    if gap > _DIGITS * float(np.abs(state).max(initial=0.0)):
        text = (
            f"state.rest_curvature, which is used, and rest_curvature.coefficients differ by "
            f"{gap:.3g} 1/m; without `state` the coefficients are used"
        )
        yield ConfigProblem(("state",), text)


def _beyond(q: Parameter, row: _Value) -> str:
    """Message on a value outside the bounds of the file or the model; empty if it is inside."""
    least, most = q.bounds(estimated=row.fitted)
    lower = max(least, -math.inf if row.lower is None else row.lower)
    upper = min(most, math.inf if row.upper is None else row.upper)
    bound = lower if lower > row.value else upper
    beyond = max(lower - row.value, row.value - upper)
    if not (q.log and row.value <= 0) and beyond <= _ROUNDING * max(q.scale, abs(bound)):
        return ""
    bounds = f"[{lower:.12g}, {upper:.12g}]"
    return f"{row.value:.12g} {q.unit} lies outside of its bounds {bounds}"


def metadata_of(
    document: dict[str, Any], source: Path | None, file: ParametersFile | None = None
) -> Metadata:
    """Contents of a document besides the model; `file`: the same, if it is checked already."""
    file = file or ParametersFile(**document)
    names = file.covariance.names
    covariance = np.array(file.covariance.values, dtype=float).reshape(len(names), len(names))
    scatter = file.scatter or _Scatter()
    fixtures = {name: std or 0.0 for name, std in (scatter.fixtures or {}).items()}
    own, smoothness = scatter.from_pose_to_pose, scatter.rest_curvature_smoothness
    bends = scatter.rest_curvature_std if own.source == REST_CURVATURE else 0.0
    pose_scatter = PoseScatter(own.std or bends, smoothness, source=own.source)
    if pose_scatter.of_moments:  # written in N m
        stiffness = file.parameters[BENDING_STIFFNESS].value
        pose_scatter = replace(pose_scatter, std=own.std / stiffness)
    return Metadata(
        path=source,
        params={name: row.estimate for name, row in file.parameters.items()},
        covariance=Covariance(names, covariance),
        uncertainty=Uncertainty(names, covariance, fixtures, pose_scatter, scatter.hanging),
        coefficients=np.array(file.rest_curvature.coefficients, dtype=float),
        fixtures=document.get("fixtures") or {},
        limits=file.limits,
        explains=file.explains,
        model_hash=file.model_hash,
        edited=parameters_hash(document) != file.model_hash,
        config=file.config,
        document=document,
    )
