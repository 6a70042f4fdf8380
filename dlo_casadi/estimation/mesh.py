"""Discretisation error of a fit, from two meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.assembly import Shapes
from dlo_casadi.errors import EstimationError
from dlo_casadi.estimation.fit import on_other_mesh
from dlo_casadi.estimation.result import Fit
from dlo_casadi.estimation.sweep import Sweep

FloatArray = NDArray[np.floating]


def on_mesh(fit: Fit, n: int) -> tuple[Sweep, Shapes, FloatArray, bool]:
    """Equilibria of the fitted parameters on a mesh of n elements.

    Returns
    -------
    Sweep, Shapes, (n_rests,), bool
        The finer model's poses, their shapes, the rest curvature, and whether they converged.
    """
    model = fit.model.with_mesh(n)
    sweep = Sweep(model, [item.pose for item in fit.problem.measured])
    rest = model.rest_basis @ fit.coefficients
    shapes = on_other_mesh(fit.point.shapes, fit.model, model)
    solved, converged = sweep.solve(shapes, fit.p, rest)
    return sweep, solved, rest, bool(converged.all())


def discretization_error(fit: Fit) -> float:
    """Largest RMS distance [m] between a pose on this mesh and on an infinitely fine one.

    The difference to the mesh of half the element size, times 4/3: the error falls at least with
    the square of the element size (Richardson).

    Raises
    ------
    EstimationError
        If the fitted parameters have no equilibria on the finer mesh nearby.
    """
    sweep, shapes, rest, ok = on_mesh(fit, 2 * fit.model.n)
    if not ok:
        raise EstimationError(
            f"the fitted shapes are no equilibria on a mesh of {2 * fit.model.n} elements: the "
            f"mesh of {fit.model.n} is far too coarse.\n  Try: model.n larger."
        )
    fine = sweep.seen(shapes, fit.p, rest)
    coarse = fit.problem.observed(fit.point.theta, fit.point.shapes)
    places = np.linspace(0.0, fit.model.cable.length, 101)
    worst = 0.0
    for true, seen in zip(fine, coarse, strict=True):
        gap = true.curve.at(places) - seen.curve.at(places)
        worst = max(worst, float(np.sqrt((gap**2).sum(axis=1).mean())))
    return 4 / 3 * worst
