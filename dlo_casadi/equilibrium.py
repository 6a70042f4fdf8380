"""Equilibrium of one pose: min V(phi) s.t. the end conditions, solved by IPOPT."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.assembly import Given, Shapes
from dlo_casadi.descent import Minima, descend
from dlo_casadi.ends import reaction_rows
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.initial import arc_headings, arc_into_clamps, limited, wrapped
from dlo_casadi.initial_frames import guessed_frames_of
from dlo_casadi.model import COARSE_MESH, CableModel
from dlo_casadi.rod.band import BandMatrix, Vector
from dlo_casadi.rod.chain import Chain
from dlo_casadi.rod.node import Frame, quaternion_product
from dlo_casadi.whole_pose import potential

FloatArray = NDArray[np.floating]
Branch = Literal["ccw", "cw"]
# In a session a pose may also continue the one before it, see `continued`.
PoseBranch = Branch | Literal["previous"]

# Sign of the turning from start to end on a branch.
SIGNS: dict[Branch, int] = {"ccw": 1, "cw": -1}
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
    start, end : (dimension,) [m]
        `end` is None for a free end.
    start_heading, end_heading : float [rad] or None
        Directions of clamped ends in a plane, continuous along the cable.
    start_orientation, end_orientation : (4,) or None
        Frames of clamped ends in space: unit quaternions (x, y, z, w), x forward along the cable.
    turns : float
        In space, full turns of twist at the end about its x axis beside the roll nearest to none.
    branch : "ccw", "cw" or "previous", optional
        Which way the cable turns from start to end: the sign of `Equilibrium.turn`; or as in the
        pose before it, from which whoever predicts a series of poses follows it (`continued`).
    name : str
    camera_center : (float, float, float), optional [m]
        Where the camera stood: x, y in the board frame, z in front of the cable's declared plane.
    """

    start: tuple[float, ...]
    end: tuple[float, ...] | None = None
    start_heading: float | None = None
    end_heading: float | None = None
    start_orientation: tuple[float, ...] | None = None
    end_orientation: tuple[float, ...] | None = None
    turns: float = 0.0
    branch: PoseBranch | None = None
    name: str = "pose"
    camera_center: tuple[float, float, float] | None = None

    @property
    def ends(self) -> FloatArray:
        """Start, end [m], start frame, end frame: see `EndConditions.vector`."""
        end = self.end if self.end is not None else (0.0,) * len(self.start)
        return np.concatenate([self.start, end, *self.frames])

    @property
    def frames(self) -> tuple[FloatArray, FloatArray]:
        """Frames (coordinates,) of both ends as nodes carry them: in a plane headings [rad]."""
        if len(self.start) == 2:
            return np.array([self.start_heading or 0.0]), np.array([self.end_heading or 0.0])
        first, last = self.start_orientation, self.end_orientation
        return _unit(first or Frame.identity), _unit(last or Frame.identity)

    def moved(self, start: FloatArray, end: FloatArray, frames: Sequence[FloatArray]) -> Pose:
        """The same pose elsewhere; what is free stays free."""
        headings = [float(frame[0]) if len(frame) == 1 else None for frame in frames]
        orientations = [tuple(frame) if len(frame) == 4 else None for frame in frames]
        return replace(
            self,
            start=tuple(start),
            end=None if self.end is None else tuple(end),
            start_heading=headings[0],
            end_heading=headings[1],
            start_orientation=orientations[0],
            end_orientation=orientations[1],
        )

    def rolled(self, angle: float) -> Pose:
        """The pose with its end clamp, in space, turned about its x axis [rad]."""
        if self.end_orientation is None:
            return self
        roll = (np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2))
        turned = quaternion_product(self.end_orientation, roll)
        return replace(self, end_orientation=tuple(float(x) for x in turned))

    @property
    def vector(self) -> FloatArray:
        """The model's argument `pose`: the ends, then what `effects.Sight` says of the camera.

        Its centre (x, y, z) enters as (x, y, 1) / z: zeros for none, which sees from infinity.
        """
        x, y, z = self.camera_center or (0.0, 0.0, np.inf)
        return np.concatenate([self.ends, np.array([x, y, 1.0]) / z])


def _unit(quaternion: tuple[float, ...]) -> FloatArray:
    q = np.array(quaternion, dtype=float)
    return q / max(float(np.linalg.norm(q)), 1e-300)


@dataclass(frozen=True)
class Equilibrium:
    """Shape of the cable in one pose.

    Parameters
    ----------
    x : (n_nodes, coordinates)
        States of the nodes: of a planar cable, absolute headings [rad].
    points : (n + 1, dimension) [m]
        Nodes from start to end.
    energy : float [J]
    lam : (dimension,) [N]
        Force of the cable on whatever holds its end; zero at a free end.
    lam_start : (dimension,) [N]
        Force of the cable on whatever holds its start.
    moments : (2, increment) [N m]
        Of the cable on its clamps (start, end), in space about the world's axes; zero at pins.
        In a plane (2,).
    multipliers : (n_border,)
        Of the end conditions, places and pulls of springs: in the order of `model.border_names`.
    bound_multipliers : (n_nodes - 1,) [N m]
        Of the joint bounds; zero where a joint bends freely.
    curvature : (axes n_cells,) [1/m]
        Mean curvature of each bending cell, in space about the axis y, then about z.
    twist : (n_cells,) [1/m]
        Mean twist of each cell; zero in a plane.
    min_bend_radius : float [m]
        Smallest radius of curvature along the cable: of the cells' mean curvatures, continued
        linearly to both ends; of second order in the cells' length.
    residual : float
        Largest violation of an end condition [m or rad].
    status : Status
    iterations : int
    tipping : float or None [rad]
        By how much the clamp of a cable with a free end must turn until the lowest equilibrium on
        the other branch is as low; None if no stable one was found there, or none looked for.
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
    twist: FloatArray
    min_bend_radius: float
    residual: float
    status: Status
    iterations: int
    tipping: float | None = None

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
    def turn(self) -> float:
        """Last minus first heading [rad], counter-clockwise positive."""
        return float(self.phi[-1] - self.phi[0])

    def turns(self, branch: Branch | None) -> bool:
        """Whether the cable turns as the branch says; always for None."""
        return branch is None or SIGNS[branch] * self.turn > 0

    @property
    def stable(self) -> bool:
        """Whether the energy has a strict minimum here under the end conditions."""
        return self.status is Status.STABLE


def smallest_radius(curvature: FloatArray, cells: FloatArray) -> float:
    """Smallest radius [m] of curvatures that are means over cells (n, 2), see `Equilibrium`."""
    widths = np.diff(cells, axis=1).ravel()
    if len(curvature) > len(cells):
        curvature = np.linalg.norm(curvature.reshape((-1, len(cells))), axis=0)
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
# In 690 solves of random problems of all boundaries IPOPT took 7 iterations (median), at most 84.
IPOPT_ITERATIONS = 300
# First guesses that seldom lead to the lowest equilibrium are left out, see `guesses` [rad].
# Of 300 random problems with a clamp at the end or at both ends this loses none.
FAR, CURVED = 1.5, 1.0
# Farther no end is moved at once [lengths, rad]: shapes near a fold are followed, not jumped over.
MOST_MOVED, MOST_TURNED = 0.05, 0.2
# In space first guesses are followed on a coarse mesh, and so many of the lowest minima that they
# lead to on the model's own.
FEW = 2
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


def resting_headings(chain: Chain, rest: FloatArray) -> FloatArray:
    """Headings (n_nodes,) of the cable at rest, counted from its start [rad]."""
    cells = chain.cells
    turn = np.concatenate([[0.0], np.cumsum(rest * np.diff(cells, axis=1).ravel())])
    edges = np.concatenate([cells[:1, 0], cells[:, 1]])
    return np.interp(chain.places, edges, turn)


def guesses(model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose) -> list[FloatArray]:
    """First guesses of the headings, in the order in which they are tried.

    Pinned at both ends:

    1. the arc of the cable's length through both ends that turns counter-clockwise, and
    2. the one that turns clockwise; a pose that names its branch swaps them;
    3. the rest shape turned into the chord, if it turns by more than 0.05 rad;
    4. a loop in the middle of a straight cable, counter-clockwise, and
    5. clockwise; both if the rest shape turns by more than 1 rad and the loop has 4.5 elements.

    With a clamp at one end or at both:

    1. the counter-clockwise arc, bent into the headings of the clamps (`arc_into_clamps`), and
    2. the clockwise one; a pose that names its branch swaps them;
    3. and 4. the same on the other way around: where the nearer one bends the cable by more than
       1.5 rad, or the rest shape turns by more than 1 rad.

    With a free end:

    1. the rest shape from the start on;
    2. the cable falling down from the start's direction;
    3. straight on;
    4. the cable falling down the other way round: where the nearer one turns by more than 1.5 rad,
       or the rest shape by more than 1 rad.

    In all of them bends are cut at 0.9 of the joints' bound, and clamps keep their headings.
    The generated solver tries the same ones: codegen/templates/guesses.c.in.

    Parameters
    ----------
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
    """
    chain = model.chain
    ends, length = model.held(p, pose.ends, 0)
    start, end, headings = np.array(ends).reshape(3, 2)
    u, chord = chain.places / chain.length, (end - start) / float(length)
    held = tuple(side == "clamped" for side in (model.start, model.end))
    clamps = (
        float(headings[0]) if held[0] else None,
        float(headings[1]) if held[1] else None,
    )
    bent = resting_headings(chain, rest)
    sides = (-1, 1) if pose.branch == "cw" else (1, -1)
    if model.end == "free":
        found = _hanging(model, u, bent, clamps[0])
    elif any(held):
        into = [arc_into_clamps(u, chord, clamps, side) for side in sides]
        found = [near for near, _, _ in into]
        found += [far for _, far, bend in into if bend > FAR or np.ptp(bent) > CURVED]
    else:
        found = [arc_headings(u, 1.0, np.zeros(2), chord, side) for side in sides]
        found += _curved(chain.n, u, bent, chord)
    out = [limited(phi) for phi in found]
    for phi in out:
        phi[[0, -1]] = np.where(held, headings, phi[[0, -1]])
    return out


def first_nodes(model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose) -> list[FloatArray]:
    """First guesses of the nodes (n_nodes, coordinates): `guesses`, or `guessed_frames`."""
    if model.in_space:
        return guessed_frames(model, p, rest, pose)
    return [phi[:, None] for phi in guesses(model, p, rest, pose)]


def guessed_frames(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose
) -> list[FloatArray]:
    """First guesses of the frames (n_nodes, 4) of a cable in space.

    Between two ends, four arcs of the cable's length, the first sagging along gravity, the others
    turned about the chord by quarter turns; bent into the clamps, the roll of the end clamp that
    is nearest to none, and `turns`, spread evenly; where that roll is nearly half a turn, also with
    the one the other way round. With a free end: the rest shape, the cable fallen down, and
    straight on.
    """
    ends, length = model.held(p, pose.ends, 0)
    values = np.array(ends).ravel()
    start, end, first, last = np.split(values, [3, 6, 10])
    held = tuple(side == "clamped" for side in (model.start, model.end))
    clamps = (first if held[0] else None, last if held[1] else None)
    u = model.chain.places / model.chain.length
    down = np.array(model.gravity)
    chord = None if model.end == "free" else (end - start) / float(length)
    cells = model.chain.cells
    widths = np.diff(cells, axis=1).ravel()
    bent = model.chain.curvatures(rest) * widths
    return guessed_frames_of(u, chord, clamps, down, bent, pose.turns)


def _hanging(
    model: CableModel, u: FloatArray, bent: FloatArray, first: float | None
) -> list[FloatArray]:
    """Guesses for a cable with a free end; `first` is the clamp's heading."""
    down = float(np.arctan2(model.gravity[1], model.gravity[0])) if any(model.gravity) else 0.0
    if first is None:
        first = down
    drop, decay = wrapped(down - first), 1 - np.exp(-4 * u)
    found = [first + bent, first + drop * decay, np.full_like(u, first)]
    if abs(drop) > FAR or np.ptp(bent) > CURVED:
        found.append(first + (drop - 2 * np.pi * (1 if drop > 0 else -1)) * decay)
    return found


def _curved(n: int, u: FloatArray, bent: FloatArray, chord: FloatArray) -> list[FloatArray]:
    """Guesses for a cable of n elements between two pins that is curved at rest."""
    direction, slack = np.arctan2(chord[1], chord[0]), 1 - float(np.hypot(*chord))
    turning = np.ptp(bent)
    found = []
    if turning > 0.05:
        bent = limited(bent)
        found.append(bent + direction - np.arctan2(np.sin(bent).sum(), np.cos(bent).sum()))
    if turning > CURVED and slack * n > 4.5:
        looped = 2 * np.pi * np.clip((u - 0.5) / slack + 0.5, 0.0, 1.0)
        found += [direction + looped, direction - looped]
    return found


def check_reach(model: CableModel, p: FloatArray, pose: Pose) -> None:
    """Raise EquilibriumError when the end is farther away than the cable is long."""
    if pose.end is None or model.extensible:
        return
    ends, true_length = model.held(p, pose.ends, 0)
    start, end = np.array(ends).ravel()[: 2 * model.node.dimension].reshape(2, -1)
    distance, length = float(np.linalg.norm(end - start)), float(true_length)
    if distance >= length:
        where = ", ".join(f"{x:.4f}" for x in pose.end)
        raise EquilibriumError(
            f"no equilibrium: the end ({where}) m is {distance:.4f} m "
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
    x_init: FloatArray | None = None,
) -> Equilibrium:
    """Shape of the cable held at the ends of a pose.

        min V(phi)   s.t.   r(L) = end, clamped headings, |phi_(i+1) - phi_i| <= pi/2

    Of the equilibria that the first guesses lead to (see `guesses`), the stable one of lowest
    energy is returned, an unstable one where no other is found. A pose that names its branch
    gets one of that branch or none; between two pins the first stable one, as a rule that of the
    branch's own arc. With `x_init`, the equilibrium that it leads to, on whichever branch.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_rests,) [1/m]
        Rest curvature of the bending cells: `model.rest_basis @ coefficients`.
    pose : Pose
    x_init : (n_nodes, coordinates), optional

    Raises
    ------
    EquilibriumError
        If the end is out of reach or not finite, no start leads to an equilibrium, or none to one
        on the branch that the pose names.

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
    check_reach(model, p, pose)
    if model.in_space:
        return _in_space(model, p, rest, pose, x_init)
    starts = [x_init[:, 0]] if x_init is not None else guesses(model, p, rest, pose)
    branch = None if x_init is not None or pose.branch == "previous" else pose.branch
    first_suffices = branch is not None and (model.start, model.end) == ("pinned", "pinned")
    found: list[Equilibrium] = []
    for phi in starts:
        eq = _from_start(model, p, rest, pose, phi)
        if eq.status is Status.FAILED:
            continue
        found.append(eq)
        if first_suffices and eq.stable and eq.turns(branch):
            break
    where = "its end free" if pose.end is None else f"its end at {pose.end} m"
    if not found:
        raise EquilibriumError(
            f"no equilibrium found from {len(starts)} first guesses with {where}.\n"
            "  Try: a finer mesh (model.n), or check the stiffness and the headings.",
            pose.name,
            pose.end,
        )
    found.sort(key=lambda eq: (not eq.stable, eq.energy))
    lowest = found[0]
    for eq in found:
        if eq.turns(branch) and eq.stable is lowest.stable:
            return replace(eq, tipping=_tipping(model, eq, found))
    there = next((f"branch {branch}" for branch in SIGNS if lowest.turns(branch)), "neither branch")
    kind = "stable equilibrium" if lowest.stable else "equilibrium"
    raise EquilibriumError(
        f"no {kind} found on the branch {branch} from {len(starts)} first guesses with "
        f"{where}: the lowest one, of {lowest.energy:.4g} J, turns by {lowest.turn:+.3g} rad from "
        f"start to end ({there}).\n"
        "  Try: the other branch, or none.",
        pose.name,
        pose.end,
    )


def _tipping(model: CableModel, eq: Equilibrium, found: list[Equilibrium]) -> float | None:
    """Angle [rad] of the clamp at which another way to fall is as low, to first order.

    dV/d(heading) of the clamp is the moment on it.
    """
    others = [other for other in found if other.stable and other.turn * eq.turn < 0]
    if (model.start, model.end) != ("clamped", "free") or not others:
        return None
    lever = abs(float(others[0].moments[0] - eq.moments[0]))
    return abs(others[0].energy - eq.energy) / max(lever, 1e-300)


def continued(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, before: Pose, x: FloatArray
) -> Equilibrium:
    """Shape to which a cable comes whose ends are moved from another pose's, slowly.

    Ends and frames move evenly from one pose's to the other's. Where the shape loses its stability
    on the way, the cable snaps to the equilibrium that its last shape leads to.

    Parameters
    ----------
    p, rest
        As in `solve_equilibrium`.
    pose : Pose
    before : Pose
    x : (n_nodes, coordinates)
        Nodes of the cable in the pose `before`.

    Raises
    ------
    EquilibriumError
        If no equilibrium is found in the pose.
    """
    ends = np.array([before.ends, pose.ends])[:, : 2 * model.node.dimension]
    frames = np.array([before.frames, pose.frames])
    # Of frames half a turn apart the increment is of any length.
    turned = min(float(np.abs(model.node.difference(*frames)).max()), 2 * np.pi)
    moved = float(np.abs(np.diff(ends, axis=0)).max()) / model.cable.length
    count = int(np.ceil(max(turned / MOST_TURNED, moved / MOST_MOVED, 1.0)))
    for k in range(1, count):
        share = np.array([k / count])
        start, end = (ends[0] + share * (ends[1] - ends[0])).reshape(2, -1)
        held = [
            model.node.interpolated(share, np.arange(2.0), way)[0] for way in frames.swapaxes(0, 1)
        ]
        with suppress(EquilibriumError):  # the way may lead out of reach
            x = solve_equilibrium(model, p, rest, pose.moved(start, end, held), x_init=x).x
    return solve_equilibrium(model, p, rest, pose, x_init=x)


def _from_start(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, phi: FloatArray
) -> Equilibrium:
    """One IPOPT solve from one first guess, and Newton's method on the Lagrangian."""
    chain = model.chain
    solver = _solver(id(model), _Held(model))
    deviation = np.zeros(len(model.deviation_names))
    given = Given.of(p, rest, pose.vector[None])
    x0 = np.concatenate([phi, np.zeros(solver.size1_in("x0") - len(phi))])
    bounds = np.zeros(model.n_multipliers + chain.n_nodes - 1)
    bounds[model.n_multipliers :] = JOINT_BOUND
    parameters = np.concatenate([p, rest, pose.vector, deviation])
    out = solver(x0=x0, p=parameters, lbg=-bounds, ubg=bounds)
    stats = stats_of(solver)
    multipliers = np.array(out["lam_g"]).ravel()
    coordinates, places = np.array(out["x"]).ravel(), 2 * model.n_springs
    border = np.zeros(model.n_border)
    border[model.are_multipliers] = multipliers[: model.n_multipliers]
    border[~model.are_multipliers] = coordinates[chain.n_nodes : chain.n_nodes + places]
    start = Shapes(coordinates[None, : chain.n_nodes, None], border[None], deviation[None])
    # Whatever IPOPT says of its end (on fine meshes of stiff cables its tolerance lies below
    # rounding), what counts is whether the shape that is returned balances.
    found = _balanced(model, start, multipliers[model.n_multipliers :], given)
    energy = float(model.assembly.energy(found.shapes, given)[0])
    if not found.holds or not np.isfinite(energy):
        status = Status.FAILED
    else:
        status = Status.STABLE if found.stable else Status.UNSTABLE
    iterations = int(stats["iter_count"])
    return _equilibrium(
        model, found.shapes, given, found.bound_lam, found.residual, status, iterations
    )


def _equilibrium(
    model: CableModel,
    shapes: Shapes,
    given: Given,
    bound_lam: FloatArray,
    residual: float,
    status: Status,
    iterations: int,
) -> Equilibrium:
    """What there is to say of one shape."""
    assembly = model.assembly
    strain = assembly.strain(shapes, given)[0]
    n_cells = model.chain.n_cells
    curvature = model.chain.curvatures(strain).ravel()
    on_fixtures, rows = assembly.reactions(shapes, given)[0], reaction_rows(model.node)
    return Equilibrium(
        x=shapes.x[0],
        points=assembly.nodes(shapes, given)[0],
        energy=float(assembly.energy(shapes, given)[0]),
        lam=on_fixtures[rows["end_force"]],
        lam_start=on_fixtures[rows["start_force"]],
        moments=clamp_moments(model, shapes.x[0], shapes.lam[0]),
        multipliers=shapes.lam[0],
        bound_multipliers=bound_lam,
        curvature=curvature,
        twist=strain[:n_cells] if model.in_space else np.zeros(n_cells),
        min_bend_radius=smallest_radius(curvature, model.chain.cells),
        residual=residual,
        status=status,
        iterations=iterations,
    )


def _in_space(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose, x_init: FloatArray | None
) -> Equilibrium:
    """The minimum of lowest energy among those that the first guesses lead to.

    Raises
    ------
    EquilibriumError
        If none leads to one.
    """
    starts = np.array([x_init] if x_init is not None else first_nodes(model, p, rest, pose))
    count = len(starts)
    first = Shapes.declared(starts, np.zeros((count, model.n_border)))
    found: Minima | None = None
    if count > 1 and model.n > COARSE_MESH:
        likely = _coarse_minima(model, p, rest, pose)
        if likely is not None:
            found = descend(model.assembly, likely, _repeated(p, rest, pose, likely))
    if found is None or not found.converged.any():
        found = descend(model.assembly, first, _repeated(p, rest, pose, first))
    if not found.converged.any():
        raise EquilibriumError(
            f"no stable equilibrium found from {count} first guesses with its end at {pose.end} m "
            f"and {pose.turns:g} turns.\n"
            "  Try: fewer turns (a twisted cable loops), a finer mesh (model.n), or check the "
            "stiffnesses and orientations.",
            pose.name,
            pose.end,
        )
    best = int(np.where(found.converged, found.energy, np.inf).argmin())
    one = np.array([best])
    shapes = found.shapes.subset(one)
    given = _repeated(p, rest, pose, shapes)
    _, force, _ = model.assembly.balance(shapes, given)
    residual = float(np.abs(force.y).max(initial=0.0))
    none = np.zeros(model.chain.n_nodes - 1)
    return _equilibrium(
        model, shapes, given, none, residual, Status.STABLE, int(found.iterations[best])
    )


def _repeated(p: FloatArray, rest: FloatArray, pose: Pose, shapes: Shapes) -> Given:
    """One pose, for each of some shapes."""
    return Given.of(p, rest, np.repeat(pose.vector[None], len(shapes.x), axis=0))


def _coarse_minima(model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose) -> Shapes | None:
    """The lowest minima of a coarse mesh that differ, on the model's mesh; None without any."""
    coarse, fine = model.coarse, model.chain
    edges = np.concatenate([fine.cells[:1, 0], fine.cells[:, 1]])
    widths = np.diff(edges)
    means = []
    for part in fine.by_strain(rest[:, None]):
        turn = np.concatenate([[0.0], np.cumsum(part[:, 0] * widths)])
        low, high = (np.interp(side, edges, turn) for side in coarse.chain.cells.T)
        means.append((high - low) / np.diff(coarse.chain.cells, axis=1).ravel())
    own = np.concatenate(means)
    first = np.array(first_nodes(coarse, p, own, pose))
    shapes = Shapes.declared(first, np.zeros((len(first), coarse.n_border)))
    found = descend(coarse.assembly, shapes, _repeated(p, own, pose, shapes))
    kept: list[int] = []
    for k in np.argsort(np.where(found.converged, found.energy, np.inf)):
        x = found.shapes.x
        differs = all(not model.node.same(x[k], x[other], NEARBY) for other in kept)
        if found.converged[k] and differs and len(kept) < FEW:
            kept.append(int(k))
    if not kept:
        return None
    nodes = model.node.interpolated(fine.places, coarse.chain.places, found.shapes.x[kept])
    return Shapes.declared(nodes, found.shapes.lam[kept])


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


def clamp_moments(model: CableModel, x: FloatArray, lam: FloatArray) -> FloatArray:
    """Moments [N m] on the clamps (start, end): (2,), in space (2, 3) about the world's axes."""
    node, named = model.node, dict(zip(model.border_names, lam, strict=True))
    moments = [
        node.to_world(frame, np.array([named.get(f"{side}_{turn}", 0.0) for turn in node.turns]))
        for side, frame in (("start", x[0]), ("end", x[-1]))
    ]
    return np.squeeze(np.array(moments))


def total_dead_load(model: CableModel, p: FloatArray) -> FloatArray:
    """Sum of all dead loads on the cable (2,) [N]: -dV/d(start) with the shape carried along."""
    return np.array(model.dead_load(p)).ravel()
