"""Contact in the generated C solver: python scripts/check_contact_c.py [--count N] [--python M].

Random cables in random poses among one to three obstacles near where they hang without: how many
have a shape, how deep nodes and whole cables are in obstacles, the sign of the forces, how many are
no strict minimum when they are evaluated again (without derivatives), and the processor time beside
that of the same poses without obstacles. Of the first poses the energy beside Python's, as a share
of m g L + EI/L.
"""

import argparse
from collections import Counter
from dataclasses import replace
from time import process_time

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.codegen.shapes import CompiledShape
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.obstacles import Capsule, Obstacle, Plane

CABLES = 8
# As in check_contact.py.
SAME_ENERGY, LIGHTEST = 1e-8, 1e-6


def random_cable(rng: np.random.Generator, spatial: bool, n: int, end: str) -> CableModel:
    """A straight cable, between clamps, pins or with a free end."""
    mass, stiffness = 10 ** rng.uniform(-2, -0.3), 10 ** rng.uniform(-2.5, -1)
    twist = {"torsional_stiffness": 0.6 * stiffness} if spatial else {}
    cable = CableData(1.0, mass, 0.008, stiffness, **twist)
    gravity = (*[0.0] * (1 + spatial), -9.81)
    return CableModel(cable, n, gravity=gravity, n_rest=0, start="clamped", end=end)


def random_pose(rng: np.random.Generator, model: CableModel) -> HeldPose:
    """Ends at the same height, about, turned against the chord."""
    d, turns = model.node.dimension, rng.normal(0, 0.35, (2, 3))
    reach = tuple(float(x) for x in (rng.uniform(0.5, 0.85), *rng.normal(0, 0.1, d - 1)))
    end = None if model.end == "free" else reach
    if model.in_space:
        first, last = (tuple(map(float, x)) for x in Rotation.from_rotvec(turns).as_quat())
        return HeldPose((0.0,) * d, end, start_orientation=first, end_orientation=last)
    headings = {"start_heading": float(turns[0, 2]), "end_heading": float(turns[1, 2])}
    return HeldPose((0.0,) * d, end, **headings)


def random_obstacles(rng: np.random.Generator, hung: CompiledShape, kinds: str) -> list[Obstacle]:
    """A table under a hanging cable, bars and balls where it hangs."""
    d, found = hung.points.shape[1], []
    lowest, highest = hung.points[:, -1].min(), min(0.0, hung.points[-1, -1])
    for k in range(1 if kinds == "plane" else rng.integers(1, 4)):
        if kinds == "plane" or (k == 0 and rng.random() < 0.6):
            level = lowest + rng.uniform(0.05, 0.7) * (highest - lowest) - 0.006
            normal = np.array([*rng.normal(0, 0.1, d - 1), 1.0])
            normal /= np.linalg.norm(normal)
            found.append(Plane((*[0.0] * (d - 1), float(level)), tuple(normal.tolist())))
            continue
        place = hung.points[rng.integers(len(hung.points) // 5, 4 * len(hung.points) // 5)]
        place = place + rng.normal(0, 0.03, d)
        half = Rotation.random(rng=rng).apply([0.2 if d == 3 else 0.03, 0.0, 0.0])[:d]
        half *= rng.random() < 0.5  # balls and discs
        a, b = (tuple((place + side * half).tolist()) for side in (-1, 1))
        found.append(Capsule(a, b, float(rng.uniform(0.02, 0.06))))
    return found


def compare(
    model: CableModel, pose: HeldPose, obstacles: list[Obstacle], shape: CompiledShape
) -> tuple[str, float]:
    """Whether Python ends in the same contacts, and C's energy minus Python's, as a share."""
    full = replace(model, obstacles=tuple(obstacles))
    (eq,) = solve_equilibria(full, full.nominal, np.zeros(full.chain.n_rests), [pose], [None])
    scale = model.cable.mass * 9.81 * model.cable.length + model.cable.bending_stiffness
    if not isinstance(eq, Equilibrium) or not eq.stable:
        return ("both none" if shape.status != "ok" else "C alone"), 0.0
    if shape.status != "ok":
        return "Python alone", 0.0
    own = shape.contact_forces[: len(obstacles), 3::4]
    own = own[:, : full.n_contacts // len(obstacles)].ravel()
    other = eq.multipliers[full.n_lam :]
    apart = (shape.energy - eq.energy) / scale
    same = np.array_equal(own > LIGHTEST * scale, other > LIGHTEST * scale)
    if same and abs(apart) < 1e-3:
        return "same contacts", apart
    return ("C lower" if apart < 0 else "C higher"), apart


def check(count: int, spatial: bool, beside: int, kinds: str, n: int, end: str, seed: int) -> None:
    """Random poses of one dimension."""
    rng, found, compared = np.random.default_rng(seed), Counter(), Counter()
    depth = whole = lowest = 0.0
    times, steps = [0.0, 0.0], []
    apart: dict[str, list[float]] = {}
    differ: list[int] = []
    flags = ("-O2", "-DBETWEEN=0") if beside else ("-O2",)  # Python's contacts are at nodes alone
    for k in range(CABLES):
        model = random_cable(rng, spatial, n, end)
        rest = np.zeros(model.chain.n_rests)
        solver = CompiledSolver(model, model.nominal, rest, flags=flags, obstacles=3)
        number = 0
        while number < count // CABLES:
            pose = random_pose(rng, model)
            began = process_time()
            hung = solver.solve(pose, throw=False, obstacles=())
            without = process_time() - began
            if hung.status != "ok":
                continue
            obstacles = random_obstacles(rng, hung, kinds)
            began = process_time()
            shape = solver.solve(pose, throw=False, obstacles=obstacles)
            spent = process_time() - began
            if shape.status == "no_room":
                continue
            number += 1
            found[shape.status] += 1
            if number <= beside // CABLES:
                what, far = compare(model, pose, obstacles, shape)
                compared[what] += 1
                apart.setdefault(what, []).append(far)
                if what != "same contacts":
                    differ.append(k * (count // CABLES) + number)
            if shape.status != "ok":
                continue
            touched = shape.contact_forces[: len(obstacles)]
            if np.any(touched):
                found["touching"] += 1
                times[0], times[1] = times[0] + without, times[1] + spent
                steps.append((hung.iterations, shape.iterations))
                try:
                    solver.sensitivity(shape, pose, obstacles=obstacles)
                except DloError:
                    found["without derivatives"] += 1  # no strict minimum
            lowest = min(lowest, float(touched.min()))
            gap = solver.clearance(shape, obstacles).distance
            whole = max(whole, -gap)
            if gap < 0:
                first, last = 1, n + (end == "free")
                for one in obstacles:
                    near = one.near(shape.points[first:last]).distance - model.cable.diameter / 2
                    depth = max(depth, -float(near.min()))
    told = {key: max(map(abs, row)) for key, row in apart.items()}
    print(
        f"{'space' if spatial else 'plane'}, {kinds}, n = {n}, end {end}: {dict(found)}; nodes at "
        f"most {depth:.1e} m deep, between them {whole:.1e} m, least force {lowest:.1e} N; time of "
        f"touching ones {times[1] / max(times[0], 1e-9):.2f} of that without, steps "
        f"{np.mean(steps, axis=0) if steps else None} and at most "
        f"{np.max(steps, axis=0) if steps else None}",
        flush=True,
    )
    if beside:
        print(f"    beside Python: {dict(compared)}; energies apart {told}; {differ}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="random poses of each kind")
    parser.add_argument("--python", type=int, default=0, help="how many of them beside Python")
    parser.add_argument(
        "--where", nargs="+", choices=("plane", "space"), default=["plane", "space"]
    )
    parser.add_argument("--kinds", nargs="+", choices=("plane", "all"), default=["plane", "all"])
    parser.add_argument("--elements", type=int, default=12)
    parser.add_argument("--end", choices=("clamped", "pinned", "free"), default="clamped")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    for where in chosen.where:
        for kinds in chosen.kinds:
            given = (chosen.python, kinds, chosen.elements, chosen.end, chosen.seed)
            check(chosen.count, where == "space", *given)
