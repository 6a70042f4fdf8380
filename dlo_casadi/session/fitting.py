"""Fit of the declared model on a mesh that is fine enough."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.config import Config
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.batch import solve_batch
from dlo_casadi.estimation.fit import fit_model, refine_mesh
from dlo_casadi.estimation.hyperparameters import first_reading_noise
from dlo_casadi.estimation.linearization import Point
from dlo_casadi.estimation.mesh import fine_enough, mesh_error
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.declared import REST_COEFFICIENTS, Declared

# The search over decades of stiffness runs on this mesh; in space, where an element takes 17
# times the operations, on half of it.
FIRST_MESH, FIRST_MESH_IN_SPACE = 20, 10
# Markers that are nearer to each other than this share of the cable are at one place.
SAME_PLACE = 0.02
# Share of the objective by which IPOPT's minimum may lie higher and be the same: it stops once the
# points' places along the cable move by a thousandth of the noise. 1.5e-7 is the most of ten fits.
SAME_MINIMUM = 1e-6
# Huber's constant: points beyond it count with their distance instead of its square.
HUBER = 1.5


def fit_declared(
    config: Config, declared: Declared, measured: Sequence[MeasuredPose], n: int | None = None
) -> tuple[Fit, float]:
    """Fit the declared model on a mesh that is fine enough, and return the mesh's error [m].

    A mesh that is too coarse looks like a missing effect; it is refined first.
    """
    finest, first = config.model.n or n, first_mesh(declared.model)
    model = declared.model.with_mesh(min(finest or first, first))
    if config.estimation.rest_curvature_coefficients is None:
        model = replace(model, n_rest=min(model.n_rest, carried_coefficients(model, measured)))
    free = [name for name in model.names if name not in declared.fixed]
    measurement = config.experiment.measurement
    fit = fit_model(
        model,
        measured,
        declared.tolerances,
        measurement.std,
        free=free,
        values=declared.start_values(),
        readings=first_reading_noise(model, measurement.force_std, measurement.moment_std),
    )
    if finest:
        fit = refine_mesh(fit, finest)
        return fit, mesh_error(fit)
    return fine_enough(fit, first)


def first_mesh(model: CableModel) -> int:
    """Number of elements on which stiffnesses and shapes are searched for."""
    return FIRST_MESH_IN_SPACE if model.in_space else FIRST_MESH


def carried_coefficients(model: CableModel, measured: Sequence[MeasuredPose]) -> int:
    """Number of coefficients of the rest curvature that the measurements can carry.

    All poses share one rest curvature, so that each place with a marker tells one number across
    the cable; the heading of a clamp takes one of them, but for the first two: it is known within
    its tolerance. Lines show all places.
    """
    fitted = [item for item in measured if item.readable and not item.held_out]
    if not all(sensor.marked for item in fitted for sensor in item.sensors):
        return REST_COEFFICIENTS
    places = np.sort(np.concatenate([item.places(np.inf) for item in fitted]))
    count = 1 + int((np.diff(places) > SAME_PLACE * places[-1]).sum())
    # Of twenty simulated cables of two to four markers a constant left structure in two, both with
    # two markers; a straight line did not.
    return max(min(count, 2), count - (model.start, model.end).count("clamped"))


@dataclass(frozen=True)
class Minimum:
    """Minimum of the batch NLP as IPOPT has found it, None where it fails, and its time [s]."""

    point: Point | None
    seconds: float


def minimum_by_ipopt(fit: Fit) -> Minimum:
    """Minimum of the batch NLP, from the Gauss-Newton fit's; none is looked for in space.

    Third derivatives of all elements would cost IPOPT minutes a run there.
    """
    if fit.model.in_space:
        return Minimum(None, 0.0)
    began = time.perf_counter()
    try:
        point = solve_batch(fit.problem, fit.point).point
    except EstimationError:
        point = None
    return Minimum(point, time.perf_counter() - began)


def confirmed(fit: Fit, found: Minimum) -> Fit:
    """The fit, held against IPOPT's minimum.

    Where that is lower by more than what a descent stops at, it is the fit's. Where it is the same,
    the fit has converged; where IPOPT has failed, it has not. In space, and where IPOPT ends
    higher, the fit stays as it is.
    """
    point, own = found.point, fit.point.objective
    if fit.model.in_space:
        return fit
    if point is None:
        return replace(fit, converged=False)
    if point.objective < own - fit.problem.least_decrease(fit.point):
        return Fit(fit.problem, point, converged=True)
    same = point.objective <= own + SAME_MINIMUM * abs(own)
    return replace(fit, converged=True) if same and not fit.converged else fit


def reweighted(fit: Fit) -> tuple[MeasuredPose, ...]:
    """All poses of a fit, in those fitted outlying points weigh less (Huber's weights)."""
    out = list(fit.problem.history)
    for k, d in zip(fit.problem.fitted, fit.linearization.raw, strict=True):
        item = out[k]
        square = np.bincount(item.point_of, d[item.on_points] ** 2) / np.bincount(item.point_of)
        score = np.sqrt(square) / (fit.noise.std * item.relative_white)
        grown = np.sqrt(np.maximum(1.0, score / HUBER))
        out[k] = item.weighing(item.relative_std * grown)
    return tuple(out)
