"""Discretisation error of a fit, from two meshes, and a mesh that is fine enough."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.errors import EstimationError, counted
from dlo_casadi.estimation.fit import refine_mesh
from dlo_casadi.estimation.hyperparameters import SMOOTH_MODES
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.transfer import on_other_mesh
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.rod.chain import ELEMENTS
from dlo_casadi.thresholds import LACKING_SHARE, MESH_SHARE

FloatArray = NDArray[np.floating]

FINEST_MESH = 160
# The search for missing effects, a hundred refits, runs on at most so many elements.
SEARCH_MESH = 80


def on_mesh(fit: Fit, n: int) -> tuple[BatchEquilibrium, Shapes, FloatArray, bool]:
    """Equilibria of the fitted parameters on a mesh of n elements.

    Returns
    -------
    BatchEquilibrium, Shapes, (n_rests,), bool
        The finer model's poses, their shapes, the rest curvature, and whether they converged.
    """
    model = fit.model.with_mesh(n)
    equilibria = BatchEquilibrium(model, [item.pose for item in fit.problem.measured])
    rest = model.rest_basis @ fit.coefficients
    shapes = on_other_mesh(fit.point.shapes, fit.model, model)
    solved, converged = equilibria.solve(shapes, fit.p, rest)
    return equilibria, solved, rest, bool(converged.all())


def discretization_error(fit: Fit) -> float:
    """Largest RMS distance [m] between a pose on this mesh and on an infinitely fine one.

    The difference to the mesh of half the element size, times 4/3: the error falls at least with
    the square of the element size (Richardson).

    Raises
    ------
    EstimationError
        If the fitted parameters have no equilibria on the finer mesh nearby.
    """
    equilibria, shapes, rest, ok = on_mesh(fit, 2 * fit.model.n)
    if not ok:
        raise EstimationError(
            "the fitted shapes are no equilibria on a mesh of "
            f"{counted(2 * fit.model.n, 'element')}: the mesh of {fit.model.n} is far too coarse.\n"
            "  Try: model.n larger."
        )
    fine = equilibria.seen(shapes, fit.p, rest)
    coarse = fit.problem.observed(fit.point.theta, fit.point.shapes)
    places = np.linspace(0.0, fit.model.cable.length, 101)
    worst = 0.0
    for true, seen in zip(fine, coarse, strict=True):
        gap = true.curve.at(places) - seen.curve.at(places)
        worst = max(worst, float(np.sqrt((gap**2).sum(axis=1).mean())))
    return 4 / 3 * worst


def fine_enough(
    fit: Fit, n: int, modes: int = SMOOTH_MODES, finest: int = FINEST_MESH
) -> tuple[Fit, float]:
    """Refine a fit's mesh, from n elements on, until its error [m] is far below the noise.

    Where an effect is missing, the mesh need not be much finer than what is missing.
    """
    while True:
        if fit.noise.source == "misfit":
            return fit, mesh_error(fit)
        if n != fit.model.n:
            fit = refine_mesh(fit, n, modes)
        error = mesh_error(fit)
        largest = finest if np.isfinite(error) else SEARCH_MESH
        allowed = allowed_mesh_error(fit)
        if error <= allowed or n >= largest:
            return fit, error
        n = min(_finer(n, error / allowed, fit.model.element), largest)


def mesh_error(fit: Fit) -> float:
    """Error of a fit's mesh [m]; infinite if its shapes cannot be followed to a finer one."""
    try:
        return discretization_error(fit)
    except EstimationError:
        return float("inf")


def allowed_mesh_error(fit: Fit) -> float:
    """Error of the mesh [m] that is far below the noise, or below what else is left."""
    left = LACKING_SHARE if fit.beyond_noise else MESH_SHARE
    return max(MESH_SHARE * fit.compared_std, left * fit.residual_rms)


def _finer(n: int, excess: float, element: str) -> int:
    """Even number of elements that should make the error smaller by the factor `excess`."""
    # Carefully: as if half of what lies above the second order were lost on a coarse mesh.
    order = 1 + ELEMENTS[element].order / 2
    return 2 * int(np.ceil(n * np.clip(excess ** (1 / order), 1.2, 2.0) / 2))
