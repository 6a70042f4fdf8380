"""One session of measurements from configuration to outcome."""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Protocol

import numpy as np

from dlo_casadi.config import Config
from dlo_casadi.diagnosis.diagnose import diagnose, separating_pose
from dlo_casadi.errors import DloError
from dlo_casadi.estimation.branches import as_measured
from dlo_casadi.estimation.fit import SEARCH_MESH, fine_enough, mesh_error, refine_mesh
from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.estimation.profile import profile_intervals
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import SETTLED_MODES
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.runtime.executors import InProcess, one_thread
from dlo_casadi.runtime.parallel import begin
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import (
    confirmed,
    declared_model,
    first_mesh,
    fit_declared,
    minimum_by_ipopt,
    not_worse,
    reweighted,
    simpler_fits,
)
from dlo_casadi.session.measure import calibrated, measured_poses, read_inputs
from dlo_casadi.session.outcome import (
    Discretization,
    MeasurementSummary,
    Outcome,
    PoseInput,
    Repeatability,
    Stage,
    found_effects,
)
from dlo_casadi.session.plausibility import without_implausible
from dlo_casadi.session.remarks import (
    branch_warnings,
    doubts_of,
    fit_warnings,
    held_out_missing,
    reading_warnings,
    weight_warning,
    worse_than_simpler,
)
from dlo_casadi.session.stages import fit_stage, fitted_parameters


class Progress(Protocol):
    """Who wants to know how far a run has come."""

    def step(self, name: str, done: int, total: int) -> None:
        """`done` of `total` parts of the named work are finished."""

    def message(self, text: str) -> None:
        """Something worth a line."""


@dataclass
class Silent:
    """Progress that nobody watches."""

    lines: list[str] = field(default_factory=list)

    def step(self, name: str, done: int, total: int) -> None:
        """Ignore."""

    def message(self, text: str) -> None:
        """Keep the line."""
        self.lines.append(text)


class Clock:
    """Wall-clock time per part of the run; parts that run beside one another both count."""

    def __init__(self) -> None:
        self._begin = time.perf_counter()
        self.parts: dict[str, float] = {}
        self._last = self._begin

    def lap(self, name: str) -> None:
        """Add the time since the last lap to the named part."""
        now = time.perf_counter()
        self.parts[name] = self.parts.get(name, 0.0) + now - self._last
        self._last = now

    def add(self, name: str, seconds: float) -> None:
        """Add the time [s] that a named part has taken beside others."""
        self.parts[name] = self.parts.get(name, 0.0) + seconds

    def total(self) -> dict[str, float]:
        """All parts and the total [s]."""
        parts = {key: self.parts.get(key, 0.0) for key in TIMED}
        return {**parts, "total": time.perf_counter() - self._begin}


TIMED = ("vision", "algorithm1", "batch", "diagnosis")


def run_session(
    config: Config, progress: Progress | None = None, executor: Executor | None = None
) -> Outcome:
    """Read, fit and report one session.

    Parameters
    ----------
    executor : Executor, optional
        Where what can be done at the same time is done; in this process by default.

    Raises
    ------
    MeasurementError
        If no fit pose can be read, or if the lines contradict the configuration beyond doubt.
    ConfigError
        If the configuration names an unknown effect.
    EstimationError
        If no model of the declared cable comes near the measured shapes.
    """
    progress = progress or Silent()
    clock = Clock()
    executor = executor or InProcess()
    begin(executor, versions)  # another process starts, and imports what fits, meanwhile
    config = calibrated(config, lambda name, k, m: progress.step(f"calibrate {name}".strip(), k, m))
    inputs = read_inputs(config, lambda name, k, m: progress.step(f"read {name}", k, m))
    try:
        with one_thread():
            return fit_session(config, inputs, clock, progress, executor)
    except DloError as error:
        error.poses = inputs  # for whoever tells what had been read
        raise


def fit_session(
    config: Config,
    inputs: Sequence[PoseInput],
    clock: Clock,
    progress: Progress,
    executor: Executor,
) -> Outcome:
    """Fit and report a session whose poses have been read; raises as `run_session` does."""
    inputs, odd = without_implausible(config, inputs)
    measured = measured_poses(config, inputs)
    clock.lap("vision")
    warnings = [*config.warnings, *reading_warnings(inputs, config.skipped), *odd]
    declared = declared_model(config, _center(inputs), _pixel(inputs))

    progress.step("fit the declared model", 0, 1)
    n, refined = config.model.n or first_mesh(declared.model), None
    if config.estimation.robust:
        fit, _ = fit_declared(config, declared, measured)
        measured, n, refined = reweighted(fit), fit.model.n, fit.model.n
    compared = begin(executor, simpler_fits, config.estimation, declared.model, measured, n)
    fit, error = fit_declared(config, declared, measured, refined)
    confirming = begin(executor, minimum_by_ipopt, fit)
    progress.step("fit the declared model", 1, 1)

    progress.step("compare with simpler fits", 0, 1)
    reported = _parameters_of({item.name for item in config.model.effects}, fit.model)

    def staged(fit: Fit) -> Stage:
        # A diagnosis that finds nothing replaces this stage; intervals are taken after it.
        intervals = {} if config.diagnosis.enabled else profile_intervals(fit)
        return fit_stage("batch", fit, measured, intervals, reported)

    own = staged(fit)
    simpler, stages = compared()
    if fit.model.n != n:
        stages = simpler.stages(measured, fit.model.n)
    found = confirming()
    clock.add("algorithm1", simpler.seconds)
    clock.add("batch", found.seconds)
    best = confirmed(fit, found)
    if best.point is not fit.point:
        own = staged(best)
    fit = not_worse(best, [*stages, own])
    if not config.diagnosis.enabled:
        fit = as_measured(fit)
    if fit is not best:
        own = staged(fit)
    progress.step("compare with simpler fits", 1, 1)
    clock.lap("fit")
    outcome = Outcome(
        config=config,
        poses=tuple(inputs),
        measurement=_summary(config, inputs, measured, fit),
        stages=(*stages, own),
        discretization=Discretization(fit.model.n, fit.model.element, error),
        repeatability=Repeatability.of(fit),
        timing=clock.total(),
        fit=fit,
        warnings=tuple(warnings),
        versions=versions(),
    )
    if not config.diagnosis.enabled:
        return judged(outcome)
    return close_the_loop(outcome, measured, reported, _center(inputs), clock, progress, executor)


def judged(outcome: Outcome) -> Outcome:
    """An outcome with what is said of its fit, and its verdict if that stands."""
    fit, stages = outcome.fit, outcome.stages
    doubts = doubts_of(stages, outcome.poses, fit)
    declared = outcome.config.experiment.measurement.std
    said = fit_warnings(fit, outcome.discretization.error, declared)
    said += worse_than_simpler(stages)
    if outcome.hidden_weight is not None:
        said.append(weight_warning(outcome.hidden_weight, fit.expected_error))
    return replace(
        outcome,
        verdict="unexplained" if outcome.verdict and doubts else outcome.verdict,
        doubts=doubts,
        warnings=(*outcome.warnings, *said, *branch_warnings(stages)),
    )


def close_the_loop(
    outcome: Outcome,
    measured: Sequence[MeasuredPose],
    reported: Sequence[str],
    center: tuple[float, float] | None,
    clock: Clock,
    progress: Progress,
    executor: Executor,
) -> Outcome:
    """Diagnose the declared model's residual and add what is missing.

    Parameters
    ----------
    reported : sequence of str
        Parameters of effects that the configuration declares.
    """
    options = outcome.config.diagnosis
    searched = outcome.fit
    if searched.model.n > SEARCH_MESH and not outcome.config.model.n:
        searched = refine_mesh(searched, SEARCH_MESH)
    diagnosis = diagnose(
        searched,
        center=center,
        exclude=options.exclude,
        significance=options.significance,
        max_effects=options.max_effects,
        step=progress.step,
        executor=executor,
        finest=None if outcome.config.model.n else SEARCH_MESH,
    )
    fit, stages = diagnosis.after, list(outcome.stages)
    if outcome.config.model.n:
        error = mesh_error(fit)
    else:
        fit, error = fine_enough(fit, fit.model.n, SETTLED_MODES)
    confirming = begin(executor, minimum_by_ipopt, fit) if diagnosis.added else None
    next_pose = separating_pose(diagnosis) if diagnosis.added else None
    if diagnosis.added or diagnosis.unexplained:
        parameters = fitted_parameters(outcome.fit, profile_intervals(outcome.fit), reported)
        stages[-1] = replace(stages[-1], parameters=parameters)
    else:
        # Nothing is missing: the declared model's own noise, estimated as that of a complete one.
        fit = as_measured(fit)
        stages[-1] = fit_stage("batch", fit, measured, profile_intervals(fit), reported)
    if confirming is not None:
        labels = {item.candidate.effect.label for item in diagnosis.added}
        names = [*reported, *_parameters_of(labels, fit.model)]
        own = fit_stage("closed", fit, measured, profile_intervals(fit), names)
        found = confirming()
        clock.add("batch", found.seconds)
        best = as_measured(confirmed(fit, found))
        if best.point is not fit.point:
            own = fit_stage("closed", best, measured, profile_intervals(best), names)
        fit = best
        stages.append(own)
    mesh = Discretization(fit.model.n, fit.model.element, error)
    diagnosis = replace(diagnosis, after=fit)
    validated = diagnosis.validation_after
    clock.lap("diagnosis")
    closed = replace(
        outcome,
        fit=fit,
        measurement=_summary(outcome.config, outcome.poses, measured, fit),
        stages=tuple(stages),
        discretization=mesh,
        repeatability=Repeatability.of(fit),
        timing=clock.total(),
        verdict=diagnosis.verdict,
        effects=found_effects(diagnosis),
        candidates=diagnosis.ranked,
        unexplained=diagnosis.pull,
        next_pose=next_pose,
        structure=(diagnosis.structure_before, diagnosis.structure_after),
        cross_validated=validated.rmse if validated.complete and not diagnosis.added else None,
        hidden_weight=diagnosis.weight,
    )
    return judged(closed)


def versions() -> dict[str, str]:
    """Versions of what computed the results."""
    packages = ("dlo-casadi", "casadi", "numpy", "scipy", "opencv-contrib-python-headless")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _center(inputs: Sequence[PoseInput]) -> tuple[float, float] | None:
    centers = [item.center for item in inputs if item.center is not None]
    if not centers:
        return None
    x, y = np.mean(centers, axis=0).tolist()
    return x, y


def _pixel(inputs: Sequence[PoseInput]) -> float | None:
    sizes = [item.pixel for item in inputs if item.pixel is not None]
    return float(np.median(sizes)) if sizes else None


def _parameters_of(labels: set[str], model: CableModel) -> list[str]:
    """Qualified parameters of the effects with these labels."""
    return [name for name in model.names if name.split(".")[0] in labels]


def _summary(
    config: Config, inputs: Sequence[PoseInput], measured: Sequence[MeasuredPose], fit: Fit
) -> MeasurementSummary:
    readable = [item for item in measured if item.readable]
    readings = [name for item in readable for name in item.reactions]
    kinds, points = {name.split("_")[1] for name in readings}, fit.noise.of_points
    noise = points.readings
    return MeasurementSummary(
        kind=config.experiment.measurement.kind,
        poses_fit=sum(not item.held_out for item in readable),
        poses_held_out=sum(item.held_out for item in readable),
        points=sum(len(item.points) for item in readable),
        std=points.std,
        std_source="declared" if points.source == "declared" else "estimated",
        correlation_length=fit.noise.length if fit.noise.share > 0 else 0.0,
        noise_distance=noise_distance(measured, points.std),
        readings=len(readings),
        force_std=noise.force if "force" in kinds else None,
        moment_std=noise.moment if "moment" in kinds else None,
        held_out_missing=held_out_missing(inputs, config.skipped),
    )
