"""What a notebook or a program calls: fit a session, and look at what came out.

import dlo_casadi as dlo

result = dlo.fit("configs/cable.yaml")
print(result)
result.plot().savefig("poses.png")
result.predict(end=(0.3, -0.1)).points()
"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
from matplotlib.figure import Figure

from dlo_casadi.config import Config, load_config
from dlo_casadi.config.values import implausible_quaternion
from dlo_casadi.equilibrium.fitted_cable import CableShape, FittedCable, shape_in
from dlo_casadi.equilibrium.pose import Branch, HeldPose
from dlo_casadi.errors import ConfigError, DloError
from dlo_casadi.io.parameters import load_parameters
from dlo_casadi.report.documents import parameters_of
from dlo_casadi.report.figures_poses import outcome_figure, prediction_figure
from dlo_casadi.report.tables import outcome_html, outcome_text, shape_html, shape_text
from dlo_casadi.report.writer import ResultsFolder
from dlo_casadi.session import Outcome, Progress, run_session

Kind = TypeVar("Kind")


class PredictedShape(CableShape):
    """A `CableShape` that can show itself.

    In a notebook it is a short table; `print` gives the same as text.
    """

    def plot(self) -> Figure:
        """The shape with the forces of the cable on its fixtures."""
        return prediction_figure(self)

    def __str__(self) -> str:
        return shape_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return shape_html(self)


class Result(Outcome):
    """An `Outcome` that can show itself, write itself, and predict.

    In a notebook it is a short table; `print` gives the same as text.
    """

    def __str__(self) -> str:
        return outcome_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return outcome_html(self)

    def plot(self) -> Figure:
        """All poses in one frame: measured points, and shapes predicted from their ends alone."""
        return outcome_figure(self)

    def write(self, folder: str | Path) -> Path:
        """Write report, parameters, centre-lines and figures, as `dlo fit` does.

        Earlier results in the folder are replaced by the complete new ones.

        Raises
        ------
        DloError
            If the folder cannot be written, or holds files of these names from elsewhere.
        """
        with ResultsFolder(folder, self.config) as results:
            return results.write(self)

    def predict(self, end: Sequence[float] | None = None, **ends: Any) -> PredictedShape:
        """Predict the fitted cable's shape in a new pose: `dlo_casadi.predict` without a file.

        Takes what that takes: start, start_heading, end_heading, start_orientation,
        end_orientation, turns, branch.
        """
        return predict(parameters_of(self), end, **ends)


def fit(
    config: str | Path | Config,
    *,
    diagnosis: bool | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> Result:
    """Fit a cable to its photographs or centre-lines.

    Parameters
    ----------
    config : str, Path or Config
        A configuration file, or what `load_config` has made of one.
    diagnosis : bool, optional
        Whether to search for missing effects; as the configuration says by default.
    progress : Progress, optional
        Told how far the run has come: an object with `step(name, done, total)` and
        `message(text)`.
    executor : Executor, optional
        Runs independent tasks at the same time; by default they run in this process. In a script,
        below `if __name__ == "__main__":`, `with open_executor(2, here=True) as executor` of
        `dlo_casadi.runtime.parallel` opens one.

    Returns
    -------
    Result
        Nothing is written; see `Result.write`.

    Raises
    ------
    ConfigError
        If the configuration cannot be used.
    DloError
        If the executor is none.
    MeasurementError
        If no pose can be read, or if the lines contradict the configuration beyond doubt.
    EstimationError
        If no model of the declared cable comes near the measured shapes.
    """
    if not isinstance(config, str | os.PathLike | Config):
        raise ConfigError(
            f"{config!r} is no configuration.\n"
            '  Try: the path of a YAML file, such as "configs/cable.yaml".'
        )
    if executor is not None and not isinstance(executor, Executor):
        raise DloError(
            f"executor={executor!r} is no Executor.\n"
            "  Try: with dlo_casadi.runtime.parallel.open_executor(2, here=True) as executor: ..."
        )
    if not isinstance(config, Config):
        config = load_config(config)
    if diagnosis is not None:
        options = config.diagnosis.model_copy(update={"enabled": diagnosis})
        config = replace(config, diagnosis=options)
    return _as(Result, run_session(config, progress, executor))


def predict(
    parameters: str | Path | FittedCable,
    end: Sequence[float] | None = None,
    *,
    start: Sequence[float] | None = None,
    start_heading: float | None = None,
    end_heading: float | None = None,
    start_orientation: Sequence[float] | None = None,
    end_orientation: Sequence[float] | None = None,
    turns: float = 0.0,
    branch: Branch | None = None,
) -> PredictedShape:
    """Predict the shape of a fitted cable.

    Of several equilibria this is the stable one of lowest energy, unless `branch` or `turns` name
    one. Where it is unknown which of two sides is the lower one, `other_side` has the other.

    Parameters
    ----------
    parameters : str, Path or FittedCable
        A parameters.yaml, the folder of results that holds it, or what was read from it.
    end : (d,) [m]
        Where the end is held, d = 2 or 3 in space; None for a free end.
    start : (d,) [m], optional
        Where the start is held; by default where all poses of the session had it, or the origin.
    start_heading, end_heading : float [rad], optional
        Directions of clamped ends in a plane, continuous along the cable; those that all poses of
        the session shared by default.
    start_orientation, end_orientation : (4,), optional
        Frames of clamped ends in space: unit quaternions (x, y, z, w), x forward along the cable;
        those that all poses of the session shared by default.
    turns : float
        In space, the number of full turns to which the twist shall be nearest, see `Pose`. A cable
        may shed two of them over a loop; that is an error.
    branch : "ccw" or "cw", optional
        In a plane, which way the cable turns from start to end.

    Raises
    ------
    ConfigError
        If the file cannot be used.
    EquilibriumError
        If the pose has no equilibrium, e.g. because the end is out of reach, or none is found on
        the branch.
    DloError
        If the ends are not held as the cable's boundary asks, or are no finite numbers.
    """
    if not isinstance(parameters, str | os.PathLike | FittedCable):
        raise DloError(
            f"parameters: {parameters!r} is no path.\n"
            "  Try: the parameters.yaml or the results folder of a fit."
        )
    cable = parameters if isinstance(parameters, FittedCable) else load_parameters(parameters)
    asked = {"start": start, "end": end, "turns": turns, "branch": branch}
    asked |= {"start_heading": start_heading, "end_heading": end_heading}
    asked |= {"start_orientation": start_orientation, "end_orientation": end_orientation}
    shape = shape_in(cable, _pose(cable, asked))
    other = shape.other_side
    if other is None:
        return _as(PredictedShape, shape)
    return replace(_as(PredictedShape, shape), other_side=_as(PredictedShape, other))


def _as(kind: type[Kind], found: Any) -> Kind:
    """The same values as an object of a class that can show itself."""
    return kind(**{field.name: getattr(found, field.name) for field in fields(found)})


def _pose(cable: FittedCable, asked: Mapping[str, Any]) -> HeldPose:
    """End conditions, checked against the boundary; what is not given is as in the session."""
    model, shared = cable.model, cable.metadata.fixtures
    name, size, spatial = model.cable.name, model.node.dimension, model.in_space
    start, end, branch = asked["start"], asked["end"], asked["branch"]
    if branch is not None and branch not in get_args(Branch):
        raise DloError(f"branch must be 'ccw', 'cw' or None, found {branch!r}")
    if branch is not None and spatial:
        raise DloError(f"{name!r} is in space: a branch has no meaning")
    if model.end == "free" and end is not None:
        raise DloError(f"the end of {name!r} is free: it cannot be held at {end} m")
    if model.end != "free" and end is None:
        raise DloError(
            f"the end of {name!r} is {model.end}: where is it?\n"
            f"  Try: --end {' '.join(model.node.axes).upper()} [m], in Python end."
        )
    turns = _number(asked["turns"], "turns", "full turns")
    if turns and not (spatial and model.start == model.end == "clamped"):
        raise DloError(f"{name!r} has no turns: it is not in space and clamped at both ends")
    if start is None:
        start = shared.get("start") or (0.0,) * size
    return HeldPose(
        start=_point(start, "start", size),
        end=None if end is None else _point(end, "end", size),
        turns=turns,
        branch=branch,
        name=name or "cable",
        **_directions(cable, asked),
    )


def _directions(cable: FittedCable, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Directions of the clamps, by their key; none of pins."""
    model, shared, name = cable.model, cable.metadata.fixtures, repr(cable.model.cable.name)
    kind, unit, other, where = _DIRECTIONS[model.node.increment]
    found: dict[str, Any] = {}
    for side, held in (("start", model.start), ("end", model.end)):
        key = f"{side}_{kind}"
        value = asked[key]
        if asked[f"{side}_{other}"] is not None:
            raise DloError(f"{side}_{other}: {name} is in {where}.\n  Try: {key}{unit}")
        if held != "clamped" and value is not None:
            raise DloError(f"the {side} of {name} is {held}: {key} has no meaning")
        if held != "clamped":
            continue
        value = shared.get(key) if value is None else value
        if value is None:
            raise DloError(
                f"the {side} of {name} is clamped, and its {kind} differed from pose to pose: "
                f"give {key}{unit}"
            )
        found[key] = (
            _orientation(value, key) if kind == "orientation" else _number(value, key, "rad")
        )
    return found


# Size of a node's increment -> key of a clamp's direction, unit, the other dimension's key, words.
_DIRECTIONS = {
    1: ("heading", " [rad]", "orientation", "a plane (two numbers of gravity)"),
    3: ("orientation", " [qx, qy, qz, qw]", "heading", "space (three numbers of gravity)"),
}
_WORDS = {2: "two finite numbers (x, y)", 3: "three finite numbers (x, y, z)"}


def _point(values: Any, what: str, size: int) -> tuple[float, ...]:
    point = _finite(values)
    if len(point) != size:
        raise DloError(f"{what}: {_WORDS[size]} in metres belong here, found {values!r}")
    return point


def _orientation(values: Any, what: str) -> tuple[float, ...]:
    quaternion = _finite(values)
    wrong = "four finite numbers [qx, qy, qz, qw] belong here"
    if not quaternion or (wrong := implausible_quaternion(quaternion)):
        raise DloError(f"{what}: {wrong}, found {values!r}")
    return quaternion


def _number(value: Any, what: str, unit: str) -> float:
    numbers = _finite([value])
    if not numbers:
        raise DloError(f"{what}: a finite number [{unit}] belongs here, found {value!r}")
    return numbers[0]


def _finite(values: Any) -> tuple[float, ...]:
    """Finite numbers, or nothing."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        return ()
    return tuple(array.tolist()) if array.ndim == 1 and np.all(np.isfinite(array)) else ()
