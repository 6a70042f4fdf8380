"""Contact against others: python scripts/check_contact.py [--count 100] [--where plane] ...

Closed forms: a heavy beam laid on a table, a cable over a cylinder, a rod between walls. Random
cables with one to three obstacles against IPOPT with inequalities on the same energy: cables that
differ are listed by their numbers, and --only tries one of them alone. With a folder of sessions
(--fixtures), what their fits say beside the truth next to it.
"""

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.ipopt import Ipopt
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.config import read_yaml
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import NEARBY, Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.equilibrium.spans import first_guesses
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.rod.obstacles import Capsule, Obstacle, Plane

MESHES = (20, 40, 80)
# Shortening of the rod from which on it touches along a stretch, relative to that at first contact.
LINE = 12 / np.pi**2
# Elements of random cables in the plane, and in space; random starts of IPOPT.
ELEMENTS, STARTS = {False: 30, True: 24}, 4
# Least difference of energies that are not the same, relative to m g L + EI/L, and least force of a
# contact that counts, relative to the same per length.
SAME_ENERGY, LIGHTEST = 1e-8, 1e-6


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


def check_rod() -> None:
    """A weightless rod between pins pushed against a wall at the distance A, small slopes.

    With P in units of pi^2 EI / L^2: it touches at P = 1, shortened by pi^2 A^2 / (4 L); in a
    point with the force 2 P A / (l - tan(k l) / k), k^2 = P / EI, l = L/2; from P = 4 on along a
    stretch, l from either pin, where k l = pi and the shortening is 3 A^2 / (2 l).
    """
    stiffness, gap = 0.02, 0.005
    cable = CableData(1.0, 1e-9, 0.004, stiffness)
    walls = tuple(Plane((0.0, y * (gap + 0.002)), (0.0, -y), f"wall {y:+g}") for y in (1.0, -1.0))
    for n in MESHES:
        model = CableModel(cable, n, n_rest=0, gravity=(0.0, 0.0), obstacles=walls)
        bent = gap * np.pi * np.cos(np.pi * model.chain.places)[:, None]
        touch = np.pi**2 * gap**2 / 4
        for share in (0.98, 1.1, 1.5, 1.8):
            found = solved(model, HeldPose((0.0, 0.0), (1 - share * touch, 0.0)), bent)
            pushed = abs(found.end_force[0]) / (np.pi**2 * stiffness)
            told = f"rod n = {n}, shortened by {share:g} of first contact: P = {pushed:.4f}"
            for one in found.contacts:
                k = np.pi * np.sqrt(pushed)
                force = 2 * pushed * np.pi**2 * stiffness * gap / (0.5 - np.tan(k / 2) / k)
                lifts = 3 * gap**2 / (2 * share * touch)
                told += (
                    f", force {one.force[1] / force - 1:+.1e}"
                    if share < LINE
                    else (f" (line: {1 / lifts**2:.4f}), lift-off {one.start / lifts - 1:+.1e}")
                )
            print(told)


def curve_of(model: CableModel, found: Equilibrium) -> np.ndarray:
    """Rows of places and slopes of the pose of `check_cylinder`."""
    pose = HeldPose((-0.2, -0.25), (0.22, -0.15))
    given = Inputs.of(model.nominal, np.zeros(model.chain.n_rests), pose.vector[None])
    return Assembly(model, found.shapes, given).curve()[0]


def random_cable(
    rng: np.random.Generator, spatial: bool
) -> tuple[CableModel, HeldPose, Equilibrium] | None:
    """A cable with one to three obstacles near where it hung without them, and that shape.

    None where a fixture is too near to an obstacle.
    """
    mass, stiffness = 10 ** rng.uniform(-2, -0.3), 10 ** rng.uniform(-2.5, -1)
    twist = {"torsional_stiffness": 0.6 * stiffness} if spatial else {}
    cable, d = CableData(1.0, mass, 0.008, stiffness, **twist), 2 + spatial
    ends = {"start": "clamped", "end": "clamped"} if spatial or rng.random() < 0.5 else {}
    gravity = (*[0.0] * (d - 1), -9.81)
    free = CableModel(cable, ELEMENTS[spatial], gravity=gravity, n_rest=0, **ends)
    reach, turns = [rng.uniform(0.5, 0.85), *rng.normal(0, 0.1, d - 1)], rng.normal(0, 0.35, (2, 3))
    held = {"start_heading": float(turns[0, 2]), "end_heading": float(turns[1, 2])}
    if spatial:
        frames = Rotation.from_rotvec(turns).as_quat().tolist()
        held = dict(zip(("start_orientation", "end_orientation"), map(tuple, frames), strict=True))
    pose = HeldPose((0.0,) * d, tuple(map(float, reach)), **(held if ends else {}))
    hung = solved(free, pose)
    obstacles: list[Obstacle] = []
    lowest, highest = hung.points[:, -1].min(), min(0.0, reach[-1])
    for k in range(rng.integers(1, 4)):
        if k == 0 and rng.random() < 0.6:
            level = lowest + rng.uniform(0.05, 0.7) * (highest - lowest) - 0.006
            normal = np.array([*rng.normal(0, 0.1, d - 1), 1.0])
            normal /= np.linalg.norm(normal)
            point = (*[0.0] * (d - 1), float(level))
            obstacles.append(Plane(point, tuple(normal.tolist()), "table"))
            continue
        place = hung.points[rng.integers(len(hung.points) // 5, 4 * len(hung.points) // 5)]
        place = place + rng.normal(0, 0.03, d)
        half = Rotation.random(random_state=rng).apply([0.2 if spatial else 0.03, 0.0, 0.0])[:d]
        half *= spatial or rng.random() < 0.5  # discs, and stadiums, in a plane
        sides = (tuple((place + side * half).tolist()) for side in (-1, 1))
        obstacles.append(Capsule(*sides, float(rng.uniform(0.02, 0.06)), f"bar {k}"))
    if any(one.near(np.array([pose.start, reach])).distance.min() < 0.004 for one in obstacles):
        return None
    return replace(free, obstacles=tuple(obstacles)), pose, hung


def same_on_finer(model: CableModel, pose: HeldPose, found: list[np.ndarray]) -> bool:
    """Whether shapes (n_nodes, coordinates) lead to the same one on elements half as long.

    Nodes that touch a bar hold it like a notch: several minima on 30 elements were one on 60.
    """
    finer, places = model.with_mesh(2 * model.n), model.chain.places
    starts = [model.node.interpolated(finer.chain.places, places, x) for x in found]
    rest = np.zeros(finer.chain.n_rests)
    first, *others = solve_equilibria(finer, finer.nominal, rest, [pose] * len(starts), starts)
    return isinstance(first, Equilibrium) and all(
        isinstance(one, Equilibrium) and model.node.same(first.x, one.x, NEARBY) for one in others
    )


def check_random(count: int, spatial: bool, only: int | None, seed: int) -> None:
    """Energies of random cables beside IPOPT's, see `Ipopt`.

    IPOPT starts from our shape, from that without obstacles, from the documented guesses and from
    random shapes. Energies are compared as shares of m g L + EI/L. An IPOPT shape of lower energy
    counts where Newton's method from there finds the same, stable, and apart where both shapes are
    one on a finer mesh.
    """
    rng, found, began = np.random.default_rng(seed), Counter(), time.process_time()
    missed: dict[str, list[int]] = {}
    worst = ours = 0.0
    while found["cables"] < count:
        drawn = random_cable(rng, spatial)
        if drawn is None:
            continue
        model, pose, hung = drawn
        waves = np.sin(np.pi * np.outer(model.chain.places, np.arange(1, 5)))
        turns = 0.5 * waves @ rng.normal(size=(STARTS, 4, model.node.increment))
        found["cables"] += 1
        if only not in (None, found["cables"]):
            continue
        p, rest = model.nominal, np.zeros(model.chain.n_rests)
        before = time.process_time()
        (eq,) = solve_equilibria(model, p, rest, [pose])
        ours += time.process_time() - before
        scale = model.cable.mass * 9.81 * model.cable.length + model.cable.bending_stiffness
        solver, here = Ipopt(model), np.inf
        if isinstance(eq, Equilibrium):
            here = eq.energy
            found["solved"] += 1
            found["touching"] += bool(eq.contacts)
            for one in solver.solve(p, rest, pose, [eq.x]):
                pressed = -one.multipliers[-model.n_contacts :], eq.multipliers[model.n_lam :]
                first, second = (force > LIGHTEST * scale for force in pressed)
                found["same contacts"] += (same := np.array_equal(first, second))
                apart = abs(one.energy - here) / scale if same else 0.0
                worst = max(worst, apart)
                if apart > SAME_ENERGY:
                    missed.setdefault("another energy", []).append(found["cables"])
        starts = [hung.x, *(x for x, _ in first_guesses(model, p, rest, pose))]
        starts += [model.node.moved(hung.x, turn) for turn in turns]
        every = list(solver.solve(p, rest, pose, starts))
        found["by IPOPT"] += bool(every)
        low = [one for one in every if one.energy < here - SAME_ENERGY * scale]
        for one, other in zip(
            low,
            solve_equilibria(model, p, rest, [pose] * len(low), [one.frames for one in low]),
            strict=True,
        ):
            if not isinstance(other, Equilibrium) or not other.stable:
                continue
            if abs(other.energy - one.energy) < 1e-6 * scale:
                what = "IPOPT lower" if np.isfinite(here) else "IPOPT alone"
                if np.isfinite(here) and same_on_finer(model, pose, [eq.x, other.x]):
                    what = "IPOPT lower, but the same on a finer mesh"
                missed.setdefault(what, []).append(found["cables"])
                if only is not None:
                    print(f"{what}: {one.energy:.9g} J, ours {here:.9g} J")
    said = "in space" if spatial else "in a plane"
    told = {what: sorted(set(numbers)) for what, numbers in missed.items()}
    print(
        f"{said}: {dict(found)}; {told}; energies differ by at most {worst:.1e}; "
        f"{time.process_time() - began:.0f} s, {ours:.0f} s of them ours",
        flush=True,
    )


def check_fixtures(folder: Path) -> None:
    """Fits of sessions beside their truth."""
    for name in ("table", "ramp", "table_hidden"):
        began = time.process_time()
        result = dlo.fit(folder / name / "session.yaml")
        truth = read_yaml(folder.parent / f"{folder.name}_truth" / name / "truth.yaml")
        print(f"{name}: {time.process_time() - began:.0f} s, truth {truth}\n{result.summary()}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="random cables, of each dimension")
    parser.add_argument(
        "--where", nargs="+", choices=("plane", "space"), default=["plane", "space"]
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random cables")
    parser.add_argument("--only", type=int, help="number of one random cable")
    parser.add_argument("--fixtures", type=Path)
    chosen = parser.parse_args()
    if chosen.only is None:
        check_beam()
        check_cylinder()
        check_rod()
    for where in chosen.where:
        check_random(chosen.count, where == "space", chosen.only, chosen.seed)
    if chosen.fixtures:
        check_fixtures(chosen.fixtures)
