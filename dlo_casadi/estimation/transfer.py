"""What one fit has found, for the model and mesh of another: shapes, multipliers, projections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.solve import continued, solve_equilibrium
from dlo_casadi.errors import EquilibriumError, EstimationError
from dlo_casadi.estimation.gauss_newton import BatchProblem
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.assembly import Shapes
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]


def carried_shapes(problem: BatchProblem, start: Fit) -> Shapes:
    """Shapes of a problem's poses from those of a fit, on the problem's mesh.

    Poses that the fit did not need, because it carried no state, are predicted.

    Raises
    ------
    EstimationError
        If such a pose has no equilibrium.
    """
    known = {index: k for k, index in enumerate(start.problem.indices)}
    own = start.point.shapes
    rows = []
    for index in problem.indices:
        if index in known:
            k = known[index]
            rows.append((own.x[k], own.lam[k], own.deviation[k]))
            continue
        pose = problem.history[index].pose
        try:
            if pose.branch == "previous" and rows:
                before = problem.history[index - 1].pose
                found = continued(start.model, start.p, start.rest, pose, before, rows[-1][0])
            else:
                found = solve_equilibrium(start.model, start.p, start.rest, pose)
        except EquilibriumError as error:
            raise EstimationError(error.message) from error
        rows.append((found.x, found.multipliers, np.zeros(len(start.model.deviation_names))))
    x, lam, deviation = (np.array(column) for column in zip(*rows, strict=True))
    model = problem.unknowns.model
    shapes = with_border_of(Shapes(x, lam, deviation), start.model, model)
    return on_other_mesh(shapes, start.model, model)


def on_other_mesh(shapes: Shapes, model: CableModel, other: CableModel) -> Shapes:
    """Nodes interpolated from one model's mesh to another's."""
    if model.chain == other.chain:
        return shapes
    coarse, fine = model.chain.places, other.chain.places
    return replace(shapes, x=other.chain.kind.node.interpolated(fine, coarse, shapes.x))


def with_border_of(shapes: Shapes, model: CableModel, other: CableModel) -> Shapes:
    """Multipliers in another model's order; what it has beside them begins at zero."""
    if model.border_names == other.border_names:
        return shapes
    lam = np.zeros((len(shapes.lam), other.n_border))
    for i, name in enumerate(other.border_names):
        if name in model.border_names:
            lam[:, i] = shapes.lam[:, model.border_names.index(name)]
    return replace(shapes, lam=lam)


def carried_projections(problem: BatchProblem, start: Fit) -> list[FloatArray]:
    """Feet of the problem's fitted poses, by the pose's place in the session."""
    known = dict(zip(start.problem.fitted, start.point.projections, strict=True))
    return [known[k] for k in problem.fitted]
