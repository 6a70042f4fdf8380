"""Clips held against others: python scripts/check_clips.py [--count 200] [--fixtures FOLDER].

Random cables with one to four clips of all kinds, in the plane and in space: how many are solved
where IPOPT finds a minimum from starts of its own, where IPOPT finds a lower one, and whether any
result is not a minimum; what is missed is listed by its number, which with --only is tried alone.
One shape against scipy's solve_bvp with an interior point. With a folder of sessions, what their
fits say beside the truth next to it.
"""

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
from benchmarks.ipopt import Ipopt
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation

import dlo_casadi as dlo
from dlo_casadi.config import read_yaml
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.by_ipopt import by_ipopt
from dlo_casadi.equilibrium.curve import NodeCurve
from dlo_casadi.equilibrium.equilibrium import Equilibrium
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.solve import solve_equilibria
from dlo_casadi.model.assembly import Assembly, Inputs
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import HeldClip, clamped_nodes, node_places

# Elements in the plane, and in space.
ELEMENTS = {False: 32, True: 16}
# Starts of IPOPT, and the largest distance of a clip from the free cable, as a share of the length.
STARTS, MOVED = 6, 0.04
# Largest chord of a span over its length.
ROOM = 0.97
KINDS = {False: ("pinned", "clamped", "eyelet"), True: ("pinned", "clamped", "swivel", "eyelet")}


def random_pose(
    rng: np.random.Generator, spatial: bool
) -> tuple[CableModel, HeldPose, list[np.ndarray], list[float]] | None:
    """A cable held by clips near places where it hung without them; starts of IPOPT.

    These are the nodes of the free cable, and turned at random along it; and the arc lengths of
    eyelets.
    """
    mass, stiffness = 10 ** rng.uniform(-2, -0.3), 10 ** rng.uniform(-3, -1)
    twist = {"torsional_stiffness": stiffness / 1.3} if spatial else {}
    cable = CableData(1.0, mass, 0.008, stiffness, **twist)
    ends = {"start": "clamped", "end": "clamped"} if spatial or rng.random() < 0.5 else {}
    gravity = (0.0, 0.0, -9.81) if spatial else (0.0, -9.81)
    mesh = {"n": ELEMENTS[spatial], "n_rest": 0, "gravity": gravity, **ends}
    free = CableModel(cable, **mesh)
    d, turned = len(gravity), rng.normal(0, 0.4, (2, 3))
    reach = rng.uniform(0.4, 0.85) * np.eye(d)[0] + rng.normal(0, 0.15, d)
    held = {}
    if ends and spatial:
        both = (tuple(Rotation.from_rotvec(turn).as_quat()) for turn in turned)
        held = dict(zip(("start_orientation", "end_orientation"), both, strict=True))
    elif ends:
        held = {"start_heading": float(turned[0, 2]), "end_heading": float(turned[1, 2])}
    pose = HeldPose((0.0,) * d, tuple(reach.tolist()), **held)
    rest = np.zeros(free.chain.n_rests)
    (hung,) = solve_equilibria(free, free.nominal, rest, [pose])
    if not isinstance(hung, Equilibrium):
        return None
    given = Inputs.of(free.nominal, rest, pose.vector[None])
    curve = NodeCurve.of(1.0, Assembly(free, hung.shapes, given).curve()[0])
    count = rng.integers(1, 5)
    at = (np.arange(1, count + 1) + rng.uniform(-0.25, 0.25, count)) / (count + 1)
    places = curve.at(at) + MOVED * rng.uniform(-1, 1, (count, d))
    holders = np.vstack([np.zeros(d), places, reach])
    spans = np.diff(np.concatenate([[0.0], at, [1.0]]))
    if np.any(np.linalg.norm(np.diff(holders, axis=0), axis=1) > ROOM * spans):
        return None
    frames = free.node.interpolated(at, free.chain.places, hung.x)
    turns = rng.normal(0, 0.2, (count, free.node.increment))
    clips = []
    for s, place, frame in zip(at, places, free.node.moved(frames, turns), strict=True):
        kind = str(rng.choice(KINDS[spatial]))
        clamp = kind in ("clamped", "swivel")
        direction = {"orientation": tuple(frame)} if spatial else {"heading": float(frame[0])}
        own = direction if clamp else {}
        clips.append(HeldClip(kind, tuple(place), None if kind == "eyelet" else float(s), **own))
    model = CableModel(cable, clips=tuple(c.kind for c in clips), **mesh)
    waves = np.sin(np.pi * np.outer(np.linspace(0, 1, model.n + 1), np.arange(1, 5)))
    turns = 0.3 * waves @ rng.normal(size=(STARTS - 1, 4, free.node.increment))
    starts = [hung.x, *(free.node.moved(hung.x, turn) for turn in turns)]
    slid = [float(s) for s, clip in zip(at, clips, strict=True) if clip.kind == "eyelet"]
    return model, HeldPose(pose.start, pose.end, clips=tuple(clips), **held), starts, slid


def by_own_starts(
    model: CableModel, pose: HeldPose, starts: list[np.ndarray], slid: list[float]
) -> list[float]:
    """Energies [J] of stable minima that IPOPT finds."""
    rest = np.zeros(model.chain.n_rests)
    if not model.in_space:
        found = [by_ipopt(model, model.nominal, rest, pose, x[:, 0]) for x in starts]
        return [own.energy for own in found if own is not None and own.stable]
    solver, energies = Ipopt(model, clamped_nodes(model.chain, pose.clips)), []
    for one in solver.solve(model.nominal, rest, pose, starts, slid):
        (eq,) = solve_equilibria(model, model.nominal, rest, [pose], [one.frames])
        same = isinstance(eq, Equilibrium) and np.isclose(eq.energy, one.energy, rtol=1e-6)
        energies += [eq.energy] if same and eq.stable else []
    return energies


def check_random(
    count: int, where: tuple[bool, ...], only: int | None, ipopt: bool, seed: int
) -> None:
    """Count what is solved."""
    for spatial in where:
        rng, found, began = np.random.default_rng(seed), Counter(), time.process_time()
        missed: dict[str, list[int]] = {}
        while found["cables"] < count:
            drawn = random_pose(rng, spatial)
            if drawn is None:
                continue
            model, pose, starts, slid = drawn
            found["cables"] += 1
            if only not in (None, found["cables"]):
                continue
            rest = np.zeros(model.chain.n_rests)
            (eq,) = solve_equilibria(model, model.nominal, rest, [pose])
            solved = isinstance(eq, Equilibrium)
            found["solved"] += solved
            minima = by_own_starts(model, pose, starts, slid) if ipopt else []
            found["by IPOPT"] += bool(minima)
            own = eq.energy if solved else np.inf
            what = {
                "not a minimum": solved and not eq.stable,
                "IPOPT alone": bool(minima) and not solved,
                "IPOPT lower": solved and min(minima, default=own) < own - 1e-8 * abs(own) - 1e-12,
                "neither": not (solved or minima),
            }
            for name in (name for name, so in what.items() if so):
                missed.setdefault(name, []).append(found["cables"])
            if only is not None:
                print(pose, getattr(eq, "message", own), minima)
        said = "in space" if spatial else "in a plane"
        print(f"{said}: {dict(found)}, {time.process_time() - began:.0f} s; {missed}", flush=True)


def check_bvp() -> None:
    """A heavy elastica through one pinned clip, on two meshes."""
    stiffness, weight, at, place, end = 0.02, 0.2 * 9.81, 0.437, (0.33, 0.12), (0.7, 0.05)
    spans = np.array([at, 1 - at])

    def slopes(u, y, p):
        rows = []
        for k in (0, 1):
            _, _, phi, bend = y[4 * k : 4 * k + 4]
            nx, ny = p[2 * k], p[2 * k + 1] + weight * spans[k] * u
            cos, sin = np.cos(phi), np.sin(phi)
            rows += [cos, sin, bend, -(cos * ny - sin * nx) / stiffness]
        return np.array(rows) * np.repeat(spans, 4)[:, None]

    def conditions(a, b, p):
        return np.array(
            [
                *(a[0], a[1], a[3]),
                *(b[:2] - place),
                *(a[4:6] - place),
                *(a[6:8] - b[2:4]),
                *(b[4:6] - end),
                b[7],
            ]
        )

    for n in (40, 80, 160):
        model = CableModel(CableData(1.0, 0.2, 0.01, stiffness), n, n_rest=0, clips=("pinned",))
        pose = HeldPose((0.0, 0.0), end, clips=(HeldClip("pinned", place, at),))
        (eq,) = solve_equilibria(model, model.nominal, np.zeros(n), [pose])
        given = Inputs.of(model.nominal, np.zeros(n), pose.vector[None])
        curve = NodeCurve.of(1.0, Assembly(model, eq.shapes, given).curve()[0])
        u, nodes = np.linspace(0, 1, 201), node_places(model.chain, pose.clips)
        guess = []
        for s in (at * u, at + (1 - at) * u):
            phi = np.interp(s, nodes, eq.phi)
            guess += [*curve.at(s).T, phi, np.gradient(phi, s)]
        first = eq.start_force
        pulls = [first, first + np.array([0.0, weight * at]) + eq.clips[0].force]
        found = solve_bvp(slopes, conditions, u, np.array(guess), np.ravel(pulls), tol=1e-10,
                          max_nodes=200000)  # fmt: skip
        there = np.hstack([found.sol(u)[:2], found.sol(u)[4:6]]).T
        apart = np.abs(np.vstack([curve.at(at * u), curve.at(at + (1 - at) * u)]) - there).max()
        print(f"solve_bvp ({found.message}), n = {n}: shapes differ by {apart:.1e} L", flush=True)


def check_fixtures(folder: Path) -> None:
    """What fits say, beside the truth."""
    for session in sorted(folder.glob("clip_*/session.yaml")):
        truth = read_yaml(
            folder.parent / f"{folder.name}_truth" / session.parent.name / "truth.yaml"
        )
        began, result = time.process_time(), dlo.fit(session)
        print(result)
        print({k: v for k, v in truth.items() if k != "poses"})
        shapes = result.stages[-1].shapes
        true = {f"pose_{k:02d}": pose["clip_at"] for k, pose in enumerate(truth["poses"], 1)}
        apart = [
            abs(clip["at"] - s)
            for name, shape in shapes.items()
            for clip, s in zip(shape.clips, true[name], strict=True)
        ]
        left = sorted(true.keys() - shapes.keys())
        print(f"arc lengths off by at most {1e3 * max(apart):.2f} mm; without a shape: {left}")
        print(f"{time.process_time() - began:.0f} s", flush=True)


def main() -> None:
    """Run the checks that are asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=100, help="random cables, of each dimension")
    parser.add_argument(
        "--where", nargs="+", choices=("plane", "space"), default=["plane", "space"]
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random cables")
    parser.add_argument("--only", type=int, help="number of one random cable")
    parser.add_argument("--no-ipopt", action="store_true", help="count what is solved alone")
    parser.add_argument("--fixtures", type=Path, help="folder of sessions, its truth beside it")
    chosen = parser.parse_args()
    if chosen.only is None:
        check_bvp()
    where = tuple(name == "space" for name in chosen.where)
    check_random(chosen.count, where, chosen.only, not chosen.no_ipopt, chosen.seed)
    if chosen.fixtures is not None:
        check_fixtures(chosen.fixtures)


if __name__ == "__main__":
    main()
