"""All estimates from a replica: the paper's loop and the batch problem, on several meshes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from time import perf_counter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.estimation.constrained import profile_interval
from dlo_casadi.estimation.fit import fit_model, refine_mesh
from dlo_casadi.estimation.prediction import predict_poses
from dlo_casadi.estimation.result import Fit
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.tolerances import Tolerances
from dlo_casadi.paper.algorithm1 import run_algorithm1
from dlo_casadi.runtime.parallel import map_in_order
from dlo_casadi.sensing.measured_pose import MeasuredPose
from dlo_casadi.session.fitting import confirmed, minimum_by_ipopt
from dlo_casadi.session.stages import rest_curvature_of
from paper import published
from paper.replica import PLACES, Replica

FloatArray = NDArray[np.floating]
Method = Literal["guess", "loop", "link", "arc", "quadratic"]

ELEMENTS: tuple[Method, ...] = ("link", "arc", "quadratic")
METHODS: tuple[Method, ...] = ("guess", "loop", *ELEMENTS)
LABELS: dict[Method, str] = {
    "guess": "α⁰",
    "loop": "paper's loop",
    "link": "batch, links",
    "arc": "batch, arcs",
    "quadratic": "batch, quadratic",
}
# The mesh on which stiffness and shapes are searched for.
FIRST = 10
REST_COEFFICIENTS = 13


@dataclass(frozen=True)
class Estimate:
    """What one method has found on one mesh.

    Parameters
    ----------
    replica : str
    method : Method
    n : int
    held_out : bool
        Whether the two poses of Table 6 were kept from the fit.
    stiffness : float [N m^2]
    interval : (float or None, float or None) [N m^2]
        95 % by profile likelihood; of the batch problem on the first mesh only.
    theta_0 : (9,) [rad]
        Rest curvature at the interior joints of ten links, times their length.
    theta_0_std : (9,) [rad] or None
        Of the batch problem.
    errors : (m, 2) [m]
        RMSE and STD of each pose, predicted from its end conditions alone.
    shapes : (m, 201, 2) [m]
        Predicted shapes at `PLACES`.
    status : str
    seconds : float
        Of the estimate; of the batch problem only on its first mesh from prior knowledge alone.
    """

    replica: str
    method: Method
    n: int
    held_out: bool
    stiffness: float
    interval: tuple[float | None, float | None] | None
    theta_0: FloatArray
    errors: FloatArray
    shapes: FloatArray
    status: str
    seconds: float
    history: tuple[float, ...] = ()
    theta_0_std: FloatArray | None = None


def all_estimates(
    replicas: Sequence[Replica], executor: Executor, meshes: Sequence[int] = published.MESHES
) -> list[Estimate]:
    """Estimates of every method on every mesh; those without the two poses for n = 10 and 20."""
    tasks: list[tuple[Replica, Method, tuple[int, ...], bool]] = []
    for replica in replicas:
        # The control is there for Table 3 alone.
        control = replica.name == "straight"
        for held_out in (False,) if control else (False, True):
            few = (FIRST,) if control else (10, 20)
            chosen = tuple(n for n in meshes if n in few or not (held_out or control))
            tasks += [(replica, method, chosen, held_out) for method in METHODS]
    return [item for found in map_in_order(executor, estimate, tasks) for item in found]


def estimate(task: tuple[Replica, Method, tuple[int, ...], bool]) -> list[Estimate]:
    """Estimates of one method on several meshes."""
    replica, method, meshes, held_out = task
    measured = replica.without(published.HELD_OUT if held_out else ())
    if method == "guess":
        return [_guess(replica, n, held_out) for n in meshes]
    if method == "loop":
        return [_loop(replica, measured, n, held_out) for n in meshes]
    return _batch(replica, measured, method, meshes, held_out)


def _guess(replica: Replica, n: int, held_out: bool) -> Estimate:
    """alpha^0: the guessed stiffness, straight at rest."""
    model = CableModel(replica.guess, n=n, element="link")
    rest = np.zeros(model.chain.n_cells)
    return _seen(replica, "guess", held_out, model, model.nominal, rest, "", 0.0)


def _loop(replica: Replica, measured: tuple[MeasuredPose, ...], n: int, held_out: bool) -> Estimate:
    """Algorithm 1."""
    found = run_algorithm1(replica.guess, measured, published.GRAVITY, n=n)
    return _seen(
        *(replica, "loop", held_out, found.model, found.p, found.rest),
        *(found.status.name.lower(), found.seconds),
        history=tuple(float(k) for k in found.history),
    )


def _batch(
    replica: Replica,
    measured: tuple[MeasuredPose, ...],
    method: Method,
    meshes: tuple[int, ...],
    held_out: bool,
) -> list[Estimate]:
    """The batch NLP: from prior knowledge on the first mesh, then carried to the others."""
    element = "link" if method == "link" else "arc" if method == "arc" else "quadratic"
    model = CableModel(replica.guess, n=FIRST, element=element, n_rest=REST_COEFFICIENTS)
    begin = perf_counter()
    first = fit_model(model, measured, Tolerances())
    out = []
    for n in meshes:
        finer = first if n == FIRST else refine_mesh(first, n)
        fit = confirmed(finer, minimum_by_ipopt(finer))
        seconds = perf_counter() - begin
        interval = None
        if n == FIRST:
            found = profile_interval(fit)
            interval = (found.low, found.high)
        out.append(
            _seen(
                *(replica, method, held_out, fit.model, fit.p, fit.rest),
                *("converged" if fit.converged else "not converged", seconds),
                interval=interval,
                fit=fit,
            )
        )
        begin = perf_counter()
    return out


def _seen(
    replica: Replica,
    method: Method,
    held_out: bool,
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    status: str,
    seconds: float,
    *,
    history: tuple[float, ...] = (),
    interval: tuple[float | None, float | None] | None = None,
    fit: Fit | None = None,
) -> Estimate:
    """Predict every pose from its end conditions and compare with the truth."""
    predictions = predict_poses(model, p, rest, published.poses())
    lost = np.full((len(PLACES), 2), np.nan)
    joints = np.arange(1, published.LINKS) * published.LENGTH / published.LINKS
    h, spread = published.LENGTH / published.LINKS, None
    if fit is None:
        middles = model.chain.cells.mean(axis=1)
        curvature = np.interp(joints, middles, rest)
    else:
        curvature = model.rest.basis(joints) @ fit.coefficients
        found = rest_curvature_of(fit)
        spread = np.interp(joints, found.s, found.std) * h
    return Estimate(
        replica=replica.name,
        method=method,
        n=model.n,
        held_out=held_out,
        stiffness=float(p[0]),
        interval=interval,
        theta_0=curvature * h,
        errors=replica.errors(predictions),
        shapes=np.array([lost if q is None else q.curve.at(PLACES) for q in predictions]),
        status=status,
        seconds=seconds,
        history=history,
        theta_0_std=spread,
    )


def pick(
    estimates: Sequence[Estimate], replica: str, method: Method, n: int, held_out: bool = False
) -> Estimate:
    """The estimate of one method on one mesh."""
    return next(
        item
        for item in estimates
        if (item.replica, item.method, item.n, item.held_out) == (replica, method, n, held_out)
    )
