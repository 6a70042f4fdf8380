"""The interface for notebooks and programs: fit a session, and look at the result.

import dlo_casadi as dlo

result = dlo.fit("configs/cable.yaml")  # or dlo.Session(cable, poses, ...).fit(), from arrays
print(result)
result.plot().savefig("poses.png")
result.cable.solve(end=(0.3, -0.1)).points
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import fields
from functools import cached_property
from inspect import Signature, signature
from os import PathLike
from pathlib import Path
from typing import Any, Never, Self

from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from dlo_casadi.arrays import FloatArray
from dlo_casadi.cable.estimate import Covariance, Estimates, Named
from dlo_casadi.cable.file import load
from dlo_casadi.cable.fitted_cable import FittedCable, Shape
from dlo_casadi.config import (
    Cable,
    Config,
    Motion,
    Obstacle,
    Pose,
    any_photographs,
    checked_config,
    known_config,
    load_config,
)
from dlo_casadi.config.frozen import Numbers, Rows, plain
from dlo_casadi.config.oddities import odd_gravity
from dlo_casadi.config.problems import Arguments
from dlo_casadi.errors import DloError, library
from dlo_casadi.report.documents import cable_of_known, fitted_cable
from dlo_casadi.report.figures_poses import outcome_figure
from dlo_casadi.report.tables import estimates_of, outcome_html, outcome_text, summary_text
from dlo_casadi.report.writer import ResultsFolder
from dlo_casadi.session import Outcome, Progress, run_session
from dlo_casadi.session.fitting import declared_model


class Result(Outcome):
    """An `Outcome` that can show itself, write itself, and predict.

    In a notebook it is a short table; `print` gives the same as text.

    Attributes
    ----------
    verdict : "complete", "effect_found", "unexplained" or None
        None without a diagnosis, unless there are `doubts`.
    effects : tuple of FoundEffect
        Effects added to the declared model: name, parameters, p_value, indistinguishable_from.
    stages : tuple of Stage
        Fits in order, the last one with the effects: name, parameters, rmse_fit, rmse_held_out [m].
    warnings, doubts : tuple of str
        Remarks on the data, and reasons why the numbers of the last stage may be unreliable.
    candidates, unexplained, next_pose
        All effects tried; the remaining unknown load; the pose that best separates rivals.
    """

    def __str__(self) -> str:
        return outcome_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return outcome_html(self)

    def plot(self) -> Figure:
        """Draw all poses in one frame: measured points, and shapes predicted from ends alone."""
        return outcome_figure(self)

    @cached_property
    def params(self) -> Estimates:
        """All parameters of the last stage by name: value, std, interval_95, unit, fixed.

        A notebook shows them as a table, `print` as lines; `stderr` is lmfit's name of `std`.

        Parameters known within a tolerance, such as `length_error.length_difference`, follow the
        fitted ones. Intervals are profile likelihoods; a model that does not explain the
        measurements has none.
        """
        return Estimates(estimates_of(self))

    @property
    def covariance(self) -> Covariance:
        """Covariance of all fitted parameters, by name, including the residual's excess."""
        return Covariance(*self.fit.named_covariance)

    @property
    def residuals(self) -> dict[str, FloatArray]:
        """Measured minus predicted points (K, d) [m] of each pose in the last stage.

        Predicted from the ends of the pose alone; poses without points are absent.
        """
        shapes = self.stages[-1].shapes
        return Named((name, shape.gap) for name, shape in shapes.items() if len(shape.gap))

    def summary(self) -> str:
        """Text on the whole fit: errors, all parameters, effects, strong correlations, warnings."""
        return summary_text(self)

    def to_dataframe(self) -> Any:
        """`params` as a pandas.DataFrame, one row each.

        Raises
        ------
        DloError
            If pandas is not installed.
        """
        pandas = library("pandas", "pandas", "to_dataframe")
        rows = [
            {
                "value": x.value,
                "std": x.std,
                **dict(zip(("low_95", "high_95"), x.interval_95 or (None, None), strict=True)),
                "unit": x.unit,
                "fixed": x.fixed,
            }
            for x in self.params.values()
        ]
        return pandas.DataFrame(rows, index=list(self.params))

    def write(self, folder: str | Path) -> Path:
        """Write report, parameters, centre-lines and figures, as `dlo fit` does.

        Earlier results in the folder are replaced by the complete new ones.

        Raises
        ------
        DloError
            If the folder cannot be written, or holds files of the same names from another source.
        """
        if not isinstance(folder, str | PathLike):
            raise DloError(f"folder: a path belongs here, found {folder!r}")
        with ResultsFolder(folder, self.config) as results:
            return results.write(self)

    @cached_property
    def cable(self) -> FittedCable:
        """The fitted cable, identical to what `load` reads after `write`."""
        return fitted_cable(self)


class Session(Config):
    """A cable, how it was held and what was measured: the input of a fit.

    A configuration file makes the same object: `Session.load("session.yaml")`.

    Parameters
    ----------
    cable : Cable
    poses : sequence of Pose
        In the order in which they were taken.
    gravity : (d,) [m/s^2]
        Two numbers put the cable in a plane, three in space.
    boundary : (str, str)
        How start and end are held: pinned, clamped, swivel, slide; the end also free.
    std : float [m], optional
        Standard deviation of one coordinate of a point; estimated when absent.
    force_std, moment_std : float [N], [N m], optional
        Of one component of a reading; estimated when absent.
    obstacles : sequence of Obstacle or mapping, optional
        Obstacles that the cable may touch, as in a configuration.
    motions : sequence of Motion or mapping, optional
        Recordings of the moving cable.
    camera, board, reference : mapping, optional
        For photographs, as in a configuration.
    tolerances, model, estimation, diagnosis, limits : mapping, optional
        As in a configuration: `diagnosis={"enabled": False}`.

    Raises
    ------
    ConfigError
        If the arguments cannot be used; the message lists every problem with the argument's name.

    Examples
    --------
    >>> rope = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
    >>> poses = [dlo.Pose((0, 0), (0.5, 0.1), points=points)]  # points (K, 2) [m]
    >>> dlo.Session(rope, poses, gravity=(0, -9.81), boundary=("pinned", "pinned")).fit()
    """

    def __init__(
        self,
        cable: Cable,
        poses: Sequence[Pose],
        *,
        gravity: Numbers | None = None,
        boundary: Sequence[str] | None = None,
        obstacles: Sequence[Obstacle | Mapping[str, Any]] | None = None,
        motions: Sequence[Motion | Mapping[str, Any]] | None = None,
        std: float | None = None,
        force_std: float | None = None,
        moment_std: float | None = None,
        camera: Mapping[str, Any] | None = None,
        board: Mapping[str, Any] | None = None,
        reference: Mapping[str, Any] | None = None,
        tolerances: Mapping[str, float] | None = None,
        model: Mapping[str, Any] | None = None,
        estimation: Mapping[str, Any] | None = None,
        diagnosis: Mapping[str, Any] | None = None,
        limits: Mapping[str, float] | None = None,
        **unknown: Never,  # refused with a hint
    ) -> None:
        equipment = _given(camera=camera, board=board, reference=reference)
        pictures = equipment or any_photographs(poses)
        measurement = _given(std=std, force_std=force_std, moment_std=moment_std) | equipment
        measurement["kind"] = "images" if pictures else "centerlines"
        experiment = {"measurement": measurement, "poses": poses}
        experiment |= _given(
            gravity=gravity,
            boundary=boundary,
            tolerances=tolerances,
            obstacles=obstacles,
            motions=motions,
        )
        options = _given(model=model, estimation=estimation, diagnosis=diagnosis, limits=limits)
        given = plain({"cable": cable, "experiment": experiment, **options, **unknown})
        checked = checked_config(Arguments(given, tuple(signature(Session).parameters)))
        vars(self).update(vars(checked))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read and check a configuration file.

        Raises
        ------
        ConfigError
            If the file cannot be used; the message lists every problem with its line.
        """
        session = cls.__new__(cls)
        vars(session).update(vars(load_config(path)))
        return session

    def fit(
        self,
        *,
        diagnosis: bool | None = None,
        progress: Progress | None = None,
        executor: Executor | None = None,
    ) -> Result:
        """Fit the cable to the measurements.

        Parameters
        ----------
        diagnosis : bool, optional
            Whether to search for missing effects; by default as the session declares.
        progress : Progress, optional
            Receives the progress of the run: an object with `step(name, done, total)`.
        executor : Executor, optional
            Runs independent tasks at the same time; by default they run in this process. In a
            script, below `if __name__ == "__main__":`, `with open_executor(2, here=True) as
            executor` of `dlo_casadi.runtime.parallel` opens one.

        Returns
        -------
        Result
            Nothing is written; see `Result.write`.

        Raises
        ------
        DloError
            If `diagnosis` is not True, False or None, `progress` has no method `step`, or
            `executor` is not an `Executor`.
        MeasurementError
            If no pose can be read, or if the lines contradict the session beyond doubt.
        EstimationError
            If no model of the declared cable comes near the measured shapes.
        """
        if progress is not None and not hasattr(progress, "step"):
            raise DloError(
                f"progress={progress!r} has no method step(name, done, total).\n  Try: an object "
                "of a class of yours that has."
            )
        if executor is not None and not isinstance(executor, Executor):
            raise DloError(
                f"executor={executor!r} is no Executor.\n  Try: with "
                "dlo_casadi.runtime.parallel.open_executor(2, here=True) as executor: ..."
            )
        if not isinstance(diagnosis, bool | None):
            raise DloError(f"diagnosis is True, False or None, found {diagnosis!r}")
        session = self if diagnosis is None else self.changed(diagnosis={"enabled": diagnosis})
        found = run_session(session, progress, executor)
        return Result(**{field.name: getattr(found, field.name) for field in fields(found)})


# Arguments of a session: without `self` and the unknown ones, which are refused.
_KNOWN = list(signature(Session.__init__).parameters.values())[1:-1]
Session.__signature__ = Signature(_KNOWN)  # type: ignore[attr-defined]


def _given(**values: Any) -> dict[str, Any]:
    """The arguments that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def fit(path: str | Path, **options: Any) -> Result:
    """Fit a cable to its photographs or centre-lines: `Session.load(path).fit(...)`.

    Parameters
    ----------
    path : str or Path
        A configuration file.
    **options
        See `Session.fit`.

    Raises
    ------
    ConfigError
        If the configuration cannot be used.
    DloError, MeasurementError, EstimationError
        As `Session.fit`.
    """
    return Session.load(path).fit(**options)


def known_cable(
    cable: Cable,
    *,
    gravity: Numbers | None = None,
    boundary: Sequence[str] | None = None,
    rest_curvature: float | Numbers | Rows | None = None,
    model: Mapping[str, Any] | None = None,
    limits: Mapping[str, float] | None = None,
    **unknown: Never,  # refused with a hint
) -> FittedCable:
    """A cable with known data, without poses and without a fit.

    It has the form of a fit's result, with standard deviations of zero.

    Parameters
    ----------
    cable : Cable
        Its stiffnesses and its mass are exact values, not first guesses; in space it needs a
        torsional stiffness.
    gravity, boundary
        As of `Session`.
    rest_curvature : float or (K,), in space (2,) or (2, K) [1/m], optional
        Curvature without load at K <= 64 places, evenly spaced from start to end, with a cubic
        spline between them; counter-clockwise, in space about the material axes y and z. By default
        the cable is straight.
    model, limits : mapping, optional
        As in a configuration: {"n": 40, "effects": [...]}, each effect with all its values.

    Raises
    ------
    ConfigError
        If the arguments cannot be used; the message lists every problem with the argument's name.

    Warns
    -----
    UserWarning
        If gravity is neither that on Earth nor none: it may be in other units.

    Examples
    --------
    >>> rope = dlo.Cable(length=0.8, mass=0.05, diameter=0.005, bending_stiffness=0.01)
    >>> rope = dlo.known_cable(rope, gravity=(0, -9.81), boundary=("pinned", "pinned"))
    >>> rope.solve(end=(0.5, 0.1)).points
    """
    given = _given(gravity=gravity, boundary=boundary, model=model, limits=limits)
    given |= _given(rest_curvature=rest_curvature) | {"cable": cable} | unknown
    names = tuple(signature(known_cable).parameters)[:-1]
    config, coefficients = known_config(given, names)
    for text in odd_gravity(config.experiment.gravity):
        warnings.warn(text, stacklevel=2)
    return cable_of_known(declared_model(config, known=True), coefficients, config.limits)


def predict(
    parameters: str | Path | FittedCable, end: ArrayLike | None = None, **ends: Any
) -> Shape:
    """Predict the shape of a fitted cable: `load(parameters).solve(end, ...)`.

    Parameters
    ----------
    parameters : str, Path or FittedCable
        A parameters.yaml, its folder of results, or what was read from it.
    end, **ends
        See `FittedCable.solve`.

    Raises
    ------
    ConfigError
        If the file cannot be used.
    EquilibriumError, DloError
        As `FittedCable.solve`.
    """
    cable = parameters if isinstance(parameters, FittedCable) else load(parameters)
    return cable.solve(end, **ends)
