"""What a notebook or a program calls: fit a session, and look at what came out.

import dlo_casadi as dlo

result = dlo.fit("configs/cable.yaml")
print(result)
result.plot().savefig("poses.png")
result.cable.solve(end=(0.3, -0.1)).points
"""

import os
from concurrent.futures import Executor
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from dlo_casadi.cable import FittedCable, Shape, load
from dlo_casadi.config import Config, load_config
from dlo_casadi.errors import ConfigError, DloError
from dlo_casadi.report.documents import fitted_cable
from dlo_casadi.report.figures_poses import outcome_figure
from dlo_casadi.report.tables import outcome_html, outcome_text
from dlo_casadi.report.writer import ResultsFolder
from dlo_casadi.session import Outcome, Progress, run_session

Kind = TypeVar("Kind")


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

    @cached_property
    def cable(self) -> FittedCable:
        """The fitted cable, as `load` reads it from what `write` has written."""
        return fitted_cable(self)


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
    parameters: str | Path | FittedCable, end: ArrayLike | None = None, **ends: Any
) -> Shape:
    """Predict the shape of a fitted cable: `load(parameters).solve(end, ...)`.

    Parameters
    ----------
    parameters : str, Path or FittedCable
        A parameters.yaml, the folder of results that holds it, or what was read from it.
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


def _as(kind: type[Kind], found: Any) -> Kind:
    """The same values as an object of a class that can show itself."""
    return kind(**{field.name: getattr(found, field.name) for field in fields(found)})
