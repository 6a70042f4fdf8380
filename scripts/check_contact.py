"""Contact against others: python scripts/check_contact.py [--count 200] [--space 20] ...

Closed forms: a heavy beam laid on a table, a cable over a cylinder. Random cables in the plane
against IPOPT with inequalities on the same energy, in space against random starts. With a folder
of sessions (--fixtures), what their fits say beside the truth next to it.
"""

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.config import read_yaml
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.guesses import guessed_frames, guesses
from dlo_casadi.equilibrium.minima import ipopt, run_ipopt
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.model.assembly import Inputs, assembly_of
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.functions import functions_of
from dlo_casadi.model.whole_pose import potential
from dlo_casadi.rod.obstacles import Capsule, Obstacle, Plane

MESHES = (20, 40, 80)


def solved(model: CableModel, pose: HeldPose, start: np.ndarray | None = None) -> Equilibrium:
    """The equilibrium of a cable that is straight at rest."""
    rest = np.zeros(model.chain.n_rests)
    (found,) = solve_equilibria(model, model.nominal, rest, [pose], [start])
    if not isinstance(found, Equilibrium):
        raise found
    return found


def check_beam() -> None:
    """Small slopes: H = q l^4 / (72 EI), and Q = q l / 3 where the beam leaves the table."""
    weight, stiffness, height = 0.5, 0.02, 0.004
    lift = (72 * stiffness * height / weight) ** 0.25
    for length in (0.8, 0.806, 0.812):
        for n in MESHES:
            cable = CableData(length, weight * length / 9.81, 0.004, stiffness)
            table = Plane((0.0, -height - 0.002), (0.0, 1.0))
            model = CableModel(cable, n, start="clamped", end="free", n_rest=0, obstacles=(table,))
            found = solved(model, HeldPose((0.0, 0.0), start_heading=0.0))
            held = -found.start_force[1] / (2 / 3 * weight * lift)
            print(
                f"beam {length:g} m, n = {n}: lift-off {found.contacts[0].start / lift - 1:+.1e}, "
                f"force on the clamp {held - 1:+.1e}"
            )


def check_cylinder() -> None:
    """T + M^2 / (2 EI) - w y is the same everywhere: compared at the ends, with the force there."""
    weight, radius = 1.0, 0.1
    for n in MESHES:
        cable = CableData(1.0, weight / 9.81, 0.006, 2e-3)
        cylinder = Capsule((0.0, 0.0), (0.0, 0.0), radius)
        model = CableModel(cable, n, n_rest=0, obstacles=(cylinder,))
        over = np.linspace(0.23 + 2.03, 0.23 - 2.03, n + 1)[:, None]
        try:
            found = solved(model, HeldPose((-0.2, -0.25), (0.22, -0.15)), over)
        except dlo.DloError:
            print(f"cylinder n = {n}: no equilibrium found")
            continue
        ahead = np.concatenate([np.cos(found.x), np.sin(found.x)], axis=1)
        ends = found.end_force @ ahead[-1], -found.start_force @ ahead[0]
        force = float(np.linalg.norm(found.contacts[0].force))
        places = NodeCurve.of(1.0, curve_of(model, found)).at(np.linspace(0, 1, 2001))
        depth = radius + 0.003 - np.linalg.norm(places, axis=1).min()
        print(
            f"cylinder n = {n}: T_2 - T_1 - w dy = {ends[0] - ends[1] + weight * 0.1:+.1e} N of "
            f"{force:.3f} N, between nodes {1e3 * depth:.3f} mm deep"
        )


def curve_of(model: CableModel, found: Equilibrium) -> np.ndarray:
    """Rows of places and slopes of the pose of `check_cylinder`."""
    pose = HeldPose((-0.2, -0.25), (0.22, -0.15))
    given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), pose.vector[None])
    return assembly_of(model).curve(found.shapes, given)[0]


def random_cable(rng: np.random.Generator) -> tuple[CableModel, HeldPose]:
    """A planar cable with one to three obstacles near where it hung without them."""
    mass, stiffness = 10 ** rng.uniform(-2, -0.3), 10 ** rng.uniform(-2.5, -1)
    cable = CableData(1.0, mass, 0.008, stiffness)
    ends = {"start": "clamped", "end": "clamped"} if rng.random() < 0.5 else {}
    free = CableModel(cable, 30, n_rest=0, **ends)
    reach = np.array([rng.uniform(0.5, 0.85), rng.normal(0, 0.1)])
    headings = rng.normal(0, 0.3, 2)
    held = dict(zip(("start_heading", "end_heading"), headings.tolist(), strict=True))
    pose = HeldPose((0.0, 0.0), tuple(reach.tolist()), **(held if ends else {}))
    hung = solved(free, pose)
    obstacles: list[Obstacle] = []
    lowest = min(hung.points[:, 1].min(), 0.0, reach[1])
    for k in range(rng.integers(1, 4)):
        if k == 0 and rng.random() < 0.6:
            level = lowest + rng.uniform(0.05, 0.7) * (min(0.0, reach[1]) - lowest) - 0.006
            tilt = rng.normal(0, 0.1)
            normal = (float(-np.sin(tilt)), float(np.cos(tilt)))
            obstacles.append(Plane((0.0, float(level)), normal, "table"))
            continue
        place = hung.points[rng.integers(6, 25)] + rng.normal(0, 0.03, 2)
        radius = float(rng.uniform(0.02, 0.06))
        obstacles.append(Capsule(tuple(place), tuple(place), radius, f"bar {k}"))
    return replace(free, obstacles=tuple(obstacles)), pose


def stated(model: CableModel) -> tuple[ca.Function, int]:
    """IPOPT on the potential without obstacles, and the distances of its nodes as inequalities."""
    free = replace(model, obstacles=())
    problem, n = potential(free), free.chain.n_nodes
    x, function = problem.coordinates, functions_of(free).segment_potential
    inner = ca.reshape(x[n:], free.n_inner, free.chain.n_segments)
    both = ca.vertcat(x[: n - 1].T, x[1:n].T)
    p, place = problem.parameters[: len(free.names)], ca.DM(free.chain.layout.segments.T)
    nothing = [ca.DM.zeros(k, 1) for k in (free.n_lam, 3, len(free.deviation_names))]
    # What a segment has of the conditions on the end's place is its advance.
    _, advance = function(both, nothing[0], p, nothing[1], place, nothing[2], inner)
    places, gaps = ca.cumsum(advance[:2, :], 1), []
    for obstacle in model.obstacles:
        for i in range(free.n - 1):
            gap = places[:, i] - ca.DM(getattr(obstacle, "a", None) or obstacle.point)
            if isinstance(obstacle, Plane):
                gap = ca.dot(gap, ca.DM(obstacle.normal))
            else:
                gap = ca.norm_2(gap) - obstacle.radius
            gaps.append(gap - free.cable.diameter / 2)
    conditions = ca.vertcat(problem.conditions, *gaps)
    whole = {"x": x, "p": problem.parameters, "f": problem.energy, "g": conditions}
    return ipopt("contact", whole, 1e-11, 500), problem.conditions.numel()


def check_random(count: int) -> None:
    """Energies of random cables beside IPOPT's from the solution, the free shape and arcs."""
    rng, found, began = np.random.default_rng(0), Counter(), time.process_time()
    worst = 0.0
    while found["cables"] < count:
        try:
            model, pose = random_cable(rng)
        except dlo.DloError:
            continue
        ends = [np.zeros(2), np.array(pose.end)]
        if any(o.near(end).distance < 0.004 for o in model.obstacles for end in ends):
            continue
        found["cables"] += 1
        rest = np.zeros(model.chain.n_rests)
        (eq,) = solve_equilibria(model, model.nominal, rest, [pose])
        solver, equalities = stated(model)
        given = np.concatenate(
            [model.nominal, rest, pose.vector, np.zeros(len(model.deviation_names))]
        )
        upper = np.concatenate(
            [np.zeros(equalities), np.full(solver.size1_out("g") - equalities, np.inf)]
        )
        free = replace(model, obstacles=())
        starts = [solved(free, pose).x[:, 0], *guesses(model, model.nominal, rest, pose)]
        if isinstance(eq, Equilibrium):
            starts.append(eq.x[:, 0])
            found["solved"] += 1
            found["touching"] += bool(eq.contacts)
        energies = []
        for phi in starts:
            x0 = np.concatenate([phi, np.zeros(solver.size1_in("x0") - len(phi))])
            out, stats = run_ipopt(solver, x0=x0, p=given, lbg=0.0, ubg=upper)
            energies.append(float(out["f"]) if stats["success"] else np.inf)
        lowest = min(energies)
        found["IPOPT solved"] += bool(np.isfinite(lowest))
        if isinstance(eq, Equilibrium) and np.isfinite(energies[-1]):
            gap = (eq.energy - energies[-1]) / (abs(eq.energy) + 1e-3)
            found["same energy"] += abs(gap) < 1e-6
            found["IPOPT lower"] += lowest < eq.energy - 1e-6 * (abs(eq.energy) + 1e-3)
            worst = max(worst, abs(gap)) if abs(gap) < 1e-3 else worst
    print(
        f"random: {dict(found)}, largest difference of those alike {worst:.1e}, "
        f"{time.process_time() - began:.0f} s"
    )


def random_in_space(rng: np.random.Generator) -> tuple[CableModel, HeldPose]:
    """A cable between two clamps, with one to three obstacles near where it hung without them."""
    mass, stiffness = 10 ** rng.uniform(-1.7, -0.5), 10 ** rng.uniform(-2.2, -1.2)
    cable = CableData(1.0, mass, 0.008, stiffness, 0.6 * stiffness)
    free = CableModel(
        cable, 24, start="clamped", end="clamped", gravity=(0.0, 0.0, -9.81), n_rest=0
    )
    turns = Rotation.from_rotvec(rng.normal(0, 0.4, (2, 3))).as_quat()
    end = (rng.uniform(0.5, 0.85), *rng.normal(0, 0.1, 2))
    frames = dict(zip(("start_orientation", "end_orientation"), turns.tolist(), strict=True))
    pose = HeldPose((0.0, 0.0, 0.0), end, **frames)
    hung = solved(free, pose)
    obstacles: list[Obstacle] = []
    lowest, highest = hung.points[:, 2].min(), min(0.0, end[2])
    for k in range(rng.integers(1, 4)):
        if k == 0 and rng.random() < 0.6:
            level = lowest + rng.uniform(0.05, 0.7) * (highest - lowest) - 0.006
            normal = np.array([*rng.normal(0, 0.1, 2), 1.0])
            normal /= np.linalg.norm(normal)
            obstacles.append(Plane((0.0, 0.0, float(level)), tuple(normal), "table"))
            continue
        place = hung.points[rng.integers(5, 20)] + rng.normal(0, 0.03, 3)
        along = 0.2 * Rotation.random(random_state=rng).apply([1.0, 0.0, 0.0])
        radius = float(rng.uniform(0.02, 0.06))
        obstacles.append(Capsule(tuple(place - along), tuple(place + along), radius, f"bar {k}"))
    return replace(free, obstacles=tuple(obstacles)), pose


def check_space(count: int) -> None:
    """Energies of random cables in space beside the lowest from random starts.

    Starts are first guesses, each turned by random smooth rotations along it.
    """
    rng, found, began = np.random.default_rng(0), Counter(), time.process_time()
    spent = 0.0
    while found["cables"] < count:
        try:
            model, pose = random_in_space(rng)
        except dlo.DloError:
            continue
        ends = np.array([pose.start, pose.end])
        if any(one.near(ends).distance.min() < 0.004 for one in model.obstacles):
            continue
        found["cables"] += 1
        rest, p = np.zeros(model.chain.n_rests), model.nominal
        before = time.process_time()
        (eq,) = solve_equilibria(model, p, rest, [pose])
        spent += time.process_time() - before
        waves = np.sin(np.pi * np.outer(model.chain.places / model.cable.length, [1, 2, 3]))
        starts = [
            model.node.moved(x, waves @ rng.normal(0, 0.6, (3, 3)))
            for x in 3 * guessed_frames(model, p, rest, pose)
        ]
        others = solve_equilibria(model, p, rest, [pose] * len(starts), starts)
        energies = [x.energy for x in others if isinstance(x, Equilibrium) and x.stable]
        found["from random starts"] += bool(energies)
        if isinstance(eq, Equilibrium):
            found["solved"] += 1
            found["touching"] += bool(eq.contacts)
            lower = min(energies, default=np.inf) < eq.energy - 1e-6 * (abs(eq.energy) + 1e-3)
            found["lower from random starts"] += lower
    print(f"space: {dict(found)}, {time.process_time() - began:.0f} s, {spent:.0f} s of them ours")


def check_fixtures(folder: Path) -> None:
    """Fits of sessions beside their truth."""
    for name in ("table", "ramp", "table_hidden"):
        began = time.process_time()
        result = dlo.fit(folder / name / "session.yaml", output=None)
        truth = read_yaml(folder.parent / f"{folder.name}_truth" / name / "truth.yaml")
        print(f"{name}: {time.process_time() - began:.0f} s, truth {truth}\n{result.summary()}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--space", type=int, default=0, help="random cables in space")
    parser.add_argument("--fixtures", type=Path)
    chosen = parser.parse_args()
    check_beam()
    check_cylinder()
    if chosen.count:
        check_random(chosen.count)
    if chosen.space:
        check_space(chosen.space)
    if chosen.fixtures:
        check_fixtures(chosen.fixtures)
