"""The simpler fits (prior, stiffness alone, the paper's loop): the batch estimate is no worse."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dlo_casadi.config.options import EstimationOptions
from dlo_casadi.estimation.gauss_newton import CONVERGED
from dlo_casadi.estimation.hyperparameters import refine
from dlo_casadi.estimation.prediction import predicted_shapes
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.stiffness import StiffnessFit, fit_stiffness
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.paper.algorithm1 import Algorithm1Result, applies, run_algorithm1
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.declared import straight
from dlo_casadi.session.fitting import first_mesh
from dlo_casadi.session.outcome import SIMPLER, Stage
from dlo_casadi.session.stages import algorithm1_stage, initial_stage, stiffness_stage


@dataclass(frozen=True)
class SimplerFits:
    """Simpler fits of the same cable, straight at rest, without its effects.

    Parameters
    ----------
    model : CableModel
        On the mesh that the stiffness was searched on.
    alone : StiffnessFit
        The stiffness alone.
    loop : Algorithm1Result, optional
        Of the paper's loop.
    missing : str
        Why the loop did not run.
    seconds : float [s]
        That it took.
    """

    model: CableModel
    alone: StiffnessFit
    loop: Algorithm1Result | None
    missing: str
    seconds: float

    def stages(self, measured: Sequence[MeasuredPose], n: int) -> list[Stage]:
        """Prior, stiffness alone and the paper's loop as stages on a mesh of n elements."""
        model = self.model.with_mesh(n)
        return [
            initial_stage(model, measured),
            stiffness_stage(model, measured, self.alone),
            algorithm1_stage(self.loop, measured, model, self.missing),
        ]


def simpler_fits(
    options: EstimationOptions, declared: CableModel, measured: Sequence[MeasuredPose], n: int
) -> tuple[SimplerFits, list[Stage]]:
    """The simpler fits, and their stages on a mesh of n elements."""
    # One number of a model that is far off by itself: a coarse mesh finds it.
    model = straight(declared).with_mesh(min(n, first_mesh(declared)))
    alone = fit_stiffness(model, measured)
    missing, loop, seconds = _not_applicable(options, declared, measured), None, 0.0
    if not missing:
        began = time.perf_counter()
        loop = run_algorithm1(
            declared.cable,
            [item for item in measured if item.readable and not item.held_out],
            declared.gravity,
            n=options.algorithm1_n,
            inner=options.algorithm1_inner,
        )
        seconds = time.perf_counter() - began
    found = SimplerFits(model, alone, loop, missing, seconds)
    return found, found.stages(measured, n)


def _not_applicable(
    options: EstimationOptions, model: CableModel, measured: Sequence[MeasuredPose]
) -> str:
    """Why the paper's loop does not run; empty if it does."""
    if not options.algorithm1:
        return "switched off"
    if not applies(model):
        return "the paper's loop needs a plane and two pinned ends"
    sensors = [sensor for item in measured for sensor in item.sensors]
    if any(sensor.marked and sensor.per_point for sensor in sensors):
        return "the paper's loop needs lines along the cable, not single markers"
    return ""


def not_worse(fit: Fit, stages: Sequence[Stage]) -> Fit:
    """A fit, or a better one that starts from a simpler one.

    A simpler fit is a start where its objective is smaller, where it predicts the fit poses
    better, or where the fit has not converged.

    Parameters
    ----------
    stages : sequence of Stage
        The simpler ones, and at last the fit's own.
    """
    best, own = fit, stages[-1]
    for stage in stages[:-1]:
        if stage.name in SIMPLER:
            better = not fit.converged or predicts_better(stage, own)
            found = _from_simpler(fit, stage.parameters["bending_stiffness"].value, better)
            best = max(best, found, key=lambda item: item.log_evidence)
    return best


def predicts_better(stage: Stage, other: Stage) -> bool:
    """Whether a stage comes nearer to the fit poses, each on the branch where it was measured."""
    errors = [
        np.inf if item.rmse_fit_measured_branch is None else item.rmse_fit_measured_branch
        for item in (stage, other)
    ]
    return bool(errors[0] < errors[1])


def _from_simpler(fit: Fit, stiffness: float, better: bool) -> Fit:
    """What a straight cable of a stiffness leads to if it is `better` or lower; else the fit."""
    problem, model = fit.problem, fit.model
    values = model.nominal.copy()
    values[model.stiffness_indices] *= stiffness / values[0]
    theta = problem.unknowns.pack(values, np.zeros(model.n_coefficients))
    p, rest = problem.unknowns.p(theta), problem.unknowns.rest(theta)
    shapes, known = problem.equilibria.settled(fit.point.shapes, p, rest)
    if not known.all() and better:
        predicted = predicted_shapes(problem, fit.point.shapes, p, rest)
        shapes, known = problem.equilibria.settled(predicted, p, rest)
    if not known.all():
        return fit
    point = problem.evaluate(theta, shapes, fit.point.projections)
    if not better and point.objective >= fit.point.objective:
        return fit
    point, converged = problem.descend(point)
    if point.objective > fit.point.objective - CONVERGED:
        return fit
    if fit.noise.source == "misfit":
        return Fit(problem, point, converged)
    problem, point, converged = refine(problem, point, estimate=not fit.noise.known)
    return Fit(problem, point, converged)
