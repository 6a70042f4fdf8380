"""The batch estimate beside the simpler fits: it must not be worse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dlo_casadi.estimation.gauss_newton import CONVERGED
from dlo_casadi.estimation.hyperparameters import refine
from dlo_casadi.estimation.prediction import predicted_shapes
from dlo_casadi.estimation.result import Fit
from dlo_casadi.session.outcome import SIMPLER, Stage


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
    shapes, known = problem.sweep.settled(fit.point.shapes, p, rest)
    if not known.all() and better:
        predicted = predicted_shapes(problem, fit.point.shapes, p, rest)
        shapes, known = problem.sweep.settled(predicted, p, rest)
    if not known.all():
        return fit
    point = problem.evaluate(theta, shapes, fit.point.feet)
    if not better and point.objective >= fit.point.objective:
        return fit
    point, converged = problem.descend(point)
    if point.objective > fit.point.objective - CONVERGED:
        return fit
    if fit.noise.source == "misfit":
        return Fit(problem, point, converged)
    problem, point, converged = refine(problem, point, estimate=not fit.noise.known)
    return Fit(problem, point, converged)
