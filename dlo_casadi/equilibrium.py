"""Equilibrium of one pose: min V(phi) s.t. the end conditions, solved by IPOPT."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.assembly import DEVIATIONS, Given, Shapes
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.initial import arc_headings, clamped_headings
from dlo_casadi.model import CableModel
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.whole_pose import potential

FloatArray = NDArray[np.floating]
Branch = Literal["ccw", "cw"]

# No joint bends by more than this between neighbouring headings (Eq. 8; joints only).
JOINT_BOUND = np.pi / 2
# Largest violation of an end condition [m or rad] of an accepted equilibrium.
END_TOLERANCE = 1e-8
# Largest imbalance of an accepted equilibrium, relative to the tangent matrix.
BALANCE = 1e-12


class Status(Enum):
    """Outcome of a solve, one sentence each."""

    STABLE = "stable equilibrium"
    UNSTABLE = "stationary, but not a minimum of the energy"
    FAILED = "no equilibrium found"


@dataclass(frozen=True)
class Pose:
    """End conditions of one pose as declared.

    Parameters
    ----------
    start, end : (2,) [m]
        `end` is None for a free end.
    start_heading, end_heading : float [rad] or None
        Directions of clamped ends, continuous along the cable.
    branch : "ccw" or "cw", optional
        Which way a pinned cable turns from start to end.
    name : str
    """

    start: tuple[float, float]
    end: tuple[float, float] | None = None
    start_heading: float | None = None
    end_heading: float | None = None
    branch: Branch | None = None
    name: str = "pose"

    @property
    def vector(self) -> FloatArray:
        """The model's argument `ends` (6,)."""
        end = self.end if self.end is not None else (0.0, 0.0)
        return np.array([*self.start, *end, self.start_heading or 0.0, self.end_heading or 0.0])


@dataclass(frozen=True)
class Equilibrium:
    """Shape of the cable in one pose.

    Parameters
    ----------
    x : (n_nodes, coordinates)
        States of the nodes: of a planar cable, absolute headings [rad].
    points : (n + 1, 2) [m]
        Nodes from start to end.
    energy : float [J]
    lam : (2,) [N]
        Force of the cable on whatever holds its end; zero at a free end.
    lam_start : (2,) [N]
        Force of the cable on whatever holds its start.
    moments : (2,) [N m]
        Of the cable on its clamps (start, end); zero at pins.
    multipliers : (n_conditions,)
        All multipliers, in the order of `model.condition_names`.
    bound_multipliers : (n_nodes - 1,) [N m]
        Of the joint bounds; zero where a joint bends freely.
    curvature : (n_cells,) [1/m]
        Mean curvature of each bending cell.
    min_bend_radius : float [m]
        Smallest radius of curvature along the cable: of the cells' mean curvatures, continued
        linearly to both ends; of second order in the cells' length.
    residual : float
        Largest violation of an end condition [m or rad].
    status : Status
    iterations : int
    """

    x: FloatArray
    points: FloatArray
    energy: float
    lam: FloatArray
    lam_start: FloatArray
    moments: FloatArray
    multipliers: FloatArray
    bound_multipliers: FloatArray
    curvature: FloatArray
    min_bend_radius: float
    residual: float
    status: Status
    iterations: int

    @property
    def shapes(self) -> Shapes:
        """As stacked unknowns of one pose, its ends where they are declared."""
        return Shapes.declared(self.x[None], self.multipliers[None])

    @property
    def phi(self) -> FloatArray:
        """Absolute headings (n_nodes,) [rad] of a planar cable."""
        return self.x[:, 0]

    @property
    def theta(self) -> FloatArray:
        """Relative joint angles; the first is the heading of the first link [rad]."""
        return np.concatenate([self.phi[:1], np.diff(self.phi)])

    @property
    def stable(self) -> bool:
        """Whether the energy has a strict minimum here under the end conditions."""
        return self.status is Status.STABLE


def smallest_radius(curvature: FloatArray, cells: FloatArray) -> float:
    """Smallest radius [m] of curvatures that are means over cells (n, 2), see `Equilibrium`."""
    widths = np.diff(cells, axis=1).ravel()
    largest = float(np.abs(curvature).max())
    for inner in (1, -2) if len(curvature) > 1 else ():
        outer = 0 if inner == 1 else -1
        share = widths[outer] / (widths[outer] + widths[inner])
        at_end = curvature[outer] + share * (curvature[outer] - curvature[inner])
        largest = max(largest, abs(float(at_end)))
    return 1 / max(largest, 1e-300)


# Minima of the potential and of the Lagrangian that lie within this are the same one [rad].
NEARBY = 0.05
NEWTON_STEPS = 8
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
            "ipopt.max_iter": 300,
            "ipopt.max_cpu_time": 20.0,
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


def stats_of(solver: ca.Function) -> dict[str, Any]:
    """Statistics of an IPOPT solver's last run.

    Raises
    ------
    KeyboardInterrupt
        If the run was interrupted: IPOPT takes the signal for an answer and returns.
    """
    stats: dict[str, Any] = solver.stats()
    if stats["return_status"] == "User_Requested_Stop":
        raise KeyboardInterrupt
    return stats


def guesses(model: CableModel, pose: Pose, rest: FloatArray) -> list[FloatArray]:
    """First guesses of the headings, by boundary and branch.

    Pinned: the two arcs of the cable's length through both ends (one, if the pose names its
    branch) and the rest shape turned into the chord. Clamped: headings between the clamps with
    three bows. A free end: along the start's direction, and hanging down.
    """
    chain = model.chain
    places = chain.places
    start = np.array(pose.start)
    cells = chain.cells
    turn = np.concatenate([[0.0], np.cumsum(rest * np.diff(cells, axis=1).ravel())])
    edges = np.concatenate([cells[:1, 0], cells[:, 1]])
    bent = np.interp(places, edges, turn)
    down = np.arctan2(model.gravity[1], model.gravity[0]) if any(model.gravity) else 0.0
    if pose.end is None:
        first = pose.start_heading if pose.start_heading is not None else down
        falling = down + (first - down + np.pi) % (2 * np.pi) - np.pi
        fall = first + (down - falling) * (1 - np.exp(-4 * places / chain.length))
        return [first + bent, fall, np.full_like(places, first)]
    end = np.array(pose.end)
    if model.start == "pinned" and model.end == "pinned":
        sides = {"ccw": (1,), "cw": (-1,), None: (1, -1)}[pose.branch]
        arcs = [arc_headings(places, chain.length, start, end, side) for side in sides]
        chord = np.arctan2(end[1] - start[1], end[0] - start[0])
        own = np.array([np.cos(bent).mean(), np.sin(bent).mean()])
        return [*arcs, bent + chord - np.arctan2(own[1], own[0])]
    heads = (
        pose.start_heading if model.start == "clamped" else None,
        pose.end_heading if model.end == "clamped" else None,
    )
    return [
        clamped_headings(places, chain.length, end - start, *heads, bow) for bow in (0.0, 1.5, -1.5)
    ]


def check_reach(model: CableModel, pose: Pose, stretch: float = 1.0) -> None:
    """Raise EquilibriumError when the end is farther away than the cable is long."""
    if pose.end is None or model.extensible:
        return
    distance = float(np.hypot(*(np.array(pose.end) - np.array(pose.start))))
    length = model.cable.length * stretch
    if distance >= length:
        raise EquilibriumError(
            f"no equilibrium: the end ({pose.end[0]:.4f}, {pose.end[1]:.4f}) m is {distance:.4f} m "
            f"from the start, the cable is {length:.4f} m long.\n"
            "  Try: end in metres? cable.length?",
            pose.name,
            pose.end,
        )


def solve_equilibrium(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    pose: Pose,
    *,
    phi_init: FloatArray | None = None,
) -> Equilibrium:
    """Shape of the cable held at the ends of a pose.

        min V(phi)   s.t.   r(L) = end, clamped headings, |phi_(i+1) - phi_i| <= pi/2

    Of the equilibria that the first guesses lead to, the stable one of lowest energy is returned;
    of those on the branch that the pose names, where there is one. With `phi_init`, the one that
    it leads to.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_cells,) [1/m]
        Rest curvature of the bending cells: `model.rest_basis @ coefficients`.
    pose : Pose
    phi_init : (n_nodes,) [rad], optional

    Raises
    ------
    EquilibriumError
        If the end is out of reach or not finite, or no start leads to an equilibrium.

    References
    ----------
    Eq. 8 of Quartaro et al. 2025, the bounds on the joints only.
    """
    if not np.all(np.isfinite(pose.vector)):
        raise EquilibriumError(
            f"no equilibrium: a number of the pose is not finite: start {pose.start} m, end "
            f"{pose.end} m, headings {pose.start_heading} and {pose.end_heading} rad.\n"
            "  Try: see where these numbers come from.",
            pose.name,
            pose.end,
        )
    named = dict(zip(model.names, p, strict=True))
    stretch = 1 + named.get("length_error.length_difference", 0.0) / model.cable.length
    check_reach(model, pose, stretch)
    starts = [phi_init] if phi_init is not None else guesses(model, pose, rest)
    found = [_from_start(model, p, rest, pose, start) for start in starts]
    found = [eq for eq in found if eq.status is not Status.FAILED]
    if pose.branch is not None:
        sign = 1 if pose.branch == "ccw" else -1
        on_branch = [eq for eq in found if sign * (eq.phi[-1] - eq.phi[0]) > 0]
        found = on_branch or found
    if not found:
        where = "its end free" if pose.end is None else f"its end at {pose.end} m"
        raise EquilibriumError(
            f"no equilibrium found from {len(starts)} first guesses with {where}.\n"
            "  Try: a finer mesh (model.n), or check the stiffness and the headings.",
            pose.name,
            pose.end,
        )
    return min(found, key=lambda eq: (not eq.stable, eq.energy))


def _from_start(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, phi: FloatArray
) -> Equilibrium:
    """One IPOPT solve from one first guess, and Newton's method on the Lagrangian."""
    chain = model.chain
    solver = _solver(id(model), _Held(model))
    deviation = np.zeros(len(DEVIATIONS))
    given = Given.of(p, rest, pose.vector[None])
    x0 = np.concatenate([phi, np.zeros(model.n_inner * chain.n_slots)])
    bounds = np.zeros(model.n_conditions + chain.n_nodes - 1)
    bounds[model.n_conditions :] = JOINT_BOUND
    parameters = np.concatenate([p, rest, pose.vector, deviation])
    out = solver(x0=x0, p=parameters, lbg=-bounds, ubg=bounds)
    stats = stats_of(solver)
    multipliers = np.array(out["lam_g"]).ravel()
    start = Shapes(
        np.array(out["x"]).ravel()[None, : chain.n_nodes, None],
        multipliers[None, : model.n_conditions],
        deviation[None],
    )
    # Whatever IPOPT says of its end (on fine meshes of stiff cables its tolerance lies below
    # rounding), what counts is whether the shape that is returned balances.
    found = _balanced(model, start, multipliers[model.n_conditions :], given)
    energy = float(model.assembly.energy(found.shapes, given)[0])
    if not found.holds or not np.isfinite(energy):
        status = Status.FAILED
    else:
        status = Status.STABLE if found.stable else Status.UNSTABLE
    curvature = model.assembly.strain(found.shapes, given)[0]
    end_force, moments = split_multipliers(model, found.shapes.lam[0])
    return Equilibrium(
        x=found.shapes.x[0],
        points=model.assembly.nodes(found.shapes, given)[0],
        energy=energy,
        lam=end_force,
        lam_start=total_dead_load(model, p) - end_force,
        moments=moments,
        multipliers=found.shapes.lam[0],
        bound_multipliers=found.bound_lam,
        curvature=curvature,
        min_bend_radius=smallest_radius(curvature, chain.cells),
        residual=found.residual,
        status=status,
        iterations=int(stats["iter_count"]),
    )


@dataclass(frozen=True)
class _Balance:
    """Where Newton's method has led: the shape of one pose, and whether it is an equilibrium."""

    shapes: Shapes
    bound_lam: FloatArray
    residual: float
    holds: bool
    stable: bool


def _balanced(
    model: CableModel, shapes: Shapes, bound_multipliers: FloatArray, given: Given
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
                lam=now.lam + step.y[:, : model.n_conditions, 0],
            )
            pulls = pulls + step.y[0, model.n_conditions :, 0]
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
        int(matrix.negative()[0]) == model.n_conditions + len(held)
    )
    return _Balance(now, bound_lam, residual, holds and inside, bool(stable))


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
    given: Given,
) -> tuple[Vector, BandMatrix]:
    """Imbalance and tangent with the joints that are held as further conditions."""
    _, force, matrix = model.assembly.balance(shapes, given)
    arms = np.zeros((1, model.chain.n_nodes, 1, len(held)))
    arms[0, held, 0, np.arange(len(held))] = -1.0
    arms[0, held + 1, 0, np.arange(len(held))] = 1.0
    gap = (_bends(model, shapes)[held] - bound)[None, :, None]
    whole = Vector(force.x + (arms @ pulls)[..., None], np.concatenate([force.y, gap], axis=1))
    return whole, matrix.with_border(arms)


def split_multipliers(model: CableModel, lam: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Force on the end's holder (2,) [N] and moments of clamped headings (start, end) [N m]."""
    named = dict(zip(model.condition_names, lam, strict=True))
    force = np.array([named.get("end_position_x", 0.0), named.get("end_position_y", 0.0)])
    moments = np.array([named.get("start_heading", 0.0), named.get("end_heading", 0.0)])
    return force, moments


def total_dead_load(model: CableModel, p: FloatArray) -> FloatArray:
    """Sum of all dead loads on the cable (2,) [N]: -dV/d(start) with the shape carried along."""
    return np.array(model.dead_load(p)).ravel()
