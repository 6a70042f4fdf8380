"""Shapes of cables in space against Kirchhoff's equations, which others wrote and others solve.

    python scripts/check_statics.py [--collocated 50] [--sets 100]

1. Random cables between clamps on a fine mesh against SciPy's `solve_bvp`: from our shape, and from
   arcs to four sides, continued to the same clamps, rest shape and weight.
2. Jacobi's condition, by shooting, on Michell's ring below and above its critical twist.
3. Sets of 100 poses of one random cable each, turns from -2 to 2: solved or not, and whether what
   was returned as stable has a conjugate point (Jacobi) when shot from its start. Of cables that
   shed their turns over a loop, whether one holds them that is wound up from a turn less, slowly.

Exit code 1 if a shape differs, another is lower, one is unstable, or 0.5 % are not solved.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from time import process_time
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from benchmarks import kirchhoff
from benchmarks.kirchhoff import FORCE, FRAME, MOMENT, PLACE, Ends, Rod
from cables.free import SpaceProblem, space_problem
from harness import options
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import MOST_SHED, solve_equilibria
from dlo_casadi.errors import EquilibriumError

FloatArray = NDArray[np.floating]

# Elements of the fine mesh, and of the sets'.
FINE, N = 160, 20
POSES = 100
# Tolerance of solve_bvp from our shape, and from its own arcs.
TIGHT, LOOSE = 1e-7, 1e-5
# Shapes within this are the same [lengths], energies within this alike [EI / L + weight L].
SAME, ALIKE = 1e-6, 1e-6
# Number of steps in which a cable is twisted by a full turn.
WOUND = 80
# Shooting ends at this error of the end, or after so many shots. Share of poses to be solved.
REACHED, SHOTS, SHARE = 1e-8, 6, 0.995


def rod_of(problem: SpaceProblem) -> Rod:
    """The same cable as the equations want it."""
    model, (bending, torsion) = problem.model, problem.p[:2]
    coefficients = np.linalg.lstsq(model.rest_basis, problem.rest, rcond=None)[0].reshape(2, -1)

    def rest(s: FloatArray | float) -> FloatArray:
        at = np.atleast_1d(np.clip(s, 0.0, 1.0))
        bends = model.rest.basis(at) @ coefficients.T
        return np.concatenate([np.zeros((len(at), 1)), bends], axis=1)

    load = np.array(model.gravity) * model.cable.mass / bending
    return Rod(np.array([torsion / bending, 1.0, 1.0]), load, rest)


def start_of(problem: SpaceProblem, eq: Equilibrium) -> FloatArray:
    """State (13,) at the start of a shape."""
    first = Rotation.from_quat(eq.x[0])
    force, moment = eq.start_force, first.inv().apply(eq.moments[0])
    return np.concatenate([eq.points[0], eq.x[0], force / problem.p[0], moment / problem.p[0]])


def states_of(problem: SpaceProblem, rod: Rod, eq: Equilibrium) -> tuple[FloatArray, FloatArray]:
    """Nodes of a shape as states, their moments from the nearest cells' strains."""
    s = np.linspace(0.0, 1.0, problem.model.n + 1)
    y = np.zeros((len(s), 13))
    y[:, PLACE], y[:, FRAME] = eq.points, kirchhoff.same_sign(eq.x)
    y[:, FORCE] = eq.start_force / problem.p[0] - np.outer(s, rod.load)
    cells = problem.model.chain.cells.mean(axis=1)
    strains = np.stack([eq.twist, *eq.curvature.reshape(2, -1)])
    at_nodes = np.stack([np.interp(s, cells, strain) for strain in strains], axis=1)
    y[:, MOMENT] = (at_nodes - rod.rest(s)) * rod.stiffness
    return s, y.T


def check_collocated(count: int) -> bool:
    """Part 1; whether all is well."""
    rng, begin = np.random.default_rng(0), process_time()
    words = {"same": 0, "higher": 0, "lower": 0, "failed": 0}
    farthest, unstable, ours = 0.0, 0, 0
    for k in range(count):
        problem = space_problem(rng, 1, FINE)
        pose = replace(problem.poses[0], turns=0.0)
        (eq,) = solve_equilibria(problem.model, problem.p, problem.rest, [pose])
        if not isinstance(eq, Equilibrium):
            print(f"pose {k}: {eq}")
            continue
        rod = rod_of(problem)
        ends = Ends(Rotation.from_quat(eq.x[0]), eq.points[-1], Rotation.from_quat(eq.x[-1]))
        own = kirchhoff.solved(rod, ends, *states_of(problem, rod, eq), TIGHT)
        if own is None:
            print(f"pose {k}: solve_bvp fails from our shape")
            continue
        ours += 1
        points, energy, _ = said(rod, own)
        farthest = max(farthest, _apart(points, eq.points))
        for side in range(4):
            other = kirchhoff.from_an_arc(rod, ends, side * np.pi / 2, LOOSE)
            if other is None:
                words["failed"] += 1
                continue
            there, its, twist = said(rod, other)
            if _apart(there, eq.points) < 1e-3:
                words["same"] += 1
                continue
            _, _, conjugate = kirchhoff.shot(rod, other.y[:, :1].T)
            unstable += bool(conjugate[0])
            slack = ALIKE * (1.0 + float(np.linalg.norm(rod.load)))
            words["lower" if its < energy - slack else "higher"] += 1
            if its < energy - slack:
                print(f"pose {k}: {its:.6g} is lower than {energy:.6g}, twist {twist:.2f} turns")
    print(
        f"{ours} of {count} poses, n = {FINE}: solve_bvp's shape is at most {farthest:.2g} L away; "
        f"from its own arcs {words}, {unstable} of these others unstable; "
        f"{process_time() - begin:.0f} s",
        flush=True,
    )
    return ours == count and farthest < SAME and not words["lower"]


def said(rod: Rod, found: Any) -> tuple[FloatArray, float, float]:
    """Points (FINE + 1, 3) of a shape that solve_bvp found, its energy and its twist [turns]."""
    s = np.linspace(0.0, 1.0, 4 * FINE + 1)
    y = found.sol(s).T
    return y[::4, PLACE], rod.energy(s, y), rod.twist(s, y)


def _apart(points: FloatArray, others: FloatArray) -> float:
    return float(np.linalg.norm(points - others, axis=1).max())


def check_judge() -> bool:
    """Whether Jacobi's condition tells Michell's ring 1 % below its critical twist from 1 % above.

    Ring of curvature 2 pi and twist t: the force GJ t 2 pi along its axis balances the moments.
    """
    torsion, counts = 0.75, []
    rod = Rod(np.array([torsion, 1.0, 1.0]), np.zeros(3), lambda _: np.zeros((1, 3)))
    for share in (0.99, 1.01):
        moment = share * 2 * np.pi * np.sqrt(3.0)
        ring = np.zeros((1, 13))
        ring[0, FRAME.stop - 1], ring[0, FORCE.stop - 1] = 1.0, 2 * np.pi * moment
        ring[0, MOMENT] = moment, 0.0, 2 * np.pi
        counts.append(int(kirchhoff.shot(rod, ring)[2][0]))
    print(f"Michell's ring 1 % below and above its critical twist: conjugate points {counts}")
    return counts[0] == 0 < counts[1]


def check_sets(count: int) -> bool:
    """Part 3; whether all is well."""
    rng = np.random.default_rng(1)
    solved, unstable, judged, farthest, spent = 0, 0, 0, 0.0, 0.0
    shed, wound = 0, 0
    reasons: dict[str, int] = {}
    for _ in range(count):
        problem = space_problem(rng, POSES, N)
        begin = process_time()
        found = solve_equilibria(problem.model, problem.p, problem.rest, problem.poses)
        spent += process_time() - begin
        loops = []
        for pose, one in zip(problem.poses, found, strict=True):
            if isinstance(one, Equilibrium):
                continue
            if "turns of twist" in one.message:
                loops.append(pose)
            else:
                word = one.message.partition(" with ")[0]
                reasons[word] = reasons.get(word, 0) + 1
        shed, wound = shed + len(loops), wound + held_if_wound(problem, loops)
        poses, shapes = problem.poses, found
        # A limp cable's end is far off by small errors of its start: from a finer mesh, then.
        for finely in (False, True):
            pairs = zip(poses, shapes, strict=True)
            there = [(one, eq) for one, eq in pairs if isinstance(eq, Equilibrium) and eq.stable]
            if not there:
                break
            poses, stable = zip(*there, strict=True)
            solved += 0 if finely else len(stable)
            apart, conjugate = shot_at(problem, stable)
            reached = np.isfinite(apart)
            judged += int(np.count_nonzero(reached))
            unstable += int(np.count_nonzero(conjugate[reached]))
            farthest = max(farthest, float(apart[reached].max(initial=0.0)))
            problem, poses, shapes = finer(problem, there, ~reached)
    total = count * POSES
    print(
        f"{solved} of {total} poses solved, n = {N}, {1e3 * spent / total:.0f} ms each; "
        f"{shed} shed their turns, {wound} of them hold them if wound up slowly; {judged} reached "
        f"by shooting, whose middle is at most {farthest:.2g} L away, {unstable} of them "
        f"unstable by Jacobi's condition; not solved: {reasons or 'none'}",
        flush=True,
    )
    return solved + shed - wound >= SHARE * total and judged >= SHARE * solved and not unstable


def held_if_wound(problem: SpaceProblem, poses: Sequence[HeldPose]) -> int:
    """Number of poses whose turns a cable holds that is wound up in them from a turn less."""
    model, p, rest = problem.model, problem.p, problem.rest
    if not poses:
        return 0
    less = [replace(pose, turns=pose.turns - np.sign(pose.turns)) for pose in poses]
    found = solve_equilibria(model, p, rest, less)
    there = [(j, eq) for j, eq in enumerate(found) if isinstance(eq, Equilibrium)]
    for angle in np.linspace(0.0, 2 * np.pi, WOUND + 1)[1:]:
        ends = [less[j].rolled(angle * float(np.sign(poses[j].turns))) for j, _ in there]
        found = solve_equilibria(model, p, rest, ends, [eq.x for _, eq in there])
        pairs = zip(there, found, strict=True)
        there = [(j, eq) for (j, _), eq in pairs if isinstance(eq, Equilibrium) and eq.stable]
    twists = [abs(np.mean(eq.twist) / (2 * np.pi) - poses[j].turns) for j, eq in there]
    return sum(twist <= MOST_SHED for twist in twists)


def finer(
    problem: SpaceProblem, there: Sequence[tuple[HeldPose, Equilibrium]], chosen: NDArray[np.bool_]
) -> tuple[SpaceProblem, tuple[HeldPose, ...], list[Equilibrium | EquilibriumError]]:
    """The problem on a mesh four times as fine, and the chosen poses and shapes there."""
    model = space_problem(np.random.default_rng(0), 0, 4 * N).model
    rest = model.rest_basis @ np.linalg.lstsq(problem.model.rest_basis, problem.rest, rcond=None)[0]
    coarse, fine = problem.model.chain.places, model.chain.places
    left = [pair for pair, on in zip(there, chosen, strict=True) if on]
    poses = tuple(pose for pose, _ in left)
    starts = [model.node.interpolated(fine, coarse, eq.x) for _, eq in left]
    shapes = solve_equilibria(model, problem.p, rest, poses, starts) if left else []
    return replace(problem, model=model, rest=rest), poses, shapes


def shot_at(
    problem: SpaceProblem, shapes: Sequence[Equilibrium]
) -> tuple[FloatArray, NDArray[np.intp]]:
    """How far the middle (m,) of the exact shapes is, inf if not reached, and conjugate points.

    Newton's method by the matrix that tells the conjugate points, from our force and moment.
    """
    rod, y = rod_of(problem), np.array([start_of(problem, eq) for eq in shapes])
    place, middle = (np.array([eq.points[k] for eq in shapes]) for k in (-1, problem.model.n // 2))
    frame = Rotation.from_quat([eq.x[-1] for eq in shapes])
    apart, conjugate = np.full(len(y), np.inf), np.zeros(len(y), dtype=np.intp)
    left = np.arange(len(y))
    for _ in range(SHOTS):
        with np.errstate(all="ignore"):
            (half, end), matrix, points = kirchhoff.shot(rod, y[left])
        sane = np.abs(end[:, : FORCE.start]).max(axis=1) < 2.0
        sane &= np.isfinite(matrix).all(axis=(1, 2))
        turn = Rotation.from_quat(np.where(sane[:, None], end[:, FRAME], 1.0)).inv() * frame[left]
        missed = np.concatenate([place[left] - end[:, PLACE], turn.as_rotvec()], axis=1)
        there = sane & (np.abs(missed).max(axis=1) < REACHED)
        apart[left[there]] = np.linalg.norm(half[there, PLACE] - middle[left[there]], axis=1)
        conjugate[left[there]] = points[there]
        on = sane & ~there
        left = left[on]
        if not len(left):
            break
        y[left, FORCE.start :] += (np.linalg.pinv(matrix[on], 1e-15) @ missed[on][..., None])[
            ..., 0
        ]
    return apart, conjugate


def main() -> int:
    """Run all parts."""
    parser = options(__doc__)
    parser.add_argument("--collocated", type=int, default=50, help="poses against solve_bvp")
    parser.add_argument("--sets", type=int, default=100, help=f"cables, {POSES} poses each")
    chosen = parser.parse_args()
    right = [check_collocated(chosen.collocated), check_judge(), check_sets(chosen.sets)]
    return 0 if all(right) else 1


if __name__ == "__main__":
    sys.exit(main())
