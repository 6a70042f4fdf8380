"""Equilibria of poses: minima of the energy under the end conditions."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from dlo_casadi.arrays import BoolArray, FloatArray, IntArray
from dlo_casadi.effects import ContactEffect
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.equilibrium import (
    JOINT_BOUND,
    NEARBY,
    Equilibrium,
    equilibria_of,
    stacked,
)
from dlo_casadi.equilibrium.minima import KEEPING_SIDE, Minima, descend_to_contact
from dlo_casadi.equilibrium.pose import SIGNS, HeldPose
from dlo_casadi.equilibrium.sides import (
    beside_bars,
    named_sides,
    on_named_sides,
    on_other_side,
    touchdowns,
)
from dlo_casadi.equilibrium.spans import (
    arches,
    border_of,
    first_guesses,
    no_equilibrium,
    nothing_found,
    out_of_reach,
)
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.assembly import Assembly, Inputs, Shapes
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clipped import Clipped

# Largest move of an end in one step [lengths, rad], so that a shape can be followed up to a fold.
MOST_MOVED, MOST_TURNED = 0.05, 0.2
# Number of lowest minima of the coarse mesh, in space, that are solved on the model's own mesh, in
# addition to the lowest one on the other side.
FEW = 2
# Values of `HeldPose.turns` for the two directions of half a turn.
WAYS_ROUND = (0.5, -0.5)
# Largest difference [turns] between a twist and that asked for before turns count as shed. In 7,500
# random problems with up to four turns 1,369 differ by more than 1.35, and 7 by 1.15 to 1.35.
MOST_SHED = 1.3
# First guesses: index of the pose, nodes (n_nodes, coordinates), border (n_border,).
Guesses = list[tuple[int, FloatArray, FloatArray]]


def solve_equilibrium(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    pose: HeldPose,
    *,
    x_init: FloatArray | None = None,
) -> Equilibrium:
    """Shape of the cable held at the ends of a pose.

        min V(phi)   s.t.   r(L) = end, clamped headings, |phi_(i+1) - phi_i| <= pi/2

    Among the equilibria reached from the first guesses (see `guesses`), the stable one of lowest
    energy is returned, or an unstable one if no other is found. If the pose names its branch, the
    result is on that branch, or an error. Between two clamps the headings fix the turn, so a branch
    is no choice; between two pins the result is the first stable one, as a rule that of the
    branch's own arc. If it names sides of bars, the cable passes them there. With `x_init` it is
    the equilibrium reached from there, on any branch or side.

    Parameters
    ----------
    model : CableModel
    p : (n_parameters,)
        In the order of `model.names`, SI units.
    rest : (n_rests,) [1/m]
        Rest curvature of the bending cells: `model.rest_basis @ coefficients`.
    pose : HeldPose
    x_init : (n_nodes, coordinates), optional

    Raises
    ------
    EquilibriumError
        If the end is out of reach or not finite, or if no start leads to an equilibrium, or none to
        one on the branch that the pose names.

    References
    ----------
    Eq. 8 of Quartaro et al. 2025, the bounds on the joints only.
    """
    starts = None if x_init is None else [x_init]
    found = solve_equilibria(model, p, rest, [pose], starts)[0]
    if isinstance(found, EquilibriumError):
        raise found
    return found


def solve_equilibria(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    poses: Sequence[HeldPose],
    starts: Sequence[FloatArray | None] | None = None,
) -> list[Equilibrium | EquilibriumError]:
    """`solve_equilibrium` for many poses at once: each pose's shape, or why there is none.

    The energy is minimised from all first guesses of all poses together. In a plane, IPOPT then
    solves the guesses from which this gives no minimum within the bounds of the joints.

    Parameters
    ----------
    p, rest
        As in `solve_equilibrium`.
    starts : sequence of (n_nodes, coordinates) or None, optional
        `x_init` of each pose.
    """
    given = list(starts) if starts is not None else [None] * len(poses)
    errors = [out_of_reach(model, p, pose) for pose in poses]
    asked = [j for j, error in enumerate(errors) if error is None]
    search = _PoseSearch(model, p, rest)
    reached = search.reached([poses[j] for j in asked], [given[j] for j in asked])
    found: dict[int, Equilibrium | EquilibriumError] = {}
    sided: list[tuple[int, Equilibrium]] = []
    for j, minima in zip(asked, reached, strict=True):
        found[j] = chosen = _chosen(model, poses[j], given[j], minima)
        stable = [eq.x for eq in minima if eq.stable and given[j] is None]
        if isinstance(chosen, EquilibriumError) or not stable:
            continue
        if on_other_side(model, poses[j], chosen.x, np.array(stable)).any():
            sided.append((j, chosen))
    told = [way for j, _ in sided for way in ways_of(model, poses[j])]
    ways = solve_equilibria(model, p, rest, told) if told else []
    for (j, chosen), *pair in zip(sided, ways[::2], ways[1::2], strict=True):
        for own, other in (pair, pair[::-1]):
            if isinstance(own, Equilibrium) and isinstance(other, Equilibrium) and other.stable:
                same = model.node.same(own.x, chosen.x, NEARBY)
                if same and on_other_side(model, poses[j], chosen.x, other.x[None])[0]:
                    found[j] = replace(chosen, other_side=other)
    return [error or found[j] for j, error in enumerate(errors)]


def all_equilibria(
    model: CableModel, p: FloatArray, rest: FloatArray, poses: Sequence[HeldPose]
) -> list[list[Equilibrium]]:
    """All stable equilibria of each pose that its first guesses lead to.

    If a pose names its branch, turns or sides, or has no stable equilibrium, the one that
    `solve_equilibrium` returns; none where that is an error.
    """
    found: list[list[Equilibrium]] = [[] for _ in poses]
    asked = [j for j, pose in enumerate(poses) if not out_of_reach(model, p, pose)]
    reached = _PoseSearch(model, p, rest).reached([poses[j] for j in asked], [None] * len(asked))
    for j, minima in zip(asked, reached, strict=True):
        chosen = _chosen(model, poses[j], None, minima)
        if isinstance(chosen, Equilibrium):
            named = poses[j].branch or poses[j].turns or named_sides(model, poses[j])
            stable = [eq for eq in minima if eq.stable and not named]
            found[j] = [stable[k] for k in _distinct(model, [eq.x for eq in stable])] or [chosen]
    return found


def ways_of(model: CableModel, pose: HeldPose) -> list[HeldPose]:
    """Copies of a pose, one for each branch or direction of twist it may name; ccw first."""
    named = [replace(pose, branch=name) for name in SIGNS if name in pose.node.branches]
    return named or ways_round(model, pose)


def ways_round(
    model: CableModel, pose: HeldPose, every: Sequence[float] = WAYS_ROUND
) -> list[HeldPose]:
    """Copies of a pose with each of these turns, half a turn either way, if `turns` may name it."""
    twists = pose.node.twists and model.tipped_by is not None
    return [replace(pose, turns=turns) for turns in every] if twists else []


def _chosen(
    model: CableModel, pose: HeldPose, start: FloatArray | None, found: list[Equilibrium]
) -> Equilibrium | EquilibriumError:
    """The equilibrium chosen among those found from a pose's first guesses, or the error.

    See `solve_equilibrium`; also an error if none is on the branch that the pose names.
    """
    named = None if start is not None or pose.branch == "previous" else pose.branch
    where = "its end free" if pose.end is None else f"its end at {pose.end} m"
    if start is None and found and pose.turns:
        given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), pose.vector[None])
        twisted = Assembly(model, stacked(found), given.subset(np.zeros(len(found), dtype=int)))
        twists = _twists(twisted.clipped, np.array([eq.twist for eq in found]))
        kept = [eq for eq, held in zip(found, _holds(pose, twists), strict=True) if held]
        if not kept:
            left = min(zip(twists, found, strict=True), key=lambda pair: pair[1].energy)[0]
            what = (
                f"the cable does not hold {pose.turns:g} turns of twist with {where}: it loops "
                f"until {left:.2g} are left"
            )
            return no_equilibrium(pose, what, "fewer turns, or the end farther from the start.")
        found = kept
    if start is None and found and (asked := named_sides(model, pose)):
        passing = on_named_sides(model, pose, np.array([eq.points for eq in found]))
        if not passing.any():
            said = [f"{'over' if over else 'under'} {bar.name}" for bar, _, over in asked]
            what = f"no equilibrium found in which the cable passes {' and '.join(said)}, {where}"
            hint = "the other side (over), a longer cable, or a finer mesh (model.n)."
            return no_equilibrium(pose, what, hint)
        found = [eq for eq, kept in zip(found, passing, strict=True) if kept]
    if not found:
        return nothing_found(
            model, pose, "its first guesses" if start is None else "a nearby shape"
        )
    if named is not None and model.start.turns and model.end.turns:
        for eq in found:
            if eq.stable and eq.has_branch(named):
                return eq
    found = sorted(found, key=lambda eq: (not eq.stable, eq.energy))
    lowest = found[0]
    for eq in found:
        if eq.has_branch(named) and eq.stable is lowest.stable:
            return eq
    there = next(branch for branch in SIGNS if branch != named)
    kind = "stable equilibrium" if lowest.stable else "equilibrium"
    what = (
        f"no {kind} found on the branch {named} from its first guesses with {where}: the lowest "
        f"one, of {lowest.energy:.4g} J, turns by {lowest.turn:+.3g} rad from start to end "
        f"(branch {there})"
    )
    return no_equilibrium(pose, what, "the other branch, or none.")


@dataclass(frozen=True)
class _PoseSearch:
    """Search for the equilibria of a cable from the first guesses of all poses together."""

    model: CableModel
    p: FloatArray
    rest: FloatArray

    def reached(
        self, poses: Sequence[HeldPose], starts: Sequence[FloatArray | None]
    ) -> list[list[Equilibrium]]:
        """Equilibria of each pose, in the order of the first guesses that led to them."""
        found: list[list[Equilibrium]] = [[] for _ in poses]
        free = [j for j, start in enumerate(starts) if start is None]
        better = self._beside if self.model.surfaces else None
        if free and self.model.in_space and self.model.n > self.model.coarse.n:
            better = self._likely
        if guesses := better([poses[j] for j in free]) if free and better else []:
            guesses = [(free[j], x, border) for j, x, border in guesses]
            found = self._descended(poses, guesses, np.ones(len(poses), dtype=bool))
        left = [j for j, minima in enumerate(found) if not any(eq.stable for eq in minima)]
        if left:
            others = [poses[j] for j in left]
            near = np.array([starts[j] is not None for j in left])
            again = self._descended(others, self._first(others, [starts[j] for j in left]), near)
            for j, minima in zip(left, again, strict=True):
                found[j] += minima
        return found

    def _first(self, poses: Sequence[HeldPose], starts: Sequence[FloatArray | None]) -> Guesses:
        """First guesses of all poses, or the given starts."""
        model, found = self.model, []
        for j, (pose, start) in enumerate(zip(poses, starts, strict=True)):
            if start is None:
                found += [(j, *guess) for guess in first_guesses(model, self.p, self.rest, pose)]
            else:
                found.append((j, start, border_of(model, pose, start)))
        return found

    def _beside(self, poses: Sequence[HeldPose]) -> Guesses:
        """Guesses with obstacles: first ones, and minima without obstacles.

        All these minima are pushed out of the obstacles. The lowest one also gets both sides of
        bars, see `sides`, and touches a plane where it is deepest, with its slack on either side.
        """
        model, none = self.model, [None] * len(poses)
        alone, p = replace(model, obstacles=()).without_kind(ContactEffect, self.p)
        search = _PoseSearch(alone, p, self.rest)
        guesses = self._first(poses, none)
        for j, minima in enumerate(search.reached(poses, none)):
            stable = sorted((eq for eq in minima if eq.stable), key=lambda eq: eq.energy)
            for k, i in enumerate(_distinct(model, [eq.x for eq in stable])):
                x, points = stable[i].x, stable[i].points
                every = [x] if k else beside_bars(model, x, points[: len(x)])
                guesses += [(j, one, border_of(model, poses[j], one)) for one in every]
                for place in () if k else touchdowns(model, points):
                    guesses += [(j, *arch) for arch in arches(model, self.p, poses[j], place)]
        return guesses

    def _descend(
        self, poses: Sequence[HeldPose], guesses: Guesses, near: BoolArray
    ) -> tuple[IntArray, Assembly, Minima]:
        """Pose of each guess, and the minima reached; `near` as in `_descended`."""
        of, x, border = (np.array(part) for part in zip(*guesses, strict=True))
        shapes = Shapes.declared(x, border, len(self.model.clips))
        given = Inputs.of(self.p, self.rest, np.array([poses[j].vector for j in of]))
        sided = np.array([bool(named_sides(self.model, poses[j])) for j in of])
        skipped = (KEEPING_SIDE + sided) * near[of]
        minima = descend_to_contact(Assembly(self.model, shapes, given), skipped)
        return of, Assembly(self.model, minima.shapes, given), minima

    def _descended(
        self, poses: Sequence[HeldPose], guesses: Guesses, near: BoolArray
    ) -> list[list[Equilibrium]]:
        """Equilibria of each pose reached by minimising the energy from its guesses.

        `near` (poses,): whether they are to stay on their side of obstacles.
        """
        _, found, minima = self._descend(poses, guesses, near)
        kept = minima.balanced
        if not self.model.in_space:
            bends = np.abs(np.diff(found.shapes.x[..., 0], axis=1))
            kept = minima.converged & (bends.max(axis=1) < JOINT_BOUND)
        stable, iterations = minima.converged[kept], minima.iterations[kept]
        equilibria = equilibria_of(found.subset(kept), stable=stable, iterations=iterations)
        out: list[list[Equilibrium]] = [[] for _ in poses]
        untold = not self.model.end.place and bool(self.model.surfaces)  # not in IPOPT's problem
        for k, (j, x, _) in enumerate(guesses):
            eq = equilibria.pop(0) if kept[k] else None
            if eq is None and not (self.model.in_space or untold):
                eq = by_ipopt(self.model, self.p, self.rest, poses[j], x[:, 0])
            if eq is not None:
                out[j].append(eq)
        return out

    def _likely(self, poses: Sequence[HeldPose]) -> Guesses:
        """Lowest distinct minima of a coarse mesh, on the model's mesh."""
        model, coarse = self.model, self.model.coarse
        search = _PoseSearch(coarse, self.p, coarse_rest(model, coarse, self.rest))
        touching = bool(model.surfaces)
        guesses = search._beside(poses) if touching else search._first(poses, [None] * len(poses))
        of, found, minima = search._descend(poses, guesses, np.full(len(poses), touching))
        twist, points = found.strain()[:, : coarse.chain.n_cells], found.nodes()
        x, kept = found.shapes.x, []
        for j, pose in enumerate(poses):
            rows = np.flatnonzero((of == j) & minima.converged)
            rows = rows[_holds(pose, _twists(found.clipped, twist)[rows])]
            rows = rows[on_named_sides(coarse, pose, points[rows])]
            rows = rows[np.argsort(minima.energy[rows], kind="stable")]
            mine = [int(rows[k]) for k in _distinct(model, x[rows])[:FEW]]
            if mine:
                there = rows[on_other_side(model, pose, x[mine[0]], x[rows])]
                mine += [int(k) for k in there[:1] if k not in mine]
            kept += mine
        nodes = model.node.interpolated(model.chain.places, coarse.chain.places, x[kept])
        lam = np.zeros((len(kept), model.n_border))
        lam[:, : model.n_lam] = found.shapes.lam[kept, : model.n_lam]
        return list(zip(of[kept].tolist(), nodes, lam, strict=True))


def _distinct(model: CableModel, shapes: Sequence[FloatArray] | FloatArray) -> list[int]:
    """Indices of shapes (n_nodes, coordinates) that differ from all shapes before them."""
    found: list[int] = []
    for k, x in enumerate(shapes):
        if all(not model.node.same(x, shapes[other], NEARBY) for other in found):
            found.append(k)
    return found


def coarse_rest(model: CableModel, coarse: CableModel, rest: FloatArray) -> FloatArray:
    """Rest strains (n_rests,) of the coarse cells: means over the fine cells."""
    (low, high), (start, end) = model.chain.cells.T, coarse.chain.cells.T[..., None]
    shares = np.clip(np.minimum(high, end) - np.maximum(low, start), 0.0, None) / (end - start)
    return np.concatenate([shares @ part for part in np.split(rest, len(model.node.strains))])


def _twists(clipped: Clipped, twist: FloatArray) -> FloatArray:
    """Turns (m,) that the end clamp gives cables, from the `twist` (m, n_cells) [1/m] of cells."""
    # They stop at a clip that holds the roll.
    rolled = clipped.nodes[:, [kind.roll for kind in clipped.kinds]]
    beyond = np.arange(twist.shape[1]) >= rolled.max(axis=1, keepdims=True, initial=0)
    return np.asarray((twist * np.diff(clipped.places) * beyond).sum(axis=1) / (2 * np.pi))


def _holds(pose: HeldPose, twists: FloatArray) -> BoolArray:
    """Whether cables of these twists (m,) [turns] have kept all the turns that a pose asks for."""
    return (np.abs(twists - pose.turns) <= MOST_SHED) | (pose.turns == 0)


def solve_after(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    pose: HeldPose,
    before: tuple[HeldPose, FloatArray] | None,
) -> Equilibrium:
    """Shape in a pose; where the pose says so, continued from the nodes of the pose before.

    Raises
    ------
    EquilibriumError
        As `solve_equilibrium` and `continued` do.
    """
    if pose.branch == "previous" and before is not None:
        return continued(model, p, rest, pose, *before)
    return solve_equilibrium(model, p, rest, pose)


def continued(
    model: CableModel,
    p: FloatArray,
    rest: FloatArray,
    pose: HeldPose,
    before: HeldPose,
    x: FloatArray,
) -> Equilibrium:
    """Shape of a cable whose ends are moved quasi-statically from another pose.

    Ends, clips and frames move evenly from one pose to the other. If the shape loses its stability
    on the way, the cable snaps to the equilibrium reached from its last shape.

    Parameters
    ----------
    p, rest
        As in `solve_equilibrium`.
    x : (n_nodes, coordinates)
        Nodes of the cable in the pose `before`.

    Raises
    ------
    EquilibriumError
        If no equilibrium is found in the pose.
    """
    if error := out_of_reach(model, p, pose):
        raise error
    both, d = (before, pose), model.node.dimension
    ends = [one.ends[: 2 * d] for one in both]
    clips = [[x for clip in one.clips for x in (*clip.place, clip.at or 0.0)] for one in both]
    moved = float(np.abs(np.diff(np.hstack([ends, clips]), axis=0)).max()) / model.cable.length
    held = [[*one.frames, *(clip.frame for clip in one.clips)] for one in both]
    frames = np.array([[x for x in each if x is not None] for each in held])
    # The increment between frames half a turn apart is infinite: limit it.
    turned = min(float(np.abs(model.node.difference(*frames)).max()), 2 * np.pi)
    count = int(np.ceil(max(turned / MOST_TURNED, moved / MOST_MOVED, 1.0)))
    for k in range(1, count):
        with suppress(EquilibriumError):  # poses on the way may be out of reach
            way = pose.on_the_way(before, k / count)
            x = solve_equilibrium(model, p, rest, way, x_init=x).x
    return solve_equilibrium(model, p, rest, pose, x_init=x)
