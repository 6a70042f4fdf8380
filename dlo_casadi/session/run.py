"""Run one session of measurements from its configuration to the outcome."""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dlo_casadi.config import Config, declared_effects, declared_setup
from dlo_casadi.diagnosis.diagnose import diagnose
from dlo_casadi.diagnosis.found import AddedEffect
from dlo_casadi.diagnosis.from_data import from_data
from dlo_casadi.diagnosis.from_pose_to_pose import at_random, with_loose_poses
from dlo_casadi.diagnosis.if_hidden import IfHidden, wider
from dlo_casadi.diagnosis.next_measurement import separating_pose
from dlo_casadi.diagnosis.next_motion import separating_motion
from dlo_casadi.diagnosis.told_apart import among_rivals
from dlo_casadi.errors import DloError, EstimationError
from dlo_casadi.estimation.constrained import as_measured, profile_intervals, profiled
from dlo_casadi.estimation.fit import SEARCH_MESH, fine_enough, mesh_error, refine_mesh
from dlo_casadi.estimation.prediction import noise_distance
from dlo_casadi.estimation.repeats import enough_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.variances import SETTLED_MODES, SMOOTH_MODES
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.quantities import quantity_of
from dlo_casadi.runtime.executors import InProcess, one_thread, software
from dlo_casadi.runtime.parallel import begin
from dlo_casadi.runtime.progress import Progress, Step, nobody
from dlo_casadi.runtime.work import accounted, accounted_as, add, part
from dlo_casadi.sensing.measured_motion import MeasuredMotion
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session import fitting, remarks
from dlo_casadi.session.fit_remarks import fit_warnings
from dlo_casadi.session.found_effects import found_effects, with_motions
from dlo_casadi.session.in_motion import fit_moving
from dlo_casadi.session.measure import calibrated, measured_poses, read_inputs
from dlo_casadi.session.motions import read_motions
from dlo_casadi.session.outcome import MeasurementSummary, Outcome, PoseInput, Stage
from dlo_casadi.session.outliers import outliers_of
from dlo_casadi.session.plausibility import without_implausible
from dlo_casadi.session.stages import checked_limits, fit_stage, fitted_parameters
from dlo_casadi.session.still_in_motion import with_still_poses

TIMED = ("vision", "algorithm1", "batch", "diagnosis", "motion")


def run_session(
    config: Config, progress: Progress | None = None, executor: Executor | None = None
) -> Outcome:
    """Read, fit and report one session.

    Parameters
    ----------
    executor : Executor, optional
        Runs independent parts in parallel; in this process by default.

    Raises
    ------
    MeasurementError
        If no fit pose can be read, or if the lines contradict the configuration beyond doubt.
    ConfigError
        If the configuration names an unknown effect.
    EstimationError
        If no model of the declared cable comes near the measured shapes.
    """
    began = time.perf_counter()
    step = nobody if progress is None else progress.step
    warn = getattr(progress, "warn", nobody)
    executor = executor or InProcess()
    begin(executor, software)  # meanwhile another process starts and imports what fits need
    config = calibrated(config, step)
    motions = read_motions(config, step)
    config = with_still_poses(config, motions)
    inputs = read_inputs(config, step)
    try:
        with one_thread(), accounted() as work:
            outcome = _Run(config, step, warn, executor, began, motions).outcome(inputs)
        add(work)
        work.tell()
        return replace(outcome, work=work)
    except DloError as error:
        error.poses = inputs  # for the page of a failure, which shows what was read
        raise


@dataclass(frozen=True)
class _Run:
    """One run: what its parts use.

    `began`: the time at which it began. `seconds`: wall-clock time [s] per part of a run; parts
    that run in parallel both count in full. `motions`: the recordings of the session.
    """

    config: Config
    step: Step
    warn: Callable[[Sequence[str]], None]
    executor: Executor
    began: float
    motions: tuple[MeasuredMotion, ...] = ()
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TIMED, 0.0))

    def outcome(self, inputs: Sequence[PoseInput]) -> Outcome:
        """Fit and report a session whose poses have been read; raises as `run_session` does."""
        config, step, executor = self.config, self.step, self.executor
        inputs, odd = without_implausible(config, inputs)
        self.warn(odd)
        measured = measured_poses(config, inputs)
        self.seconds["vision"] = time.perf_counter() - self.began
        warnings = [*config.warnings, *remarks.reading_warnings(inputs, config.skipped), *odd]
        centers = [item.center for item in inputs if item.center is not None]
        x, y = np.mean(centers or [(np.nan, np.nan)], axis=0).tolist()
        center = (x, y) if centers else None
        pixels = [item.pixel for item in inputs if item.pixel is not None]
        pixel = float(np.median(pixels)) if pixels else None
        declared = fitting.declared_model(config, center, pixel)

        step("fit the declared model", 0, 1)
        n = config.model.n or fitting.first_mesh(declared.model)
        if config.estimation.robust:
            fit = fitting.fit_declared(config, declared, measured)
            outliers = outliers_of(fit, inputs)
            inputs, measured = outliers.poses, measured_poses(config, outliers.poses)
            warnings += remarks.left_out(outliers)
        others = config.estimation, declared.model, measured, n
        compared = begin(executor, fitting.simpler_fits, *others)
        with part("declared model"):
            fit = fitting.fit_declared(config, declared, measured)
        confirming = begin(executor, fitting.minimum_by_ipopt, fit)
        step("fit the declared model", 1, 1)

        step("compare with simpler fits", 0, 1)
        effects = declared_effects(config, declared_setup(config))
        reported = _parameters_of({effect.label for _, effect in effects}, fit.model)
        diagnosed = config.diagnosis.enabled

        def staged(fit: Fit) -> Stage:
            # Intervals follow the diagnosis: a model that does not explain the points gets none.
            intervals = dict.fromkeys(profiled(fit)) if diagnosed else profile_intervals(fit)
            return fit_stage("batch", fit, measured, intervals, reported)

        simpler = compared()
        self.seconds["algorithm1"] = simpler.seconds
        own = staged(fit)
        stages = simpler.stages(measured, fit.model.n)
        best = self.confirmed(fit, confirming)
        own = own if best.point is fit.point else staged(best)
        fit = fitting.not_worse(best, [*stages, own])
        if not diagnosed:
            if fit.noise.source == "misfit" and enough_poses(fit.problem.history, fit.model):
                near = with_loose_poses(fit, from_data(fit)[0]) or at_random(fit)
                fit = fit if near is None else self.meshed(near)
            fit = as_measured(fit)
        own = own if fit is best else staged(fit)
        nearest, own = fitting.nearest_to_poses(fit, [*stages, own], staged, diagnosed=diagnosed)
        stages = [*stages, own]
        step("compare with simpler fits", 1, 1)
        if diagnosed:
            fit, found, added = self.close_the_loop(
                fit, nearest, stages, measured, reported, center
            )
        else:
            fit, found, added = nearest, {}, ()
        if self.motions:
            still, model = found.get("effects", ()), declared.model
            try:
                fit, found = self.moved(fit, found, added, stages, measured, reported, model)
                warnings += remarks.not_in_motion(still, found["effects"])
            except EstimationError as error:
                # What the still poses tell stands without them.
                warnings.append(f"recorded motions could not be fitted: {error.message}")
                found |= {"verdict": "unexplained"} if "verdict" in found else {}
        return judged(
            Outcome(
                config=config,
                poses=tuple(inputs),
                measurement=_summary(config, inputs, measured, fit),
                stages=tuple(stages),
                mesh_error=mesh_error(fit),
                timing={**self.seconds, "total": time.perf_counter() - self.began},
                fit=fit,
                warnings=tuple(warnings),
                serious=tuple(odd),
                versions=software(),
                limits=checked_limits(config.limits, fit, [item.pose for item in measured]),
                **found,
            )
        )

    @accounted_as("diagnosis")
    def close_the_loop(
        self,
        declared: Fit,
        nearest: Fit,
        stages: list[Stage],
        measured: Sequence[MeasuredPose],
        reported: Sequence[str],
        center: tuple[float, float] | None,
    ) -> tuple[Fit, dict[str, Any], tuple[AddedEffect, ...]]:
        """Diagnose the declared model's residual and add missing effects.

        Returns the last fit, the diagnosis in the fields of an `Outcome`, and what was added.

        `nearest`: the declared fit, or a fit with the misfit as noise where that comes nearer to
        the poses; it is reported unless effects are found, or nothing is missing. The last of the
        `stages`, the declared one, gets its intervals; another follows if effects are added.
        `reported`: parameters of the effects that the configuration declares.
        """
        began, options = time.perf_counter(), self.config.diagnosis
        kept_mesh = self.config.model.n is not None
        fine = declared.model.n > SEARCH_MESH and not kept_mesh
        diagnosis = diagnose(
            refine_mesh(declared, SEARCH_MESH) if fine else declared,
            center=center,
            exclude=options.exclude,
            significance=options.significance,
            max_effects=options.max_effects,
            step=self.step,
            executor=self.executor,
            finest=None if kept_mesh else SEARCH_MESH,
        )
        unknown = diagnosis.unexplained and not diagnosis.added
        fit = nearest if unknown and nearest is not declared else diagnosis.fit
        fit = self.meshed(fit, SETTLED_MODES)
        confirming = (
            begin(self.executor, fitting.minimum_by_ipopt, fit) if diagnosis.added else None
        )
        next_pose = separating_pose(diagnosis.fit, diagnosis.added)
        moved = None if self.motions else separating_motion(diagnosis.fit, diagnosis.added)
        if diagnosis.unexplained or (nearest.noise.source == "misfit" and diagnosis.added):
            stages[-1] = _marked(stages[-1], explains=False)
        elif diagnosis.added:
            parameters = fitted_parameters(declared, profile_intervals(declared), reported)
            stages[-1] = replace(stages[-1], parameters=parameters)
        else:
            # Nothing is missing: estimate the declared model's noise as that of a complete one.
            fit = as_measured(fit)
            stages[-1] = fit_stage("batch", fit, measured, profile_intervals(fit), reported)
        if confirming is not None:
            labels = {item.candidate.effect.label for item in diagnosis.added}
            names = [*reported, *_parameters_of(labels, fit.model)]
            own = fit_stage("closed", fit, measured, profile_intervals(fit), names)
            best = as_measured(self.confirmed(fit, confirming))
            if best.point is not fit.point:
                own = fit_stage("closed", best, measured, profile_intervals(best), names)
            fit = best
            stages.append(own)
        diagnosis = replace(diagnosis, fit=fit)
        validated = diagnosis.validation
        told = validated.complete and not diagnosis.added and fit.has_points
        effects, ranked = found_effects(diagnosis), diagnosis.ranked
        if not fit.has_points:  # errors of readings have no length
            effects = tuple(
                replace(x, rmse_cross_validated_before=None, rmse_cross_validated_after=None)
                for x in effects
            )
            ranked = tuple(replace(row, rmse_cross_validated=None) for row in ranked)
        self.seconds["diagnosis"] = time.perf_counter() - began
        found = {
            "verdict": diagnosis.verdict,
            "effects": effects,
            "candidates": ranked,
            "unexplained": diagnosis.unknown_force,
            "next_pose": next_pose,
            "next_motion": moved,
            "structure": (diagnosis.structure_before, diagnosis.structure),
            "cross_validated": validated.rmse if told else None,
            "if_hidden": diagnosis.if_hidden,
            "cut_off": diagnosis.cut_off,
            "as_likely": diagnosis.as_likely,
        }
        return fit, found, diagnosis.added

    def moved(
        self,
        fit: Fit,
        found: dict[str, Any],
        added: Sequence[AddedEffect],
        stages: list[Stage],
        measured: Sequence[MeasuredPose],
        reported: Sequence[str],
        declared: CableModel,
    ) -> tuple[Fit, dict[str, Any]]:
        """Fit the motions with the still poses; the last stage becomes that of both.

        Of effects `added` to the `declared` model that still shapes leave tied the motions choose.
        Another stage follows if effects are found that only motion shows.
        """
        began, options = time.perf_counter(), self.config.diagnosis
        effects, shown = list(found.get("effects", ())), [item.candidate for item in added]
        for k, item in enumerate(added):
            told = among_rivals(fit, item, self.motions, self.config.cable.damping_time)
            if told:
                fit, shown[k] = told[0].fit, told[0].candidate
                effects[k] = with_motions(effects[k], told[0], told)
        result = fit_moving(
            fit,
            self.motions,
            options.exclude,
            self.step,
            diagnosed=options.enabled,
            significance=options.significance,
            damping_time=self.config.cable.damping_time,
            shown=shown,
            declared=declared,
        )
        self.seconds["motion"] = time.perf_counter() - began
        effects = [x for x in effects if x.label not in result.dropped] + [*result.effects]
        names = [*reported, *_parameters_of({x.label for x in effects}, result.fit.model)]
        last = stages[-1]
        own = fit_stage(last.name, result.fit, measured, profile_intervals(result.fit), names)
        first, *others = result.stages
        if others:
            stages[-1] = replace(last, motion=first)
            stages.append(replace(own, name="closed", motion=others[-1], explains=last.explains))
        else:
            stages[-1] = replace(own, motion=first, explains=last.explains)
        more: dict[str, Any] = {
            "effects": tuple(effects),
            "motion_scores": result.scores,
            "modes": result.modes,
        }
        if result.effects and found.get("verdict") == "complete":
            more["verdict"] = "effect_found"
        return result.fit, {**found, **more}

    def meshed(self, fit: Fit, modes: int = SMOOTH_MODES) -> Fit:
        """The fit on a fine enough mesh, or as it is on the declared one."""
        return fit if self.config.model.n else fine_enough(fit, fit.model.n, modes)

    def confirmed(self, fit: Fit, confirming: Callable[[], fitting.Minimum]) -> Fit:
        """Compare a fit with the minimum that IPOPT has found in the meantime."""
        found = confirming()
        self.seconds["batch"] += found.seconds
        return fitting.confirmed(fit, found)


def judged(outcome: Outcome) -> Outcome:
    """Add the remarks on its fit to an outcome, and the verdict if no doubt forbids it."""
    fit, stages, verdict = outcome.fit, outcome.stages, outcome.verdict
    doubts = (
        *remarks.doubts_of(stages, outcome.poses, fit),
        *remarks.motion_doubts(stages[-1]),
    )
    declared = outcome.config.experiment.measurement.std
    # With `robust` the outliers have been sought, and are left out.
    poses = () if outcome.config.estimation.robust else outcome.poses
    said = fit_warnings(fit, outcome.mesh_error, declared, poses)
    said += remarks.worse_than_simpler(stages)
    said += [remarks.CUT_OFF] if outcome.cut_off else []
    said += remarks.as_likely(outcome.as_likely)
    if fit.model.cable.straight and outcome.config.cable.rest_shape == "curved":
        said.append(remarks.TAKEN_AS_STRAIGHT)
    told = (*doubts, *remarks.branch_warnings(stages))
    far = remarks.far_off(stages[-1], outcome.poses, told)
    said += far
    verdict = "unexplained" if doubts else verdict
    if verdict is not None:
        stages = (*stages[:-1], _marked(stages[-1], verdict != "unexplained"))
    hidden = {} if verdict == "unexplained" else _joined(stages[-1], outcome.if_hidden)
    stages = (*stages[:-1], _if_hidden(stages[-1], hidden))
    if not outcome.config.experiment.motions:
        known = stages[-1].parameters
        for name, one in hidden.items():
            before = known[name].interval_95
            if before is not None and wider(one.interval, before):
                hidden[name] = one.with_motion()
    return replace(
        outcome,
        verdict=verdict,
        if_hidden=hidden,
        stages=stages,
        doubts=doubts,
        serious=(*outcome.serious, *far),
        warnings=(*outcome.warnings, *said, *remarks.branch_warnings(stages)),
    )


def _joined(stage: Stage, found: Mapping[str, IfHidden]) -> dict[str, IfHidden]:
    """What one hidden effect could do, its intervals joined with those if nothing is hidden."""
    joined = {}
    for name, one in found.items():
        low, high = stage.parameters[name].interval_95 or one.interval
        ends = (
            None if low is None else min(low, one.interval[0] or low),
            None if high is None else max(high, one.interval[1] or high),
        )
        joined[name] = replace(one, interval=ends)
    return joined


def _if_hidden(stage: Stage, found: Mapping[str, IfHidden]) -> Stage:
    """A stage whose stiffnesses have the interval that holds if one effect is hidden, too."""
    parameters = dict(stage.parameters)
    for name, one in found.items():
        own = parameters[name]
        if own.interval_95 is not None:
            parameters[name] = replace(own, interval_95_if_hidden=one.interval, hidden=one.effect)
    return replace(stage, parameters=parameters)


def _marked(stage: Stage, explains: bool) -> Stage:
    """Mark a stage by whether its model explains the data; if not, remove the intervals."""
    found = stage.parameters
    if not explains:
        found = {name: replace(estimate, interval_95=None) for name, estimate in found.items()}
    return replace(stage, parameters=found, explains=explains)


def _parameters_of(labels: set[str], model: CableModel) -> list[str]:
    """Qualified parameters of the effects with these labels."""
    return [name for name in model.names if name.split(".")[0] in labels]


def _summary(
    config: Config, inputs: Sequence[PoseInput], measured: Sequence[MeasuredPose], fit: Fit
) -> MeasurementSummary:
    readable = [item for item in measured if item.readable]
    readings = [name for item in readable for name in item.reactions]
    read, points = {quantity_of(name) for name in readings}, fit.noise.of_points
    noise, shown = points.readings, any(item.has_points for item in readable)
    return MeasurementSummary(
        kind=config.experiment.measurement.kind,
        poses_fit=sum(not item.held_out for item in readable),
        poses_held_out=sum(item.held_out for item in readable),
        points=sum(len(item.points) for item in readable),
        std=points.std if shown else None,
        std_source="declared" if points.source == "declared" else "estimated",
        correlation_length=fit.noise.length if fit.noise.share > 0 else 0.0,
        noise_distance=noise_distance(measured, points.std) if shown else None,
        readings=len(readings),
        **{x.std_key: noise.of(x) for x in read},
        held_out_missing=remarks.held_out_missing(inputs, config.skipped),
    )
