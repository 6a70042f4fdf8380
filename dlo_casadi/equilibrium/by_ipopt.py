"""Equilibria of planar cables by IPOPT, from first guesses where Newton's method finds none.

IPOPT keeps the bounds of the joints and the nodes out of obstacles. Newton's method on the
Lagrangian then converges to rounding.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.equilibrium import (
    BALANCE,
    END_TOLERANCE,
    JOINT_BOUND,
    NEARBY,
    Equilibrium,
    equilibria_of,
)
from dlo_casadi.equilibrium.eyelets import slid
from dlo_casadi.equilibrium.minima import descend
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spans import border_of
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import outwards
from dlo_casadi.model.whole_pose import Laid, potential
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.runtime.executors import interrupts_held

# Maximum number of Newton steps after IPOPT.
NEWTON_STEPS = 8
# Maximum number of IPOPT iterations: 690 random problems of all boundaries took 7 (median) to 84.
IPOPT_ITERATIONS = 300
# Share of the segments beside an eyelet by which it slides before another node is moved to it, and
# maximum number of such changes.
MOST_SLID, NODE_CHANGES = 0.8, 8
# Distance within which a joint is at its bound [rad].
AT_BOUND = 1e-6


def ipopt(name: str, problem: dict[str, ca.SX], tolerance: float, iterations: int) -> ca.Function:
    """A silent IPOPT solver."""
    options: dict[str, Any] = {
        "print_time": False,
        # Multipliers of p are not needed; without an equilibrium they gave a warning of CasADi.
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": tolerance,
        "ipopt.max_iter": iterations,
    }
    return ca.nlpsol(name, "ipopt", problem, options)


@lru_cache(maxsize=32)
def _solver(model: CableModel) -> ca.Function:
    problem, count, gaps = potential(model), model.chain.n_nodes, []
    x, start = problem.coordinates, problem.parameters[len(model.names) + model.chain.n_rests :][:2]
    if model.surfaces:
        touching = model.n_contacts // len(model.surfaces)
        places = start + ca.cumsum(problem.by_segment[model.end_pull, :touching], 1)
        offsets = ca.DM(outwards(model)) @ problem.parameters[: len(model.names)]
        clearance = offsets + model.cable.diameter / 2
        gaps = [one.symbolic(places).T - clearance[k] for k, one in enumerate(model.surfaces)]
    conditions = ca.vertcat(problem.conditions, x[1:count] - x[: count - 1], *gaps)
    stated = {"x": x, "p": problem.parameters, "f": problem.energy, "g": conditions}
    return ipopt("equilibrium", stated, 1e-11, IPOPT_ITERATIONS)


def run_ipopt(solver: ca.Function, **given: Any) -> tuple[dict[str, ca.DM], dict[str, Any]]:
    """Outputs and statistics of one run of an IPOPT solver.

    Raises
    ------
    KeyboardInterrupt
        After an interrupted run, which CasADi reports as a failure of the solver.
    """
    with interrupts_held():
        out = solver(**given)
    return out, solver.stats()


def by_ipopt(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: HeldPose, phi: FloatArray
) -> Equilibrium | None:
    """Equilibrium of a planar cable that IPOPT reaches from one first guess; None if it does not.

    IPOPT minimises the potential under the end conditions and the bounds of the joints. It uses the
    same functions of segments as the rest, assembled to one problem of the whole pose; inequalities
    keep nodes out of obstacles. Newton's method on the Lagrangian then converges to rounding.

    Parameters
    ----------
    p, rest
        As in `solve.solve_equilibrium`.
    phi : (n_nodes,) [rad]
    """
    if model.slides and rest.any():
        return None  # segments change the cells whose rest strains they have
    border, still = border_of(model, pose, phi[:, None]), np.zeros((1, len(model.deviation_names)))
    given = Inputs.of(p, rest, pose.vector[None])
    now, iterations = Assembly(model, Shapes(phi[None, :, None], border[None], still), given), 0
    for _ in range(NODE_CHANGES if model.sliding else 1):
        if (np.diff(now.clipped.places[0]) <= 0).any():
            return None  # the guess, or a slide, puts an eyelet beyond the next clip
        there, bounded, count = _minimised(now)
        iterations += count
        now = replace(there, shapes=slid(there, there.shapes)) if model.sliding else there
        if not model.sliding or np.array_equal(now.clipped.nodes, there.clipped.nodes):
            break
    if model.surfaces:
        now = replace(now, shapes=descend(now).shapes)
    return _balanced(now, bounded, iterations)


def _minimised(start: Assembly) -> tuple[Assembly, FloatArray, int]:
    """What IPOPT reaches from the shape of one pose, multipliers of joint bounds, iterations.

    The nodes that are moved to clips stay the same.
    """
    model, given, clipped = start.model, start.given, start.clipped
    count, touching = model.chain.n_nodes, model.n_contacts
    conditions, places = model.n_multipliers - touching, ~model.are_multipliers
    rows, most = np.flatnonzero(model.are_multipliers)[:conditions], np.full(touching, np.inf)
    held = np.where(np.isin(rows, model.no_pull), np.inf, 0.0)
    bent = np.full(count - 1, JOINT_BOUND)
    lower = np.concatenate([-held, -bent, np.zeros(touching)])
    upper = np.concatenate([held, bent, most])
    solver, others = _solver(model), start.shapes.lam[0, places]
    x0 = np.zeros(solver.size1_in("x0"))
    x0[:count] = clipped.in_frames(start.shapes.x)[0, :, 0]
    x0[count : count + len(others)] = others
    room = np.where(np.isin(np.arange(len(x0)), clipped.clamped[0]), 0.0, np.inf)
    bounds = {"lbx": x0 - room, "ubx": x0 + room, "lbg": lower, "ubg": upper}
    for k, row in model.sliding.items():
        if not 0 < k <= len(model.clips):
            continue
        node, at = clipped.nodes[0, k - 1], count + int(places[:row].sum())
        back, ahead = MOST_SLID * np.diff(clipped.places[0, node - 1 : node + 2])
        bounds["lbx"][at], bounds["ubx"][at] = x0[at] - back, x0[at] + ahead
    laid = Laid.numbers(model, clipped)
    numbers = (given.p[0], given.rest[0], given.poses[0], start.shapes.deviation[0], laid)
    out, stats = run_ipopt(solver, x0=x0, p=np.concatenate(numbers), **bounds)
    multipliers, coordinates = (np.array(out[name]).ravel() for name in ("lam_g", "x"))
    border = np.zeros(model.n_border)
    bounded, pressed = np.split(multipliers[conditions:], [count - 1])
    border[model.are_multipliers] = np.concatenate([multipliers[:conditions], -pressed])
    border[places] = coordinates[count:][: len(others)]
    near = clipped.near[:, [*model.sliding]]
    x = coordinates[None, :count, None]
    shapes = Shapes(x, border[None], start.shapes.deviation, near)
    return replace(start, shapes=shapes), bounded, stats["iter_count"]


def _balanced(
    start: Assembly, bound_multipliers: FloatArray, iterations: int
) -> Equilibrium | None:
    """Newton's method from IPOPT's minimum, on a Lagrangian that keeps compressed bubbles stiff.

    Joints at their bound are held there, and released if their multiplier has the wrong sign. The
    status of IPOPT is ignored, because on fine meshes of stiff cables its tolerance lies below
    rounding. Only the balance of the shape counts: the result is None if it does not balance.
    """
    model, node = start.model, start.model.node

    def bends(shapes: Shapes) -> FloatArray:
        """Angles (n_nodes - 1,) [rad] between neighbouring nodes."""
        return node.difference(shapes.x[0, :-1], shapes.x[0, 1:])[:, 0]

    def linearized(here: Assembly, moments: FloatArray) -> tuple[Vector, BandMatrix]:
        """Imbalance and tangent with the active joints as further conditions."""
        _, force, matrix = here.balance()
        arms = np.zeros((1, model.chain.n_nodes, 1, len(active)))
        arms[0, active, 0, np.arange(len(active))] = -1.0
        arms[0, active + 1, 0, np.arange(len(active))] = 1.0
        arms[0, here.clipped.clamped[0]] = 0.0
        gap = (bends(here.shapes)[active] - bound)[None, :, None]
        conditions = np.concatenate([force.y, gap], axis=1)
        return Vector(force.x + (arms @ moments)[..., None], conditions), matrix.with_border(arms)

    bent = bends(start.shapes)
    active = np.flatnonzero(np.abs(bent) > JOINT_BOUND - AT_BOUND)
    while True:
        bound, moments = np.copysign(JOINT_BOUND, bent[active]), bound_multipliers[active]
        now = start
        for _ in range(NEWTON_STEPS):
            force, matrix = linearized(now, moments)
            try:
                step = matrix.factor().solve(Vector(-force.x, -force.y))
            except np.linalg.LinAlgError:  # not finite: a cable without stiffness
                return None
            size = float(np.abs(step.x).max())
            if not size < NEARBY:
                break
            lam = now.shapes.lam + step.y[:, : model.n_border, 0]
            x = node.moved(now.shapes.x, step.x[..., 0])
            now = replace(now, shapes=replace(now.shapes, x=x, lam=lam))
            moments = moments + step.y[0, model.n_border :, 0]
            if size < 1e-12:
                break
        if not np.any(moments * np.sign(bound) < 0):
            break
        active = active[moments * np.sign(bound) >= 0]
    force, matrix = linearized(now, moments)
    residual = float(np.abs(force.y).max(initial=0.0))
    imbalance = float(np.abs(force.x).max())
    inside = bool(np.abs(bends(now.shapes)).max() < JOINT_BOUND + AT_BOUND)
    balanced = imbalance <= BALANCE * float(matrix.scale[0]) < np.inf
    inside = inside and bool(now.clipped.in_order[0])
    if not (inside and balanced and residual <= END_TOLERANCE):
        return None
    stable = int(matrix.negative()[0]) == model.n_multipliers + len(active)
    numbers = {"stable": np.array([stable]), "iterations": np.array([iterations])}
    (found,) = equilibria_of(now, **numbers)
    bound_lam = np.zeros(len(bent))
    bound_lam[active] = moments
    return replace(found, bound_multipliers=bound_lam)
