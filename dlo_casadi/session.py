"""One session of measurements from configuration to outcome."""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Protocol

import numpy as np

from dlo_casadi.config import Config
from dlo_casadi.declared import Declared, declared_model, straight
from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.diagnosis.repeatability import alike, repeatability
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.algorithm1 import applies, run_algorithm1
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.fit import SETTLED_MODES, SMOOTH_MODES, Fit, fit_model, refine_mesh
from dlo_casadi.estimation.mesh import discretization_error
from dlo_casadi.estimation.observation import MeasuredPose
from dlo_casadi.estimation.profile import stiffness_interval
from dlo_casadi.estimation.stiffness import fit_stiffness
from dlo_casadi.findings import candidate_rows, effect_rows, next_pose_row, unexplained_row
from dlo_casadi.measure import read_poses
from dlo_casadi.model import CableModel
from dlo_casadi.outcome import Discretization, MeasurementSummary, Outcome, PoseInput, Stage
from dlo_casadi.stages import algorithm1_stage, fit_stage, initial_stage, stiffness_stage

# The search over decades of stiffness runs on this mesh.
FIRST_MESH = 20
# The mesh is refined until its error is below this share of the noise.
MESH_SHARE = 0.1
FINEST_MESH = 160
# The search for missing effects, a hundred refits, runs on at most so many elements.
SEARCH_MESH = 80
# Poses that repeat worse than this many times the noise get a warning.
REPEATS = 1.5
# Huber's constant: points beyond it count with their distance instead of its square.
HUBER = 1.5


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


class _Clock:
    """Wall-clock time per part of the run."""

    def __init__(self) -> None:
        self._begin = time.perf_counter()
        self.parts: dict[str, float] = {}
        self._last = self._begin

    def lap(self, name: str) -> None:
        """Add the time since the last lap to the named part."""
        now = time.perf_counter()
        self.parts[name] = self.parts.get(name, 0.0) + now - self._last
        self._last = now

    def total(self) -> dict[str, float]:
        """All parts and the total [s]."""
        parts = {key: self.parts.get(key, 0.0) for key in TIMED}
        return {**parts, "total": time.perf_counter() - self._begin}


TIMED = ("vision", "algorithm1", "batch", "diagnosis")


def run_session(config: Config, progress: Progress | None = None) -> Outcome:
    """Read, fit and report one session.

    Raises
    ------
    MeasurementError
        If no fit pose can be read.
    ConfigError
        If the configuration names an unknown effect.
    EstimationError
        If no model of the declared cable comes near the measured shapes.
    """
    progress = progress or Silent()
    clock = _Clock()
    inputs, measured = read_poses(config, lambda name, k, m: progress.step(f"read {name}", k, m))
    clock.lap("vision")
    warnings = [*config.warnings, *_reading_warnings(inputs)]
    declared = declared_model(config, _center(inputs), _pixel(inputs))

    progress.step("fit the declared model", 0, 1)
    fit, error = fit_declared(config, declared, measured)
    clock.lap("fit")
    if config.estimation.robust:
        measured = reweighted(fit, measured)
        fit, error = fit_declared(config, declared, measured, fit.model.n)
        clock.lap("fit")
    fit = solved_by_ipopt(fit)
    clock.lap("batch")
    progress.step("fit the declared model", 1, 1)

    std = fit.noise.std
    stages = before_stages(config, declared, measured, std, fit.model.n, clock, progress)
    reported = _declared_names(config, fit.model)
    stages.append(fit_stage("batch", fit, measured, stiffness_interval(fit), reported))
    clock.lap("fit")
    warnings += _fit_warnings(fit, error)
    outcome = Outcome(
        config=config,
        poses=inputs,
        measurement=_summary(config, measured, fit),
        stages=tuple(stages),
        discretization=Discretization(fit.model.n, fit.model.element, error),
        timing=clock.total(),
        fit=fit,
        warnings=tuple(warnings),
        versions=versions(),
    )
    if not config.diagnosis.enabled:
        return outcome
    return close_the_loop(outcome, measured, reported, _center(inputs), clock, progress)


def close_the_loop(
    outcome: Outcome,
    measured: Sequence[MeasuredPose],
    reported: Sequence[str],
    center: tuple[float, float] | None,
    clock: _Clock,
    progress: Progress,
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
    )
    fit, stages = diagnosis.after, list(outcome.stages)
    fit, error = fine_enough(fit, fit.model.n, SETTLED_MODES)
    if diagnosis.added:
        fit = solved_by_ipopt(fit)
    mesh = Discretization(fit.model.n, fit.model.element, error)
    diagnosis = replace(diagnosis, after=fit)
    interval = stiffness_interval(fit)
    if diagnosis.added:
        labels = {item.candidate.effect.label for item in diagnosis.added}
        names = [name for name in fit.model.names if name.split(".")[0] in labels]
        stages.append(fit_stage("closed", fit, measured, interval, [*reported, *names]))
    elif diagnosis.pull is None:
        # Nothing is missing: the declared model's own noise, estimated as that of a complete one.
        stages[-1] = fit_stage("batch", fit, measured, interval, reported)
    clock.lap("diagnosis")
    return replace(
        outcome,
        fit=fit,
        measurement=_summary(outcome.config, measured, fit),
        stages=tuple(stages),
        discretization=mesh,
        timing=clock.total(),
        verdict=diagnosis.verdict,
        effects=effect_rows(diagnosis),
        candidates=candidate_rows(diagnosis),
        unexplained=unexplained_row(diagnosis),
        next_pose=next_pose_row(diagnosis),
        diagnosis=diagnosis,
    )


def fit_declared(
    config: Config, declared: Declared, measured: Sequence[MeasuredPose], n: int | None = None
) -> tuple[Fit, float]:
    """Fit the declared model on a mesh that is fine enough, and return the mesh's error [m].

    A mesh that is too coarse looks like a missing effect; it is refined first.
    """
    std = config.experiment.measurement.std
    finest = config.model.n or n
    model = declared.model.with_mesh(min(finest or FIRST_MESH, FIRST_MESH))
    free = [name for name in model.names if name not in declared.fixed]
    fit = fit_model(
        model, measured, declared.tolerances, std, free=free, values=declared.start_values()
    )
    if finest:
        fit = refine_mesh(fit, finest)
        return fit, discretization_error(fit)
    return fine_enough(fit, 2 * FIRST_MESH)


def fine_enough(fit: Fit, n: int, modes: int = SMOOTH_MODES) -> tuple[Fit, float]:
    """Refine a fit's mesh, from n elements on, until its error [m] is far below the noise.

    Where an effect is missing, the mesh need not be finer than what is missing.
    """
    while True:
        if n != fit.model.n:
            fit = refine_mesh(fit, n, modes)
        try:
            error = discretization_error(fit)
        except EstimationError:
            error = np.inf
        largest = FINEST_MESH if np.isfinite(error) else SEARCH_MESH
        if error <= MESH_SHARE * max(fit.noise.std, fit.residual_rms) or n >= largest:
            return fit, error
        n *= 2


def solved_by_ipopt(fit: Fit) -> Fit:
    """Minimum of the batch NLP, from the Gauss-Newton fit's; that one where IPOPT fails."""
    try:
        return replace(fit, point=solve_batch(fit.problem, fit.point).point)
    except EstimationError:
        return replace(fit, converged=False)


def before_stages(
    config: Config,
    declared: Declared,
    measured: Sequence[MeasuredPose],
    std: float,
    n: int,
    clock: _Clock,
    progress: Progress,
) -> list[Stage]:
    """The stages to compare with: prior, stiffness alone, the paper's loop."""
    plain = straight(declared.model).with_mesh(n)
    progress.step("stiffness alone", 0, 1)
    stages = [initial_stage(plain, measured, std)]
    stages.append(stiffness_stage(plain, measured, std, fit_stiffness(plain, measured)))
    progress.step("stiffness alone", 1, 1)
    clock.lap("fit")
    length = config.cable.length
    if not config.estimation.algorithm1:
        stages.append(algorithm1_stage(None, measured, std, length, "switched off"))
    elif not applies(declared.model):
        note = "the paper's loop needs two pinned ends"
        stages.append(algorithm1_stage(None, measured, std, length, note))
    else:
        progress.step("the paper's loop", 0, 1)
        result = run_algorithm1(
            declared.model.cable,
            [item for item in measured if item.readable and not item.held_out],
            declared.model.gravity,
            n=config.estimation.algorithm1_n,
            inner=config.estimation.algorithm1_inner,
        )
        clock.lap("algorithm1")
        stages.append(algorithm1_stage(result, measured, std, length))
        progress.step("the paper's loop", 1, 1)
    clock.lap("fit")
    return stages


def reweighted(fit: Fit, measured: Sequence[MeasuredPose]) -> tuple[MeasuredPose, ...]:
    """Measured poses in which outlying points weigh less (Huber's weights)."""
    out = list(measured)
    for j, d in zip(fit.problem.used, fit.linearization.raw, strict=True):
        item = measured[j]
        score = np.abs(d) / (fit.noise.std * item.relative_std)
        grown = np.sqrt(np.maximum(1.0, score / HUBER))
        out[j] = replace(item, weight=item.relative_std * grown)
    return tuple(out)


def versions() -> dict[str, str]:
    """Versions of what computed the results."""
    packages = ("dlo-casadi", "casadi", "numpy", "scipy", "opencv-contrib-python-headless")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _center(inputs: Sequence[PoseInput]) -> tuple[float, float] | None:
    centers = [item.center for item in inputs if item.center is not None]
    if not centers:
        return None
    middle = np.mean(centers, axis=0)
    return float(middle[0]), float(middle[1])


def _pixel(inputs: Sequence[PoseInput]) -> float | None:
    sizes = [item.pixel for item in inputs if item.pixel is not None]
    return float(np.median(sizes)) if sizes else None


def _declared_names(config: Config, model: CableModel) -> list[str]:
    """Qualified parameters of the effects that the configuration declares."""
    labels = {item.name for item in config.model.effects}
    return [name for name in model.names if name.split(".")[0] in labels]


def _summary(config: Config, measured: Sequence[MeasuredPose], fit: Fit) -> MeasurementSummary:
    readable = [item for item in measured if item.readable]
    return MeasurementSummary(
        kind=config.experiment.measurement.kind,
        poses_fit=sum(not item.held_out for item in readable),
        poses_held_out=sum(item.held_out for item in readable),
        points=sum(len(item.points) for item in readable),
        std=fit.noise.std,
        std_source="declared" if fit.noise.declared else "estimated",
        correlation_length=fit.noise.length if fit.noise.share > 0 else 0.0,
    )


def _reading_warnings(inputs: Sequence[PoseInput]) -> list[str]:
    lines = []
    for item in inputs:
        if item.problem:
            lines.append(f"{item.name} is left out: {item.problem}")
        lines += [f"{item.name}: {text}" for text in item.messages]
    return lines


def _fit_warnings(fit: Fit, error: float) -> list[str]:
    lines = []
    spread = repeatability(fit.problem.measured, fit.model.cable.length)
    if spread is not None and spread > REPEATS * fit.noise.std:
        lines.append(
            f"the same pose repeats only within {1e3 * spread:.2g} mm (each from the mean of the "
            f"others), the noise is {1e3 * fit.noise.std:.2g} mm: repeatability limits any "
            "prediction, and intervals from this session are too narrow"
        )
        lines += [
            f"cannot be told apart in this session: {', '.join(group)}" for group in alike(fit)
        ]
    if not fit.converged:
        lines.append("the batch fit stopped before it had converged")
    unstable = [
        item.pose.name
        for item, ok in zip(fit.problem.measured, fit.stable, strict=True)
        if item.readable and not ok
    ]
    if unstable:
        lines.append(f"not a stable equilibrium at the fitted parameters: {', '.join(unstable)}")
    if not np.isfinite(error):
        lines.append(
            f"the fitted shapes cannot be followed to a mesh finer than {fit.model.n} elements: "
            "some pose is close to losing its stability"
        )
    elif error > MESH_SHARE * fit.noise.std:
        lines.append(
            f"the mesh of {fit.model.n} elements is off by {1e3 * error:.3g} mm, more than "
            f"{MESH_SHARE:.0%} of the noise: model.n larger?"
        )
    return lines
