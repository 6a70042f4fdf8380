"""Contact in the generated C solver on random poses among one to three obstacles.

Cables in random poses, obstacles near where they hang without: how many have a shape, how deep
nodes and whole cables are in obstacles, the sign of the forces, how many are no strict minimum when
they are evaluated again (without derivatives), and the processor time beside that of the same poses
without obstacles. Of the first poses the energy beside Python's, as a share of m g L + EI/L.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from time import process_time

import numpy as np

from cables.draw import bar, directions, table
from dlo_casadi.codegen.compiled import CompiledSolver
from dlo_casadi.codegen.shapes import CompiledShape
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.obstacles import Obstacle

CABLES = 8
# Least force of a contact that counts, relative to m g L + EI/L per length.
LIGHTEST = 1e-6


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of this part."""
    parser.add_argument("--python", type=int, default=0, help="in C, poses beside Python")
    parser.add_argument("--kinds", nargs="+", choices=("plane", "all"), default=["plane", "all"])
    parser.add_argument("--elements", type=int, default=12, help="in C")
    parser.add_argument(
        "--end", choices=("clamped", "pinned", "free"), default="clamped", help="in C"
    )


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
    return HeldPose((0.0,) * d, end, **directions(turns, d))


def random_obstacles(rng: np.random.Generator, hung: CompiledShape, kinds: str) -> list[Obstacle]:
    """A table under a hanging cable, bars and balls where it hangs."""
    d, found = hung.points.shape[1], []
    lowest, highest = hung.points[:, -1].min(), min(0.0, hung.points[-1, -1])
    for k in range(1 if kinds == "plane" else rng.integers(1, 4)):
        if kinds == "plane" or (k == 0 and rng.random() < 0.6):
            found.append(table(rng, lowest, highest, d))
        else:
            found.append(bar(rng, hung.points, 0.5, ""))
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


def check(case: tuple[str, str], chosen: argparse.Namespace) -> str:
    """What is found in random poses, in the plane or in space, among obstacles of a kind."""
    spatial, kinds = case[0] == "space", case[1]
    count, beside, n, end = chosen.count, chosen.python, chosen.elements, chosen.end
    rng, found, compared = np.random.default_rng(chosen.seed), Counter(), Counter()
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
    text = (
        f"{case[0]}, {kinds}, n = {n}, end {end}: {dict(found)}; nodes at "
        f"most {depth:.1e} m deep, between them {whole:.1e} m, least force {lowest:.1e} N; time of "
        f"touching ones {times[1] / max(times[0], 1e-9):.2f} of that without, steps "
        f"{np.mean(steps, axis=0) if steps else None} and at most "
        f"{np.max(steps, axis=0) if steps else None}"
    )
    if beside:
        text += f"\n    beside Python: {dict(compared)}; energies apart {told}; {differ}"
    return text
