"""Equilibrium of one pose: min V(phi) s.t. the end conditions, solved by IPOPT."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.errors import EquilibriumError
from dlo_casadi.initial import arc_headings, clamped_headings
from dlo_casadi.model import DEVIATIONS, CableModel

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
    phi : (n_headings,) [rad]
        Absolute headings.
    points : (n + 1, 2) [m]
        Nodes from start to end.
    energy : float [J]
    lam : (2,) [N]
        Force of the cable on whatever holds its end; zero at a free end.
    lam_start : (2,) [N]
        Force of the cable on whatever holds its start.
    moments : (2,) [N m]
        Multipliers of clamped headings (start, end); zero at pins and for links.
    multipliers : (n_conditions,)
        All multipliers, in the order of `model.condition_names`.
    bound_multipliers : (n_headings - 1,) [N m]
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

    phi: FloatArray
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


def is_stable(matrix: FloatArray, n_conditions: int) -> bool:
    """Whether the reduced Hessian is positive definite, read off the KKT matrix's inertia.

    A KKT matrix of full rank has as many negative eigenvalues as conditions if, and only if,
    its Hessian is positive definite on the conditions' null space.

    References
    ----------
    Gould, Mathematical Programming 32 (1985).
    """
    # Scaling by congruence leaves the inertia; forces and lengths differ by powers of ten.
    inner = len(matrix) - n_conditions
    scale = np.ones(len(matrix))
    scale[:inner] = np.sqrt(_inverse_of_largest(matrix[:inner, :inner]))
    give = np.sqrt(np.abs(np.diag(matrix)[inner:]))
    conditions = np.column_stack([matrix[inner:, :inner] * scale[:inner], give])
    scale[inner:] = _inverse_of_largest(conditions)
    eigenvalues = np.linalg.eigvalsh((matrix + matrix.T) / 2 * np.outer(scale, scale))
    floor = 1e-13 * np.abs(eigenvalues).max()
    return int((eigenvalues < floor).sum()) == n_conditions


def _inverse_of_largest(rows: FloatArray) -> FloatArray:
    """1 / max|.| of each row, 1 for a row of zeros."""
    largest = np.abs(rows).max(axis=1)
    return 1 / np.where(largest > 0, largest, 1.0)


# Minima of the potential and of the Lagrangian that lie within this are the same one [rad].
NEARBY = 0.05
NEWTON_STEPS = 8
# A joint so near to its bound is at it [rad].
AT_BOUND = 1e-6


@lru_cache(maxsize=32)
def _solver(key: int, holder: _Held) -> ca.Function:
    model = holder.model
    x, parameters, energy, conditions = model.potential
    bends = x[1 : model.chain.n_headings] - x[: model.chain.n_headings - 1]
    return ca.nlpsol(
        "equilibrium",
        "ipopt",
        {"x": x, "p": parameters, "f": energy, "g": ca.vertcat(conditions, bends)},
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
    places = chain.heading_places
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
    phi_init : (n_headings,) [rad], optional

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
    ends = pose.vector
    deviation = np.zeros(len(DEVIATIONS))
    n_bends = chain.n_headings - 1
    x0 = np.concatenate([phi, np.zeros(model.n_inner)])
    bounds = np.concatenate([np.zeros(model.n_conditions), np.full(n_bends, JOINT_BOUND)])
    out = solver(x0=x0, p=np.concatenate([p, rest, ends, deviation]), lbg=-bounds, ubg=bounds)
    stats = stats_of(solver)
    phi = np.array(out["x"]).ravel()[: chain.n_headings]
    multipliers = np.array(out["lam_g"]).ravel()
    given = (p, rest, ends, deviation)
    # Whatever IPOPT says of its end (on fine meshes of stiff cables its tolerance lies below
    # rounding), what counts is whether the shape that is returned balances.
    found = _balanced(model, phi, multipliers, given)
    phi, lam = found.phi, found.lam
    energy, nodes = model.energy(phi, lam, *given)
    if not found.holds or not np.isfinite(float(energy)):
        status = Status.FAILED
    else:
        status = Status.STABLE if found.stable else Status.UNSTABLE
    curvature = np.array(model.strain(phi, ends, deviation, p)).ravel()
    end_force, moments = split_multipliers(model, lam)
    return Equilibrium(
        phi=phi,
        points=np.array(nodes),
        energy=float(energy),
        lam=end_force,
        lam_start=np.array(model.start_force(phi, lam, *given)).ravel(),
        moments=moments,
        multipliers=lam,
        bound_multipliers=found.bound_lam,
        curvature=curvature,
        min_bend_radius=smallest_radius(curvature, chain.cells),
        residual=found.residual,
        status=status,
        iterations=int(stats["iter_count"]),
    )


@dataclass(frozen=True)
class _Balance:
    """Where Newton's method has led: headings, multipliers, and whether it is an equilibrium."""

    phi: FloatArray
    lam: FloatArray
    bound_lam: FloatArray
    residual: float
    holds: bool
    stable: bool


def _balanced(
    model: CableModel, phi: FloatArray, multipliers: FloatArray, given: tuple[FloatArray, ...]
) -> _Balance:
    """Newton's method from the potential's minimum, whose bows are stiff under compression too.

    Joints at their bound are held there; one whose multiplier pulls it back is let go.
    """
    n, m = len(phi), model.n_conditions
    lam, bound_lam = multipliers[:m], multipliers[m:]
    bends = np.diff(phi)
    held = np.flatnonzero(np.abs(bends) > JOINT_BOUND - AT_BOUND)
    while True:
        bound = np.copysign(JOINT_BOUND, bends[held])
        arms = np.zeros((len(held), n + m))
        arms[np.arange(len(held)), held] = -1.0
        arms[np.arange(len(held)), held + 1] = 1.0
        x = np.concatenate([phi, lam, bound_lam[held]])
        for _ in range(NEWTON_STEPS):
            force, matrix = _bordered(model, x, arms, bound, given)
            step = np.linalg.lstsq(matrix, -force, rcond=1e-14)[0]
            if not np.abs(step[:n]).max() < NEARBY:
                break
            x = x + step
            if np.abs(step[:n]).max() < 1e-12:
                break
        pulls = x[n + m :] * np.sign(bound)
        if not np.any(pulls < 0):
            break
        held = held[pulls >= 0]
    force, matrix = _bordered(model, x, arms, bound, given)
    residual = float(np.abs(force[n:]).max(initial=0.0))
    imbalance = float(np.abs(force[:n]).max())
    bound_lam = np.zeros(n - 1)
    bound_lam[held] = x[n + m :]
    inside = bool(np.abs(np.diff(x[:n])).max() < JOINT_BOUND + AT_BOUND)
    holds = imbalance <= BALANCE * np.abs(matrix[:n, :n]).max() and residual <= END_TOLERANCE
    stable = bool(np.all(np.isfinite(matrix))) and is_stable(matrix, m + len(held))
    return _Balance(x[:n], x[n : n + m], bound_lam, residual, holds and inside, stable)


def _bordered(
    model: CableModel,
    x: FloatArray,
    arms: FloatArray,
    bound: FloatArray,
    given: tuple[FloatArray, ...],
) -> tuple[FloatArray, FloatArray]:
    """Stationarity and its Jacobian by (phi, lam, multipliers of the joints that are held)."""
    size = arms.shape[1]
    n = size - model.n_conditions
    force, matrix = (np.array(block) for block in model.kkt(x[:n], x[n:size], *given))
    whole = np.zeros((len(x), len(x)))
    whole[:size, :size], whole[size:, :size], whole[:size, size:] = matrix, arms, arms.T
    return np.concatenate([force.ravel() + arms.T @ x[size:], arms @ x[:size] - bound]), whole


def split_multipliers(model: CableModel, lam: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Force on the end's holder (2,) [N] and moments of clamped headings (start, end) [N m]."""
    named = dict(zip(model.condition_names, lam, strict=True))
    force = np.array([named.get("end_position_x", 0.0), named.get("end_position_y", 0.0)])
    moments = np.array([named.get("start_heading", 0.0), named.get("end_heading", 0.0)])
    return force, moments


def total_dead_load(model: CableModel, p: FloatArray) -> FloatArray:
    """Sum of all dead loads on the cable (2,) [N]: -dV/d(start) with the shape carried along."""
    return np.array(model.dead_load(p)).ravel()
