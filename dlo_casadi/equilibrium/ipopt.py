"""One equilibrium by IPOPT: min V(phi) s.t. the end conditions and the bounds of the joints.

The same functions of segments as everywhere, stated as one problem of the whole pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.equilibrium import (
    BALANCE,
    END_TOLERANCE,
    JOINT_BOUND,
    NEARBY,
    Equilibrium,
    Status,
    equilibria_of,
)
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.model.assembly import Inputs, Shapes, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.whole_pose import potential
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.runtime.executors import interrupts_held

FloatArray = NDArray[np.floating]

NEWTON_STEPS = 8
# In 690 solves of random problems of all boundaries IPOPT took 7 iterations (median), at most 84.
IPOPT_ITERATIONS = 300
# A joint so near to its bound is at it [rad].
AT_BOUND = 1e-6


@lru_cache(maxsize=32)
def _solver(key: int, holder: _Held) -> ca.Function:
    model = holder.model
    problem, count = potential(model), model.chain.n_nodes
    x = problem.coordinates
    bends = x[1:count] - x[: count - 1]
    return ca.nlpsol(
        "equilibrium",
        "ipopt",
        {
            "x": x,
            "p": problem.parameters,
            "f": problem.energy,
            "g": ca.vertcat(problem.conditions, bends),
        },
        {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": 1e-11,
            "ipopt.max_iter": IPOPT_ITERATIONS,
        },
    )


@dataclass(frozen=True)
class _Held:
    """A model that hashes by identity, for the cache of solvers."""

    model: CableModel

    def __hash__(self) -> int:
        return id(self.model)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Held) and other.model is self.model


def run_ipopt(solver: ca.Function, **given: Any) -> tuple[dict[str, ca.DM], dict[str, Any]]:
    """Outputs and statistics of one run of an IPOPT solver.

    Raises
    ------
    KeyboardInterrupt
        After a run that was interrupted: CasADi would take the signal for a failure of the solver.
    """
    with interrupts_held():
        out = solver(**given)
    return out, solver.stats()


def by_ipopt(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, phi: FloatArray
) -> Equilibrium | None:
    """Equilibrium of a planar cable that IPOPT reaches from one first guess; None if there is none.

    IPOPT minimises the potential, Newton's method on the Lagrangian settles the shape to rounding.

    Parameters
    ----------
    p, rest
        As in `solve.solve_equilibrium`.
    pose : Pose
    phi : (n_nodes,) [rad]
    """
    chain = model.chain
    solver = _solver(id(model), _Held(model))
    deviation = np.zeros(len(model.deviation_names))
    given = Inputs.of(p, rest, pose.vector[None])
    x0 = np.concatenate([phi, np.zeros(solver.size1_in("x0") - len(phi))])
    bounds = np.zeros(model.n_multipliers + chain.n_nodes - 1)
    bounds[model.n_multipliers :] = JOINT_BOUND
    parameters = np.concatenate([p, rest, pose.vector, deviation])
    out, stats = run_ipopt(solver, x0=x0, p=parameters, lbg=-bounds, ubg=bounds)
    multipliers = np.array(out["lam_g"]).ravel()
    coordinates, places = np.array(out["x"]).ravel(), 2 * model.n_springs
    border = np.zeros(model.n_border)
    border[model.are_multipliers] = multipliers[: model.n_multipliers]
    border[~model.are_multipliers] = coordinates[chain.n_nodes : chain.n_nodes + places]
    start = Shapes(coordinates[None, : chain.n_nodes, None], border[None], deviation[None])
    # Whatever IPOPT says of its end (on fine meshes of stiff cables its tolerance lies below
    # rounding), what counts is whether the shape that is returned balances.
    found = _balanced(model, start, multipliers[model.n_multipliers :], given)
    if not found.holds:
        return None
    return equilibria_of(
        model,
        found.shapes,
        given,
        statuses=[Status.STABLE if found.stable else Status.UNSTABLE],
        iterations=np.array([stats["iter_count"]]),
        bound_multipliers=found.bound_lam[None],
    )[0]


@dataclass(frozen=True)
class _Balance:
    """Where Newton's method has led: the shape of one pose, and whether it is an equilibrium."""

    shapes: Shapes
    bound_lam: FloatArray
    holds: bool
    stable: bool


def _balanced(
    model: CableModel, shapes: Shapes, bound_multipliers: FloatArray, given: Inputs
) -> _Balance:
    """Newton's method from the potential's minimum, whose bows are stiff under compression too.

    Joints at their bound are held there; one whose multiplier pulls it back is let go.
    """
    bends = _bends(model, shapes)
    held = np.flatnonzero(np.abs(bends) > JOINT_BOUND - AT_BOUND)
    while True:
        bound, pulls = np.copysign(JOINT_BOUND, bends[held]), bound_multipliers[held]
        now = shapes
        for _ in range(NEWTON_STEPS):
            force, matrix = _bordered(model, now, held, bound, pulls, given)
            step = matrix.factor().solve(Vector(-force.x, -force.y))
            size = float(np.abs(step.x).max())
            if not size < NEARBY:
                break
            now = replace(
                now,
                x=model.chain.kind.node.moved(now.x, step.x[..., 0]),
                lam=now.lam + step.y[:, : model.n_border, 0],
            )
            pulls = pulls + step.y[0, model.n_border :, 0]
            if size < 1e-12:
                break
        if not np.any(pulls * np.sign(bound) < 0):
            break
        held = held[pulls * np.sign(bound) >= 0]
    force, matrix = _bordered(model, now, held, bound, pulls, given)
    residual = float(np.abs(force.y).max(initial=0.0))
    imbalance = float(np.abs(force.x).max())
    bound_lam = np.zeros(len(bends))
    bound_lam[held] = pulls
    inside = bool(np.abs(_bends(model, now)).max() < JOINT_BOUND + AT_BOUND)
    holds = imbalance <= BALANCE * float(matrix.scale[0]) and residual <= END_TOLERANCE
    stable = np.isfinite(matrix.scale[0]) and (
        int(matrix.negative()[0]) == model.n_multipliers + len(held)
    )
    return _Balance(now, bound_lam, holds and inside, bool(stable))


def _bends(model: CableModel, shapes: Shapes) -> FloatArray:
    """Angles (n_nodes - 1,) [rad] between neighbouring nodes of one pose."""
    node = model.chain.kind.node
    return node.difference(shapes.x[0, :-1], shapes.x[0, 1:])[:, 0]


def _bordered(
    model: CableModel,
    shapes: Shapes,
    held: NDArray[np.intp],
    bound: FloatArray,
    pulls: FloatArray,
    given: Inputs,
) -> tuple[Vector, BandMatrix]:
    """Imbalance and tangent with the joints that are held as further conditions."""
    _, force, matrix = assembly_of(model).balance(shapes, given)
    arms = np.zeros((1, model.chain.n_nodes, 1, len(held)))
    arms[0, held, 0, np.arange(len(held))] = -1.0
    arms[0, held + 1, 0, np.arange(len(held))] = 1.0
    gap = (_bends(model, shapes)[held] - bound)[None, :, None]
    whole = Vector(force.x + (arms @ pulls)[..., None], np.concatenate([force.y, gap], axis=1))
    return whole, matrix.with_border(arms)
